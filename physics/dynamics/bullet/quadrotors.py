"""Quadrotors in a Bullet world: NumPy moves them, and Bullet those that may touch something.

In free air Bullet would do nothing that `physics.dynamics.quadrotor_fleet.Fleet.integrate` does not do for all at once. There
a quadrotor's body is parked: far below, touching nothing, asleep. One that may come to touch anything (floor, solid, another
body) before the next look, 20 times a second, is handed over: its body gets its state, and from then on the force and torque
of every step. It stays there until it has been clear of everything for a while.

While its body touches nothing, the state of one that is near is still NumPy's, which differs from Bullet's by rounding alone;
only what a contact does is taken from Bullet. So whoever is near, without touching, changes no bit of anybody's flight.
"""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, UPRIGHT, p
from vcmvsp.physics.dynamics.bullet.airborne_clearance import SolidsMap, near_each_other, near_others
from vcmvsp.physics.dynamics.bullet.world_bodies import base_motion
from vcmvsp.physics.dynamics.quadrotor_fleet import Fleet
from vcmvsp.physics.dynamics.wind import Gusts
from vcmvsp.physics.engine.interface import Motion
from vcmvsp.physics.vehicles.quadrotor import Quadrotor
from vcmvsp.physics.world.scene import rotations
from vcmvsp.physics.world.shapes import Shapes

_LOOK_HZ = 20.0
_AWAY_LOOKS = 10  # clear in so many looks: handed back
_SLACK_M = 0.1  # between surfaces; what half of 40 m/s2 in the time between two looks squared may add is in it
_FRICTION = 0.5  # of the hull, assumed
_FEET_AT = 0.6  # of the radius: a flat face keeps one point of contact in Bullet, and rocks; four spheres in it hold it
_SAME = 1e-7  # m, m/s, rad/s: what differs by less did not touch anything
_PARK_M = 1e4  # below the floor, and apart


