"""Avoidance around any agent: forwarding of the task's output, limits, and errors in building it."""

import math
import tomllib
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.agents.agent_loop import Uav, info
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import PotentialField
from vcmvsp.agents.avoidance.avoid import Avoid
from vcmvsp.cosim.agent import Agent, Body, Observation, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Follows, Velocity, Waypoint

pytestmark = pytest.mark.slow

HERE = "tests.agents.avoidance.test_avoid"
PUSHLESS: Any = {"gain": 1e-9, "tang": 0.0}  # a field without effect: only the limits remain
KIND = "vcmvsp.agents.avoidance.avoid:Avoid"
FREE = (math.inf,) * 32
NEAR = (0.8, *FREE[1:])
WHEELS, WINGS = Body(width_m=0.4, radius_m=0.25), Body(width_m=0.5, radius_m=0.25, flies=True)


class ScriptedTask(Agent):
    """Task: returns the given commands in turn and notes the number of calls."""

    period = 0.2
    sensors = ("gps",)

    def __init__(self, *commands: Velocity | Waypoint | None) -> None:
        self.commands, self.calls = list(commands), list[str]()

    def start(self, info: VehicleInfo) -> None:
        self.calls.append("start")
        self.note(started=True)

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        self.calls.append("act")
        self.note(asked=len(self.calls))
        self.follows = Follows(leader="b")
        radio.send(x=1.0)
        return self.commands.pop(0)

    def close(self) -> None:
        self.calls.append("close")


class Forward(Agent):
    """Task: drives straight ahead."""

    def __init__(self, speed: float = 0.6) -> None:
        self.speed = speed

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        return Velocity(linear=(self.speed, 0.0, 0.0))


class Idle(Agent):
    """An agent without `act`."""


def around(task: Agent, body: Body = WHEELS, goal: tuple[float, float] | None = None, **settings: Any) -> Avoid:
    made = Avoid({"kind": f"{HERE}:Forward"}, PotentialField(**settings), goal=goal)
    made.task = task
    made.start(info(body=body))
    return made


def act(agent: Agent, ranges: tuple[float, ...] = FREE, at_ms: int = 0, yaw: float = 0.0, height: float = 0.0) -> Any:
    now_ns = at_ms * 1_000_000
    return agent.act(Uav((0.0, 0.0, height), yaw).see(now_ns, scan=ring(ranges, now_ns)), Radio("a", ("a", "b")))


# --- forwarding ---


def test_the_task_is_started_called_and_closed_and_its_output_forwarded() -> None:
    task = ScriptedTask(Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.1))
    made = around(task)
    radio = Radio("a", ("a", "b"))
    made.act(Uav((0.0, 0.0, 0.0)).see(0), radio)
    made.close()
    assert task.calls == ["start", "act", "close"]
    assert made.follows == Follows(leader="b")
    assert made.drain_notes() == {"started": True, "asked": 2.0, "mode": "blind", "level": 0.0}
    assert [message.body for message in radio.drain()] == [{"x": 1.0}]


@pytest.mark.parametrize(("task", "sensors"), [("ScriptedTask", ("gps", "scan")), ("Forward", None)])
def test_it_reads_the_sensors_of_the_task_and_its_scanner(task: str, sensors: tuple[str, ...] | None) -> None:
    made = Avoid({"kind": f"{HERE}:{task}"}, PotentialField())
    assert made.sensors == sensors
    assert made.period == (0.2 if task == "ScriptedTask" else 0.1)


def test_on_wheels_velocities_are_in_the_body_frame() -> None:
    velocity = Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.1)
    made = around(ScriptedTask(velocity, velocity))
    assert act(made, yaw=1.0) == velocity
    assert act(made, (0.5, *FREE[1:])).linear[0] == 0.0


def test_in_the_air_velocities_are_in_the_world_frame() -> None:
    """Heading north, with an obstacle 0.8 m north: the velocity to the north is limited, east and up are not."""
    velocity = Velocity(linear=(0.2, 0.5, 0.1), yaw_rate=0.3)
    made = around(ScriptedTask(velocity, velocity), WINGS, **PUSHLESS)
    free = act(made, yaw=math.pi / 2)
    assert (*free.linear, free.yaw_rate) == pytest.approx((0.2, 0.5, 0.1, 0.3))
    near = act(made, NEAR, yaw=math.pi / 2)
    assert (*near.linear, near.yaw_rate) == pytest.approx((0.2, 0.4 * 0.17, 0.1, 0.3), abs=1e-6)


