"""Quadrotors in a Bullet world: `QuadrotorFleet` moves them in free air; near other bodies, Bullet computes their contacts.

In free air Bullet adds nothing to `QuadrotorFleet.fly`, which moves all quadrotors at once. There the body of a quadrotor
is parked: far below, without contacts, asleep. Twenty times a second each quadrotor looks around. If it may touch anything
(floor, solid, another body) before the next look, its body gets its state, then the force and torque of every step, until the
quadrotor has been clear of everything for a while.

Without a contact, the state of a near quadrotor is still the fleet's, which differs from Bullet's by rounding; only the effect
of a contact comes from Bullet. So near bodies without contact change no bit of a flight.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.cosim.util.polygons import outward
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, UPRIGHT, p
from vcmvsp.physics.dynamics.bullet.bodies import base_motion, rigid_body
from vcmvsp.physics.dynamics.engine import BodyMotion, flown
from vcmvsp.physics.dynamics.quadrotor_fleet import fleet_of
from vcmvsp.physics.dynamics.wind import Gusts
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Shapes
from vcmvsp.physics.world.world import World, rotations

_LOOK_HZ = 20.0
_AWAY_LOOKS = 10  # parked after so many clear looks
_SLACK_M = 0.1  # between surfaces, for the way of an acceleration of 40 m/s2 between two looks
_FRICTION = 0.5  # of the hull, assumed
_FEET_AT = 0.6  # of the radius: a flat face rocks on one contact point in Bullet; four spheres in it are stable
_SAME = 1e-7  # m, m/s, rad/s: smaller differences are no contact
_FEW = 16  # quadrotors of which all pairs are compared; of more, neighbours are found first
_PARK_M = 1e4  # below the floor, and apart


def _parking_place(row: int) -> Vec3:
    return 10.0 * row, 0.0, -_PARK_M


class BulletQuadrotors:
    """n quadrotors, a row each."""

    def __init__(
        self, client: int, world: World, specs: Sequence[VehicleSpec], *, seed: int, gravity: float, step_s: float
    ) -> None:
        models: list[Any] = [spec.model for spec in specs]
        n = len(models)
        self._client, self._step_s = client, step_s
        self._gusts = Gusts(world.wind, [spec.name for spec in specs], seed)
        self.fleet = fleet_of(specs, gravity)
        self._reach = np.array([float(np.hypot(model.radius_m, 0.5 * model.height_m)) for model in models])
        self._map = SolidsMap(world.shapes)
        self._steps_a_look = max(1, round(1.0 / (_LOOK_HZ * step_s)))
        self.look_s = (self._steps_a_look + 1) * step_s  # Bullet leaves a body out of the step in which it wakes
        self._step = 0
        self.look_is_due = True  # before the next step
        self.bodies = [self._build(row, model) for row, model in enumerate(models)]
        self.near = np.ones(n, bool)  # until the first look
        self.near_rows: list[int] = []
        self._clear_looks = np.full(n, _AWAY_LOOKS)
        self._woken: list[int] = []  # before the next step
        self._touched = np.zeros(n, bool)  # in the last step
        self.hits: list[int] = []  # in the last step and not in the one before

    def _build(self, row: int, model: Quadrotor) -> int:
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
        place = _parking_place(row)  # n bodies at one place would be n**2 / 2 pairs that overlap
        body = rigid_body(self._client, model.mass_kg, shape, _FRICTION, FLOOR | SOLID, basePosition=place)
        p.changeDynamics(body, -1, localInertiaDiagonal=model.inertia, physicsClientId=self._client)
        return body

    def _park(self, row: int) -> None:
        body, client = self.bodies[row], self._client
        p.setCollisionFilterGroupMask(body, -1, 0, 0, client)
        p.resetBasePositionAndOrientation(body, _parking_place(row), UPRIGHT, client)
        p.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), client)
        asleep = p.ACTIVATION_STATE_SLEEP | p.ACTIVATION_STATE_ENABLE_SLEEPING | p.ACTIVATION_STATE_DISABLE_WAKEUP
        p.changeDynamics(body, -1, activationState=asleep, physicsClientId=client)

    def _wake(self, row: int) -> None:
        body, client = self.bodies[row], self._client
        for awake in (p.ACTIVATION_STATE_ENABLE_WAKEUP, p.ACTIVATION_STATE_WAKE_UP | p.ACTIVATION_STATE_DISABLE_SLEEPING):
            p.changeDynamics(body, -1, activationState=awake, physicsClientId=client)  # in this order
        p.setCollisionFilterGroupMask(body, -1, SOLID, FLOOR | SOLID, client)

    def _place(self, rows: list[int]) -> None:
        fleet, client = self.fleet, self._client
        spin = np.einsum("nij,nj->ni", rotations(fleet.attitude[rows]), fleet.rate[rows]).tolist()
        at, speed, attitude = fleet.position[rows].tolist(), fleet.velocity[rows].tolist(), fleet.attitude[rows].tolist()
        for k, row in enumerate(rows):
            w, x, y, z = attitude[k]
            p.resetBasePositionAndOrientation(self.bodies[row], at[k], (x, y, z, w), client)
            p.resetBaseVelocity(self.bodies[row], speed[k], spin[k], client)

    def look(self, others: Array, other_reach: Array) -> None:
        """Find near quadrotors; ``others`` (m, 3) m are positions of other bodies, with radius and way to the next look."""
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
        self.near_rows = np.flatnonzero(stays).tolist()
        if self.near_rows:
            self._place(self.near_rows)  # all: bodies drift off by rounding

    def push(self, times_ns: Sequence[int]) -> int:
        """Before Bullet's steps at these times: fly to the next look in free air, one step near bodies, which are pushed.

        Returns:
            The number of steps, 1 at least.
        """
        steps = 1 if self.near_rows else min(len(times_ns), self._steps_a_look - self._step % self._steps_a_look)
        winds = [self._gusts.advance(now_ns) for now_ns in times_ns[:steps]]
        if self.near_rows:
            self._push_near(winds[0])
        else:
            self.fleet.fly_in(winds, self._step_s)
        self._step += steps
        self.look_is_due = self._step % self._steps_a_look == 0
        return steps

    def _push_near(self, wind: Array) -> None:
        fleet, client, bodies = self.fleet, self._client, self.bodies
        force, torque = fleet.wrench(self._step_s, wind)
        at, forces, torques = fleet.position.tolist(), force.tolist(), torque.tolist()
        for row in self.near_rows:
            p.applyExternalForce(bodies[row], -1, forces[row], at[row], p.WORLD_FRAME, client)
            p.applyExternalTorque(bodies[row], -1, torques[row], p.WORLD_FRAME, client)
        fleet.integrate(force, torque, self._step_s)

    def take(self) -> None:
        """After Bullet's step: take the states of bodies with contacts, and record new contacts."""
        self.hits = []
        if not self.near_rows:
            self._touched[:] = False
            return
        if self._woken:
            self._place(self._woken)
            self._woken = []
        fleet, rows = self.fleet, self.near_rows
        motion = base_motion(self._client, [self.bodies[row] for row in rows])
        both = ((motion.position, fleet.position), (motion.velocity, fleet.velocity), (motion.angular_velocity, fleet.rate))
        touched = np.any([np.abs(actual - expected[rows]).max(axis=1) > _SAME for actual, expected in both], axis=0)
        before, self._touched = self._touched, np.zeros_like(self._touched)
        if touched.any():
            self._touched[rows] = touched
            self.hits = np.flatnonzero(self._touched & ~before).tolist()
            hit = np.array(rows)[touched]
            fleet.position[hit], fleet.velocity[hit] = motion.position[touched], motion.velocity[touched]
            fleet.attitude[hit], fleet.rate[hit] = motion.attitude[touched], motion.angular_velocity[touched]

    def read(self) -> BodyMotion:
        """Motion of every quadrotor."""
        return flown(self.fleet, self._step_s)


