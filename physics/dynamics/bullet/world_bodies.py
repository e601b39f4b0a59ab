"""What is in a Bullet world besides vehicles: floor and solids, things that can be pushed, obstacles with a time-table."""

import math

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, WHEEL, p, turned
from vcmvsp.physics.dynamics.movables import on_time
from vcmvsp.physics.dynamics.rigid_body import into_body, pairs
from vcmvsp.physics.engine.interface import NO_BODIES, Motion
from vcmvsp.physics.world.solids import Box, Cylinder, heading_of
from vcmvsp.physics.world.world import World

HEAVY_KG = 1e6  # an obstacle with a time-table: nothing holds it up, and unlike a body without mass it wakes what it meets
_LEAST_FRICTION = 1e-6  # as good as none
_FALLS_ASLEEP = 0.01  # m2/s2: a movable slower than this for 2 s is left out of the steps until something touches it

_X, _Y, _Z, _W = range(4)  # Bullet's order
_WXYZ = np.array([_W, _X, _Y, _Z])
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # axes

# Of a rotation matrix, row by row: half of each entry is the first of these products of a quaternion's components plus or minus
# the second; on the diagonal, of 1 less the entry.
_FIRST = pairs((_Y, _Y), (_X, _Y), (_X, _Z), (_X, _Y), (_X, _X), (_Y, _Z), (_X, _Z), (_Y, _Z), (_X, _X))
_SECOND = pairs((_Z, _Z), (_W, _Z), (_W, _Y), (_W, _Z), (_Z, _Z), (_W, _X), (_W, _Y), (_W, _X), (_Y, _Y))
_SIGN = np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])[:, None]


