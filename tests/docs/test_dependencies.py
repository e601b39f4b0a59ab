"""What is imported is declared, and what documents tell a newcomer to type works after ``make setup``."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions

from tests.support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PARTS = ("cosim", "physics", "netsim", "agents", "hardware", "src/vcmvsp")


def named(requirement: str) -> str:
    """The distribution that a requirement is about, as an index writes it."""
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def imported() -> set[str]:
    """Top-level modules that the product imports, anywhere in a module."""
    found = set[str]()
    for path in (path for part in PARTS for path in (ROOT / part).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"vcmvsp"}


def test_whatever_is_imported_is_declared() -> None:
    project = PROJECT["project"]
    extras = [each for extra in project["optional-dependencies"].values() for each in extra]
    declared = {named(each) for each in (*project["dependencies"], *extras)}
    distributions = packages_distributions()
    of = {module: {named(each) for each in distributions.get(module, [])} for module in imported()}
    assert {module: names for module, names in of.items() if names and not names & declared} == {}


def test_what_is_replaced_inside_a_library_binds_its_version() -> None:
    bounds = {named(each): each for each in PROJECT["project"]["dependencies"]}
    assert "<" in bounds["viser"]
    assert "<" in bounds["websockets"]


def test_setup_leaves_what_the_user_installed_and_has_pip() -> None:
    syncs = re.findall(r"\$\(UV\) sync[^|\n]*", (ROOT / "Makefile").read_text("utf-8"))
    assert syncs
    assert all("--inexact" in each for each in syncs)
    assert "pip" in {named(each) for each in PROJECT["dependency-groups"]["dev"]}
