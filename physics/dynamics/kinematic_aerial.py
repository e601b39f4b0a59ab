"""Vehicles in the air without bodies, all at once, in closed form: exact after an interval of any length.

In each of x, y, z and yaw a vehicle follows an ideal point q with a lag of time constant T: ``dv/dt = (dq/dt - v) / T``. The
point moves at a constant rate u: without end for a velocity command, up to the way-point for a way-point. While u is constant,

    v(t) = u + (v(0) - u) exp(-t/T)        p(t) = p(0) + u t + (v(0) - u) T (1 - exp(-t/T))

The lag keeps p + T v - q constant: if q starts from ``p + T v``, where the vehicle comes to rest by itself, and stops at the
way-point, then the vehicle stops there, too.
"""

from collections.abc import Sequence
from math import inf

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.kinematic_ground import AT_ONCE_S
from vcmvsp.physics.dynamics.rigid_body import Floats
from vcmvsp.physics.engine.interface import Bodiless, BodyMotion, still
from vcmvsp.physics.vehicles.models import Point
from vcmvsp.physics.vehicles.quadrotor import Quadrotor

_YAW = 3


class AerialEngine(Bodiless):
    """Moves n vehicles in the air without bodies. Quadrotors move as a `Point` without lag."""

    def __init__(self, models: Sequence[Point | Quadrotor], positions: Sequence[Vec3], headings: Sequence[float]) -> None:
        n = len(models)
        self._tau = np.array([max(getattr(model, "tau_s", 0.0), AT_ONCE_S) for model in models])
        self._most = [(model.max_speed, model.max_climb, model.max_yaw_rate) for model in models]
        # Rows: x, y, z, yaw.
        self._place = np.column_stack([np.array(positions, float).reshape(n, 3), headings]).T.copy()
        self._speed, self._rate = np.zeros((4, n)), np.zeros((4, n))
        self._left_s = np.full((4, n), inf)  # how long the ideal point still moves
        self._now_ns = 0

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, world, and a yaw rate, rad/s."""
        (x, y, z), (most, climb, turn) = linear, self._most[row]
        share = min(1.0, most / level) if (level := float(np.hypot(x, y))) > 0.0 else 1.0
        self._rate[:, row] = x * share, y * share, max(-climb, min(z, climb)), max(-turn, min(yaw_rate, turn))
        self._left_s[:, row] = inf

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly straight to a position, m, turn to ``yaw``, rad, the shorter way, and stay there."""
        most, climb, turn = self._most[row]
        rest = self._place[:, row] + self._tau[row] * self._speed[:, row]
        way = np.array(position) - rest[:3]
        level, up = float(np.hypot(way[0], way[1])), abs(float(way[2]))
        needed_s = max(level / most, up / climb, float(np.hypot(level, up)) / (speed or inf))
        angle = wrap(yaw - rest[_YAW]) if yaw is not None else 0.0
        needed = np.array([needed_s, needed_s, needed_s, abs(angle) / turn])
        self._rate[:, row] = np.array([*way, angle]) / np.maximum(needed, AT_ONCE_S)
        self._left_s[:, row] = needed

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""
        span_s = (to_ns - self._now_ns) / SECOND_NS
        if span_s <= 0.0:
            return
        self._now_ns = to_ns
        moving = np.minimum(self._left_s, span_s)
        self._left_s -= moving
        self._glide(self._rate, moving)
        self._rate = np.where(self._left_s > 0.0, self._rate, 0.0)
        self._glide(0.0, span_s - moving)

    def _glide(self, rate: Floats | float, span_s: Floats) -> None:
        """Follow a point that moves at constant rates (4, n), for spans (4, n) s."""
        fading, rest = np.exp(-span_s / self._tau), self._speed - rate
        self._place += rate * span_s + rest * (self._tau * (1.0 - fading))
        self._speed = np.where(span_s > 0.0, rate + rest * fading, self._speed)

    def read(self) -> BodyMotion:
        """Motion of every vehicle: level, without wheels."""
        gain = np.where(self._tau > AT_ONCE_S, (self._rate - self._speed) / self._tau, 0.0)
        turning = np.zeros((self._place.shape[1], 3))
        turning[:, 2] = self._speed[_YAW]
        return still(self._place[:3].T.copy(), self._place[_YAW])._replace(
            velocity=self._speed[:3].T.copy(), angular_velocity=turning, acceleration=gain[:3].T.copy()
        )
