"""Specification of one vehicle of a run: its model, start, sensors and pose source."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, Protocol

from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.fusion import Fusion
from vcmvsp.cosim.types import Value, Vec3
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.vehicles.models import DifferentialDrive, Point, Quadrotor
from vcmvsp.physics.vehicles.station import FixedStation
from vcmvsp.physics.vehicles.urdf import UrdfDrive
from vcmvsp.physics.world.solids import Hull

POSE_SOURCES = ("truth", "odometry", "positioning", "fusion")


class Vehicle(Protocol):
    """Properties of every vehicle."""

    @property
    def radius_m(self) -> float:
        """Radius of its circle in drawings, m."""

    @property
    def height_m(self) -> float:
        """Height from its lowest to its highest point, m."""

    @property
    def hull(self) -> Hull:
        """Outer shape, for sensors and contacts of other vehicles."""


def flies(model: Vehicle | type[Vehicle]) -> bool:
    """Whether a model, or a class of models, takes commands of aerial vehicles, or is a station, at any height like them."""
    return issubclass(model if isinstance(model, type) else type(model), Point | Quadrotor | FixedStation)


def body_of(model: Vehicle) -> Body:
    """Size of a vehicle's body, for its agent."""
    (length, width, _), (dx, dy, _), kind = model.hull[:3]
    aside, round_m = 0.5 * width + abs(dy), 0.5 * length + math.hypot(dx, dy)
    if kind != "cylinder":
        round_m = math.hypot(0.5 * length + abs(dx), aside)
    return Body(width_m=2.0 * aside, radius_m=round_m, flies=flies(model))


class VehicleSpec(Value, frozen=True, kw_only=True):
    """One vehicle of a run: model, start, sensors and pose source."""

    name: str
    model: Vehicle
    position: Vec3 = (0.0, 0.0, 0.0)  # m, world; on the ground z does not count; too low to fly: it stands on the floor
    heading: float = 0.0  # rad
    pose_source: str = "truth"  # "truth" | "odometry" | "positioning" | "fusion"
    positioning: Positioning | None = None  # the sensor, if fitted
    fusion: Fusion | None = None  # for the pose source "fusion"; every run has its own copy
    sensors: Mapping[str, Sensor] = {}  # others, by name

    def __post_init__(self) -> None:
        key = "pose_source"
        if self.pose_source not in POSE_SOURCES:
            raise ScenarioError(f'"{self.pose_source}" is unknown; pose sources: {", ".join(POSE_SOURCES)}', key=key)
        if self.pose_source == "positioning" and self.positioning is None:
            raise ScenarioError('"positioning" needs a sensor "positioning" on the vehicle', key=key)
        if self.fusion is not None and self.positioning is None:
            raise ScenarioError('"fusion" needs a sensor "positioning" on the vehicle', key=key)
        if (self.pose_source == "odometry" or self.fusion is not None) and flies(self.model):
            raise ScenarioError(f'"{self.pose_source}" needs wheels; this vehicle flies', key=key)

    @property
    def start(self) -> Vec3:
        """Real start, m: on the ground at z = 0; in the air, not lower than standing on the floor."""
        (x, y, z), hull = self.position, self.model.hull
        if not flies(self.model):
            return x, y, 0.0
        return x, y, max(z, 0.5 * hull.size[2] - hull.offset[2]) if z >= 0.0 else z


class Roles(NamedTuple):
    """Vehicles with bodies by role; the keys are their rows."""

    ground: dict[int, VehicleSpec]  # differential drives
    air: dict[int, VehicleSpec]  # quadrotors
    external: dict[int, VehicleSpec]  # of any model, moved from outside


def roles_of(vehicles: Sequence[VehicleSpec], external: Collection[str]) -> Roles:
    """The roles of vehicles; ``external``: names of the external ones."""
    roles = Roles({}, {}, {})
    for row, spec in enumerate(vehicles):
        if spec.name in external:
            roles.external[row] = spec
        elif isinstance(spec.model, DifferentialDrive | UrdfDrive):
            roles.ground[row] = spec
        elif isinstance(spec.model, Quadrotor):
            roles.air[row] = spec
    return roles
