"""The example agents and the example avoidance of the README work as documented."""

import re
from pathlib import Path

import pytest

import vcmvsp
from tests.support.docs.readme_pages import PAGES, block

pytestmark = pytest.mark.slow


def test_it_flies_east_until_an_obstacle_is_near(tmp_path: Path) -> None:
    (tmp_path / "advance.py").write_text(block("docs/reference/agents.md", "class Advance"))
    (tmp_path / "wall.toml").write_text("""
        name = "wall"
        duration_s = 15.0
        world = { kind = "boxes", boxes = [{ center = [10.1, 0.0, 2.5], size = [0.2, 20.0, 5.0] }] }
        [[vehicle]]
        name = "uav"
        kind = "quadrotor"
        position = [0.0, 0.0, 2.0]
        sensors = { ring = { kind = "ring" } }
        agent = { kind = "advance.py:Advance" }
    """)
    result = vcmvsp.run(tmp_path / "wall.toml")
    last = result.states.to_pandas().iloc[-1]
    assert 7.5 < last.x < 9.5
    assert abs(last.vx) < 0.1
    assert abs(last.z - 2.0) < 0.1
    assert result.metrics["safety"]["collisions"] == 0


def test_the_example_avoidance_stops_before_obstacles(tmp_path: Path) -> None:
    (own,) = re.findall(r"`avoidance = (\{ kind = \"own\".*?\} \})`", PAGES["docs/reference/agents.md"])
    (tmp_path / "stop.py").write_text(block("docs/reference/agents.md", "class Stop"))
    (tmp_path / "wall.toml").write_text(f"""
        name = "wall"
        duration_s = 15.0
        physics = {{ kind = "kinematic" }}
        world = {{ kind = "boxes", boxes = [{{ center = [3.1, 0.0, 0.5], size = [0.2, 4.0, 1.0] }}] }}
        [[vehicle]]
        name = "car"
        kind = "amigobot"
        pose = [0.0, 0.0, 0.0]
        sensors = {{ scan = {{ kind = "lms", sigma_m = 0.0 }} }}
        agent = {{ kind = "avoid", avoidance = {own}, task = {{ kind = "trajectory", path = "straight" }} }}
    """)
    result = vcmvsp.run(tmp_path / "wall.toml")
    radius, distance = 0.216, 0.3  # of the body; from the table
    assert result.metrics["safety"]["min_clearance_m"] == pytest.approx(radius + distance, abs=0.02)  # a tick at low speed
    assert abs(result.states.to_pandas().iloc[-1].vx) < 1e-9


def test_it_stops_at_a_strong_signal(tmp_path: Path) -> None:
    (tmp_path / "nearest.py").write_text(block("docs/reference/agents.md", "class Nearest"))
    (tmp_path / "meet.toml").write_text("""
        name = "meet"
        duration_s = 15.0
        physics = { kind = "kinematic" }
        radio = { preset = "wifi-b-1", mac = { kind = "ideal" } }
        agents = { kind = "nearest.py:Nearest" }
        [[vehicle]]
        name = "car1"
        kind = "p2dx"
        agent = {}
        [[vehicle]]
        name = "car2"
        kind = "p2dx"
        pose = [6.0, 0.0, 3.141592653589793]
        agent = {}
    """)
    result = vcmvsp.run(tmp_path / "meet.toml")
    states, levels_dbm = result.states.to_pandas(), result.radio.to_pandas().rssi_dbm
    assert levels_dbm.iloc[0] < -45.0
    assert levels_dbm.max() == pytest.approx(-40.0, abs=0.5)  # the level at which it stops
    assert states.groupby("vehicle").last().vx.abs().max() == 0.0
