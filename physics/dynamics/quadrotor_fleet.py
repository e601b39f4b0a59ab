"""A fleet of quadrotors in flight: autopilots, rotors, air and rigid bodies, all at once.

A step is `QuadrotorFleet.wrench`, then `QuadrotorFleet.integrate` for vehicles in free air; for vehicles in contact an engine
writes their states into the fleet's arrays. `integrate` is the semi-implicit Euler method of Bullet for a free body, so a
vehicle may change over at any step:

    rate += dt J^-1 (torque - rate x J rate)      velocity += dt (force / m + g)      position += dt velocity
    attitude = attitude exp(dt rate / 2)

(All in the body's frame, where the new rate is the same before and after the rotation about it. Bullet also cuts rates to
100 rad/s and turns to 45 degrees a step, which quadrotors do not reach.)

Rotor speeds follow the autopilot with a first-order lag; thrust and drag torque grow with their squares. The air adds a force
of ``drag`` times the airspeed along each axis of the body. Gyroscopic torques of the rotors are left out.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.physics.dynamics.rigid_body import (
    Floats,
    column,
    columns,
    coupled,
    gyration,
    into_body,
    precession,
    rotations,
    turned,
)
from vcmvsp.physics.dynamics.wind import rotorwash_of
from vcmvsp.physics.vehicles.models import Quadrotor


class QuadrotorFleet:
    """n quadrotors, a row each; without commands they hover.

    The state may be read, and written in place, between steps:

    - ``position`` (n, 3) m and ``velocity`` (n, 3) m/s, world, of the centres of mass;
    - ``attitude`` (n, 4) w, x, y, z; world_from_body; unit norm;
    - ``rate`` (n, 3) rad/s, body;
    - ``rotor`` (n, 4) rad/s: front, left, back, right.

    They start at ``positions`` (n, 3) m, world, with ``headings`` (n,) rad.
    """

    def __init__(self, models: Sequence[Quadrotor], positions: Any, headings: Any, gravity: float = 9.81) -> None:
        n = len(models)
        for model in models:
            model.check_lift(gravity)
        self._pilot = Autopilot(models, headings, gravity)
        self._gravity, self._mass = gravity, column(models, "mass_kg")
        inertia = columns([model.inertia for model in models], 3)
        self._flexibility, self._gyration = 1.0 / inertia, gyration(inertia)
        self._thrust_factor, self._lag_s = column(models, "thrust_factor"), column(models, "motor_lag_s")
        self._arm, self._yaw_arm = column(models, "arm_m"), column(models, "torque_factor") / self._thrust_factor
        self._resistance = -columns([model.drag for model in models], 3)
        self._follow, self._step_s = np.zeros(n), 0.0  # share of the rotors' lag that a step makes up for
        self._wash = rotorwash_of(models)
        self._rotation: Floats | None = None  # of this step, after `wrench`

        # A column for each vehicle, so that NumPy works on rows that lie together.
        self._state = np.zeros((13, n))
        self._position, self._velocity, self._attitude, self._rate = np.split(self._state, (3, 6, 10))
        self._position[:] = columns(positions, 3)
        half = 0.5 * np.array(headings, float).reshape(n)
        self._attitude[0], self._attitude[3] = np.cos(half), np.sin(half)
        self._rotor = np.tile(np.sqrt(0.25 * self._mass * gravity / self._thrust_factor), (4, 1))
        self.position, self.velocity, self.attitude = self._position.T, self._velocity.T, self._attitude.T
        self.rate, self.rotor = self._rate.T, self._rotor.T

    def set_velocity(self, row: int, linear: Sequence[float], yaw_rate: float) -> None:
        """Set a velocity and a yaw rate, see `Autopilot.set_velocity`."""
        self._pilot.set_velocity(row, linear, yaw_rate)

    def set_waypoint(self, row: int, position: Sequence[float], yaw: float | None = None, speed: float | None = None) -> None:
        """Set a way-point, see `Autopilot.set_waypoint`."""
        self._pilot.set_waypoint(row, position, yaw, speed)

    def wrench(self, dt: float, wind: Any) -> tuple[Floats, Floats]:
        """Advance autopilots and rotors of all vehicles by ``dt`` s, once a step; wind (n, 3) m/s, world.

        Returns:
            Force on the centre of mass (n, 3) N without gravity, and torque (n, 3) N m, both in the world frame.
        """
        rotation = self._rotation = rotations(self._attitude)
        rotor = self._rotor
        if dt != self._step_s:
            self._follow, self._step_s = -np.expm1(-dt / self._lag_s), dt
        desired = self._pilot.rotor_speeds(dt, self._position, self._velocity, rotation, self._rate)
        rotor += self._follow * (desired - rotor)
        thrust = self._thrust_factor * rotor * rotor
        air = self._velocity - wind.T
        if self._wash is not None:
            self._wash.act(self._position, thrust, air)
        pairs, differences = thrust[:2] + thrust[2:], thrust[:2] - thrust[2:]
        body = np.empty((3, 2, len(self._mass)))
        np.multiply(self._resistance, into_body(rotation, air), out=body[:, 0])
        body[2, 0] += pairs[0] + pairs[1]
        np.multiply(self._arm, differences[1], out=body[0, 1])
        np.multiply(-self._arm, differences[0], out=body[1, 1])
        np.multiply(self._yaw_arm, pairs[1] - pairs[0], out=body[2, 1])
        body[:, 1] += precession(self._rate, body[:, 1], self._flexibility, self._gyration, dt)
        terms = rotation[:, :, None] * body
        world = terms[:, 0] + terms[:, 1] + terms[:, 2]
        return world[:, 0].T, world[:, 1].T

    def integrate(self, force: Any, torque: Any, dt: float) -> None:
        """Move all as free bodies by ``dt`` s under gravity, a force (n, 3) N and a torque (n, 3) N m, both world.

        After `wrench` in the same step, attitudes must not have changed.
        """
        rotation = rotations(self._attitude) if self._rotation is None else self._rotation
        self._rotation = None
        torque = into_body(rotation, torque.T)
        rate = self._rate + self._flexibility * (dt * (torque - self._gyration * coupled(self._rate)))
        velocity = self._velocity + force.T * (dt / self._mass)
        velocity[2] -= self._gravity * dt
        after = (self._position + velocity * dt, velocity, turned(self._attitude, rate, dt), rate)
        np.concatenate(after, out=self._state)


LOOP_HZ = 60.0  # of way-points and velocities; slower where steps are longer

_EARLY_S = 1e-9  # of rounding, where steps add up to a period
_LEAST_GRAVITY = 1e-9  # m/s2, assumed without gravity: the direction up must exist
_LEAST_LIFT = 0.2  # of the weight, at any rate of descent
_LEAST_TRIM, _MOST_TRIM = -0.3, 0.6  # of gravity: limits of the integral's vertical part, which must not prevent a take-off
_LEASH_RAD = 0.5  # greatest lead of the desired heading over the heading
_YAW_RESERVE = 0.1  # of the greatest thrust of a rotor
_UPRIGHT = 0.5  # cosine of the tilt from which turning upright has priority over lift
_OVERHEAD = 1e-4  # 1 + the cosine at which it counts as upside down
_TINY = 1e-12

# Signs of front, left, back and right for yaw, and for the pairs right to left and front to back.
_YAW_SIGN = np.array([-1.0, 1.0, -1.0, 1.0])[:, None]
_PAIR, _PAIR_SIGN = np.array([1, 0, 1, 0]), np.array([-1.0, 1.0, 1.0, -1.0])[:, None]


class Autopilot:
    """Autopilots of n quadrotors at once: from commands to rotor speeds.

    A cascade, from the outside inwards:

    1. Way-point (60 Hz): a velocity straight towards the way-point, from which braking stops there: proportional to the
       distance d close to it, sqrt(2 a (d - d0)) further away, with d0 such that both have the same slope where they meet.
    2. Velocity (60 Hz): a PI law demands an acceleration, which the limits of thrust and then of tilt cut. The integral takes
       the error against the answer of the proportional law alone, so that steps do not overshoot; it stands still while tilt is
       at its limit (conditional integration: Astrom and Hagglund, "PID Controllers", 3.5) and has limits of its own. With
       gravity added, the direction of the acceleration is the desired thrust axis, its vertical part the lift.
    3. Attitude (every step): a rate about the axis of the shortest rotation from the thrust axis to the desired one,
       2 k sin(a/2) for its angle a: the law of Brescianini, Hehn and D'Andrea, "Nonlinear quadrocopter attitude control" (ETH
       Zurich 2013). It is strongest upside down, where the usual error vee(Rd' R - R' Rd)/2 = sin a vanishes. Heading has a
       weaker loop of its own, since tilt matters more (Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude
       control", 2020).
    4. Rates (every step): torque = J k (desired - rate) + rate x J rate.
    5. Mixer (every step): the thrust of each rotor. Forward takes more behind, left more on the right (Toh 2012, 2.5.4 has both
       the other way round). Under saturation, roll and pitch get their share first, then lift, then yaw; a tenth is reserved
       for yaw, since a spinning quadrotor cannot turn upright.

    Arrays have a column for each vehicle, (3, n); small arrays: the number of NumPy calls is the cost.
    """

    def __init__(self, models: Sequence[Quadrotor], headings: Any, gravity: float) -> None:
        n = len(models)
        self._gravity = gravity = max(gravity, _LEAST_GRAVITY)
        self._mass, self._max_speed = column(models, "mass_kg"), column(models, "max_speed")
        self._max_climb, self._max_yaw_rate = column(models, "max_climb"), column(models, "max_yaw_rate")
        limits = self._max_speed, self._max_climb, self._max_yaw_rate
        self._limits = list(zip(*(each.tolist() for each in limits), strict=True))
        self._position_gain, self._braking = column(models, "position_gain"), column(models, "braking")
        self._gain_squared = self._position_gain**2
        self._knee = self._braking / self._gain_squared  # m, distance at which the braking law begins
        self._velocity_gain, self._integral = column(models, "velocity_gain"), column(models, "velocity_integral")
        self._tan_tilt = np.tan(column(models, "max_tilt_rad"))
        self._sideways = gravity * self._tan_tilt  # m/s2, at the greatest tilt with constant height
        self._most = np.array([model.max_rotor_thrust for model in models])  # N
        self._most_up = column(models, "max_thrust") * 4.0 * self._most / self._mass  # m/s2, with gravity
        self._most_up_squared, self._least_up = self._most_up**2, np.full(n, _LEAST_LIFT * gravity)
        self._most_trim = np.array([self._sideways, self._sideways, np.full(n, _MOST_TRIM * gravity)])
        self._least_trim = np.array([-self._sideways, -self._sideways, np.full(n, _LEAST_TRIM * gravity)])
        self._attitude_gain, self._yaw_gain = column(models, "attitude_gain"), column(models, "yaw_gain")
        inertia = columns([model.inertia for model in models], 3)
        rate_gain = column(models, "rate_gain")
        self._stiffness = inertia * np.array([rate_gain, rate_gain, column(models, "yaw_rate_gain")])
        self._gyration = gyration(inertia)
        arm, factor = column(models, "arm_m"), column(models, "thrust_factor")
        yaw_arm = column(models, "torque_factor") / factor
        self._rotor_share = np.array([0.5 / arm, 0.5 / arm, 0.25 / yaw_arm])  # 1/m
        self._per_newton = 1.0 / factor
        self._yaw_reserve = _YAW_RESERVE * self._most
        self._most_pair = 0.5 * self._most - self._yaw_reserve

        self._velocity, self._place = np.zeros((3, n)), np.zeros((3, n))
        self._speed = self._max_speed.copy()
        self._to_place, self._any_place = np.zeros(n, bool), False
        self._yaw_rate, self._yaw = np.zeros(n), np.array(headings, float).reshape(n)  # rad/s; rad, at the way-point
        self._heading = self._yaw.copy()  # rad, desired now
        self._trim, self._reference = np.zeros((3, n)), np.zeros((3, n))  # m/s2, the integral; m/s, see _expected
        self._elapsed_s = 1.0 / LOOP_HZ  # since the last run of the outer loops: they are due at once
        # Outputs of the outer loops for the inner ones.
        self._axis, self._lift = np.zeros((3, n)), self._mass * gravity
        self._axis[2] = 1.0
        self._turn, self._cos, self._sin = np.zeros(n), np.cos(self._heading), np.sin(self._heading)

    def set_velocity(self, row: int, linear: Sequence[float], yaw_rate: float) -> None:
        """Set a velocity, m/s, world, and a yaw rate, rad/s, both within the vehicle's limits."""
        x, y, z = linear
        most, climb, turn = self._limits[row]
        scale = min(1.0, most / max(math.hypot(x, y), _TINY))
        self._velocity[:, row] = x * scale, y * scale, max(-climb, min(z, climb))
        self._yaw_rate[row] = max(-turn, min(yaw_rate, turn))
        if self._to_place[row]:
            self._to_place[row] = False
            self._any_place = bool(self._to_place.any())

    def set_waypoint(self, row: int, position: Sequence[float], yaw: float | None, speed: float | None) -> None:
        """Set a way-point, m, with ``yaw``, rad (None: the present one), and ``speed``, m/s, at most (None: the vehicle's)."""
        self._place[:, row] = position
        self._yaw[row] = self._heading[row] if yaw is None else yaw
        self._speed[row] = self._max_speed[row] if speed is None else min(speed, self._max_speed[row])
        self._to_place[row] = self._any_place = True

    def rotor_speeds(self, dt: float, position: Floats, velocity: Floats, rotation: Floats, rate: Floats) -> Floats:
        """Rotor speeds for the next ``dt`` s, (4, n) rad/s: front, left, back, right.

        Position and velocity (3, n), world; rotation (3, 3, n), world_from_body; rate (3, n) rad/s, body.
        """
        if self._elapsed_s > 1.0 / LOOP_HZ - _EARLY_S:
            self._guide(position, velocity, rotation, self._elapsed_s)
            self._elapsed_s = 0.0
        self._elapsed_s += dt
        return self._steer(rotation, rate)

    def _guide(self, position: Floats, velocity: Floats, rotation: Floats, elapsed_s: float) -> None:
        want = self._velocity
        if self._any_place:
            want = np.where(self._to_place, self._approach(position), want)
        demand = self._velocity_gain * (want - velocity) + self._trim
        up = np.minimum(np.maximum(demand[2] + self._gravity, self._least_up), self._most_up)
        sideways = length(demand[:2])
        most = np.minimum(self._tan_tilt * up, np.sqrt(np.maximum(self._most_up_squared - up * up, _TINY)))
        axis = self._axis
        np.multiply(demand[:2], most / np.maximum(sideways, most), out=axis[:2])
        axis[2] = up
        self._lift = self._mass * up
        axis /= length(axis)
        missed = self._expected(want, elapsed_s) - velocity
        missed[:2] *= sideways <= most
        self._trim += elapsed_s * self._integral * missed
        np.minimum(np.maximum(self._trim, self._least_trim), self._most_trim, out=self._trim)
        opposite = (axis * rotation[:, 2]).sum(axis=0) < _OVERHEAD - 1.0
        if opposite.any():  # no rotation is the shortest: choose one
            axis += 0.1 * opposite * rotation[:, 0]
        self._face(np.arctan2(rotation[1, 0], rotation[0, 0]), elapsed_s)

    def _expected(self, want: Floats, elapsed_s: float) -> Floats:
        """Velocities after the answer of the proportional law alone."""
        change = self._velocity_gain * (want - self._reference)
        self._reference += change * (elapsed_s * self._sideways / np.maximum(length(change), self._sideways))
        return self._reference

    def _approach(self, position: Floats) -> Floats:
        way = self._place - position
        distance = length(way)
        # Both laws have the same value and slope at the knee; elsewhere this one is lower.
        near, beyond = np.minimum(distance, self._knee), np.maximum(distance - self._knee, 0.0)
        speed = np.sqrt(self._gain_squared * near * near + self._braking * (beyond + beyond))
        want: Floats = way * (np.minimum(speed, self._speed) / np.maximum(distance, _TINY))
        want *= self._max_climb / np.maximum(np.abs(want[2]), self._max_climb)
        return want

    def _face(self, yaw: Floats, elapsed_s: float) -> None:
        """Turn the desired heading: at the commanded rate, or towards the heading of the way-point."""
        turn = self._turn + elapsed_s * self._yaw_gain * (self._yaw_rate - self._turn)
        if self._any_place:
            rest = self._yaw_gain * wrapped(self._yaw - self._heading)
            rest = np.minimum(np.maximum(rest, -self._max_yaw_rate), self._max_yaw_rate)
            turn = np.where(self._to_place, rest, turn)
        ahead = wrapped(self._heading + turn * elapsed_s - yaw)
        self._turn = turn
        self._heading = yaw + np.minimum(np.maximum(ahead, -_LEASH_RAD), _LEASH_RAD)
        self._cos, self._sin = np.cos(self._heading), np.sin(self._heading)

    def _steer(self, rotation: Floats, rate: Floats) -> Floats:
        axis = into_body(rotation, self._axis)
        stiff = self._attitude_gain * np.sqrt(2.0 / np.maximum(axis[2] + 1.0, _OVERHEAD))
        upright = rotation[2, 2]
        want = np.empty_like(rate)
        want[0], want[1] = -stiff * axis[1], stiff * axis[0]
        want[2] = self._turn + self._yaw_gain * (self._sin * rotation[0, 0] - self._cos * rotation[1, 0])
        torque = self._stiffness * (want - rate) + self._gyration * coupled(rate)
        return self._mixed(torque, self._lift * np.maximum(upright, 0.0) / np.square(np.maximum(upright, _UPRIGHT)))

    def _mixed(self, torque: Floats, thrust: Floats) -> Floats:
        """Rotor speeds (4, n) for torque (3, n) N m, body, and thrust (n,) N."""
        share = torque * self._rotor_share  # N
        pair = share[:2]  # right to left, front to back
        size = np.abs(share)
        reach = np.maximum(size[0], size[1])
        pair *= self._most_pair / np.maximum(reach, self._most_pair)
        reach = np.minimum(reach, self._most_pair)
        least = reach + np.minimum(size[2], self._yaw_reserve)
        base = np.minimum(np.maximum(0.25 * thrust, least), self._most - least)
        room = np.minimum(base, self._most - base) - reach
        yaw = np.minimum(np.maximum(share[2], -room), room)
        each = (base + _YAW_SIGN * yaw) + _PAIR_SIGN * pair.take(_PAIR, axis=0)
        return np.sqrt(np.maximum(each * self._per_newton, 0.0))


def wrapped(angle: Floats) -> Floats:
    """Angles in [-pi, pi]."""
    return angle - math.tau * np.rint(angle / math.tau)


def length(vector: Floats) -> Floats:
    """Lengths of vectors, (n,)."""
    squares = vector * vector
    return np.sqrt(squares.sum(axis=0))
