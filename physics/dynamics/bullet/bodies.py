"""Floor, solids, movables, external vehicles and differential drives as bodies in a Bullet world.

Bullet's default damping is switched off: the parameters have no air or oil. A differential drive:

* Wheels are spheres, which touch the floor in one point at the middle of the tread. Cylinders become polyhedra in Bullet, cost
  twice the time, and track worse. Wheels collide with the floor only, because the sphere is wider than the wheel.
* The caster is a second shape of the base, nearly without friction: no further joint.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, UPRIGHT, WHEEL, p, turned
from vcmvsp.physics.dynamics.engine import NO_BODIES, BodyMotion, on_time, without_wheels
from vcmvsp.physics.dynamics.external_path import ExternalPath
from vcmvsp.physics.dynamics.kinematic import ExternalEngine
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.world.solids import Box, Cylinder, Hull, heading_of
from vcmvsp.physics.world.world import Movable, Moving, World, rotation_columns

LEFT, RIGHT = 0, 1  # joints


def hull_shape(client: int, kind: str, size: Vec3, **frame: Any) -> int:
    """Collision shape of a box or a cylinder of a size, m."""
    lengths: dict[str, Any] = {"halfExtents": [0.5 * side for side in size]}
    if kind == "cylinder":
        lengths = {"radius": 0.5 * size[0], "height": size[2]}
    geometry = p.GEOM_CYLINDER if kind == "cylinder" else p.GEOM_BOX
    return p.createCollisionShape(geometry, physicsClientId=client, **lengths, **frame)


def rigid_body(client: int, mass_kg: float, shape: int, friction: float, mask: int, **start: Any) -> int:
    """A body of one shape in the collision group `SOLID`."""
    body: int = p.createMultiBody(mass_kg, shape, physicsClientId=client, **start)
    p.changeDynamics(body, -1, lateralFriction=friction, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
    p.setCollisionFilterGroupMask(body, -1, SOLID, mask, physicsClientId=client)
    return body


def differential_drive(client: int, m: DifferentialDrive, position: Vec3, heading: float) -> int:
    """Build one robot. The base frame lies on the floor below the axle; links 0, 1 are the wheels."""
    hull_height = m.height_m - m.clearance_m
    caster_radius = 0.5 * m.clearance_m
    base = p.createCollisionShapeArray(
        shapeTypes=[p.GEOM_BOX, p.GEOM_SPHERE],
        halfExtents=[[0.5 * m.length_m, 0.5 * m.width_m, 0.5 * hull_height], [0.0, 0.0, 0.0]],
        radii=[0.0, caster_radius],
        collisionFramePositions=[
            [-m.axle_ahead_m, 0.0, m.clearance_m + 0.5 * hull_height],
            [-m.caster_behind_m, 0.0, caster_radius],
        ],
        physicsClientId=client,
    )
    wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=m.wheel_radius_m, physicsClientId=client)
    base_mass = m.mass_kg - 2.0 * m.wheel_mass_kg
    body: int = p.createMultiBody(
        baseMass=base_mass,
        baseCollisionShapeIndex=base,
        basePosition=position,
        baseOrientation=turned(heading),
        baseInertialFramePosition=(-m.mass_behind_m, 0.0, m.mass_height_m),
        linkMasses=[m.wheel_mass_kg] * 2,
        linkCollisionShapeIndices=[wheel] * 2,
        linkVisualShapeIndices=[-1] * 2,
        linkPositions=[(0.0, side * 0.5 * m.track_m, m.wheel_radius_m) for side in (1, -1)],
        linkOrientations=[UPRIGHT] * 2,
        linkInertialFramePositions=[(0.0, 0.0, 0.0)] * 2,
        linkInertialFrameOrientations=[UPRIGHT] * 2,
        linkParentIndices=[0, 0],
        linkJointTypes=[p.JOINT_REVOLUTE] * 2,
        linkJointAxis=[(0.0, 1.0, 0.0)] * 2,
        physicsClientId=client,
    )
    # Inertia: the body as a solid box about its middle, a wheel as a disc. Bullet's defaults come from the shapes.
    sides = ((m.width_m, hull_height), (m.length_m, hull_height), (m.length_m, m.width_m))
    box = tuple(base_mass / 12.0 * (u * u + v * v) for u, v in sides)
    across, axle = 0.25 * m.wheel_mass_kg * m.wheel_radius_m**2, 0.5 * m.wheel_mass_kg * m.wheel_radius_m**2
    for link, inertia in ((-1, box), (LEFT, (across, axle, across)), (RIGHT, (across, axle, across))):
        p.changeDynamics(body, link, localInertiaDiagonal=inertia, physicsClientId=client)
    finish(client, body, wheels=(LEFT, RIGHT), wheel_friction=m.wheel_friction, friction=m.caster_friction)
    return body


def finish(client: int, body: int, *, wheels: Sequence[int], wheel_friction: float, friction: float) -> None:
    """Set the friction of wheels and of all other links, no damping, and the collision groups."""
    for link in range(-1, p.getNumJoints(body, client)):
        own, group, mask = (wheel_friction, WHEEL, FLOOR) if link in wheels else (friction, SOLID, FLOOR | SOLID)
        damping = dict.fromkeys(("linearDamping", "angularDamping", "jointDamping"), 0.0)
        p.changeDynamics(body, link, lateralFriction=own, **damping, physicsClientId=client)
        p.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=client)


HEAVY_KG = 1e6  # of a body on a path: nothing stops it, and unlike a body without mass it wakes the bodies that it meets
_LEAST_FRICTION = 1e-6  # as good as none
_FALLS_ASLEEP = 0.01  # m2/s2: a movable slower than this for 2 s is left out of the steps until something touches it

_WXYZ = np.array([3, 0, 1, 2])  # of a quaternion in Bullet's order
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # axes


@lru_cache(maxsize=8)
def _lists_of(vertices: bytes, triangles: bytes) -> dict[str, Any]:
    """Vertices and indices of a mesh for Bullet, cached: PyBullet 3.2.7 never frees lists of vertices that it has read."""
    return {"vertices": np.frombuffer(vertices).reshape(-1, 3).tolist(), "indices": np.frombuffer(triangles, np.int64).tolist()}


class WorldBodies:
    """Floor, solids, movables and moving obstacles.

    All solids are one mesh: a step costs the same with one box as with hundreds.
    """

    def __init__(self, client: int, world: World) -> None:
        self._client, self._moving = client, world.moving
        plane = p.createCollisionShape(p.GEOM_PLANE, planeNormal=(0.0, 0.0, 1.0), physicsClientId=client)
        floor = p.createMultiBody(0.0, plane, physicsClientId=client)
        p.changeDynamics(floor, -1, lateralFriction=floor_friction(world), physicsClientId=client)
        p.setCollisionFilterGroupMask(floor, -1, FLOOR, SOLID | WHEEL, physicsClientId=client)
        if world.solids:
            vertices, triangles = world.mesh()
            lists = _lists_of(vertices.tobytes(), triangles.astype(np.int64).tobytes())
            mesh = p.createCollisionShape(p.GEOM_MESH, **lists, flags=p.GEOM_FORCE_CONCAVE_TRIMESH, physicsClientId=client)
            p.setCollisionFilterGroupMask(p.createMultiBody(0.0, mesh, physicsClientId=client), -1, SOLID, SOLID, client)
        self.movables = [self._build(each.solid, each.mass_kg, each.friction, FLOOR | SOLID) for each in world.movables]
        for body in self.movables:
            sleep = {"activationState": p.ACTIVATION_STATE_ENABLE_SLEEPING, "sleepThreshold": _FALLS_ASLEEP}
            p.changeDynamics(body, -1, **sleep, physicsClientId=client)
        self.moving = [self._build(each.solid, HEAVY_KG, 0.5, SOLID) for each in world.moving]  # without contact to the floor
        things: list[Movable | Moving] = [*world.movables, *world.moving]
        self._radii_m = np.array([0.5 * math.hypot(*each.solid.hull.size) for each in things])  # of spheres around them
        self.place(0)

    def _build(self, solid: Box | Cylinder, mass_kg: float, friction: float, mask: int) -> int:
        shape = hull_shape(self._client, solid.hull.kind, solid.hull.size)
        start = {"basePosition": solid.center, "baseOrientation": turned(heading_of(solid))}
        return rigid_body(self._client, mass_kg, shape, friction, mask, flags=p.URDF_ENABLE_SLEEPING, **start)

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable at a place, m, at rest, and wake all movables: one may have leaned on it."""
        body = self.movables[number]
        p.resetBasePositionAndOrientation(body, place, turned(yaw), self._client)
        p.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._client)
        for each in self.movables:
            p.changeDynamics(each, -1, activationState=p.ACTIVATION_STATE_WAKE_UP, physicsClientId=self._client)

    def place(self, now_ns: int) -> None:
        """Put the moving obstacles in place with their velocities: they push the bodies in their way."""
        if self.moving:
            set_poses(self._client, self.moving, on_time(self._moving, now_ns))

    def spheres(self, now_ns: int, span_s: float) -> tuple[Array, Array]:
        """Positions (m, 3) m, and radii of spheres around them that the bodies do not leave within ``span_s``, (m,) m."""
        if not len(self._radii_m):
            return np.empty((0, 3)), np.empty(0)
        parts = (self.read(), on_time(self._moving, now_ns))
        velocity = np.concatenate([each.velocity for each in parts])
        ways = span_s * np.sqrt((velocity * velocity).sum(axis=1))
        return np.concatenate([each.position for each in parts]), self._radii_m + ways

    def read(self) -> BodyMotion:
        """Motion of the movables."""
        return base_motion(self._client, self.movables) if self.movables else NO_BODIES


