"""From a kind to a class: short names, modules and files; errors name the remedy."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from vcmvsp.cosim.config import builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError

pytestmark = pytest.mark.processes

ORIGIN = Source("s.toml line 3")


def refusal(group: str, kind: str, folder: Path | None = None) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        registry.find(group, kind, folder=folder, key="x.kind", origin=ORIGIN)
    assert (caught.value.key, caught.value.source) == ("x.kind", "s.toml line 3")
    return caught.value


@pytest.mark.parametrize(("group", "kind"), [(group, kind) for group, kinds in builtin_kinds.KINDS.items() for kind in kinds])
def test_every_short_name_leads_to_its_class(group: str, kind: str) -> None:
    found = registry.find(group, kind)
    module, _, name = builtin_kinds.KINDS[group][kind].partition(":")
    assert found is getattr(importlib.import_module(module), name)
    assert isinstance(found, type) or builtin_kinds.KINDS[group][kind] == builtin_kinds.NOTHING
    assert found.__doc__, "the documentation of a kind is that of its class"


@pytest.mark.parametrize(("group", "kind"), [(group, kind) for group, kinds in builtin_kinds.KINDS.items() for kind in kinds])
def test_a_typo_is_answered_with_the_nearest_name(group: str, kind: str) -> None:
    problem = refusal(group, kind + "x").problem
    assert f"'{kind}x'" in problem
    assert f"did you mean '{kind}'?" in problem
    assert all(name in problem for name in builtin_kinds.KINDS[group])
    assert "module:Class or file.py:Class" in problem


def test_a_class_can_be_named_by_its_module() -> None:
    assert registry.find("agent", "vcmvsp.cosim.agent:Agent").__name__ == "Agent"
    assert "has no class 'Agnt'" in refusal("agent", "vcmvsp.cosim.agent:Agnt").problem
    assert "No module named 'vcmvsp.cosim.agnt'" in refusal("agent", "vcmvsp.cosim.agnt:Agent").problem


def test_other_distributions_can_add_short_names(monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        name, value = "mine", "vcmvsp.cosim.agent:Agent"

    def entry_points(*, group: str) -> list[Any]:
        return [Entry] if group == "vcmvsp.agent" else []

    monkeypatch.setattr("importlib.metadata.entry_points", entry_points)
    assert registry.find("agent", "mine").__name__ == "Agent"
    assert "mine" in refusal("agent", "yours").problem
    assert "mine" not in refusal("vehicle", "yours").problem


def test_a_relative_file_is_looked_for_in_the_given_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.py").write_text("class A:\n    def act(self): ...\n")
    assert registry.find("agent", "mine.py:A", folder=tmp_path / "sub").__name__ == "A"
    assert registry.find("agent", "sub/mine.py:A", folder=tmp_path).__name__ == "A"
    assert registry.find("agent", f"{tmp_path}/sub/mine.py:A").__name__ == "A"
    monkeypatch.chdir(tmp_path / "sub")
    assert registry.find("agent", "mine.py:A").__name__ == "A"
    assert str(tmp_path / "mine.py") in refusal("agent", "mine.py:A", folder=tmp_path).problem


def test_a_file_may_import_its_neighbours_and_keeps_the_path(tmp_path: Path) -> None:
    (tmp_path / "gain_of_test_registry.py").write_text("K = 3\n")
    (tmp_path / "mine.py").write_text("from gain_of_test_registry import K\nclass A:\n    act = 1\n    k = K\n")
    path = list(sys.path)
    assert registry.find("agent", "mine.py:A", folder=tmp_path).k == 3
    assert sys.path == path


def test_files_of_one_name_in_two_folders_do_not_mix(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text(f"class A:\n    act = 1\n    k = '{name}'\n")
    one, two = (registry.find("agent", "mine.py:A", folder=tmp_path / name) for name in ("one", "two"))
    assert (one.k, two.k) == ("one", "two")
    assert sys.modules[one.__module__].A is one  # needed for pickling and for resolving annotations


def test_a_file_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("class A:\n    act = 1\n    k = 1\n")
    assert registry.find("agent", "mine.py:A", folder=tmp_path).k == 1
    file.write_text("class A:\n    act = 1\n    k = 'changed'\n")
    assert registry.find("agent", "mine.py:A", folder=tmp_path).k == "changed"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a = 1\nb = 2\nraise RuntimeError('not today')\n", "RuntimeError: not today (fails.py line 3)"),
        ("import helper_of_test_registry\n", "(helper_of_test_registry.py line 4)"),
        ("a = 1\nb = = 2\n", "(fails.py, line 2)"),
        ("import math\nmath.tau_and_more\nclass A:\n    act = 1\n", "fails.py line 2"),  # not taken for a missing class
        ("open('no_such_map.png')\nclass A:\n    act = 1\n", "fails.py line 1"),  # nor for a missing file
    ],
)
def test_a_file_that_fails_is_reported_with_its_line(tmp_path: Path, text: str, place: str) -> None:
    (tmp_path / "fails.py").write_text(text)
    (tmp_path / "helper_of_test_registry.py").write_text("\n\n\n1 / 0\n")
    problem = refusal("agent", "fails.py:A", tmp_path).problem
    assert place in problem
    assert "registry.py line" not in problem.replace("test_registry.py", "")  # no line of the platform's code


def test_another_package_called_agents_does_no_harm(tmp_path: Path) -> None:
    """Other distributions install an ``agents`` too, and a notebook's folder comes first on its path."""
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").write_text("OTHER = True\n")
    code = "import agents, vcmvsp; assert agents.OTHER; vcmvsp.run('formation-circle', set={'duration_s': 1.0}, mcap=False)"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, timeout=500, check=True)


@pytest.mark.parametrize("part", ["cosim", "physics", "netsim", "agents", "hardware", "scenarios"])
def test_no_package_can_be_imported_under_a_second_name(part: str) -> None:
    """A program started in a checkout has the checkout's folders on its path."""
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import {part}"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, check=False)
    assert f"ImportError: this is vcmvsp.{part}: import it by that name" in process.stderr
