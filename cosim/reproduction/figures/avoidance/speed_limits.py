"""Speed limits near obstacles: at high speed a field alone violates its safety distance, a second level keeps it.

A flying vehicle with a lag of 0.5 s passes a square pillar on its path, 0.2 m beside the centre line, at 1, 2 and 3 m/s, guided
by a potential field of 32 beams at 10 Hz, with and without level 2.

Expected clearances are from an independent simulation that stepped the lag once a period, before the vehicle moved:
``v += (command - v) T / lag``. Such a servo follows its command after lag - T = 0.4 s instead of 0.5 s, 30 cm of path at 3 m/s:
the comparison needs the same servo, so `ServoAgent` puts it between the agent and a vehicle without lag. The results of the
exact lag stand beside it. At 3 m/s the field alone depends on where along the path the scans fall, 0.3 m apart: its clearance
scatters from 0.16 to 0.20 m (with level 2 by 3 mm).
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel, Style
from vcmvsp.cosim.reproduction.figures.scenarios import scene
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array, Positive, Velocity

SPEEDS = (1.0, 2.0, 3.0)  # m/s
ALONE, LIMITED = (0.613, 0.404, 0.167), (0.709, 0.737, 0.746)  # m: minimum clearance at these speeds
HALF_M, CORE_M = 0.25, 0.6  # half edge of the pillar; safety distance of the field
LAG_S, START = 0.5, (-9.0, 0.2, 1.0)  # m: far enough for steady flight when it first sees the pillar
RECORD_S = 0.02
SHOWN = (-3.0, 3.4)  # m, x: drawn part of the tracks
HERE = "vcmvsp.cosim.reproduction.figures.avoidance.speed_limits"
TOWARDS = f"{HERE}:Towards"
NAMES = {1: "the field alone", 2: "with level 2"}
STYLES: Mapping[int, Style] = {1: "dotted", 2: "line"}
LAGS: Mapping[bool, tuple[str, Style]] = {True: ("", "line"), False: (", exact lag", "dashed")}

Case = tuple[bool, int, float]  # stepped servo, highest level, m/s


class Towards(Agent):
    """Flies in a constant direction, (x, y), at ``speed`` m/s."""

    def __init__(self, direction: tuple[float, float], speed: Positive = 1.0) -> None:
        self.direction, self.speed = direction, speed

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Return the constant velocity."""
        x, y = (self.speed * part / math.hypot(*self.direction) for part in self.direction)
        return Velocity(linear=(x, y, 0.0))