def set_poses(client: int, bodies: Sequence[int], motion: BodyMotion) -> None:
    """Put bodies in place with their velocities; angular velocities in the world frame."""
    arrays = (motion.position, motion.attitude, motion.velocity, motion.angular_velocity)
    for body, place, (w, x, y, z), velocity, spin in zip(bodies, *(each.tolist() for each in arrays), strict=True):
        p.resetBasePositionAndOrientation(body, place, (x, y, z, w), client)
        p.resetBaseVelocity(body, velocity, spin, client)


def floor_friction(world: World) -> float:
    """Friction of the floor in Bullet: never 0 with zones, in which the friction of robots makes up for it."""
    return max(world.floor_friction, _LEAST_FRICTION) if world.zones else world.floor_friction


BaseState = tuple[Vec3, tuple[float, float, float, float], Vec3, Vec3]
"""Centre of mass of a body: position, m; attitude, x, y, z, w; velocity, m/s; angular velocity, rad/s; world frame."""


def base_states(client: int, bodies: list[int]) -> list[BaseState]:
    """States of bodies in Bullet's own form."""
    poses, speeds = p.getBasePositionAndOrientation, p.getBaseVelocity
    return [(*poses(body, client), *speeds(body, client)) for body in bodies]


def base_motion(client: int, bodies: list[int]) -> BodyMotion:
    """Motion of the centres of mass of bodies."""
    return motion_of(base_states(client, bodies), np.zeros((len(bodies), 3)))


