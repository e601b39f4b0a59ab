"""Vehicles from a user's URDF file and a few parameters.

The file gives links, masses, inertia, shapes and joints; firmware limits, motor torque and rotors are parameters with plausible
defaults. Input that Bullet silently replaces or ignores is refused by name: a link without mass or inertia, a missing joint, a
root link with a turned inertia.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, FileName, NonNegative, Positive, Vec3
from vcmvsp.cosim.util import limits
from vcmvsp.physics.vehicles.models import GroundVehicle, Quadrotor
from vcmvsp.physics.vehicles.urdf_shapes import DrawnPart, visual_parts

_TURNS = ("continuous", "revolute")
_OFF_DIAGONAL = ("ixy", "ixz", "iyz")


class _Plan(NamedTuple):
    """Wheels of a differential drive in a URDF file; places in the frame of the root link, m."""

    path: Path
    axle: Vec3  # middle of the wheel axle, projected onto the floor
    signs: tuple[float, float]  # of the left and right joint's axes: -1 points to the right
    wheel_radius_m: float
    track_m: float


@dataclass(frozen=True, kw_only=True)
class UrdfDrive(GroundVehicle):
    """A robot of two driven wheels from a URDF file; a body in Bullet, elsewhere it moves exactly as commanded.

    The root link's x points forward, its z up. Wheels are links with a sphere or a cylinder, on joints that turn.
    """

    file: FileName  # of the URDF, in a scenario relative to its folder
    left_wheel: str  # name of the joint
    right_wheel: str  # name of the joint
    wheel_friction: NonNegative = 0.9  # times the floor's; rubber on a hard floor, assumed
    body_friction: NonNegative = 0.05  # of casters and all else
    torque: Positive = 1.0  # N m, free at each wheel
    max_speed: Positive = 1.0  # m/s
    max_yaw_rate: Positive = 3.0  # rad/s
    accel: Positive = 0.5  # m/s2, away from standstill
    decel: Positive = 0.5  # m/s2, towards standstill
    yaw_accel: Positive = 2.0  # rad/s2, both ways

    def __post_init__(self) -> None:
        _ = self.plan  # errors of the file are raised at once

    @cached_property
    def plan(self) -> _Plan:
        """Wheels in the file.

        Raises:
            ScenarioError: with the key of the parameter that does not fit the file.
        """
        tree = _Tree(self.file)
        left, right = tree.wheel(self.left_wheel, "left_wheel"), tree.wheel(self.right_wheel, "right_wheel")
        if not math.isclose(left.radius_m, right.radius_m, rel_tol=1e-6):
            problem = f"both wheels must have the same radius, not {left.radius_m:g} m and {right.radius_m:g} m"
            raise ScenarioError(problem, key="right_wheel")
        track = float(left.place[1] - right.place[1])
        if track <= 0.0:
            raise ScenarioError(f"{self.left_wheel} is not to the left (+y) of {self.right_wheel}", key="left_wheel")
        x, y, z = (0.5 * (left.place + right.place)).tolist()
        return _Plan(tree.path, (x, y, z - left.radius_m), (left.sign, right.sign), left.radius_m, track)

    @cached_property
    def drawn(self) -> tuple[DrawnPart, ...]:
        """Shapes of the file in the vehicle's frame, with all joints at zero."""
        return _Tree(self.file).drawn(np.array(self.plan.axle))

    @property
    def wheel_radius_m(self) -> float:
        """Radius of both wheels, m."""
        return self.plan.wheel_radius_m

    @property
    def track_m(self) -> float:
        """Distance between the wheels' middles, m."""
        return self.plan.track_m


@dataclass(frozen=True, kw_only=True)
class UrdfQuadrotor(Quadrotor):
    """A quadrotor with the mass and inertia of a URDF file, in which all joints count as fixed; the rest are parameters.

    ``mass_kg`` and ``inertia`` come from the file. The hull is a cylinder as for `Quadrotor`.
    """

    file: FileName  # of the URDF, in a scenario relative to its folder

    def __post_init__(self) -> None:
        mass_kg, _, inertia = _Tree(self.file).rigid_body()
        object.__setattr__(self, "mass_kg", mass_kg)
        object.__setattr__(self, "inertia", inertia)
        super().__post_init__()

    @cached_property
    def drawn(self) -> tuple[DrawnPart, ...]:
        """Shapes of the file in the vehicle's frame, whose origin is the centre of mass."""
        tree = _Tree(self.file)
        return tree.drawn(tree.rigid_body()[1])


class _Wheel(NamedTuple):
    place: Array  # (3,) m, of its middle, root frame
    sign: float
    radius_m: float


