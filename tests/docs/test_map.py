"""The map of the packages is that of the code, and the files that documents lead to exist."""

import re

import pytest
from grimp import ImportGraph

from tests.support.docs import package_map
from tests.support.docs.readme_pages import PAGES
from tests.support.paths import ROOT

DOCUMENTS = (*PAGES, "cosim/DESIGN.md", "cosim/SCALING.md")
FILE = re.compile(r"\w+(?:/[\w.]+)+/?")


def files_in(text: str) -> set[str]:
    """The files and folders that Mermaid blocks and spans in backquotes name; those under ``vcmvsp/`` are keys of Zenoh."""
    drawings = re.findall(r"```mermaid\n(.*?)```", text, re.DOTALL)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = {path for each in (*drawings, *spans) for path in FILE.findall(each)}
    return {path for path in found if path.endswith((".py", "/")) and not path.startswith("vcmvsp/")}


def headings(text: str) -> set[str]:
    """The headings of a page, as links name them."""
    words = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in words}


def test_the_map_is_that_of_the_code() -> None:
    page = package_map.PAGE.read_text("utf-8")
    assert page == package_map.written(page), f"write it anew: {package_map.COMMAND}, or make docs"


def test_arrows_that_others_stand_for_are_left_out() -> None:
    graph = ImportGraph()
    for importer, imported in ("ab", "bc", "ac", "cd", "ad"):
        graph.add_import(importer=importer, imported=imported)
    assert package_map.imports(package_map.reduced(graph)) == [("a", "b"), ("b", "c"), ("c", "d")]


@pytest.mark.parametrize("page", DOCUMENTS)
def test_files_that_are_named_exist(page: str) -> None:
    """From the top of the repository, or from the folder of the page."""
    homes = ROOT, (ROOT / page).parent
    named = files_in((ROOT / page).read_text("utf-8"))
    assert sorted(each for each in named if not any((home / each).exists() for home in homes)) == []


@pytest.mark.parametrize("page", [*DOCUMENTS, "CHANGELOG.md"])
def test_links_lead_to_a_file_and_a_heading(page: str) -> None:
    for path, heading in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", (ROOT / page).read_text("utf-8")):
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), path
        assert not heading or heading in headings(target.read_text("utf-8")), f"{path}#{heading}"


def test_a_file_that_is_named_is_found() -> None:
    text = '```mermaid\na["cosim/gone.py<br/>x"]\n```\nSee `netsim/gone/away.py`, `tests/x/`; not a/b.py, not `run/state`.\n'
    assert files_in(text) == {"cosim/gone.py", "netsim/gone/away.py", "tests/x/"}
