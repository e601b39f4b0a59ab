"""Ground vehicles without bodies, all at once: speeds that follow the command, poses from the speeds.

Each speed s (v or w) obeys ``ds/dt = clip((c - s) / tau, -fall, rise)`` with c the command, clipped to the greatest speed.
Between commands this has a closed form. Let e = |c - s| at the start, a the limit of that direction and knee = min(e, a tau):
s first runs along a ramp for ``t1 = (e - knee) / a``, then decays, so that after t

    |c - s| = max(e - knee - a t, 0) + knee exp(-max(t - t1, 0) / tau)

Speeds and their integrals, distance and turn, are therefore exact after an interval of any length. The pose is a chain of
circular arcs (`cosim.frames.arc`) of at most 20 ms: exact at constant speeds, of second order while they change.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.rigid_body import Floats
from vcmvsp.physics.engine.interface import Bodiless, BodyMotion, side_by_side
from vcmvsp.physics.vehicles.models import GroundVehicle

_ARC_NS = 20_000_000  # longest arc while speeds change
AT_ONCE_S = 1e-300  # in place of a lag of 0, which would divide 0 by 0


class GroundEngine(Bodiless):
    """Moves n ground vehicles without bodies, by their `Servo`.

    Args:
        models: of the vehicles.
        positions: at the start, m, world.
        headings: at the start, rad.
        sensed: whether sensors need accelerations and wheels; else these are 0.
    """

    def __init__(
        self,
        models: Sequence[GroundVehicle],
        positions: Sequence[Vec3],
        headings: Sequence[float],
        *,
        sensed: bool = True,
    ) -> None:
        n = len(models)
        self._sensed = sensed
        servos = np.array([model.servo for model in models], float).reshape(n, 7).T
        tau_v, tau_w, accel, decel, yaw_accel, max_speed, max_yaw_rate = servos
        # All of these are (2, 1, n): v and w; times; vehicles.
        self._tau = np.maximum([[tau_v], [tau_w]], AT_ONCE_S)
        self._rise, self._fall = np.array([[accel], [yaw_accel]]), np.array([[decel], [yaw_accel]])
        self._greatest: list[tuple[float, float]] = [*zip(max_speed.tolist(), max_yaw_rate.tolist(), strict=True)]
        self._speed, self._command = np.zeros((2, 1, n)), np.zeros((2, 1, n))
        self._command_v, self._command_w = self._command[:, 0]  # views of it
        self._unsensed = np.zeros((n, 3)), np.zeros((n, 2))  # accelerations and wheels without sensors
        self._ideal = bool((self._tau == AT_ONCE_S).all() and np.isinf([self._rise, self._fall]).all())
        at = np.array(positions, float).reshape(n, 3)
        # From 0.0 on, never -0.0: then sums of one arc and of many have the same bits.
        self._x, self._y, self._yaw = at[:, 0] + 0.0, at[:, 1] + 0.0, np.array(headings, float)
        self._driven = np.zeros((2, n))  # since the start, m and rad
        # Wheels as they would turn: half the track and the radius, where there are any.
        self._half_track = 0.5 * np.array([getattr(model, "track_m", np.nan) for model in models])
        self._radius = np.array([getattr(model, "wheel_radius_m", np.nan) for model in models])
        self._now_ns = 0

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set the forward speed ``linear[0]``, m/s, and a yaw rate, rad/s."""
        v, (max_v, max_w) = linear[0], self._greatest[row]
        self._command_v[row] = v if -max_v < v < max_v else max(-max_v, min(v, max_v))
        self._command_w[row] = yaw_rate if -max_w < yaw_rate < max_w else max(-max_w, min(yaw_rate, max_w))

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Ground vehicles do not fly."""
        raise NotImplementedError

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""
        span_ns = to_ns - self._now_ns
        if span_ns <= 0:
            return
        self._now_ns = to_ns
        span_s = span_ns / SECOND_NS
        if self._ideal:
            np.copyto(self._speed, self._command)
            self._follow(self._speed[:, 0] * span_s)
        else:
            arcs = -(-span_ns // _ARC_NS)
            ways = self._drive(np.arange(1, arcs + 1)[:, None] * (span_s / arcs))
            ways[:, 1:] -= ways[:, :-1].copy()
            self._follow(ways) if arcs > 1 else self._follow(ways[:, 0])

    def _drive(self, t: NDArray[Any]) -> Floats:
        """Drive up to the last of the times t (arcs, 1), s from now; returns distances and turns (2, arcs, n), m and rad."""
        error = self._command - self._speed
        limit = np.where(error > 0.0, self._rise, self._fall)
        size = np.abs(error)
        knee = np.minimum(size, limit * self._tau)
        ramp = size - knee
        on_ramp = np.minimum(t, ramp / limit)
        ramp_left = np.maximum(ramp - limit * t, 0.0)
        decay = np.exp((on_ramp - t) / self._tau)
        missed = 0.5 * on_ramp * (ramp + ramp_left) + knee * (on_ramp + self._tau * (1.0 - decay))
        rest = ramp_left[:, -1:] + knee * decay[:, -1:]
        sign = np.sign(error)
        ways: Floats = self._command * t - sign * missed
        self._speed = self._command - sign * rest
        return ways

    def _follow(self, ways: Floats) -> None:
        """Append arcs to every pose: distances and turns (2, arcs, n), or (2, n) for one arc, m and rad."""
        way, turn = ways
        one = ways.ndim == 2  # most often: sums cost more than they add up
        if self._sensed:
            self._driven += ways if one else ways.sum(axis=1)
        yaw = self._yaw + (turn if one else turn.cumsum(axis=0))
        half = 0.5 * turn
        size = np.maximum(np.abs(half), 1e-8)  # sin(h) / h is even, and 1 there to the last bit
        chord, direction = way * np.sin(size) / size, yaw - half
        east, north = chord * np.cos(direction), chord * np.sin(direction)
        self._x += east if one else east.sum(axis=0)
        self._y += north if one else north.sum(axis=0)
        self._yaw = yaw if one else yaw[-1]

    def read(self) -> BodyMotion:
        """Motion of every vehicle, with exact wheel odometry."""
        yaw, (v, w), n = self._yaw, self._speed[:, 0], len(self._yaw)
        half = 0.5 * yaw
        half_cos, half_sin = np.cos(half), np.sin(half)
        cos, sin = half_cos * half_cos - half_sin * half_sin, (half_cos + half_cos) * half_sin
        position, velocity, attitude, turning = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, 3))
        position[:, 0], position[:, 1] = self._x, self._y
        np.multiply(v, cos, velocity[:, 0])
        np.multiply(v, sin, velocity[:, 1])
        attitude[:, 0], attitude[:, 3] = half_cos, half_sin
        turning[:, 2] = w
        odometry = np.array((self._x, self._y, wrapped(yaw), v, w)).T
        acceleration, wheels = self._felt(v, w, cos, sin) if self._sensed else self._unsensed
        return BodyMotion(position, velocity, attitude, turning, acceleration, wheels, odometry)

    def _felt(self, v: Floats, w: Floats, cos: Floats, sin: Floats) -> tuple[Floats, Floats]:
        """Accelerations (n, 3) m/s2, world, and turns of the wheels (n, 2) rad, for sensors.

        From speeds v m/s and w rad/s, and cosine and sine of the heading, all (n,).
        """
        gain, spin = np.zeros_like(v) if self._ideal else self._gain(), v * w
        across = self._half_track * self._driven[1]
        acceleration = side_by_side(gain * cos - spin * sin, gain * sin + spin * cos, np.zeros_like(v))
        wheels = side_by_side(self._driven[0] - across, self._driven[0] + across) / self._radius[:, None]
        return acceleration, wheels

    def _gain(self) -> Floats:
        """Forward acceleration, m/s2; 0 at a jump, with neither lag nor limit."""
        (tau,), (rise,), (fall,) = self._tau[0], self._rise[0], self._fall[0]
        gain = (self._command[0, 0] - self._speed[0, 0]) / tau
        jumps = (tau == AT_ONCE_S) & np.isinf(np.where(gain > 0.0, rise, fall))
        return np.where(jumps, 0.0, np.clip(gain, -fall, rise))


def wrapped(angle: Floats) -> Floats:
    """Angles in [-pi, pi), as `cosim.frames.wrap`."""
    turned: Floats = (angle + np.pi) % (2.0 * np.pi) % (2.0 * np.pi)  # of a tiny negative angle the first is 2 pi, rounded
    return turned - np.pi