def test_without_a_usable_scan_a_vehicle_hovers() -> None:
    made = around(ScriptedTask(Velocity(linear=(0.2, 0.5, 0.1), yaw_rate=0.3)), WINGS)
    assert act(made, (0.0,) * 32) == Velocity()


def test_a_command_in_force_is_limited_again() -> None:
    velocity = Velocity(linear=(0.6, 0.0, 0.0))
    made = around(ScriptedTask(None, velocity, None, None), WINGS, **PUSHLESS)
    assert act(made) is None
    assert act(made) == act(made) == velocity
    assert act(made, NEAR).linear[0] == pytest.approx(0.4 * 0.17, abs=1e-6)


def test_a_way_point_is_forwarded_until_an_obstacle_is_near() -> None:
    there = Waypoint(position=(3.0, 0.0, 4.0), speed=0.5, yaw=0.4)
    made = around(ScriptedTask(there, there, there, there), WINGS, **PUSHLESS)
    assert act(made) is there
    near = act(made, (1.19, *FREE[1:]))
    assert (*near.linear, near.yaw_rate) == pytest.approx((0.3, 0.0, 0.4, 0.4))
    assert act(made, (*FREE[:16], 1.19, *FREE[17:]), height=4.0).linear == pytest.approx((0.5, 0.0, 0.0))
    assert not isinstance(act(made), Waypoint)  # all returns vanished at once: doubted


def test_it_slows_down_at_a_way_point() -> None:
    made = around(ScriptedTask(*[Waypoint(position=(0.1, 0.0, 0.0))] * 2), WINGS, **PUSHLESS)
    assert act(made, (*FREE[:16], 1.19, *FREE[17:])).linear == pytest.approx((0.08, 0.0, 0.0))


# --- refusals ---


def scenario(agent: dict[str, Any], kind: str = "kinematic", **more: Any) -> dict[str, Any]:
    sensors = {"scan": {"kind": "lms", "sigma_m": 0.0}}
    vehicle = {"name": "a", "kind": kind, "sensors": sensors, "agent": {"kind": KIND, **agent}}
    return {"name": "avoid", "duration_s": 8.0, "physics": {"kind": "kinematic"}, "vehicle": [vehicle], **more}


FIELD = {"kind": "potential_field"}


