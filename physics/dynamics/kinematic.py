"""Vehicles without bodies, all at once: on the ground, in the air, external ones; firmware of robots with wheels."""

from collections.abc import Sequence
from math import copysign, inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import ExternalMotion
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array, Vec3, VehicleState
from vcmvsp.physics.dynamics.engine import BodyMotion, Engine, side_by_side, still
from vcmvsp.physics.dynamics.wind import Floats
from vcmvsp.physics.vehicles.models import DifferentialDrive, GroundVehicle, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.vehicles.station import FixedStation
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.world import rotations

_ARC_NS = 20_000_000  # longest arc while speeds change
AT_ONCE_S = 1e-300  # in place of a lag of 0, which would divide 0 by 0


class GroundEngine(Engine):
    """Moves n ground vehicles without bodies, by their `Servo`: speeds follow the command, poses follow from the speeds.

    Each speed s (v or w) obeys ``ds/dt = clip((c - s) / tau, -fall, rise)`` with c the command, clipped to the greatest speed.
    Between commands this has a closed form. Let e = |c - s| at the start, a the limit of that direction and
    knee = min(e, a tau): s first runs along a ramp for ``t1 = (e - knee) / a``, then decays, so that after t

        |c - s| = max(e - knee - a t, 0) + knee exp(-max(t - t1, 0) / tau)

    Speeds and their integrals, distance and turn, are therefore exact after an interval of any length. The pose is a chain of
    circular arcs (`cosim.frames.arc`) of at most 20 ms: exact at constant speeds, of second order while they change.
    Without ``sensed``, accelerations and turns of wheels are 0.
    """

    def __init__(
        self, models: Sequence[GroundVehicle], positions: Sequence[Vec3], headings: Sequence[float], *, sensed: bool = True
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
        # Simulated turns of wheels: half the track and the radius, for vehicles with wheels.
        self._half_track = 0.5 * np.array([getattr(model, "track_m", np.nan) for model in models])
        self._radius = np.array([getattr(model, "wheel_radius_m", np.nan) for model in models])
        self._now_ns = 0

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set the forward speed ``linear[0]``, m/s, and a yaw rate, rad/s."""
        v, (max_v, max_w) = linear[0], self._greatest[row]
        self._command_v[row] = v if -max_v < v < max_v else max(-max_v, min(v, max_v))
        self._command_w[row] = yaw_rate if -max_w < yaw_rate < max_w else max(-max_w, min(yaw_rate, max_w))

    def command_all(self, linear: Floats, yaw_rate: Floats) -> None:
        """`command` for all vehicles: speeds (n, 3) m/s and yaw rates (n,) rad/s."""
        most_v, most_w = np.array(self._greatest).T
        np.clip(linear[:, 0], -most_v, most_v, out=self._command_v)
        np.clip(yaw_rate, -most_w, most_w, out=self._command_w)

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""
        span_ns = to_ns - self._now_ns
        if span_ns <= 0:
            return
        self._now_ns, span_s = to_ns, span_ns / SECOND_NS
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
        is_single = ways.ndim == 2  # most often: sums cost more than they add up
        if self._sensed:
            self._driven += ways if is_single else ways.sum(axis=1)
        yaw = self._yaw + (turn if is_single else turn.cumsum(axis=0))
        half = 0.5 * turn
        size = np.maximum(np.abs(half), 1e-8)  # sin(h) / h is even, and 1 there to the last bit
        chord, direction = way * np.sin(size) / size, yaw - half
        east, north = chord * np.cos(direction), chord * np.sin(direction)
        self._x += east if is_single else east.sum(axis=0)
        self._y += north if is_single else north.sum(axis=0)
        self._yaw = yaw if is_single else yaw[-1]

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
    turned: Floats = (angle + np.pi) % (2.0 * np.pi) % (2.0 * np.pi)  # the first gives 2 pi, rounded, for a tiny negative angle
    return turned - np.pi


_YAW = 3
NO_COMMAND = "a station received a command to move: its agent must return None"


class AerialEngine(Engine):
    """Moves n vehicles in the air without bodies, in closed form. Quadrotors move as a `Point` without lag.

    In each of x, y, z and yaw a vehicle follows an ideal point q with a lag of time constant T: ``dv/dt = (dq/dt - v) / T``.
    The point moves at a constant rate u: without end for a velocity command, up to the way-point for a way-point. While u is
    constant,

        v(t) = u + (v(0) - u) exp(-t/T)        p(t) = p(0) + u t + (v(0) - u) T (1 - exp(-t/T))

    The lag keeps p + T v - q constant: if q starts from ``p + T v``, where the vehicle would come to rest, and stops at the
    way-point, the vehicle stops there, too.
    """

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

    def command_all(self, linear: Floats, yaw_rate: Floats) -> None:
        """`command` for all vehicles: velocities (n, 3) m/s, world, and yaw rates (n,) rad/s."""
        most, climb, turn = np.array(self._most).T
        level = np.hypot(linear[:, 0], linear[:, 1])
        share = np.minimum(1.0, most / np.where(level > 0.0, level, most))
        self._rate[:2] = linear[:, :2].T * share
        self._rate[2] = np.clip(linear[:, 2], -climb, climb)
        self._rate[_YAW] = np.clip(yaw_rate, -turn, turn)
        self._left_s[:] = inf

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


class StationEngine(Engine):
    """Stations, which keep their poses: positions (n, 3) m, headings (n,) rad."""

    def __init__(self, models: Sequence[FixedStation], positions: Sequence[Vec3], headings: Sequence[float]) -> None:
        self._motion = still(np.array(positions, float).reshape(-1, 3), np.array(headings, float))

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Refuse every velocity but 0."""
        if any((*linear, yaw_rate)):
            raise FederateError("physics", NO_COMMAND)

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Refuse a way-point."""
        raise FederateError("physics", NO_COMMAND)

    def read(self) -> BodyMotion:
        """Motion of every station: none."""
        return self._motion


_UNIT = 1e-3  # tolerance of the norm of a quaternion


class ExternalEngine(Engine):
    """External vehicles: their motion comes from outside (`cosim.federate.ExternalMotion`).

    Their states are requested once at every instant of a publication. In between they move straight at their last velocities
    and turn about the vertical, without effects of the simulation. ``vehicles`` are in the order of ``source.names``, with
    their poses before the first update.
    """

    def __init__(self, source: ExternalMotion, vehicles: Sequence[VehicleSpec]) -> None:
        self._source, self.names = source, tuple(spec.name for spec in vehicles)
        if self.names != tuple(source.names):
            raise ValueError(f"external vehicles of the source are {source.names}; the run needs {self.names}, in this order")
        positions = np.array([spec.start for spec in vehicles], float).reshape(-1, 3)
        self._motion = still(positions, np.array([spec.heading for spec in vehicles], float))
        self._yaw_rate = np.zeros(len(vehicles))  # rad/s, about the vertical
        self._updated_ns: int | None = None
        self._now_ns = 0

    def update(self, now_ns: int) -> None:
        """Request the states of this instant; no effect in a second call at the same instant."""
        if now_ns == self._updated_ns:
            return
        states = self._source.states(now_ns)
        self._check(now_ns, states)
        rows = [(*each.position, *each.velocity, *each.attitude, *each.angular_velocity) for each in states]
        position, velocity, attitude, spin = np.split(np.array(rows, float).reshape(-1, 13), (3, 6, 10), axis=1)
        acceleration = np.zeros_like(velocity)
        if self._updated_ns is not None:
            acceleration = (velocity - self._motion.velocity) / ((now_ns - self._updated_ns) / SECOND_NS)
        self._motion = BodyMotion(position, velocity, attitude, spin, acceleration, *self._motion[5:])
        self._yaw_rate = (rotations(attitude)[:, 2] * spin).sum(axis=1)
        self._updated_ns = now_ns

    def at(self, now_ns: int) -> tuple[BodyMotion, Array]:
        """Motion at a time since the last update, and yaw rates (n,) about the vertical, rad/s."""
        motion, span_s = self._motion, (now_ns - (self._updated_ns or 0)) / SECOND_NS
        if span_s == 0.0:
            return motion, self._yaw_rate  # to the last bit
        half = 0.5 * span_s * self._yaw_rate
        c, s = np.cos(half), np.sin(half)
        w, x, y, z = motion.attitude.T
        attitude = side_by_side(c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
        return motion._replace(position=motion.position + span_s * motion.velocity, attitude=attitude), self._yaw_rate

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""
        self._now_ns = to_ns

    def read(self) -> BodyMotion:
        """Motion now, without wheels: exactly the received states at the instant of an update."""
        return self.at(self._now_ns)[0]

    def _check(self, now_ns: int, states: Sequence[VehicleState]) -> None:
        at = f"at {now_ns / SECOND_NS:.9g} s"
        if len(states) != len(self.names):
            problem = f"{len(states)} states for {len(self.names)} external vehicles {at}"
            raise FederateError("physics", problem)
        for name, state in zip(self.names, states, strict=True):
            numbers = (*state.position, *state.velocity, *state.attitude, *state.angular_velocity)
            if not np.isfinite(numbers).all():
                raise FederateError("physics", f"the received state of {name} {at} is not finite: {state}")
            if not abs(float(np.linalg.norm(state.attitude)) - 1.0) < _UNIT:
                raise FederateError("physics", f"the attitude received for {name} {at} is no unit quaternion: {state.attitude}")


class Firmware:
    """Firmware of differential drives: moves the set points of (v, w) towards commands, a cycle at a time.

    Plain numbers in lists, and only rows with changing set points: such a row costs 0.5 us a cycle, a steady fleet nothing.
    """

    def __init__(self, models: Sequence[DifferentialDrive | UrdfDrive]) -> None:
        self._models = models
        self._command = [(0.0, 0.0)] * len(models)
        self._set = [(0.0, 0.0)] * len(models)
        self._ramping: list[int] = []  # rows with set points away from the command

    def command(self, row: int, v: float, w: float) -> None:
        """Set the target of the set points, m/s and rad/s, within the greatest speeds."""
        max_v, max_w = self._models[row].max_speed, self._models[row].max_yaw_rate
        self._command[row] = max(-max_v, min(v, max_v)), max(-max_w, min(w, max_w))
        if row not in self._ramping:
            self._ramping.append(row)

    def cycle(self, dt: float) -> list[tuple[int, float, float]]:
        """One cycle of ``dt`` s: rows with changed set points, and these (v m/s, w rad/s)."""
        if not self._ramping:
            return []
        changed, ramping = [], []
        for row in self._ramping:
            model, (v, w), target = self._models[row], self._set[row], self._command[row]
            turn = model.yaw_accel * dt
            new = _towards(v, target[0], model.accel * dt, model.decel * dt), _towards(w, target[1], turn, turn)
            if new != (v, w):
                self._set[row] = new
                changed.append((row, *new))
            if new != target:
                ramping.append(row)
        self._ramping = ramping
        return changed


def _towards(speed: float, target: float, up: float, down: float) -> float:
    """The speed after a cycle: at most ``up`` away from standstill or ``down`` towards it, and never past standstill."""
    if speed * target < 0.0:
        target = 0.0
    change = target - speed
    most = down if abs(target) < abs(speed) else up
    return target if abs(change) <= most else speed + copysign(most, change)
