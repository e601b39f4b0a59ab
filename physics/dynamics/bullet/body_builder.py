"""Bodies in Bullet from their parameters. Bullet's default damping is switched off: the parameters have no air or oil.

A differential drive:

* Wheels are spheres, which touch the floor in one point at the middle of the tread. Cylinders become polyhedra in Bullet, cost
  twice the time, and track worse. Wheels collide with the floor only, because the sphere is wider than the wheel.
* The caster is a second shape of the base, nearly without friction: no further joint.
"""

from collections.abc import Sequence
from typing import Any

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, UPRIGHT, WHEEL, p, turned
from vcmvsp.physics.vehicles.models import DifferentialDrive

LEFT, RIGHT = 0, 1  # joints


def hull_shape(client: int, kind: str, size: Vec3, **frame: Any) -> int:
    """Collision shape of a box or a cylinder of a size, m."""
    if kind == "cylinder":
        shape: int = p.createCollisionShape(
            p.GEOM_CYLINDER, radius=0.5 * size[0], height=size[2], physicsClientId=client, **frame
        )
    else:
        half = [0.5 * side for side in size]
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client, **frame)
    return shape


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
    # Inertia: the body as a solid box about its middle, a wheel as a disc. Bullet's defaults are those of the shapes.
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
        rolls = link in wheels
        p.changeDynamics(
            body,
            link,
            lateralFriction=wheel_friction if rolls else friction,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            physicsClientId=client,
        )
        group, mask = (WHEEL, FLOOR) if rolls else (SOLID, FLOOR | SOLID)
        p.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=client)
