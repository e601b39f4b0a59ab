"""A way-point as a velocity, for agents that must avoid obstacles on the way."""

import math

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Velocity, Waypoint

ARRIVAL = 0.8  # 1/s: towards a way-point no faster than this times the way that is left
TURN_GAIN, TURN = 1.0, 1.0  # 1/s, rad/s: towards the heading of a way-point


def velocity_to(obs: Observation, waypoint: Waypoint, speed: float) -> Velocity:
    """The velocity, world, that leads straight to a way-point, at its speed or else at ``speed``, m/s."""
    x, y, z = (to - at for to, at in zip(waypoint.position, obs.state.position, strict=True))
    away = math.hypot(x, y, z)
    share = min(ARRIVAL, (waypoint.speed or speed) / away) if away > 0.0 else 0.0
    turn = 0.0 if waypoint.yaw is None else TURN_GAIN * wrap(waypoint.yaw - obs.state.yaw)
    return Velocity(linear=(share * x, share * y, share * z), yaw_rate=max(-TURN, min(turn, TURN)))
