"""Motion and reports of aerial leaders and followers.

A ground vehicle moves along its heading, so a pose and two speeds describe it. An aerial vehicle moves in any direction:
its reports also hold ``vx vy vz z``; their ``v`` is the speed along the heading. So a ground vehicle can follow an aerial one
that flies along its heading, and an aerial vehicle can follow any ground vehicle.
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
    """Estimated state of a reporting vehicle."""

    position: Vec3  # m, world; of one on wheels z is 0
    velocity: Vec3  # m/s, world
    yaw: float  # rad
    yaw_rate: float  # rad/s


class Airborne:
    """Estimator for ground and aerial senders: moves each coordinate of an aerial one by its own speed.

    The inner estimator sets how long an old speed counts; for a ground sender it makes the whole estimate. ``acc`` and ``plan``
    do not exist in the air: they act as ``dr``.
    """

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The state seen from above."""
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
        # A unit report of 1 m/s along x gives the time that speeds last and their remaining share.
        unit = Report(report.t_ns, LeaderState(0.0, 0.0, 0.0, 1.0, 0.0), {})
        lasted_s, _, _, left, _ = self.inner.predict(unit, age_s)
        (x, y, yaw, _, w), (vx, vy, vz, z) = report.state, aloft
        place = (x + vx * lasted_s, y + vy * lasted_s, z + vz * lasted_s)
        return Flight(place, (vx * left, vy * left, vz * left), wrap(yaw + w * lasted_s), w * left)


def check_flies(info: VehicleInfo) -> None:
    """Reject (ValueError) a vehicle on wheels, which would take a world velocity for a body velocity."""
    if info.body is not None and not info.body.flies:
        raise ValueError(f"{info.name} drives on wheels, but this agent is for vehicles that fly (point, quadrotor)")


def told(obs: Observation, velocity: Vec3) -> dict[str, float]:
    """Additional keys of a report for a vehicle that moves at ``velocity`` m/s, world."""
    return dict(zip(KEYS, (*velocity, obs.state.position[2]), strict=True))


def along(velocity: Vec3, yaw: float) -> float:
    """Component of a velocity along a heading, m/s."""
    return velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw)


def limited(velocity: Vec3, most: float) -> Vec3:
    """The velocity, reduced to ``most`` m/s at most."""
    share = most / speed if (speed := math.hypot(*velocity)) > most else 1.0
    return velocity[0] * share, velocity[1] * share, velocity[2] * share


def _aloft(body: Mapping[str, Any]) -> tuple[float, float, float, float] | None:
    try:
        vx, vy, vz, z = (body[key] for key in KEYS)
        return (vx, vy, vz, z) if abs(vx) + abs(vy) + abs(vz) + abs(z) < PLAUSIBLE else None
    except (KeyError, TypeError):
        return None
