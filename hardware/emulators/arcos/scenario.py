"""Emulated robot as a vehicle of a scenario: it drives in that world, among the others, and its sonars measure the walls.

The run is paced by the wall clock; in place of the vehicle's own agent, `DeviceAgent` passes speeds from the emulated robot to
the vehicle, and poses and ranges back. The robot has a thread of its own, and keeps its pace with a slow simulation.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import Interrupted, UsageError
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable
from vcmvsp.cosim.types import Measured, Odometry, Reading, Scan, Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.emulators.arcos.device import Wheels
from vcmvsp.hardware.emulators.arcos.program import KINDS, Rig, RobotOptions, device_of, parameters
from vcmvsp.hardware.emulators.arcos.server import ArcosServer
from vcmvsp.hardware.emulators.device_server import Ready, until_interrupted

SONAR = "sonar{}"
"""Name of the sensor that stands for the sonar of this number; unlike the names of a scenario's own sensors."""

SONAR_HEIGHT_M = 0.1  # above the floor; assumed
CONE_RAD = 0.35  # of a sonar, 20 degrees: the echo is from the nearest object in it; assumed
BEAMS = 5  # beams in the cone

STILL, BLOCKED_S = 0.02, 0.3  # m/s and rad/s; commanded wheels at rest for this time are stalled
LEFT_AND_RIGHT = 0x0101  # bits of stalls: both wheels
FRONT, REAR = 0x003E, 0x3E00  # bits of five bumpers each

PERIODS_S = (0.02, 0.025, 0.05, 0.1)  # periods of the agent: the first that physics can keep
ENDLESS_S = 1e6


class DeviceAgent(Agent):
    """Agent driven by the emulated robot: its speeds go to the vehicle, ramped. ``truth``: x, y, z m, yaw rad."""

    def __init__(self, served: ArcosServer, senses: "VehicleSensors", started: Ready, period_s: float) -> None:
        self.truth: tuple[float, float, float, float] | None = None
        self.sensors = senses.names
        self._served, self._senses, self._started, self._period_s = served, senses, started, period_s
        self._ramp = Wheels((0.0, 0.0, 0.0))  # its speeds alone
        self._blocked_s = 0.0

    def start(self, info: VehicleInfo) -> None:
        """Called before time 0, when everything is built."""
        self._started({})

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Pass the pose to the robot, and its speeds to the vehicle."""
        state = obs.state
        self.truth = (*state.position, state.yaw)
        pose, v, w = self._odometry(obs)
        stall = self._stall(state) | self._senses.bumpers(obs)
        ranges = self._senses.ranges(obs)
        with self._served.lock:
            device = self._served.device
            device.moved(pose, v, w, ranges, stall)
            self._ramp.step(device.commanded(), device.motion, self._period_s)
        return Velocity(linear=(self._ramp.v, 0.0, 0.0), yaw_rate=self._ramp.w)

    def _odometry(self, obs: Observation) -> tuple[Vec3, float, float]:
        """Pose and speeds from wheel odometry; true values for a vehicle without wheels."""
        reading = obs.readings.get(self._senses.odometer)
        if isinstance(reading, Odometry):
            return reading.pose, reading.v, reading.w
        x, y, _ = obs.state.position
        return (x, y, obs.state.yaw), forward(obs.state), obs.state.angular_velocity[2]

    def _stall(self, state: VehicleState) -> int:
        pushing = abs(self._ramp.v) > 2.0 * STILL and abs(forward(state)) < STILL
        turning = abs(self._ramp.w) > 2.0 * STILL and abs(state.angular_velocity[2]) < STILL
        held = pushing or (turning and abs(forward(state)) < STILL)
        self._blocked_s = self._blocked_s + self._period_s if held else 0.0
        return LEFT_AND_RIGHT if self._blocked_s >= BLOCKED_S else 0


def forward(state: VehicleState) -> float:
    """Speed along the heading, m/s."""
    return rotate2(state.velocity[0], state.velocity[1], -state.yaw)[0]


class VehicleSensors:
    """Sensors of a vehicle in the role of the robot's sensors."""

    def __init__(self, robot: Robot, fitted: Mapping[str, Mapping[str, Any]]) -> None:
        self._sonars = [SONAR.format(number) for number in range(len(robot.sonars))]
        self.odometer = next((name for name, each in fitted.items() if each.get("kind") == "wheel_odometry"), "odometry")
        self._bumper = next((name for name, each in fitted.items() if each.get("kind") == "bumper"), "")
        self.names = (*self._sonars, self.odometer, *filter(None, [self._bumper]))

    def ranges(self, obs: Observation) -> list[float]:
        """Range of each sonar, m; infinite: no echo."""
        return [_range_m(obs.readings.get(name)) for name in self._sonars]

    def bumpers(self, obs: Observation) -> int:
        """Bits of pressed bumpers."""
        reading = obs.readings.get(self._bumper)
        return bumper_bits(list(reading.values.values())) if isinstance(reading, Measured) else 0


def _range_m(reading: Reading | None) -> float:
    return max(0.0, float(reading.ranges.min())) if isinstance(reading, Scan) else math.inf


