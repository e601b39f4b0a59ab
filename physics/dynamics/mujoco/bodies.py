"""Floor, solids, movables and vehicles as bodies of a MuJoCo model.

A differential drive has the shapes that it has in Bullet: wheels are spheres that meet the floor only, the caster is a sphere
of the body, nearly without friction. Of two shapes that meet, the one that can move has priority: its friction counts, and
includes the floor's. A wheel's motor is the friction of its joint, see `physics.dynamics.mujoco.engine`.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco as mj
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.vehicles.models import DifferentialDrive
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Hull, heading_of
from vcmvsp.physics.world.world import World

# Bits: two shapes meet if a bit of the type of one is in the affinity of the other.
FLOOR, SOLID = 1, 2
HEAVY_KG = 1e6  # of a body on a path: nothing stops it
MOTOR_STEPS = 2.0
"""Time constant of a motor in steps, the least that MuJoCo allows."""
MOTOR_IMPEDANCE = 0.999

_IMPEDANCE = (0.98, 0.999, 0.0001, 0.5, 2.0)  # of contacts: nearly rigid, a robot sinks in by less than 0.1 mm
CONTACT_STEPS = 5.0  # time constant of wheels and casters on the floor, in steps; robots shake with less than 4
_IMPACT_STEPS = 3.0  # of other contacts

_SHAPES = {"box": mj.mjtGeom.mjGEOM_BOX, "cylinder": mj.mjtGeom.mjGEOM_CYLINDER}
_MOST_TRIANGLES = 5000  # of all meshes: MuJoCo collides with convex shapes only, so each triangle is one
_PLATE_M = 0.02  # thickness of a triangle, downwards and inwards


class Builder:
    """A MuJoCo model of a world under construction."""

    def __init__(self, world: World, step_s: float, gravity: float) -> None:
        self.spec = mj.MjSpec()
        option = self.spec.option
        option.timestep, option.gravity = step_s, (0.0, 0.0, -gravity)
        option.integrator, option.cone = mj.mjtIntegrator.mjINT_EULER, mj.mjtCone.mjCONE_ELLIPTIC
        option.jacobian = mj.mjtJacobian.mjJAC_SPARSE  # for any number of bodies: the same bits, whatever else there is
        option.impratio = 10.0  # friction is so much stiffer than the contact: robots creep less
        self._floor = world.floor_friction
        self._under_robots = 1.0 if world.zones else world.floor_friction  # else by zone
        top = self.spec.worldbody
        top.add_geom(type=mj.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0), contype=FLOOR, conaffinity=0)
        fixed = {"contype": SOLID, "conaffinity": SOLID}
        for solid in world.solids:
            if isinstance(solid, Box | Cylinder):
                _add_hull(top, solid.hull, pos=solid.center, quat=quaternion_from_yaw(heading_of(solid)), **fixed)
            else:
                self._add_parts(solid, fixed)

    def _add_parts(self, solid: AnySolid, fixed: dict[str, Any]) -> None:
        first = len(self.spec.meshes)  # MuJoCo walks through all meshes for this
        for number, corners in enumerate(convex_parts_of(solid), first):
            if number == _MOST_TRIANGLES:
                raise ScenarioError(
                    f"the world has more than {_MOST_TRIANGLES} convex parts and triangles: MuJoCo is too slow for them; "
                    'use kind = "bullet"',
                    key="physics.kind",
                )
            mesh = self.spec.add_mesh(name=f"part{number}", uservert=corners.ravel().tolist())
            self.spec.worldbody.add_geom(type=mj.mjtGeom.mjGEOM_MESH, meshname=mesh.name, **fixed)

    def _loose(self, friction: float, meets: int = FLOOR | SOLID, steps: float = _IMPACT_STEPS) -> dict[str, Any]:
        """Properties of a shape that can move, with the time constant of its contacts in steps."""
        hard = {"solimp": _IMPEDANCE, "solref": (steps * self.spec.option.timestep, 1.0)}
        return {"friction": (friction, 0.0, 0.0), "priority": 1, "contype": SOLID, "conaffinity": meets, **hard}

    def _free_body(self, name: str, place: Vec3, heading: float) -> Any:
        body = self.spec.worldbody.add_body(name=name, pos=place, quat=quaternion_from_yaw(heading))
        body.add_freejoint()
        return body

    def add_body(
        self, name: str, hull: Hull, mass_kg: float, place: Vec3, heading: float, friction: float, steps: float = _IMPACT_STEPS
    ) -> Any:
        """Add a free body of one shape, evenly filled; ``steps``: time constant of its contacts."""
        body = self._free_body(name, place, heading)
        _add_hull(body, hull, pos=hull.offset, mass=mass_kg, **self._loose(friction * self._floor, steps=steps))
        return body

    def add_heavy(self, name: str, hull: Hull, place: Vec3, heading: float, friction: float) -> None:
        """Add a body for which every step sets place and velocity; it does not meet the floor."""
        body = self._free_body(name, place, heading)
        body.gravcomp = 1.0
        _add_hull(body, hull, pos=hull.offset, mass=HEAVY_KG, **self._loose(friction, SOLID))

    def add_drive(self, name: str, model: DifferentialDrive | UrdfDrive, place: Vec3, heading: float) -> None:
        """Add a robot; joints ``name/left`` and ``name/right`` are its wheels, whose speeds forwards are positive."""
        if isinstance(model, UrdfDrive):
            self._add_urdf(name, model, place, heading)
        else:
            self._add_parameters(name, model, place, heading)

    def _add_parameters(self, name: str, m: DifferentialDrive, place: Vec3, heading: float) -> None:
        """The frame of the body lies on the floor below the axle."""
        hull_height, caster_radius = m.height_m - m.clearance_m, 0.5 * m.clearance_m
        base_kg = m.mass_kg - 2.0 * m.wheel_mass_kg
        sides = ((m.width_m, hull_height), (m.length_m, hull_height), (m.length_m, m.width_m))
        body = self._free_body(name, place, heading)
        centre = (-m.mass_behind_m, 0.0, m.mass_height_m)
        set_inertia(body, base_kg, centre, [base_kg / 12.0 * (u * u + v * v) for u, v in sides])
        friction, box = m.caster_friction * self._under_robots, Hull((m.length_m, m.width_m, hull_height))
        _add_hull(body, box, pos=(-m.axle_ahead_m, 0.0, m.clearance_m + 0.5 * hull_height), **self._loose(friction))
        loose, caster = self._loose(friction, steps=CONTACT_STEPS), (-m.caster_behind_m, 0.0, caster_radius)
        body.add_geom(type=mj.mjtGeom.mjGEOM_SPHERE, size=(caster_radius, 0.0, 0.0), pos=caster, **loose)
        across, along = (share * m.wheel_mass_kg * m.wheel_radius_m**2 for share in (0.25, 0.5))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            wheel = body.add_body(name=f"{name}/{side}", pos=(0.0, sign * 0.5 * m.track_m, m.wheel_radius_m))
            set_inertia(wheel, m.wheel_mass_kg, (0.0, 0.0, 0.0), [across, along, across])
            wheel.add_joint(name=f"{name}/{side}", type=mj.mjtJoint.mjJNT_HINGE, axis=(0.0, 1.0, 0.0))
            wheel.add_geom(type=mj.mjtGeom.mjGEOM_SPHERE, size=(m.wheel_radius_m, 0.0, 0.0))
            self._finish_wheel(wheel, m.torque, m.wheel_friction)

    def _finish_wheel(self, wheel: Any, torque: float, friction: float) -> None:
        (joint,) = wheel.joints
        joint.frictionloss = torque
        joint.solref_friction = (MOTOR_STEPS * self.spec.option.timestep, 1.0)
        joint.solimp_friction = (MOTOR_IMPEDANCE, MOTOR_IMPEDANCE, 0.001, 0.5, 2.0)
        for geom in wheel.geoms:
            _set(geom, self._loose(friction * self._under_robots, FLOOR, CONTACT_STEPS) | {"contype": 0})

    def _add_urdf(self, name: str, model: UrdfDrive, place: Vec3, heading: float) -> None:
        """The frame of the root link is level, its axle at the place."""
        child = mj.MjSpec.from_string(_readable(model))
        names = {model.left_wheel: f"{name}/left", model.right_wheel: f"{name}/right"}
        (root,) = child.worldbody.bodies
        for body in child.bodies:
            for geom in body.geoms:
                _set(geom, self._loose(model.body_friction * self._under_robots, steps=CONTACT_STEPS))
            for joint in body.joints:
                joint.damping = np.zeros(3)
                if joint.name in names:
                    self._finish_wheel(body, model.torque, model.wheel_friction)
                    joint.name = names[joint.name]
        for each in child.bodies[1:]:
            each.name = f"{name}/link/{each.name}"
        root.name = name
        root.add_freejoint()
        axle, cos, sin = model.plan.axle, math.cos(heading), math.sin(heading)
        at = (place[0] - cos * axle[0] + sin * axle[1], place[1] - sin * axle[0] - cos * axle[1], -axle[2])
        self.spec.attach(child, frame=self.spec.worldbody.add_frame(pos=at, quat=quaternion_from_yaw(heading)))
        for each in (*self.spec.bodies, *self.spec.joints):
            each.name = each.name.removeprefix("/")  # of an attached model


def _readable(model: UrdfDrive) -> str:
    """The URDF as MuJoCo reads it."""
    robot = ET.parse(model.plan.path).getroot()  # noqa: S314  the user's own file, read before
    for inertia in robot.iter("inertia"):  # MuJoCo wants all six
        inertia.attrib.update({each: "0" for each in ("ixy", "ixz", "iyz") if each not in inertia.attrib})
    options = {"meshdir": str(model.plan.path.parent), "strippath": "false", "fusestatic": "false", "discardvisual": "true"}
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", options)
    return ET.tostring(robot, encoding="unicode")


def convex_parts_of(solid: AnySolid) -> Iterator[Array]:
    """Corners (k, 3) m, world, of the convex parts of a solid; of a mesh, the corners of a thin plate behind each triangle."""
    for corners, bottom, top in solid.uprights():
        yield np.concatenate([np.column_stack([corners, np.full(len(corners), level)]) for level in (bottom, top)])
    triangles: Array = getattr(solid, "triangles", np.empty((0, 3, 3)))
    for triangle in triangles:
        normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        size = float(np.linalg.norm(normal))
        if size > 0.0:
            yield np.concatenate([triangle, triangle - normal * (_PLATE_M / size)])


def _add_hull(body: Any, hull: Hull, **rest: Any) -> None:
    length, width, height = hull.size
    size = (0.5 * length, 0.5 * width, 0.5 * height)
    if hull.kind == "cylinder":
        size = (0.5 * length, 0.5 * height, 0.0)
    body.add_geom(type=_SHAPES[hull.kind], size=size, **rest)


def set_inertia(body: Any, mass_kg: float, centre: Vec3, inertia: Sequence[float]) -> None:
    """Set mass, centre of mass, m, and inertia about it, kg m2; without this call they come from the shapes."""
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat, body.inertia = mass_kg, centre, (1.0, 0.0, 0.0, 0.0), inertia


def _set(target: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        setattr(target, name, value)
