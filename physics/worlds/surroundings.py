"""Common parameters of all kinds of worlds: further solids, moving bodies, targets, floor, wind, light."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative
from vcmvsp.physics.world.floor import GroundPicture, GroundTarget, Mark, around, names, placed, read_picture
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Cylinder, Point2, Prism, rectangle
from vcmvsp.physics.world.world import Light, Movable, Moving, Wind, World, Zone

Bounds = tuple[float, float, float, float]

CALM = Wind()
DAYLIGHT = Light()
BARE = GroundPicture()


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Base of all kinds of worlds."""

    boxes: tuple[Box, ...] = ()  # further boxes: ``[{ center = [2, 0, 0.5], size = [0.2, 4, 1], material = "brick" }]``
    cylinders: tuple[Cylinder, ...] = ()  # further cylinders: ``[{ center = [2, 0, 0.5], radius = 0.1, height = 1 }]``
    prisms: tuple[Prism, ...] = ()  # further outlines, raised: ``[{ outline = [[0, 0], [2, 0], [0, 2]], height = 3 }]``
    movables: tuple[Movable, ...] = ()  # bodies that can be pushed
    moving: tuple[Moving, ...] = ()  # obstacles that move by a timetable
    targets: tuple[GroundTarget, ...] = ()  # targets on the ground for a search: ``[{ name = "flag", place = [3, 4] }]``
    floor_friction: NonNegative = 1.0  # factor on the friction of bodies on the floor
    zones: tuple[Zone, ...] = ()  # parts of the floor with another friction
    wind: Wind = CALM  # air that moves: ``{ velocity = [3, 0, 0], gust = 1 }``
    light: Light = DAYLIGHT  # where the sun is: ``{ direction = [0.3, 0.2, 1], ambient = 0.6 }``

    def __post_init__(self) -> None:
        bodies: list[Movable | Moving] = [*self.movables, *self.moving]
        called_bodies = [each.name for each in bodies]
        for kinds, called in (("movables or moving obstacles", called_bodies), ("targets", names(self.targets))):
            for name in called:
                if called.count(name) > 1:
                    raise ScenarioError(f"two {kinds} are named {name!r}: use distinct names")

    def sited(self) -> tuple[GroundTarget, ...]:
        """The targets, all with a place or a way.

        Raises:
            ScenarioError: a target has neither.
        """
        for number, target in enumerate(self.targets):
            if target.place is None and not target.way:
                problem = "needs a place or a way: only the world 'urban' chooses places by itself"
                raise ScenarioError(problem, key=f"targets[{number}]")
        return self.targets

    def complete(
        self, name: str, *, solids: Sequence[AnySolid] = (), ground: GroundPicture = BARE, bounds: Bounds | None = None
    ) -> World:
        """The world of these solids, with all listed surroundings.

        Raises:
            ScenarioError: the bounds are the wrong way round, a picture cannot be read, or a target has no place.
        """
        if bounds is not None and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
            raise ScenarioError(f"must be west, south, east, north; west < east and south < north, not {bounds}", key="bounds")
        painted: list[GroundPicture | Mark | GroundTarget] = [ground, *ground.marks, *self.targets]
        try:
            for picture in filter(None, dict.fromkeys(each.picture for each in painted)):
                read_picture(picture)
        except ValueError as error:
            raise ScenarioError(str(error)) from error
        values = {key: getattr(self, key) for key in ("movables", "moving", "floor_friction", "zones", "wind", "light")}
        solids = (*solids, *self.boxes, *self.cylinders, *self.prisms)
        ground = _with(ground, self.zones)
        return World(name=name, solids=solids, targets=placed(self.sited()), ground=ground, bounds=bounds, **values)


def _with(ground: GroundPicture, zones: Sequence[Zone]) -> GroundPicture:
    colored = [(zone, zone.color) for zone in zones if zone.color is not None]
    marks = [Mark(outline=rectangle_points(zone.center, zone.size, zone.yaw_rad), color=color) for zone, color in colored]
    if marks and ground.plain:
        return around(marks, ground.color)
    return msgspec.structs.replace(ground, marks=(*ground.marks, *marks)) if marks else ground


def bounds_of(length: float, width: float) -> Bounds:
    """Bounds of a rectangle around the origin, m."""
    return -0.5 * length, -0.5 * width, 0.5 * length, 0.5 * width


def upright(center: Point2, size: Point2, bottom: float, top: float, material: str, color: Color | None = None) -> Box:
    """A box between two heights, m."""
    return Box(center=(*center, 0.5 * (bottom + top)), size=(*size, top - bottom), material=material, color=color)


def rectangle_points(center: Point2, size: Point2, yaw_rad: float = 0.0) -> tuple[Point2, ...]:
    """Corners of a rectangle, m, for marks and prisms."""
    return tuple((x, y) for x, y in rectangle(*center, 0.5 * size[0], 0.5 * size[1], yaw_rad).tolist())


@dataclass(frozen=True, kw_only=True)
class Empty(Surroundings):
    """A floor with the listed surroundings only (kind ``empty``)."""

    ground: GroundPicture = BARE  # how the floor looks
    bounds: Bounds | None = None  # west, south, east, north end, m: vehicles start inside; None: no end

    def build(self) -> World:
        """Build the world."""
        return self.complete("empty", ground=self.ground, bounds=self.bounds)


@dataclass(frozen=True, kw_only=True)
class Boxes(Empty):
    """Boxes as the scenario lists them (kind ``boxes``): ``boxes = [{ center = [2, 0, 0.5], size = [0.2, 4, 1] }]``."""

    boxes: tuple[Box, ...] = field()  # required here

    def build(self) -> World:
        """Build the world."""
        return self.complete("boxes", ground=self.ground, bounds=self.bounds)