class _Tree:
    def __init__(self, file: str) -> None:
        self.path = Path(file).resolve()
        try:
            limits.check_size(self.path, limits.JSON_BYTES)
            root = ET.parse(self.path).getroot()  # noqa: S314  # the user's own file
        except (OSError, ValueError, ET.ParseError) as error:
            problem = "is not XML" if isinstance(error, ET.ParseError) else "cannot be read"
            raise ScenarioError(f"{self.path} {problem}: {error}", key="file") from error
        self._root = root
        self._links = {link.get("name", ""): link for link in root.iterfind("link")}
        self._joints = {joint.get("name", ""): joint for joint in root.iterfind("joint")}
        if root.tag != "robot" or not self._links:
            raise ScenarioError(f"{self.path} is not a URDF file: it has no <robot> with links", key="file")
        for mesh in root.iter("mesh"):
            name = mesh.get("filename", "")
            if "://" not in name and not (self.path.parent / name).is_file():  # the engine finds package://
                problem = f"{self.path.name} refers to the mesh {name!r}, but there is no such file beside it"
                raise ScenarioError(problem, key="file")
        try:
            self._check()
        except ValueError as error:
            raise ScenarioError(f"{self.path}: invalid number: {error}", key="file") from error

    def _check(self) -> None:
        for name, link in self._links.items():
            for needed in ("inertial", "inertial/mass", "inertial/inertia"):
                if link.find(needed) is None:
                    tag = needed.rpartition("/")[2]
                    problem = f"the link {name!r} of {self.path.name} has no <{tag}>: add one"
                    raise ScenarioError(problem, key="file")
            _ = _origin(link.find("inertial"))  # numbers that cannot be read
            mass, inertia = self._mass(link)
            if not (0.0 < mass < math.inf and (np.linalg.eigvalsh(inertia) > 0.0).all()):
                raise ScenarioError(f"mass and inertia of the link {name!r} of {self.path.name} must be positive", key="file")
        root = self._check_tree()
        inertial = self._links[root].find("inertial")
        turned = _origin(inertial)[:3, :3]
        off = [abs(float(_attributes(inertial, "inertia").get(each, "0"))) for each in _OFF_DIAGONAL]
        if max(off) > 0.0 or not np.array_equal(turned, np.eye(3)):
            problem = f"the inertia of the root link {root!r} of {self.path.name} must be about x, y and z: "
            raise ScenarioError(f"{problem}without rpy, ixy, ixz, iyz", key="file")

    def _check_tree(self) -> str:
        children = [_name(joint, "child") for joint in self._joints.values()]
        roots = [name for name in self._links if name not in children]
        strays = [each for joint in self._joints.values() for each in (_name(joint, "child"), _name(joint, "parent"))]
        if missing := [name for name in strays if name not in self._links]:
            raise ScenarioError(f"a joint of {self.path.name} refers to the unknown link {missing[0]!r}", key="file")
        if len(roots) != 1:
            raise ScenarioError(f"{self.path.name} must have one root link, not {len(roots)}", key="file")
        (root,) = roots
        if twice := [name for name in children if children.count(name) > 1]:
            raise ScenarioError(f"the link {twice[0]!r} of {self.path.name} is the child of two joints", key="file")
        reached = {root}
        for _ in self._links:
            reached |= {_name(joint, "child") for joint in self._joints.values() if _name(joint, "parent") in reached}
        if loose := [name for name in self._links if name not in reached]:
            problem = f"joints of {self.path.name} form a loop: {loose[0]!r} is not connected to {root!r}"
            raise ScenarioError(problem, key="file")
        for joint in self._joints.values():
            _ = _origin(joint), _axis(joint)  # numbers that cannot be read
        return root

    @staticmethod
    def _mass(link: ET.Element) -> tuple[float, Array]:
        """Mass, kg, and inertia (3, 3), kg m2, of one link in its own inertial frame."""
        inertial = link.find("inertial")
        mass = float(_attributes(inertial, "mass").get("value", "nan"))
        entries = {name: float(value) for name, value in _attributes(inertial, "inertia").items()}
        xx, yy, zz = (entries.get(each, math.nan) for each in ("ixx", "iyy", "izz"))
        xy, xz, yz = (entries.get(each, 0.0) for each in _OFF_DIAGONAL)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if not np.isfinite(inertia).all():
            raise ScenarioError(f"the inertia of the link {link.get('name')!r} needs finite ixx, iyy and izz", key="file")
        return mass, inertia

    def frame(self, link: str) -> Array:
        """root_from_link, (4, 4), with all joints at zero."""
        joint = next((each for each in self._joints.values() if _name(each, "child") == link), None)
        if joint is None:
            return np.eye(4)
        return np.asarray(self.frame(_name(joint, "parent")) @ _origin(joint))

    def wheel(self, name: str, key: str) -> _Wheel:
        joint = self._joints.get(name)
        if joint is None:
            joints = ", ".join(self._joints) or "none"
            raise ScenarioError(f"{self.path.name} has no joint {name!r}; joints: {joints}", key=key)
        if joint.get("type") not in _TURNS:
            problem = f"the joint {name!r} of {self.path.name} is {joint.get('type')}; a wheel needs continuous or revolute"
            raise ScenarioError(problem, key=key)
        if joint.get("type") == "revolute" and {"lower", "upper"} & {*_attributes(joint, "limit")}:
            problem = f"the joint {name!r} of {self.path.name} has limits, but a wheel must turn without limits: "
            raise ScenarioError(problem + "make it continuous, or take lower and upper out of its <limit>", key=key)
        link = _name(joint, "child")
        frame = self.frame(link)
        axis = frame[:3, :3] @ _axis(joint)
        if abs(axis[1]) < 0.99 * float(np.linalg.norm(axis)):
            raise ScenarioError(f"the axis of {name!r} of {self.path.name} must lie along y, left to right", key=key)
        for shape in self._links[link].iterfind("collision"):
            for kind in ("sphere", "cylinder"):
                if (geometry := shape.find(f"geometry/{kind}")) is not None:
                    radius_m = self._radius(geometry, f"the {kind} of the link {link!r}", key)
                    return _Wheel(frame[:3, 3], float(np.sign(axis[1])), radius_m)
        raise ScenarioError(f"the link {link!r} of {self.path.name} needs a sphere or cylinder to roll on", key=key)

    def _radius(self, geometry: ET.Element, what: str, key: str) -> float:
        text, radius_m = geometry.get("radius", ""), math.nan
        with suppress(ValueError):
            radius_m = float(text)
        if not 0.0 < radius_m < math.inf:
            raise ScenarioError(f"{what} of {self.path.name} needs a positive radius, not {text!r}", key=key)
        return radius_m

    def drawn(self, reference: Array) -> tuple[DrawnPart, ...]:
        """Shapes in the frame at a reference point, (3,) m, root frame."""
        to_reference = np.eye(4)
        to_reference[:3, 3] = -reference
        own = self._root.iterfind("material")
        return visual_parts(self._links, own, self.path.parent, lambda name: to_reference @ self.frame(name), _origin)

    def rigid_body(self) -> tuple[float, Array, Vec3]:
        """Mass of all links, kg, their centre of mass, (3,) m, root frame, and inertia about x, y, z through it, kg m2."""
        parts = []
        for name, link in self._links.items():
            mass, inertia = self._mass(link)
            frame = self.frame(name) @ _origin(link.find("inertial"))
            parts.append((mass, frame[:3, 3], frame[:3, :3] @ inertia @ frame[:3, :3].T))
        total = math.fsum(mass for mass, _, _ in parts)
        centre = sum((mass * place for mass, place, _ in parts), np.zeros(3)) / total
        whole = np.zeros((3, 3))
        for mass, place, inertia in parts:  # parallel axes (Steiner)
            r = place - centre
            whole += inertia + mass * (r @ r * np.eye(3) - np.outer(r, r))
        x, y, z = np.diag(whole).tolist()
        return total, centre, (x, y, z)


def _attributes(element: ET.Element | None, child: str) -> Mapping[str, str]:
    if element is None or (tag := element.find(child)) is None:
        return {}
    return tag.attrib


def _name(joint: ET.Element, end: str) -> str:
    return _attributes(joint, end).get("link", "")


def _numbers(text: str) -> list[float]:
    numbers = [float(each) for each in text.split()]
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{text!r} must be three finite numbers")
    return numbers


def _axis(joint: ET.Element) -> Array:
    return np.array(_numbers(_attributes(joint, "axis").get("xyz", "1 0 0")))


def _origin(element: ET.Element | None) -> Array:
    """The transform of an ``<origin xyz rpy>``, (4, 4)."""
    origin = _attributes(element, "origin")
    roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"))
    (cr, sr), (cp, sp), (cy, sy) = ((float(np.cos(a)), float(np.sin(a))) for a in (roll, pitch, yaw))
    x, y, z = _numbers(origin.get("xyz", "0 0 0"))
    ahead = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x]
    left = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y]
    return np.array([ahead, left, [-sp, cp * sr, cp * cr, z], [0.0, 0.0, 0.0, 1.0]])
