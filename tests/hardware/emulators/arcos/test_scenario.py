"""Emulated robot as a vehicle of a scenario: changes to the scenario, and use of sensor readings."""

import math
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vcmvsp import Observation, Odometry, Radio, VehicleState, quaternion_from_yaw
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.types import Measured, Scan, Vec3
from vcmvsp.hardware.drivers.arcos.protocol import Command, command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.program import KINDS
from vcmvsp.hardware.emulators.arcos.scenario import (
    BLOCKED_S,
    FRONT,
    LEFT_AND_RIGHT,
    REAR,
    DeviceAgent,
    VehicleSensors,
    bumper_bits,
    changes_of,
    period_of,
    sonars_of,
    vehicle_of,
)

AMIGO = ROBOTS["amigo"]
PERIOD_S = 0.025
FAR = Scan(ranges=np.full(5, np.inf, np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)


def raw_of(**more: Any) -> dict[str, Any]:
    vehicles = [{"name": "car1", "kind": "amigobot", "agent": {}}, {"name": "car2", "kind": "p2dx", "agent": {}}]
    return {"name": "two", "duration_s": 1.0, "vehicle": vehicles, **more}


def scenario_of(**more: Any) -> Scenario:
    return loader.load(raw_of(**more))[0]


def changed(pose: Vec3 | None = None, **more: Any) -> Scenario:
    """The scenario in which the emulated robot is its first vehicle."""
    before = scenario_of(**more)
    return loader.load(raw_of(**more), settings=changes_of(before, before.vehicle[0], AMIGO, 0.025, pose))[0]


def test_the_only_vehicle_of_its_kind_is_used() -> None:
    assert vehicle_of(scenario_of(), None, "amigo").name == "car1"
    assert vehicle_of(scenario_of(), None, "p2dx").name == "car2"
    assert vehicle_of(scenario_of(), "car2", "amigo").name == "car2"
    with pytest.raises(UsageError, match="--vehicle car3"):
        vehicle_of(scenario_of(), "car3", "amigo")
    several = [{"name": name, "kind": "kinematic"} for name in ("a", "b")]
    with pytest.raises(UsageError, match=r"--vehicle NAME: a, b"):
        vehicle_of(scenario_of(vehicle=several), None, "amigo")


@pytest.mark.parametrize(("rate_hz", "period_s"), [(120.0, 0.025), (240.0, 0.025), (100.0, 0.02), (1000.0, 0.02), (20.0, 0.05)])
def test_its_period_fits_the_rate_of_physics(rate_hz: float, period_s: float) -> None:
    assert period_of(scenario_of(physics={"rate_hz": rate_hz})) == period_s


@pytest.mark.parametrize(
    ("vehicles", "agents"),
    [
        ([{"agent": {"kind": "patrol"}}, {"agent": {"kind": "patrol"}}], {}),
        ([{"agent": {}}, {"agent": {}}], {"kind": "patrol"}),
        ([{"agent": {}}, {"agent": {"kind": "patrol"}}], {"kind": "patrol"}),
        ([{"agent": {}}, {}], {"kind": "patrol", "period_s": 0.1}),
        ([{}, {}], {}),
    ],
)
def test_its_agent_has_its_own_period_beside_any_others(vehicles: list[dict[str, Any]], agents: dict[str, Any]) -> None:
    named = [{"name": f"car{number}", **each} for number, each in enumerate(vehicles)]
    after = changed(agents=agents, vehicles={"kind": "amigobot"}, vehicle=named)
    agent: Any = after.vehicle[0].agent
    assert agent.period_s == 0.025
    assert (agent.kind or after.agents.defaults["kind"]) == "vcmvsp.hardware.emulators.arcos.scenario:DeviceAgent"
    others = after.vehicle[1].agent
    assert not others or (others.kind or after.agents.defaults["kind"]) == "patrol"


@pytest.mark.parametrize("start", [{"pose": [1.0, 2.0, 0.5]}, {"position": [1.0, 2.0, 0.0], "heading": 0.5}, {}])
def test_its_start_pose_replaces_any_of_the_scenario(start: dict[str, Any]) -> None:
    after = changed((5.0, 6.0, 0.7), vehicle=[{"name": "car", "kind": "amigobot", **start}])
    assert after.vehicle[0].start == ((5.0, 6.0, 0.0), 0.7)


def test_real_vehicles_are_simulated() -> None:
    real = {"driver": {"kind": "arcos", "port": "/dev/ttyUSB0"}, "localisation": {"kind": "ubisense"}, "pose_source": "fusion"}
    after = changed(vehicles={"kind": "amigobot"}, vehicle=[{"name": name, **real} for name in ("car1", "car2")])
    assert [(each.driver or {}).get("kind") for each in after.vehicle] == ["none"] * 2
    assert after.real == ()
    assert [each.pose_source for each in after.vehicle] == ["truth"] * 2


def test_sonars_are_placed_as_on_the_robot_and_scenario_ones_are_kept() -> None:
    own = {"kind": "ring", "range_max": 3.0}
    before = scenario_of(vehicle=[{"name": "car1", "kind": "amigobot", "sensors": {"sonar3": own}}])
    changes = changes_of(before, before.vehicle[0], AMIGO, 0.025, None)
    made = {key.rpartition(".")[2]: content for key, content in changes.items() if ".sensors." in key}
    assert sorted(made) == [f"sonar{number}" for number in range(8) if number != 3]
    for number, each in enumerate(AMIGO.sonars):
        content = sonars_of(AMIGO, 40.0)[f"sonar{number}"]
        assert (content["position"][:2], content["yaw"]) == ([each.x, each.y], each.angle)


def test_bumpers_ahead_and_behind() -> None:
    front, left, back, right = np.eye(4).tolist()
    assert [bumper_bits(each) for each in (front, left, back, right)] == [FRONT, 0, REAR, 0]
    assert bumper_bits([1.0] * 4) == FRONT | REAR
    assert bumper_bits([0.0] * 12) == 0
    assert bumper_bits([1.0]) == FRONT


class AgentHarness:
    """A DeviceAgent without a port; the robot's client has opened a session and enabled the motors."""

    def __init__(self, **fitted: dict[str, Any]) -> None:
        self.device = Device(AMIGO, start=None, old_session=True)
        served: Any = SimpleNamespace(device=self.device, lock=threading.Lock())
        self.started = 0
        self.agent = DeviceAgent(served, VehicleSensors(AMIGO, fitted), self._start, PERIOD_S)
        self.time_ns = 0

    def _start(self, _: object) -> None:
        self.started += 1

    def say(self, number: int, argument: int) -> None:
        self.device.receive(command(number, argument), self.device.now_ns)

    def act(self, seconds: float, v: float = 0.0, w: float = 0.0, yaw: float = 0.0, **readings: Any) -> tuple[float, float]:
        """Advances by ``seconds`` at this velocity; returns the final command, v m/s and w rad/s."""
        state = VehicleState(
            position=(1.0, 2.0, 0.0),
            velocity=(v * math.cos(yaw), v * math.sin(yaw), 0.0),
            attitude=quaternion_from_yaw(yaw),
            angular_velocity=(0.0, 0.0, w),
        )
        velocity: Any = None
        for _ in range(round(seconds / PERIOD_S)):
            self.time_ns += round(PERIOD_S * 1e9)
            obs = Observation(vehicle="car", time_ns=self.time_ns, state=state, readings=readings)
            velocity = self.agent.act(obs, Radio("car", ("car",)))
        return velocity.linear[0], velocity.yaw_rate

    @property
    def stall(self) -> int:
        return self.device._stall


def test_speeds_ramp_as_set_by_the_client() -> None:
    stage = AgentHarness()
    stage.say(Command.SETA, 400)
    stage.say(Command.VEL, 300)
    assert stage.act(0.5)[0] == pytest.approx(0.2)
    assert stage.act(0.5)[0] == pytest.approx(0.3)
    stage.say(Command.ESTOP, 0)
    assert stage.act(PERIOD_S) == (0.0, 0.0)


@pytest.mark.parametrize(("number", "argument"), [(Command.VEL, 300), (Command.VEL, -300), (Command.RVEL, 40)])
def test_blocked_wheels_are_stalled_after_a_while(number: int, argument: int) -> None:
    stage = AgentHarness()
    stage.say(number, argument)
    stage.act(BLOCKED_S)
    assert stage.stall == 0
    stage.act(1.0)
    assert stage.stall == LEFT_AND_RIGHT
    moving = {"v": math.copysign(0.3, argument)} if number == Command.VEL else {"w": 0.7}
    stage.act(PERIOD_S, yaw=2.0, **moving)
    assert stage.stall == 0


def test_a_robot_without_command_is_not_stalled() -> None:
    stage = AgentHarness()
    stage.act(3.0)
    assert stage.stall == 0


def test_odometry_is_from_encoders_or_wheels_or_else_the_pose() -> None:
    odometry = Odometry(pose=(9.0, 9.0, 1.0), v=0.1, w=0.2)
    fitted = AgentHarness(encoders={"kind": "wheel_odometry"})
    fitted.act(PERIOD_S, odometry=Odometry(pose=(0.0, 0.0, 0.0), v=0.0, w=0.0), encoders=odometry)
    assert fitted.device.pose == odometry.pose
    plain = AgentHarness()
    plain.act(PERIOD_S, odometry=odometry)
    assert plain.device.pose == odometry.pose
    bare = AgentHarness()
    bare.act(PERIOD_S, yaw=0.5)
    assert bare.device.pose == pytest.approx((1.0, 2.0, 0.5))
    assert bare.agent.truth == pytest.approx((1.0, 2.0, 0.0, 0.5))


def test_a_sonar_measures_the_nearest_in_its_cone_and_bumpers_press() -> None:
    stage = AgentHarness(skirt={"kind": "bumper"})
    near = Scan(ranges=np.array([3.0, 1.5, np.inf, 2.0, 2.5], np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)
    inside = Scan(ranges=np.array([-np.inf, 1.0], np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)
    pressed = Measured(time_ns=0, values={"front": 1.0, "left": 0.0, "back": 0.0, "right": 0.0})
    stage.act(PERIOD_S, sonar0=near, sonar1=inside, sonar2=FAR, skirt=pressed)
    assert stage.device._ranges == (1.5, 0.0, *[math.inf] * 6)
    assert stage.stall == FRONT


def test_it_requests_exactly_the_sensors_in_use() -> None:
    agent = AgentHarness(eye={"kind": "camera"}, skirt={"kind": "bumper"}).agent
    assert {*(agent.sensors or ())} == {"odometry", "skirt", *(f"sonar{number}" for number in range(8))}


def test_robots_by_the_names_of_vehicles() -> None:
    assert {ROBOTS[kind].name for kind in KINDS.values()} == {"AmigoBot", "Pioneer 2-DX", "AmigoBot SH"}
