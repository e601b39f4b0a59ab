"""Common parameters of all kinds of worlds: further solids, moving bodies, targets, floor, wind, light."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative
from vcmvsp.physics.world.floor import GroundPicture, Mark, around, read_picture
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Point2, Prism, rectangle
from vcmvsp.physics.world.targets import GroundTarget, names, placed
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
    moving: tuple[Moving, ...] = ()  # obstacles that keep to a time-table
    targets: tuple[GroundTarget, ...] = ()  # lie on the ground and are to be found: ``[{ name = "flag", place = [3, 4] }]``
    floor_friction: NonNegative = 1.0  # multiplies the friction of what rolls or slides on the floor
    zones: tuple[Zone, ...] = ()  # parts of the floor with another friction
    wind: Wind = CALM  # air that moves: ``{ velocity = [3, 0, 0], gust = 1 }``
    light: Light = DAYLIGHT  # where the sun is: ``{ direction = [0.3, 0.2, 1], ambient = 0.6 }``

    def __post_init__(self) -> None:
        bodies = [each.name for each in self.movables]
        bodies += [each.name for each in self.moving]
        for what, called in (("two of movables and moving", bodies), ("two targets", names(self.targets))):
            for name in called:
                if called.count(name) > 1:
                    raise ScenarioError(f"{what} are called {name!r}: give each a name of its own")

    def sited(self) -> tuple[GroundTarget, ...]:
        """The targets, all with a place or a way.

        Raises:
            ScenarioError: a target has neither.
        """
        for number, target in enumerate(self.targets):
            if target.place is None and not target.way:
                problem = "needs a place or a way: only a town has streets to choose a place on"
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
            raise ScenarioError(f"west, south, east, north: the first two must be less, not {bounds}", key="bounds")
        _check_pictures(ground, self.targets)
        return World(
            name=name,
            solids=(*solids, *self.boxes, *self.cylinders, *self.prisms),
            movables=self.movables,
            moving=self.moving,
            targets=placed(self.sited()),
            floor_friction=self.floor_friction,
            zones=self.zones,
            ground=_with(ground, self.zones),
            wind=self.wind,
            light=self.light,
            bounds=bounds,
        )


def _with(ground: GroundPicture, zones: Sequence[Zone]) -> GroundPicture:
    """The ground with the coloured zones painted on it."""
    colored = [(zone, zone.color) for zone in zones if zone.color is not None]
    marks = [Mark(outline=rectangle_points(zone.center, zone.size, zone.yaw_rad), color=color) for zone, color in colored]
    if not marks:
        return ground
    if ground.plain:
        return around(marks, ground.color)
    return msgspec.structs.replace(ground, marks=(*ground.marks, *marks))


def _check_pictures(ground: GroundPicture, targets: Sequence[GroundTarget]) -> None:
    pictures = [ground.picture, *[mark.picture for mark in ground.marks]]
    pictures += [target.picture for target in targets]
    for picture in filter(None, dict.fromkeys(pictures)):
        try:
            read_picture(picture)
        except ValueError as error:
            raise ScenarioError(str(error)) from error


def rectangle_points(center: Point2, size: Point2, yaw_rad: float = 0.0) -> tuple[Point2, ...]:
    """Corners of a rectangle, m, for marks and prisms."""
    corners = rectangle(*center, 0.5 * size[0], 0.5 * size[1], yaw_rad).tolist()
    return tuple((x, y) for x, y in corners)