REACH_M = 1.5  # the map knows pieces this far around a cell: more than a vehicle and its way to the next look take together
_CELLS = 250_000
_FINEST_M = 0.5
_SMALL_M = 1.0  # triangles up to this size are taken together, by cubes of this size


class SolidsMap:
    """Clearance of vehicles in the air: a clear vehicle cannot touch a solid before the next look.

    A map of square cells, each with the pieces near to it: upright convex prisms, and boxes that stand for triangles of meshes,
    one for several small ones. Distances are never overestimated.
    """

    def __init__(self, shapes: Shapes) -> None:
        pieces = [piece for group in shapes.groups for piece in zip(*group[:3], strict=True)]
        pieces += _boxes(shapes.triangles)
        self._empty = not pieces
        if self._empty:
            return
        every = np.concatenate([corners for corners, _, _ in pieces])
        low, high = every.min(axis=0) - REACH_M, every.max(axis=0) + REACH_M
        self._size = max(_FINEST_M, math.sqrt(float(np.prod(high - low)) / _CELLS))
        self._origin, self._shape = low, np.ceil((high - low) / self._size).astype(int) + 1
        edges = max(len(corners) for corners, _, _ in pieces)
        # Outward normals and offsets of all sides; a missing side has an infinite offset.
        self._normals, self._offsets = np.zeros((len(pieces), edges, 2)), np.full((len(pieces), edges), np.inf)
        self._bottom, self._top = np.array([heights for _, *heights in pieces], float).T.copy()
        cells = [self._enter(number, corners) for number, (corners, _, _) in enumerate(pieces)]
        of = np.repeat(np.arange(len(pieces)), [len(each) for each in cells])
        where = np.concatenate(cells)
        self._pieces = of[np.argsort(where, kind="stable")]
        self._count = np.bincount(where, minlength=int(np.prod(self._shape)))
        self._first = np.cumsum(self._count) - self._count

    def _enter(self, number: int, corners: Array) -> Array:
        """Store the sides of a piece; returns the cells within reach of it."""
        normals = outward(corners)
        offsets = (normals * corners).sum(axis=1)
        self._normals[number, : len(corners)], self._offsets[number, : len(corners)] = normals, offsets
        reach = REACH_M + self._size * math.sqrt(0.5)  # from the middle of a cell
        first = np.maximum(((corners.min(axis=0) - reach - self._origin) / self._size).astype(int), 0)
        last = np.minimum(((corners.max(axis=0) + reach - self._origin) / self._size).astype(int) + 1, self._shape)
        i, j = np.arange(first[0], last[0]), np.arange(first[1], last[1])
        x, y = self._origin[0] + (i + 0.5) * self._size, self._origin[1] + (j + 0.5) * self._size
        beyond = (normals[:, 0, None, None] * x[:, None] + normals[:, 1, None, None] * y - offsets[:, None, None]).max(axis=0)
        return np.asarray((i[:, None] * self._shape[1] + j)[beyond <= reach])

    def near(self, position: Array, margin: Array) -> Array:
        """Whether a solid may lie within ``margin`` (n,) m of places (n, 3) m; always True for margins beyond `REACH_M`."""
        if self._empty:
            return np.zeros(len(position), bool)
        cell = np.floor((position[:, :2] - self._origin) / self._size).astype(int)
        inside = ((cell >= 0) & (cell < self._shape)).all(axis=1)
        place = np.where(inside, cell[:, 0] * self._shape[1] + cell[:, 1], 0)
        count = np.where(inside, self._count[place], 0)
        result = margin > REACH_M
        rows = np.repeat(np.arange(len(position)), count)  # one for each piece to check
        if len(rows):
            nth = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
            piece = self._pieces[self._first[place[rows]] + nth]
            at = position[rows]
            beyond = ((self._normals[piece] * at[:, None, :2]).sum(axis=2) - self._offsets[piece]).max(axis=1)
            beyond = np.maximum(beyond, np.maximum(self._bottom[piece] - at[:, 2], at[:, 2] - self._top[piece]))
            result[rows[beyond < margin[rows]]] = True
        return result