@pytest.mark.parametrize(
    ("agent", "key", "words"),
    [
        ({"task": {"kind": "patrol", "way": [[1, 0, 0]], "sped": 1.0}}, "vehicle.a.agent.task.sped", "speed"),
        ({"task": {"kind": "patrol", "way": [[1, 0, 0]], "speed": -1.0}}, "vehicle.a.agent.task.speed", "> 0"),
        ({"task": {"kind": "patrol"}}, "vehicle.a.agent.task.way", "missing"),
        ({"task": {"kind": "patrul"}}, "vehicle.a.agent.task.kind", "patrol"),
        ({"task": {"kind": "nobody.py:Agent"}}, "vehicle.a.agent.task.kind", "no file"),
        ({"task": {"kind": f"{HERE}:Idle"}}, "vehicle.a.agent.task.kind", "no act"),
        ({"task": {}}, "vehicle.a.agent.task.kind", "must be a string"),
        (
            {"task": {"kind": f"{HERE}:Forward"}, "avoidance": {**FIELD, "scanner": "sonar"}},
            "vehicle.a.agent",
            "no such sensor",
        ),
    ],
)
def test_errors_name_the_key(agent: dict[str, Any], key: str, words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        vcmvsp.run(scenario({"avoidance": FIELD, **agent}), mcap=False)
    assert error.value.key == key
    assert words in error.value.problem


def test_a_task_may_be_in_a_file_beside_the_scenario(tmp_path: Any) -> None:
    (tmp_path / "mine.py").write_text(
        "from vcmvsp import Agent, Velocity\n\n\nclass Mine(Agent):\n"
        "    def act(self, obs, radio):\n        return Velocity(linear=(0.25, 0.0, 0.0))\n"
    )
    path = tmp_path / "mine.toml"
    path.write_text(
        'name = "mine"\nduration_s = 2.0\nphysics = { kind = "kinematic" }\n'
        '[[vehicle]]\nname = "a"\nkind = "kinematic"\nsensors = { scan = { kind = "lms" } }\n'
        f'agent = {{ kind = "{KIND}", task = {{ kind = "mine.py:Mine" }}, avoidance = {{ kind = "potential_field" }} }}\n'
    )
    assert vcmvsp.run(path, mcap=False).states["x"].to_pylist()[-1] == pytest.approx(0.5)


# --- through the platform ---


@pytest.mark.parametrize("engine", ["kinematic", "bullet"])
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_robot_driven_at_a_wall_does_not_touch_it(engine: str, turn: float) -> None:
    """The field has no effect; only the speed is limited. The body reaches 0.224 m from its reference point."""
    wall = {"kind": "boxes", "boxes": [{"center": [2.2, 0.0, 0.5], "size": [0.4, 8.0, 1.0]}]}
    straight = {"task": {"kind": f"{HERE}:Forward"}, "avoidance": {**FIELD, **PUSHLESS, "keep_m": 0.27}}
    run_config = scenario(straight, "amigobot", physics={"kind": engine}, world=wall)
    run_config["vehicle"][0]["pose"] = [0.0, 0.0, turn]
    result = vcmvsp.run(run_config, mcap=False)
    assert result.metrics["safety"]["collisions"] == 0
    x = result.states["x"].to_numpy()
    assert 1.4 < x.max() < 2.0 - 0.224
    assert result.states["x"].to_numpy()[-1] == pytest.approx(x.max(), abs=0.02)


@pytest.mark.parametrize(("kind", "method", "keeps"), [("amigobot", "gap", 0.224), ("quadrotor", "potential_field", 0.6)])
def test_a_patrol_without_sensors_is_steered_past_a_pillar(kind: str, method: str, keeps: float) -> None:
    pillar = {"kind": "boxes", "boxes": [{"center": [2.5, 0.05, 1.0], "size": [0.5, 0.5, 2.0]}]}
    task = {"kind": "patrol", "way": [[5.0, 0.0, 1.0]], "speed": 0.5, "loop": False, "flies": kind == "quadrotor"}
    run_config = scenario(
        {"task": task, "avoidance": {"kind": method}, "goal": [5.0, 0.0]}, kind, world=pillar, duration_s=25.0
    )
    run_config["vehicle"][0]["sensors"]["scan"] = {"kind": "ring" if kind == "quadrotor" else "lms"}
    run_config["vehicle"][0]["position"] = [0.0, 0.0, 1.0]
    states = vcmvsp.run(run_config, mcap=False).states
    x, y = (states[name].to_numpy() for name in ("x", "y"))
    clearance = np.hypot(np.maximum(np.abs(x - 2.5) - 0.25, 0.0), np.maximum(np.abs(y - 0.05) - 0.25, 0.0))
    assert clearance.min() > keeps
    assert math.hypot(x[-1] - 5.0, y[-1]) < 0.35


class NotingTask(Agent):
    """Task: notes the keys of the avoidance, too."""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        self.note(mode="mine", level=7.0, more=True)
        return Velocity(linear=(0.1, 0.0, 0.0))


def test_a_task_may_note_the_keys_of_the_avoidance() -> None:
    """The notes of the avoidance prevail."""
    made = around(NotingTask())
    act(made)
    assert made.drain_notes() == {"mode": "task", "level": 0.0, "more": True}


def test_avoidance_may_wrap_avoidance() -> None:
    inner = {"kind": f"{HERE}:Forward"}
    made = Avoid({"kind": "avoid", "task": inner, "avoidance": {"kind": "gap"}}, PotentialField())
    made.start(info(body=WHEELS))
    assert act(made) is not None
    assert made.drain_notes() == {"mode": "task", "level": 0.0}


@pytest.mark.parametrize("ranges", [FREE, NEAR])
def test_a_way_point_on_wheels_is_refused_with_and_without_obstacles(ranges: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="a vehicle on wheels accepts velocities only"):
        act(around(ScriptedTask(Waypoint(position=(0.0, 5.0, 0.0)))), ranges)


def test_another_method_can_be_set_over_keys_of_the_first() -> None:
    """Keys unknown to the new method are dropped, unless they were set with it."""
    result = vcmvsp.run("corridor", set={"agents.avoidance.kind": "vfh", "duration_s": 0.2}, mcap=False)
    avoidance = tomllib.loads(result.scenario)["agents"]["avoidance"]
    assert (avoidance["kind"], avoidance["max_speed"], "lookahead_m" in avoidance) == ("vfh", 0.3, False)
    with pytest.raises(ScenarioError, match="unknown key 'top'"):
        vcmvsp.run("corridor", set={"agents.avoidance.kind": "vfh", "agents.avoidance.top": 2, "duration_s": 0.2}, mcap=False)
