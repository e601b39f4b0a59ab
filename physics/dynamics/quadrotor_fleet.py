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

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.physics.dynamics import rotorwash
from vcmvsp.physics.dynamics.autopilot import Autopilot
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
from vcmvsp.physics.vehicles.quadrotor import Quadrotor


class QuadrotorFleet:
    """n quadrotors, a row each; without commands they hover.

    The state may be read, and written in place, between steps:

    - ``position`` (n, 3) m and ``velocity`` (n, 3) m/s, world, of the centres of mass;
    - ``attitude`` (n, 4) w, x, y, z; world_from_body; unit norm;
    - ``rate`` (n, 3) rad/s, body;
    - ``rotor`` (n, 4) rad/s: front, left, back, right.

    Args:
        models: one for each row.
        positions: (n, 3) m, world, at the start.
        headings: (n,) rad, at the start.
        gravity: m/s2.
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
        self._wash = rotorwash.of(models)
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
        """See `Autopilot.set_velocity`."""
        self._pilot.set_velocity(row, linear, yaw_rate)

    def set_waypoint(self, row: int, position: Sequence[float], yaw: float | None = None, speed: float | None = None) -> None:
        """See `Autopilot.set_waypoint`."""
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
        """Move all as free bodies by ``dt`` s under gravity, a force and a torque.

        After `wrench` in the same step, attitudes must not have changed.

        Args:
            force: (n, 3) N, world, on the centre of mass; without gravity.
            torque: (n, 3) N m, world.
            dt: s.
        """
        rotation = rotations(self._attitude) if self._rotation is None else self._rotation
        self._rotation = None
        torque = into_body(rotation, torque.T)
        rate = self._rate + self._flexibility * (dt * (torque - self._gyration * coupled(self._rate)))
        velocity = self._velocity + force.T * (dt / self._mass)
        velocity[2] -= self._gravity * dt
        after = (self._position + velocity * dt, velocity, turned(self._attitude, rate, dt), rate)
        np.concatenate(after, out=self._state)