def _boxes(triangles: Array) -> list[tuple[Array, float, float]]:
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    small = (high - low).max(axis=1) <= _SMALL_M
    cubes, of = np.unique(np.floor(low[small] / _SMALL_M).astype(int), axis=0, return_inverse=True)
    lows, highs = np.full((len(cubes), 3), np.inf), np.full((len(cubes), 3), -np.inf)
    np.minimum.at(lows, of.ravel(), low[small])
    np.maximum.at(highs, of.ravel(), high[small])
    lows, highs = np.concatenate([lows, low[~small]]) - 1e-3, np.concatenate([highs, high[~small]]) + 1e-3  # no flat box
    ends = np.stack([lows, highs], axis=1)  # (boxes, 2, 3)
    corners = np.stack([ends[:, [0, 1, 1, 0], 0], ends[:, [0, 0, 1, 1], 1]], axis=2)
    return list(zip(corners, lows[:, 2].tolist(), highs[:, 2].tolist(), strict=True))


def near_each_other(position: Array, velocity: Array, radius: Array, span_s: float, slack_m: float) -> Array:
    """Whether another of n spheres may touch each within ``span_s``; ``slack_m`` allows for accelerations."""
    result = np.zeros(len(position), bool)
    if len(position) <= _FEW:
        a, b = _all_pairs(len(position))
    else:
        fastest = 2.0 * span_s * float(np.sqrt((velocity * velocity).sum(axis=1).max(initial=0.0)))
        a, b = close_pairs(position, 2.0 * float(radius.max(initial=0.0)) + slack_m + fastest)
    if len(a):
        square = np.square(position[a] - position[b]).sum(axis=1)
        closing = np.sqrt(np.square(velocity[a] - velocity[b]).sum(axis=1)) * span_s
        near = square < np.square(radius[a] + radius[b] + slack_m + closing)
        result[a[near]] = result[b[near]] = True
    return result


@lru_cache
def _all_pairs(count: int) -> tuple[Array, ...]:
    return np.triu_indices(count, 1)


def close_pairs(position: Array, reach_m: float) -> tuple[Array, Array]:
    """Rows of the pairs of n places (n, 3) that are within reach along each axis: neighbours in order along one of them."""
    columns = sorted(position.T, key=_spread, reverse=True)
    order = np.argsort(columns[0], kind="stable")
    along = columns[0].take(order)
    others = np.searchsorted(along, along + reach_m, side="right") - np.arange(1, len(order) + 1)
    first = np.repeat(np.arange(len(order)), others)
    second = np.arange(1, len(first) + 1) + np.repeat(np.arange(len(order)) - np.cumsum(others) + others, others)
    a, b = order.take(first), order.take(second)
    for column in columns[1:]:
        close = np.abs(column.take(a) - column.take(b)) <= reach_m
        a, b = a[close], b[close]
    return a, b


def _spread(column: Array) -> float:
    return float(column.max(initial=-np.inf) - column.min(initial=np.inf))


def near_others(position: Array, margin: Array, others: Array, other_margin: Array) -> Array:
    """Whether any of m other spheres may touch each of n; margins are radius plus way, m."""
    if not len(others):
        return np.zeros(len(position), bool)
    square = np.square(position[:, None] - others).sum(axis=2)
    return np.asarray((square < np.square(margin[:, None] + other_margin)).any(axis=1))