class Flyers:
    """n quadrotors in a row each."""

    def __init__(
        self,
        client: int,
        models: Sequence[Quadrotor],
        positions: Sequence[Vec3],
        headings: Sequence[float],
        *,
        gravity: float,
        step_s: float,
        gusts: Gusts,
        shapes: Shapes,
    ) -> None:
        n = len(models)
        self._client, self._step_s, self._gusts = client, step_s, gusts
        self.fleet = Fleet(models, np.array(positions, float).reshape(n, 3), np.array(headings, float), gravity)
        self._reach = np.array([float(np.hypot(model.radius_m, 0.5 * model.height_m)) for model in models])
        self._map = SolidsMap(shapes)
        self._steps_a_look = max(1, round(1.0 / (_LOOK_HZ * step_s)))
        self.look_s = (self._steps_a_look + 1) * step_s  # ahead: Bullet leaves a body out of the step in which it wakes
        self._step = 0
        self.look_is_due = True  # before the next step
        self.bodies = [self._build(model) for model in models]
        self.near = np.ones(n, bool)  # until the first look
        self._rows: list[int] = []  # those that are near
        self._clear_looks = np.full(n, _AWAY_LOOKS)
        self._woken: list[int] = []  # in the step to come
        self._touched = np.zeros(n, bool)  # something, in the last step
        self.hits: list[int] = []  # those that did not in the step before
        self._before = self.fleet.velocity.copy()

    def _build(self, model: Quadrotor) -> int:
        foot, arm = 0.5 * model.height_m, _FEET_AT * model.radius_m
        feet = [[x * arm, y * arm, 0.0] for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        shape = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_CYLINDER, *[p.GEOM_SPHERE] * 4],
            radii=[model.radius_m, *[foot] * 4],
            lengths=[model.height_m, *[0.0] * 4],
            halfExtents=[[0.0, 0.0, 0.0]] * 5,
            collisionFramePositions=[[0.0, 0.0, 0.0], *feet],
            physicsClientId=self._client,
        )
        body: int = p.createMultiBody(model.mass_kg, shape, physicsClientId=self._client)
        p.changeDynamics(
            body,
            -1,
            localInertiaDiagonal=model.inertia,
            lateralFriction=_FRICTION,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self._client,
        )
        p.setCollisionFilterGroupMask(body, -1, SOLID, FLOOR | SOLID, self._client)
        return body

    # --- handing over -------------------------------------------------------------------------------------------------------

    def _park(self, row: int) -> None:
        body, client = self.bodies[row], self._client
        p.setCollisionFilterGroupMask(body, -1, 0, 0, client)
        p.resetBasePositionAndOrientation(body, (10.0 * row, 0.0, -_PARK_M), UPRIGHT, client)
        p.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), client)
        asleep = p.ACTIVATION_STATE_SLEEP | p.ACTIVATION_STATE_ENABLE_SLEEPING | p.ACTIVATION_STATE_DISABLE_WAKEUP
        p.changeDynamics(body, -1, activationState=asleep, physicsClientId=client)

    def _wake(self, row: int) -> None:
        body, client = self.bodies[row], self._client
        for awake in (p.ACTIVATION_STATE_ENABLE_WAKEUP, p.ACTIVATION_STATE_WAKE_UP | p.ACTIVATION_STATE_DISABLE_SLEEPING):
            p.changeDynamics(body, -1, activationState=awake, physicsClientId=client)  # in this order
        p.setCollisionFilterGroupMask(body, -1, SOLID, FLOOR | SOLID, client)

    def _place(self, rows: list[int]) -> None:
        """Give bodies the states of the fleet."""
        fleet, client = self.fleet, self._client
        spin = np.einsum("nij,nj->ni", rotations(fleet.attitude[rows]), fleet.rate[rows]).tolist()
        at, speed, attitude = fleet.position[rows].tolist(), fleet.velocity[rows].tolist(), fleet.attitude[rows].tolist()
        for k, row in enumerate(rows):
            w, x, y, z = attitude[k]
            p.resetBasePositionAndOrientation(self.bodies[row], at[k], (x, y, z, w), client)
            p.resetBaseVelocity(self.bodies[row], speed[k], spin[k], client)

    def look(self, others: Array, other_reach: Array) -> None:
        """Decide who is near anything; ``others`` (m, 3) m are places of other bodies, with radius and way to the next look."""
        fleet = self.fleet
        position, velocity = fleet.position, fleet.velocity
        way = np.sqrt((velocity * velocity).sum(axis=1)) * self.look_s
        margin = self._reach + way + _SLACK_M
        near = (position[:, 2] < margin) | self._map.near(position, margin)
        near |= near_each_other(position, velocity, self._reach, self.look_s, 2.0 * _SLACK_M)
        near |= near_others(position, margin, others, other_reach)
        self._clear_looks = np.where(near, 0, self._clear_looks + 1)
        stays = near | (self.near & (self._clear_looks < _AWAY_LOOKS))
        self._woken = np.flatnonzero(stays & ~self.near).tolist()
        for row in self._woken:
            self._wake(row)
        for row in np.flatnonzero(self.near & ~stays).tolist():
            self._park(row)
        self.near = stays
        self._rows = np.flatnonzero(stays).tolist()
        if self._rows:
            self._place(self._rows)  # those that were near before drift off by rounding

    # --- a step -------------------------------------------------------------------------------------------------------------

    def push(self, now_ns: int) -> None:
        """Before Bullet's step: work out what acts on all of them, move them, and push the bodies of those that are near."""
        fleet, client = self.fleet, self._client
        force, torque = fleet.wrench(self._step_s, self._gusts.advance(now_ns))
        if self._rows:
            bodies, at = self.bodies, fleet.position.tolist()
            forces, torques = force.tolist(), torque.tolist()
            for row in self._rows:
                p.applyExternalForce(bodies[row], -1, forces[row], at[row], p.WORLD_FRAME, client)
                p.applyExternalTorque(bodies[row], -1, torques[row], p.WORLD_FRAME, client)
        self._before = fleet.velocity.copy()
        fleet.integrate(force, torque, self._step_s)
        self._step += 1
        self.look_is_due = self._step % self._steps_a_look == 0

    def take(self) -> None:
        """After Bullet's step: believe it where a body touched something, and note whose has begun to."""
        self.hits = []
        if not self._rows:
            self._touched[:] = False
            return
        if self._woken:
            self._place(self._woken)
            self._woken = []
        fleet, rows = self.fleet, self._rows
        moved = base_motion(self._client, [self.bodies[row] for row in rows])
        off = np.abs(moved.position - fleet.position[rows]).max(axis=1)
        off = np.maximum(off, np.abs(moved.velocity - fleet.velocity[rows]).max(axis=1))
        off = np.maximum(off, np.abs(moved.angular_velocity - fleet.rate[rows]).max(axis=1))
        touched = off > _SAME
        before, self._touched = self._touched, np.zeros_like(self._touched)
        if touched.any():
            self._touched[rows] = touched
            self.hits = np.flatnonzero(self._touched & ~before).tolist()
            those = np.array(rows)[touched]
            fleet.position[those], fleet.velocity[those] = moved.position[touched], moved.velocity[touched]
            fleet.attitude[those], fleet.rate[those] = moved.attitude[touched], moved.angular_velocity[touched]

    def read(self) -> Motion:
        """How every quadrotor moves."""
        fleet, n = self.fleet, len(self.bodies)
        return Motion(
            position=fleet.position.copy(),
            velocity=fleet.velocity.copy(),
            attitude=fleet.attitude.copy(),
            angular_velocity=fleet.rate.copy(),
            acceleration=(fleet.velocity - self._before) / self._step_s,
            wheels=np.full((n, 2), np.nan),
            odometry=np.full((n, 5), np.nan),
        )
