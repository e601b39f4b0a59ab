"""A differential drive as a Bullet body, from its parameters.

* Wheels are spheres. They touch the floor in one point at the middle of the tread; cylinders become polyhedra in Bullet and
  cost twice the time, and track worse. They collide with the floor only, for a sphere is wider than the wheel it stands for.
* The caster is a second shape of the base, nearly without friction: no further joint.
* Bullet's default damping of bodies and joints is switched off: there is no air or oil in the parameters.
"""

from collections.abc import Sequence

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet import FLOOR, SOLID, UPRIGHT, WHEEL, p, turned
from vcmvsp.physics.vehicles.models import DifferentialDrive

LEFT, RIGHT = 0, 1  # joints


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
    # Inertia: the body as a solid box, about its middle; a wheel as a disc. Bullet takes both from the shapes otherwise.
    box = tuple(
        base_mass / 12.0 * (u * u + v * v)
        for u, v in ((m.width_m, hull_height), (m.length_m, hull_height), (m.length_m, m.width_m))
    )
    across, axle = 0.25 * m.wheel_mass_kg * m.wheel_radius_m**2, 0.5 * m.wheel_mass_kg * m.wheel_radius_m**2
    for link, inertia in ((-1, box), (LEFT, (across, axle, across)), (RIGHT, (across, axle, across))):
        p.changeDynamics(body, link, localInertiaDiagonal=inertia, physicsClientId=client)
    finish(client, body, wheels=(LEFT, RIGHT), wheel_friction=m.wheel_friction, friction=m.caster_friction)
    return body


def finish(client: int, body: int, *, wheels: Sequence[int], wheel_friction: float, friction: float) -> None:
    """Friction of wheels and of all else; no damping; wheels meet the floor only."""
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
