"""Command line: a resolved scenario gives the same bytes again."""

from pathlib import Path

import pytest

from tests.support.cosim.command_line import contents, two_cars, vcmvsp_command
from vcmvsp.cosim.scenario import loader as scenarios

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("folder")]

MINE = """
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
class Mine(Trajectory):
    period = 0.05
    def __init__(self, gain: float = 0.1, table: dict | None = None, *, speed: float = 0.3) -> None:
        super().__init__("slalom", speed)
class Camera(Mine):
    period = 1 / 30
"""
SENSOR = "positioning = { sigma_m = 0.3, outlier_probability = 0.1 }\npose_source = 'positioning'"
LOSSY = (
    "[radio]\npreset = 'zigbee'\n[radio.loss]\nprobability = 0.3\n[radio.delay]\nkind = 'fixed'\nseconds = 0.1\njitter_s = 0.02"
)
CAR3 = """
[[vehicle]]
name = "car3"
kind = "lag"
pose = [-1.0, 0.5, 0.0]
agent = { kind = "leader_follower", leader = "car1", k1 = 1.0 }
"""


def written(name: str, text: str) -> object:
    return pytest.param(text, id=name.replace(" ", "-"))


RESOLVED: list[object] = [
    written("plain", two_cars()),
    written("whole numbers", two_cars(top="seed = 3", agents="k1 = 1\nlatency_s = 0").replace("0.5", "1")),
    written("largest seed", two_cars(top=f"seed = {2**63 - 1}", tail=LOSSY)),
    written("radio", two_cars(tail=LOSSY)),
    written("another layer than the preset's", two_cars(tail="[radio]\npreset='wss'\n[radio.loss]\nkind='none'")),
    written("sensor", two_cars(car2=SENSOR)),
    written("latencies", two_cars(agents="latency_s = 0.05", agent="kind='leader_follower', leader='car1', latency_s=0.02")),
    written("periods", two_cars(agents="period_s = 0.2", agent="kind='leader_follower', leader='car1', period_s=0.07")),
    written("window and record", two_cars(tail="[metrics]\nfrom_s = 0.1\nto_s = 0.4\n[record]\nperiod_s = 0.05")),
    written("where agents run is left out", two_cars(agents="runs = 'process'\ndeadline_s = 5\nprocesses = 1")),
    written("default for all agents", two_cars(agents="k1 = 0.5\nk2 = 0.25", tail=CAR3)),
    written("kind for all agents", two_cars(agents="kind = 'trajectory'", agent="path = 'slalom'")),
    written("default for all vehicles", two_cars(tail="[vehicles]\nmax_speed = 0.2\npose_source = 'odometry'")),
    written("own value beside a default", two_cars(car2="pose_source='odometry'", tail="[vehicles]\npose_source='truth'")),
    written("own kind beside a default", two_cars(tail="[vehicles]\nkind='lag'\n[[vehicle]]\nname='car3'")),
    written(
        "vehicle without an agent", two_cars(tail="[[vehicle]]\nname = 'car3'\nkind = 'lag'\npose = [3, 3, 0]\ntau_v_s = 0.1")
    ),
    written("boxes", two_cars(tail="[world]\nkind='boxes'\nboxes=[{center=[5,5,1], size=[1,1,2], material='glass'}]")),
    written("agent of a file", two_cars(agent="kind = 'sub/mine.py:Mine', table = { a = [1, { b = 2.5 }] }")),
    written("agent of a file for all", two_cars(agents="kind='sub/mine.py:Mine'", agent="")),
    written("period of the class", two_cars(agent="kind = 'sub/mine.py:Mine'")),
    written("bullet", two_cars(car2=SENSOR, tail=LOSSY).replace('"kinematic"', '"bullet"')),
]


@pytest.mark.parametrize("text", RESOLVED)
def test_a_resolved_scenario_gives_the_same_bytes_again(folder: Path, text: str) -> None:
    (folder / "sub").mkdir()
    (folder / "sub" / "mine.py").write_text(MINE)
    (folder / "s.toml").write_text(text)
    first = vcmvsp_command("run", "s.toml", "--out", "first")
    assert first.code == 0, first.err
    shown = vcmvsp_command("show", "s.toml", "--resolved").out
    assert shown == (folder / "first" / "scenario.toml").read_text()
    again = vcmvsp_command("run", "first/scenario.toml", "--out", "again")
    assert again.code == 0, again.err
    assert contents(folder / "again") == contents(folder / "first")


@pytest.mark.parametrize("name", [name for name in scenarios.names() if name != "hybrid-formation"])  # has real vehicles
def test_built_in_scenarios_are_the_same_when_resolved(folder: Path, name: str) -> None:
    short = ["--set", "duration_s=0.5", "--set", "physics.kind=kinematic"]
    assert vcmvsp_command("run", name, *short, "--out", "first").code == 0
    assert vcmvsp_command("run", "first/scenario.toml", "--out", "again").code == 0
    assert contents(folder / "again") == contents(folder / "first")


def test_the_period_of_a_class_is_resolved_exactly(folder: Path) -> None:
    (folder / "mine.py").write_text(MINE)
    (folder / "s.toml").write_text(two_cars(agent="kind = 'mine.py:Camera'"))
    assert f"period_s = {1 / 30}\n" in vcmvsp_command("show", "s.toml", "--resolved").out


def test_settings_are_part_of_the_shown_scenario() -> None:
    assert "probability = 0.25" in vcmvsp_command("show", "s.toml", "--set", "radio.loss.probability=0.25").out
    assert "probability" not in vcmvsp_command("show", "s.toml").out


def test_nothing_of_this_machine_is_in_the_results(folder: Path) -> None:
    """Another folder, another file name, agents in other processes: the same bytes."""
    (folder / "elsewhere").mkdir()
    (folder / "elsewhere" / "other.toml").write_text(two_cars())
    vcmvsp_command("run", "s.toml", "--out", "one")
    vcmvsp_command("run", "elsewhere/other.toml", "--out", "elsewhere/two", "--agents", "process")
    assert contents(folder / "one") == contents(folder / "elsewhere" / "two")