def motion_of(states: list[BaseState], references: Array) -> BodyMotion:
    """Motion of reference points (n, 3) m, each in the frame of its body's centre of mass."""
    numbers = [(*position, *attitude, *velocity, *spin) for position, attitude, velocity, spin in states]
    columns = np.array(numbers, float).reshape(-1, 13).T.copy()  # (13, n), for few NumPy calls
    centre, attitude, velocity, spin = columns[:3], columns[3:7].take(_WXYZ, axis=0), columns[7:10], columns[10:]
    rotation = rotation_columns(attitude)
    terms = rotation * references.T
    to_reference = terms[:, 0] + terms[:, 1] + terms[:, 2]  # world
    swept = spin.take(_NEXT, axis=0) * to_reference.take(_LAST, axis=0)
    swept -= spin.take(_LAST, axis=0) * to_reference.take(_NEXT, axis=0)
    terms = rotation * spin[:, None]
    rates = terms[0] + terms[1] + terms[2]  # body
    rows = centre + to_reference, velocity + swept, attitude, rates, np.zeros_like(centre)
    return without_wheels(*(each.T.copy() for each in rows))


_FRICTION = 0.5  # of the hulls, assumed


class ExternalBodies:
    """A body with the hull of each external vehicle, put in place before every step.

    The upward speed makes up for a step of gravity in Bullet: a body in contact is not dragged down.
    """

    def __init__(self, client: int, external: ExternalEngine, hulls: list[Hull], *, gravity: float, step_s: float) -> None:
        self._client, self._path, self._lift = client, ExternalPath(external, step_s), np.array([0.0, 0.0, gravity * step_s])
        self.bodies = []
        for hull in hulls:
            shape = hull_shape(client, hull.kind, hull.size, collisionFramePosition=hull.offset)
            self.bodies.append(rigid_body(client, HEAVY_KG, shape, _FRICTION, SOLID))  # without contact to the floor
        self._reach = np.array([0.5 * math.hypot(*hull.size) + math.hypot(*hull.offset) for hull in hulls])

    def place(self, now_ns: int) -> None:
        """Put the bodies in place with their velocities."""
        motion = self._path.step(now_ns)
        set_poses(self._client, self.bodies, motion._replace(velocity=motion.velocity + self._lift))

    def spheres(self, now_ns: int, span_s: float) -> tuple[Array, Array]:
        """Positions (k, 3) m, and radii of spheres around them that the bodies do not leave within ``span_s``, (k,) m."""
        return self._path.position, self._reach + span_s * self._path.speeds(now_ns)
