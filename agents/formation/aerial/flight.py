"""What leaders and followers in the air have in common: motion in all directions, and the reports of it.

On wheels a vehicle moves where it heads, and a pose with two speeds says all. In the air it moves in any direction, whatever
its heading: reports hold ``vx vy vz z`` besides the standard keys, whose ``v`` is then the speed along the heading. So a
vehicle on wheels may follow one in the air that flies where it heads, and one in the air may follow any vehicle on wheels.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.report import PLAUSIBLE, LeaderState, Report
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Vec3

GAIN = 0.8  # 1/s, speed towards a point for each metre
YAW_GAIN = 1.0  # 1/s, yaw rate for each rad that the heading is off
KEYS = ("vx", "vy", "vz", "z")


class Flight(NamedTuple):
    """Where a vehicle that is followed is now, and how it moves, as far as its report tells."""

    position: Vec3  # m, world; of one on wheels z is 0
    velocity: Vec3  # m/s, world
    yaw: float  # rad
    yaw_rate: float  # rad/s


class Airborne:
    """An estimator for all that is reported: of a vehicle in the air it moves each coordinate by its own speed.

    How far an old speed is trusted is the matter of the estimator inside; of a vehicle on wheels it makes all of the estimate.
    There is no ``acc`` and no ``plan`` in the air: they reckon as ``dr``.
    """

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """Seen from above, for those that look at nothing else."""
        if _aloft(report.body) is None:
            return self.inner.predict(report, age_s)
        (x, y, _), velocity, yaw, w = self.flight(report, age_s)
        return LeaderState(x, y, yaw, along(velocity, yaw), w)

    def flight(self, report: Report, age_s: float) -> Flight:
        """The state of the sender ``age_s`` seconds (>= 0) after the report was valid."""
        aloft = _aloft(report.body)
        if aloft is None:
            x, y, yaw, v, w = self.inner.predict(report, age_s)
            return Flight((x, y, 0.0), (v * math.cos(yaw), v * math.sin(yaw), 0.0), yaw, w)
        # What becomes of one who reports 1 m/s along x says for how many seconds speeds last, and what is left of them.
        unit = Report(report.t_ns, LeaderState(0.0, 0.0, 0.0, 1.0, 0.0), {})
        lasted_s, _, _, left, _ = self.inner.predict(unit, age_s)
        (x, y, yaw, _, w), (vx, vy, vz, z) = report.state, aloft
        place = (x + vx * lasted_s, y + vy * lasted_s, z + vz * lasted_s)
        return Flight(place, (vx * left, vy * left, vz * left), wrap(yaw + w * lasted_s), w * left)


def check_flies(info: VehicleInfo) -> None:
    """Refuse a vehicle on wheels: it would take a velocity in the world for one ahead and aside.

    Raises:
        ValueError: it does not fly.
    """
    if info.body is not None and not info.body.flies:
        raise ValueError(f"{info.name} drives on wheels, but this agent is for vehicles that fly (point, quadrotor)")


def told(obs: Observation, velocity: Vec3) -> dict[str, float]:
    """What a report holds besides the standard keys of a vehicle that moves at ``velocity`` m/s, world."""
    return dict(zip(KEYS, (*velocity, obs.state.position[2]), strict=True))


def along(velocity: Vec3, yaw: float) -> float:
    """The part of a velocity in the direction of a heading, m/s."""
    return velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw)


def limited(velocity: Vec3, most: float) -> Vec3:
    """The same direction, at ``most`` m/s at most."""
    share = most / speed if (speed := math.hypot(*velocity)) > most else 1.0
    return velocity[0] * share, velocity[1] * share, velocity[2] * share


def _aloft(body: Mapping[str, Any]) -> tuple[float, float, float, float] | None:
    """Velocity and height in a report; None where it does not say, or says nonsense."""
    try:
        vx, vy, vz, z = (body[key] for key in KEYS)
        return (vx, vy, vz, z) if abs(vx) + abs(vy) + abs(vz) + abs(z) < PLAUSIBLE else None
    except (KeyError, TypeError):
        return None
