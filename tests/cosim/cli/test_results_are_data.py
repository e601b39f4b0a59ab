"""Reading results executes no code of theirs; the help of commands that execute classes of a scenario states it."""

import sys
import tomllib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.recorded_run import SCENARIO
from vcmvsp.cosim.analysis.coverage import coverage
from vcmvsp.cosim.cli import app
from vcmvsp.cosim.cli.options import DATA, PROGRAM
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.studies.engine import study
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.player.recording import Recording

pytestmark = pytest.mark.processes

NEITHER = {  # import only classes of their own command line, or none
    *("agent", "robot", "watch", "stop", "operator", "doctor", "new", "list", "reference", "figure", "validate", "bench"),
    *("demo", "channel", "per", "pathloss", "emulate ubisense", "emulate dwm1001", "emulate mavlink", "emulate ros2"),
    *("keys init", "keys hub", "keys vehicle", "keys observer", "keys list", "keys revoke"),
    *("net exec", "net status", "net down"),
}
READING = {
    "plot": ["plot", "."],
    "report": ["report", "."],
    "export": ["export", ".", "--csv", "--layout", "--rosbag2"],
    "radio": ["radio", "."],
    "radio link": ["radio", ".", "--link", "car1/car2"],
    "radio frame": ["radio", ".", "--link", "car1/car2", "--frame", "lost"],
    "radio coverage": ["radio", ".", "--coverage", "car1", "--resolution", "2", "--out", "map.png"],
    "report of a study": ["report", "study"],
}
"""Calls of all commands that read results, except `view`, which does not end."""
KINDS = ("evil.py:Thing", "evil:Thing", "theirs")


def commands() -> Iterator[tuple[str, str]]:
    """Every command with the epilog of its help."""
    for name, command in app.command().commands.items():
        inner = getattr(command, "commands", None)
        for each, found in (inner or {"": command}).items():
            yield f"{name} {each}".strip(), found.epilog or ""


def test_every_command_reads_data_executes_a_program_or_does_neither() -> None:
    known = dict(commands())
    reads = {name for name, epilog in known.items() if DATA in epilog}
    executes = {name for name, epilog in known.items() if PROGRAM in epilog}
    assert reads == {name.split()[0] for name in READING} | {"view"}
    assert reads & executes == {"radio"}  # reads a folder, executes a scenario
    assert known.keys() - reads - executes == NEITHER


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("honest") / "run"
    vcmvsp.run(SCENARIO, out=folder)
    short = {**SCENARIO, "duration_s": 0.2, "intervention": [], "world": {"kind": "empty"}}
    study(short, vary={"radio.loss.probability": [0.0, 0.5]}, seeds=1, out=folder / "study", jobs=1)
    return folder


@pytest.fixture(params=KINDS)
def evil(honest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """The same folder with all kinds replaced by its own classes; it is the current folder and on the module path."""
    folder = tmp_path / "run"
    for path in honest.rglob("*"):
        if path.is_file():
            (folder / path.relative_to(honest)).parent.mkdir(parents=True, exist_ok=True)
            (folder / path.relative_to(honest)).write_bytes(path.read_bytes())
    raw = tomllib.loads((folder / "scenario.toml").read_text())
    raw = {name: value if name == "intervention" else _swapped(value, request.param) for name, value in raw.items()}
    for vehicle in raw["vehicle"]:
        vehicle |= {name: {"kind": request.param} for name in ("driver", "localisation")}
    raw["agents"] |= {"estimator": request.param, "avoidance": request.param}
    raw["radio"] |= {layer: {"kind": request.param} for layer in ("trace", "script", "jammer", "delivery")}
    raw |= {"routing": {"kind": request.param}, "bridge": {"door": {"kind": request.param}}}
    (folder / "scenario.toml").write_text(tomli_w.dumps(raw))
    plan = tomllib.loads((folder / "study" / "study.toml").read_text())
    plan["scenario_toml"] = tomli_w.dumps(raw)
    (folder / "study" / "study.toml").write_text(tomli_w.dumps(plan))
    canary = f"open({str(tmp_path / 'canary')!r}, 'w').close()\nclass Thing: pass\n"
    for name in ("evil.py", "theirs.py", "sitecustomize.py", "matplotlibrc.py"):
        (folder / name).write_text(canary)
    monkeypatch.setattr(registry, "_entry_points", lambda group: {"theirs": "theirs:Thing"})
    for name in ("evil", "theirs"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return folder


def _swapped(table: Any, kind: str) -> Any:
    """The table with every kind replaced."""
    if isinstance(table, dict):
        return {name: kind if name == "kind" else _swapped(value, kind) for name, value in table.items()}
    return [_swapped(each, kind) for each in table] if isinstance(table, list) else table


@pytest.mark.usefixtures("figures")
def test_reading_executes_nothing_and_works_on_the_recording(evil: Path) -> None:
    for name, arguments in READING.items():
        outcome = vcmvsp_command(*arguments)
        assert outcome.code == 0, (name, outcome.err)
        assert "Traceback" not in outcome.err
        assert not (evil.parent / "canary").exists(), name
    with closing(Recording(evil)) as recording:
        assert recording.troubles == []
        assert len(recording.scenery.triangles)
    assert not (evil.parent / "canary").exists()


def test_trust_executes_the_code_of_a_folder(evil: Path) -> None:
    assert vcmvsp_command("radio", ".", "--coverage", "car1", "--trust").code == 2  # Thing is not a layer
    assert (evil.parent / "canary").exists()


def test_the_world_of_a_recording_is_that_of_the_run(honest: Path, evil: Path) -> None:
    def seen(folder: Path) -> tuple[Scenery, list[Any]]:
        with closing(Recording(folder)) as recording:
            shown = [recording.at(time_ns) for time_ns in (0, 1_000_000_000, 4_000_000_000)]
            return recording.scenery, [(each.obstacles, each.targets) for each in shown]

    (drawn, moving), (built, moved) = seen(evil), seen(honest)
    corners = [each.vertices[each.triangles].reshape(-1, 9) for each in (drawn, built)]
    one, other = (each[np.lexsort(each.T)] for each in corners)
    np.testing.assert_allclose(one, other, atol=1e-3)
    np.testing.assert_array_equal(np.unique(drawn.colors, axis=0), np.unique(built.colors, axis=0))
    for found, true in zip(drawn.obstacles, built.obstacles, strict=True):
        assert (found.name, found.shape, found.color) == (true.name, true.shape, true.color)
        np.testing.assert_allclose((*found.size, *found.pose), (*true.size, *true.pose), atol=1e-6)
    for (obstacles, targets), (true_obstacles, true_targets) in zip(moving, moved, strict=True):
        assert obstacles.keys() == true_obstacles.keys()
        for name, place in true_obstacles.items():
            np.testing.assert_allclose(obstacles[name], place, atol=0.2)  # recorded at ticks
        np.testing.assert_allclose(targets["alpha"], true_targets["alpha"], atol=1e-6)
    for craft, true_craft in zip(drawn.vehicles, built.vehicles, strict=True):
        assert 0.5 * max(true_craft.size) < max(craft.size) < 2.0 * max(true_craft.size)


def test_a_map_lists_the_classes_not_executed(evil: Path) -> None:
    found = coverage(evil, "car1", resolution_m=2.0)
    assert {"world", "radio.path_loss", "radio.phy", "radio.loss"} <= {*found.not_executed}
    assert "not executed: the classes of radio." in vcmvsp_command(*READING["radio coverage"]).out