class ServoAgent(Agent):
    """Passes another agent's commands to the vehicle through a servo that is stepped once a tick."""

    def __init__(self, agent: dict[str, Any], lag_s: Positive) -> None:
        kind = registry.find("agent", agent["kind"])
        self.agent: Agent = binding.call(kind, {name: value for name, value in agent.items() if name != "kind"})
        self.lag_s = lag_s

    def start(self, info: VehicleInfo) -> None:
        """Start at rest."""
        self.agent.start(info)
        self._share, self._speed = info.period_s / self.lag_s, np.zeros(3)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Move a share of the way to the command."""
        command = self.agent.act(obs, radio)
        assert isinstance(command, Velocity)  # noqa: S101
        self._speed += self._share * (np.array(command.linear) - self._speed)
        x, y, z = self._speed.tolist()
        return Velocity(linear=(x, y, z), yaw_rate=command.yaw_rate)


def fig_levels(runner: Runner) -> Figure:
    """Minimum clearance at three speeds, with and without level 2; with the stepped servo and with an exact lag."""
    cases = [(stepped, level, speed) for stepped in (True, False) for level in (1, 2) for speed in SPEEDS]
    tracks = dict(zip(cases, runner([Job(_scenario(*case), _track) for case in cases]), strict=True))
    least = {case: float(_clearance(track).min()) for case, track in tracks.items()}
    rows: list[Row] = []
    for level, expected in ((1, ALONE), (2, LIMITED)):
        for speed, clear in zip(SPEEDS, expected, strict=True):
            case = f"{NAMES[level]}, {speed:g} m/s: least clearance, m"
            rows.append(absolute(case, clear, least[True, level, speed], 0.02))
    for speed in SPEEDS:
        case = f"exact lag, {speed:g} m/s: least clearance, m"
        rows.append(at_most(f"{NAMES[1]}, {case}", CORE_M, least[False, 1, speed]))
        rows.append(at_least(f"{NAMES[2]}, {case}", CORE_M, least[False, 2, speed]))
    panels = [*(_from_above(tracks, level) for level in (1, 2)), _fast(tracks), _near(least)]
    return Figure("Past a pillar at 1, 2 and 3 m/s with a lag of 0.5 s", panels, rows)


def _scenario(stepped: bool, level: int, speed: float) -> dict[str, Any]:
    field = {"kind": "potential_field", "tang": 0.0, "max_speed": speed, "level": level}
    task = {"kind": TOWARDS, "direction": (1.0, 0.0), "speed": speed}
    agent: dict[str, Any] = {"kind": "vcmvsp.agents.avoidance.avoid:Avoid", "task": task, "avoidance": field}
    if stepped:
        agent = {"kind": f"{HERE}:ServoAgent", "agent": agent, "lag_s": LAG_S}
    vehicle = {
        "name": "uav",
        "kind": "point",
        "tau_s": 0.0 if stepped else LAG_S,
        "position": START,
        "sensors": {"scan": {"kind": "ring", "sigma_m": 0.0}},
        "agent": agent,
    }
    edge = 2.0 * HALF_M
    world = {"kind": "boxes", "boxes": [{"center": (0.0, 0.0, 2.0), "size": (edge, edge, 4.0)}]}
    duration_s = 15.0 / speed + (12.0 if level == 2 else 0.0)
    return scene("levels", duration_s, [vehicle], world=world, record={"period_s": RECORD_S})


def _track(result: Result) -> Array:
    """Position and speed at every recorded instant, (m, 3): x m, y m, m/s."""
    movement = motion(result.states)
    x, y = (movement.position[axis][:, 0] for axis in (0, 1))
    speed = np.hypot(np.gradient(x, RECORD_S), np.gradient(y, RECORD_S))
    return np.column_stack([x, y, speed])


def _clearance(track: Array) -> Array:
    """Distance to the pillar, (m,), m."""
    beyond = np.maximum(np.abs(track[:, :2]) - HALF_M, 0.0)
    return np.asarray(np.hypot(beyond[:, 0], beyond[:, 1]))


def _from_above(tracks: Mapping[Case, Array], level: int) -> Panel:
    around = np.linspace(0.0, math.tau, 401) + 1e-6  # no beam hits a corner of the pillar exactly
    cos, sin = np.cos(around), np.sin(around)
    lines = [
        Curve(HALF_M * np.array([-1, 1, 1, -1, -1]), HALF_M * np.array([-1, -1, 1, 1, -1]), "pillar"),
        Curve(HALF_M * np.sign(cos) + CORE_M * cos, HALF_M * np.sign(sin) + CORE_M * sin, "0.6 m from it", 0, "dotted"),
    ]
    for number, speed in enumerate(SPEEDS, 1):
        for stepped in (True, False):
            track = tracks[stepped, level, speed]
            x, y, _ = track[(track[:, 0] >= SHOWN[0]) & (track[:, 0] <= SHOWN[1])].T
            lines.append(Curve(x, y, f"{speed:g} m/s" if stepped else "", number, LAGS[stepped][1]))
    title = f"{NAMES[level][0].upper()}{NAMES[level][1:]} (dashed: exact lag)"
    return Panel(title, "x east [m]", "y north [m]", lines, equal=True, x_limits=(SHOWN[0], 6.0))


def _fast(tracks: Mapping[Case, Array]) -> Panel:
    lines = []
    for (stepped, level, speed), track in tracks.items():
        if stepped:
            way_m = _clearance(track)
            until = int(way_m.argmin()) + 1
            label = f"{speed:g} m/s, {NAMES[level]}"
            lines.append(Curve(way_m[:until], track[:until, 2], label, SPEEDS.index(speed) + 1, STYLES[level]))
    axes = ("distance to the pillar [m]", "speed [m/s]")
    return Panel("On the way there", *axes, lines, x_limits=(0.0, 5.0), y_limits=(0.0, 5.0))


def _near(least: Mapping[Case, float]) -> Panel:
    lines: list[Curve] = []
    for level, expected in ((1, ALONE), (2, LIMITED)):
        lines.append(Curve(np.array(SPEEDS), np.array(expected), f"{NAMES[level]}, expected", level, "hollow"))
        for stepped, (name, style) in LAGS.items():
            measured = np.array([least[stepped, level, speed] for speed in SPEEDS])
            lines.append(Curve(np.array(SPEEDS), measured, NAMES[level] + name, level, style))
    free = {"to be kept": CORE_M}
    return Panel("Least clearance", "speed [m/s]", "distance to the pillar [m]", lines, levels=free, y_limits=(0.0, 1.5))