class Things:
    """The floor, the solids as one mesh, movables and moving obstacles.

    All solids are one mesh: a step costs the same with one box as with hundreds.
    """

    def __init__(self, client: int, world: World) -> None:
        self._client, self._moving = client, world.moving
        plane = p.createCollisionShape(p.GEOM_PLANE, planeNormal=(0.0, 0.0, 1.0), physicsClientId=client)
        self.floor: int = p.createMultiBody(0.0, plane, physicsClientId=client)
        p.changeDynamics(self.floor, -1, lateralFriction=floor_friction(world), physicsClientId=client)
        p.setCollisionFilterGroupMask(self.floor, -1, FLOOR, SOLID | WHEEL, physicsClientId=client)
        self.solids = self._build_solids(world) if world.solids else -1
        self.movables = [self._build(each.solid, each.mass_kg, each.friction) for each in world.movables]
        self._asleep()
        self.moving = [self._build(each.solid, HEAVY_KG, 0.5) for each in world.moving]
        for body in self.moving:  # they do not mind the floor
            p.setCollisionFilterGroupMask(body, -1, SOLID, SOLID, physicsClientId=client)
        solids = [*(each.solid for each in world.movables), *(each.solid for each in world.moving)]
        self._radii_m = np.array([0.5 * math.hypot(*solid.hull.size) for solid in solids])  # of spheres around them
        self.place(0)

    def _build_solids(self, world: World) -> int:
        vertices, triangles = world.mesh()
        mesh = p.createCollisionShape(
            p.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=triangles.ravel().tolist(),
            flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self._client,
        )
        body: int = p.createMultiBody(0.0, mesh, physicsClientId=self._client)
        p.setCollisionFilterGroupMask(body, -1, SOLID, SOLID, physicsClientId=self._client)
        return body

    def _build(self, solid: Box | Cylinder, mass_kg: float, friction: float) -> int:
        client = self._client
        if isinstance(solid, Cylinder):
            shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=solid.radius, height=solid.height, physicsClientId=client)
        else:
            half = [0.5 * side for side in solid.size]
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        body: int = p.createMultiBody(
            mass_kg,
            shape,
            basePosition=solid.center,
            baseOrientation=turned(heading_of(solid)),
            flags=p.URDF_ENABLE_SLEEPING,
            physicsClientId=client,
        )
        p.changeDynamics(body, -1, lateralFriction=friction, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
        p.setCollisionFilterGroupMask(body, -1, SOLID, FLOOR | SOLID, physicsClientId=client)
        return body

    def _asleep(self) -> None:
        for body in self.movables:
            p.changeDynamics(
                body,
                -1,
                activationState=p.ACTIVATION_STATE_ENABLE_SLEEPING,
                sleepThreshold=_FALLS_ASLEEP,
                physicsClientId=self._client,
            )

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable somewhere, m, at rest; whatever leaned on it notices."""
        body = self.movables[number]
        p.resetBasePositionAndOrientation(body, place, turned(yaw), self._client)
        p.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._client)
        for each in self.movables:
            p.changeDynamics(each, -1, activationState=p.ACTIVATION_STATE_WAKE_UP, physicsClientId=self._client)

    def place(self, now_ns: int) -> None:
        """Put the moving obstacles where they belong, as fast as they go: what they meet is pushed."""
        if not self.moving:
            return
        now = on_time(self._moving, now_ns)
        client = self._client
        for body, place, (w, x, y, z), speed, turning in zip(
            self.moving,
            now.position.tolist(),
            now.attitude.tolist(),
            now.velocity.tolist(),
            now.angular_velocity.tolist(),
            strict=True,
        ):
            p.resetBasePositionAndOrientation(body, place, (x, y, z, w), client)
            p.resetBaseVelocity(body, speed, turning, client)

    def spheres(self, now_ns: int, span_s: float) -> tuple[Array, Array]:
        """Places (m, 3) m of movables and moving obstacles, and how far around it each may be within ``span_s``, (m,) m."""
        if not len(self._radii_m):
            return np.empty((0, 3)), np.empty(0)
        parts = (self.read(), on_time(self._moving, now_ns))
        velocity = np.concatenate([each.velocity for each in parts])
        ways = span_s * np.sqrt((velocity * velocity).sum(axis=1))
        return np.concatenate([each.position for each in parts]), self._radii_m + ways

    def read(self) -> Motion:
        """How the movables move."""
        if not self.movables:
            return NO_BODIES
        return base_motion(self._client, self.movables)


def floor_friction(world: World) -> float:
    """Of the floor in Bullet: never 0 where there are zones, in which that of robots is made up for it."""
    return max(world.floor_friction, _LEAST_FRICTION) if world.zones else world.floor_friction


BaseState = tuple[Vec3, tuple[float, float, float, float], Vec3, Vec3]
"""Of a body's centre of mass: place, m; attitude, x, y, z, w; velocity, m/s; angular velocity, rad/s; in the world's axes."""


def base_states(client: int, bodies: list[int]) -> list[BaseState]:
    """What Bullet says of bodies, as it says it."""
    poses, speeds = p.getBasePositionAndOrientation, p.getBaseVelocity
    return [(*poses(body, client), *speeds(body, client)) for body in bodies]


def base_motion(client: int, bodies: list[int]) -> Motion:
    """How the centres of mass of bodies move."""
    return motion_of(base_states(client, bodies), np.zeros((len(bodies), 3)))


def motion_of(states: list[BaseState], references: Array) -> Motion:
    """How reference points of bodies move, each at a place (n, 3) m in the frame of the body's centre of mass."""
    n = len(states)
    said = np.array([(*at, *turn, *speed, *spin) for at, turn, speed, spin in states], float).reshape(n, 13).T.copy()
    centre, turn, velocity, spin = said[:3], said[3:7], said[7:10], said[10:]  # a column each: few NumPy calls do it
    products = (turn[:, None] * turn).reshape(16, n)
    rotation = 2.0 * (products.take(_FIRST, axis=0) + _SIGN * products.take(_SECOND, axis=0))
    rotation[::4] = 1.0 - rotation[::4]
    rotation = rotation.reshape(3, 3, n)  # world_from_body
    terms = rotation * references.T
    to_reference = terms[:, 0] + terms[:, 1] + terms[:, 2]  # world
    swept = spin.take(_NEXT, axis=0) * to_reference.take(_LAST, axis=0)
    swept -= spin.take(_LAST, axis=0) * to_reference.take(_NEXT, axis=0)
    return Motion(
        position=(centre + to_reference).T.copy(),
        velocity=(velocity + swept).T.copy(),
        attitude=turn.take(_WXYZ, axis=0).T.copy(),
        angular_velocity=into_body(rotation, spin).T.copy(),
        acceleration=np.zeros((n, 3)),
        wheels=np.full((n, 2), np.nan),
        odometry=np.full((n, 5), np.nan),
    )