def bumper_bits(segments: Sequence[float]) -> int:
    """Bits of bumpers from segments counter-clockwise from ahead; segments at the sides count for none."""
    bits = 0
    for number, pressed in enumerate(segments):
        ahead = math.cos(math.tau * number / len(segments))
        if pressed and abs(ahead) > 0.5:
            bits |= FRONT if ahead > 0.0 else REAR
    return bits


def sonars_of(robot: Robot, rate_hz: float) -> dict[str, dict[str, Any]]:
    """Scanners for the sonars: a cone of beams each, of which the shortest counts."""
    return {
        SONAR.format(number): {
            "kind": "range_scanner",
            "rate_hz": rate_hz,
            "beams": BEAMS,
            "field_of_view": CONE_RAD,
            "range_max": robot.sonar_max_m,
            "position": [each.x, each.y, SONAR_HEIGHT_M],
            "yaw": each.angle,
        }
        for number, each in enumerate(robot.sonars)
    }


def emulate(
    name: str,
    chosen: RobotOptions,
    ready: Ready,
    pose: Vec3 | None = None,
    *,
    run: Callable[..., Any],
    flies: Callable[[Any], bool],
    scenario_name: str,
    vehicle: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Serve a robot in the world of a scenario until it is interrupted or its time ends; its counts.

    ``run`` is `cosim.runs.api.run`, ``flies`` is `physics.vehicles.specification.flies`; ``pose`` replaces the start in the
    scenario. The vehicle may be left out if only one is suitable. ``settings``: key path -> value, as for a run.
    """
    parsed, source = loader.load(scenario_name, settings=settings)
    robot = parameters(name, chosen)
    own = vehicle_of(parsed, vehicle, KINDS[name])
    if flies(registry.find("vehicle", own.kind, folder=source.folder, origin=source)):
        raise UsageError(f"vehicle {own.name} flies, but the {name} does not: choose another vehicle with --vehicle")
    period_s = period_of(parsed)
    changes = {**(settings or {}), **changes_of(parsed, own, robot, period_s, pose)}
    changes["duration_s"] = math.ceil(10.0 * (chosen.duration_s or ENDLESS_S)) / 10.0  # physics ends with a whole step
    with Rig(ready) as rig:
        result = None
        with until_interrupted():
            rig.fit(chosen.tags)
            served = rig.serve(device_of(name, chosen, None), chosen)
            senses = VehicleSensors(robot, own.sensors)
            agent = DeviceAgent(served, senses, lambda _: rig.start(chosen.tags, lambda: agent.truth), period_s)
            agents = {own.name: agent}
            try:
                result = run(
                    scenario_name,
                    set=changes,
                    agents=agents,
                    realtime=1.0,
                    mcap=False,
                    progress=lambda *_: rig.check(),
                )
            except Interrupted as interrupted:
                result = interrupted.result
        return {**rig.summary(), "vehicle": own.name, "lateness": result and result.about["lateness"]}


def vehicle_of(parsed: Scenario, name: str | None, kind: str) -> VehicleTable:
    """Vehicle of this name, or the only suitable one."""
    vehicles = {each.name: each for each in parsed.vehicle}
    if name is not None:
        if name not in vehicles:
            raise UsageError(f"--vehicle {name}: {binding.unknown('vehicle', name, vehicles)}")
        return vehicles[name]
    own_kind = "p2dx" if kind == "p2dx" else "amigobot"
    alike = [each for each in parsed.vehicle if each.kind == own_kind] or list(parsed.vehicle)
    if len(alike) > 1:
        raise UsageError(f"several vehicles match; choose one with --vehicle NAME: {', '.join(each.name for each in alike)}")
    return alike[0]


def period_of(parsed: Scenario) -> float:
    """Period of the agent: short, and a whole number of physics steps."""
    step = Ticks.rate(float(parsed.physics.get("rate_hz", 120.0)))
    return next((each for each in PERIODS_S if Ticks.every(each).is_multiple_of(step)), PERIODS_S[-1])


def changes_of(parsed: Scenario, own: VehicleTable, robot: Robot, period_s: float, pose: Vec3 | None) -> dict[str, Any]:
    """Changes of the scenario."""
    prefix = f"vehicle.{own.name}"
    agent: dict[str, Any] = {"period_s": period_s, "latency_s": 0.0}
    kind = f"{DeviceAgent.__module__}:{DeviceAgent.__qualname__}"
    changes: dict[str, Any] = {f"{prefix}.agent": agent, f"{prefix}.pose_source": "truth"}
    others = [each.agent for each in parsed.vehicle if each is not own and each.agent is not None]
    if "kind" in parsed.agents.defaults and all(each.kind for each in others):
        changes["agents.kind"] = kind  # no other vehicle uses that default
    else:
        agent["kind"] = kind
    for number, content in sonars_of(robot, 1.0 / period_s).items():
        if number not in own.sensors:
            changes[f"{prefix}.sensors.{number}"] = content
    if pose is not None:
        x, y, yaw = pose
        start = {"pose": [x, y, yaw]} if own.pose is not None else {"position": [x, y, 0.0], "heading": yaw}
        changes |= {f"{prefix}.{key}": value for key, value in start.items()}
    simulated = {**parsed.twins, **{f"vehicle.{name}.pose_source": "truth" for name in parsed.real}}
    return changes | simulated
