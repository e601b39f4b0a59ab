"""User-defined kinds, and user errors in worlds, sensors and commands: one line that names the cause, exit code 2."""

import json
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.command_line import answer_of, assert_refused, vcmvsp_command
from vcmvsp.cosim.errors import ScenarioError

OWN = '''
from dataclasses import dataclass
from vcmvsp.cosim.types import Measured, Positive
from vcmvsp.physics.sensors.sensor import Sensor

@dataclass(kw_only=True)
class Sonar(Sensor):
    """Tells how high it is."""

    reach_m: Positive = 3.0  # how far it hears

    def measure(self, scene, row, rng):
        return Measured(time_ns=scene.now_ns, values={"m": min(self.reach_m, float(scene.position[row, 2]))})

class Broken:
    """A world that cannot be built."""

    def build(self):
        raise RuntimeError("no trees today")

class Nothing:
    """No world."""

    def build(self):
        return 3
'''
CAR = """
name = "s"
duration_s = 0.5
[vehicles]
kind = "p2dx"
sensors = { scan = { kind = "lms", beams = 32 } }
[[vehicle]]
name = "a"
"""


@pytest.fixture
def folder(here: Path) -> Path:
    (here / "own.py").write_text(OWN)
    (here / "s.toml").write_text(CAR)
    return here


def test_a_user_class_is_shown_with_its_comments(folder: Path) -> None:
    out = answer_of("show", "sensor", "own.py:Sonar")
    assert "Tells how high it is." in out
    assert "how far it hears" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "s.toml", "--set", "world.kind=own.py:Broken"), "Broken.build raised RuntimeError: no trees today"),
        (("world", "own.py:Nothing"), "Nothing.build must return a World, not 3"),
        (("check", "s.toml", "--set", "record.sensors=['skan']"), "record.sensors: no vehicle has this sensor"),
        (("check", "s.toml", "--set", "world.kind=urban", "--set", "world.size=[1e6, 1e6]"), "world.size: a town of"),
        (("check", "s.toml", "--set", "world={kind='boxes', boxes=[], ground={pictur='a'}}"), "did you mean 'picture'?"),
        (("check", "s.toml", "--set", "vehicle.a.count=1000000"), "vehicle.a.count"),
        (("drive", "s.toml", "--vehicle", "a", "--command", "x=1,y=2,z=3"), "are for flying vehicles; use v and w"),
        (("drive", "s.toml", "--vehicle", "a", "--command", "vz=1"), "vz are for flying vehicles"),
        (("drive", "s.toml", "--vehicle", "a", "--command", "v=1,v=2"), "v is given twice"),
        (("drive", "s.toml", "--vehicle", "a", "--command", "v=1e300"), "must be NAME=NUMBER"),
    ],
)
def test_errors_are_in_one_line(folder: Path, arguments: tuple[str, ...], words: str) -> None:
    assert_refused(vcmvsp_command(*arguments), words)


def test_a_way_point_needs_a_speed_and_has_an_arrival_time(folder: Path) -> None:
    (folder / "u.toml").write_text("name='u'\nduration_s=1.0\n[[vehicle]]\nname='u'\nkind='point'\nposition=[0,0,5]\n")
    drive = ("drive", "u.toml", "--vehicle", "u", "--seconds", "3", "--json", "--command")
    assert vcmvsp_command(*drive, "x=1,y=0,z=5,speed=0").code == 2
    far, near = (json.loads(vcmvsp_command(*drive, f"x={x},y=0,z=5,speed=1").out) for x in (100, 1))
    assert far["arrival_s"] is None
    assert near["arrival_s"] == pytest.approx(0.9, abs=0.06)  # arrival: within 0.1 m


def test_a_key_of_a_shared_sensor_is_set_for_one(folder: Path) -> None:
    (folder / "s.toml").write_text(CAR + "\n[[vehicle]]\nname = 'b'\nposition = [3.0, 0.0, 0.0]\n")
    resolved = json.loads(vcmvsp_command("show", "s.toml", "--json", "--set", "vehicle.b.sensors.scan.beams=64").out)
    assert [each["sensors"]["scan"]["beams"] for each in resolved["vehicle"]] == [32, 64]


def test_two_files_of_one_name_are_both_kept(folder: Path) -> None:
    for number, name in enumerate(("a", "b")):
        (folder / name).mkdir()
        (folder / name / "own.py").write_text(OWN.replace("3.0", f"{number + 1}.0"))
    sensors = "sensors = { one = { kind = 'a/own.py:Sonar' }, other = { kind = 'b/own.py:Sonar' } }"
    (folder / "s.toml").write_text(f"name = 's'\nduration_s = 0.5\n[[vehicle]]\nname = 'a'\nkind = 'p2dx'\n{sensors}\n")
    assert vcmvsp_command("run", "s.toml", "--out", "first").code == 0
    assert vcmvsp_command("run", "first/scenario.toml", "--out", "again").code == 0
    first, again = ((folder / name / "scenario.toml").read_text() for name in ("first", "again"))
    assert ("own-2.py:Sonar" in first, first == again) == (True, True)


def test_user_physics_need_not_support_obstacles(folder: Path) -> None:
    (folder / "still.py").write_text(
        "from vcmvsp.cosim.federate import Event, Needed, Slot, Step\n"
        "from vcmvsp.cosim.types import VehicleState\n"
        "class Still:\n"
        '    name, slot, wake_slot = "physics", Slot.WORLD, Slot.WORLD\n'
        "    reads = latest = wakes = ()\n"
        "    def __init__(self, world, vehicles, outside=None): ...\n"
        "    def start(self, run):\n"
        "        self.needed, self.names = Needed(run), run.vehicles\n"
        "        return 0\n"
        "    def step(self, now_ns, inbox):\n"
        "        state = VehicleState(position=(1.0, 2.0, 3.0))\n"
        '        return Step([Event(f"{name}/estimate", now_ns, state) for name in self.names], self.needed.after(now_ns))\n'
        "    def close(self):\n"
        "        pass\n"
    )
    scenario: dict[str, Any] = {"name": "still", "duration_s": 1.0, "physics": {"kind": f"{folder / 'still.py'}:Still"}}
    scenario["vehicle"] = [{"name": "car1", "kind": "point"}]
    assert vcmvsp.run(scenario).metrics["duration_s"] == 1.0
    move = {"kind": "move", "at_s": 0.5, "obstacle": "box", "position": [0.0, 0.0]}
    with pytest.raises(ScenarioError, match=r"box cannot be moved: this physics has no check_move"):
        vcmvsp.run({**scenario, "intervention": [move]})
