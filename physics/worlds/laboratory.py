"""A laboratory full of furniture, with aisles for robots."""

from collections.abc import Iterator
from dataclasses import dataclass

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Positive
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import Box, Color, Point2
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings, bounds_of, upright

LENGTH, WIDTH, HEIGHT = 16.4, 9.5, 2.6  # inside, m
PATROL: tuple[Point2, ...] = ((-7.5, -4.05), (7.5, -4.05), (7.5, 4.05), (-7.5, 4.05))
"""Way-points, m, of a loop through the aisle along the walls; counter-clockwise, all within 0.55 m free of anything."""

AISLES: tuple[float, float] = (-1.35, 1.35)
"""Where the two aisles between the rows of tables are, y in m; from x = -7.5 to 7.5, 0.5 m free on both sides."""

_COLUMNS = (-6.0, -3.0, 0.0, 3.0, 6.0)  # x of the tables, m
_ROWS = (-2.85, -0.15, 2.55)  # y of the tables, m; the chairs stand north of them
_TABLE = (1.6, 0.8, 0.74)  # length, depth, height, m
_TOP, _TABLE_LEG = 0.04, 0.06  # thickness of the top, edge of a leg, m
_SEAT, _SEAT_TOP, _BACK_TOP = 0.42, 0.46, 0.88  # edge, heights, m
_BOARD, _CHAIR_LEG = 0.04, 0.04  # thickness of seat and back, edge of a leg, m
_CHAIRS = (-0.4, 0.4)  # x of the chairs from the table's middle, m
_WOOD: Color = (188, 150, 104)
_CHAIR: Color = (64, 92, 140)
_WALL = 0.2  # m
_LEAST_TILE_M = 0.05
_DOOR_WIDTH, _DOOR_HEIGHT, _DOOR_X = 1.4, 2.1, -4.5  # m; in the south wall


@dataclass(frozen=True, kw_only=True)
class Laboratory(Surroundings):
    """A room of 16.4 x 9.5 x 2.6 m with 15 tables and 30 chairs (kind ``laboratory``); the origin is its middle.

    The door, an opening in the south wall, is 1.4 m wide around x = -4.5 m. There is no ceiling.
    """

    tile: Positive = 0.6  # edge of a tile of the floor, m

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tile < _LEAST_TILE_M:
            raise ScenarioError(f"must be at least {_LEAST_TILE_M:g} m, not {self.tile:g}: joints take 1 cm", key="tile")

    def build(self) -> World:
        """Build the world."""
        solids = [*_walls(), *(part for x in _COLUMNS for y in _ROWS for part in _place(x, y))]
        return self.complete("laboratory", solids=solids, ground=_floor(self.tile), bounds=bounds_of(LENGTH, WIDTH))


def _walls() -> Iterator[Box]:
    length, middle = LENGTH + 2.0 * _WALL, 0.5 * (WIDTH + _WALL)
    yield upright((0.0, middle), (length, _WALL), 0.0, HEIGHT, "brick")
    for side in (-1.0, 1.0):
        yield upright((side * 0.5 * (LENGTH + _WALL), 0.0), (_WALL, WIDTH), 0.0, HEIGHT, "brick")
    west, east = _DOOR_X - 0.5 * _DOOR_WIDTH, _DOOR_X + 0.5 * _DOOR_WIDTH
    for a, b, bottom in ((-0.5 * length, west, 0.0), (west, east, _DOOR_HEIGHT), (east, 0.5 * length, 0.0)):
        yield upright((0.5 * (a + b), -middle), (b - a, _WALL), bottom, HEIGHT, "brick")


def _place(x: float, y: float) -> Iterator[Box]:
    length, depth, height = _TABLE
    yield upright((x, y), (length, depth), height - _TOP, height, "wood", _WOOD)
    for u, v in _corners(length - _TABLE_LEG, depth - _TABLE_LEG):
        yield upright((x + u, y + v), (_TABLE_LEG, _TABLE_LEG), 0.0, height - _TOP, "wood", _WOOD)
    for along in _CHAIRS:
        seat_x, seat_y = x + along, y + 0.5 * depth + 0.5 * _SEAT
        yield upright((seat_x, seat_y), (_SEAT, _SEAT), _SEAT_TOP - _BOARD, _SEAT_TOP, "wood", _CHAIR)
        yield upright((seat_x, seat_y + 0.5 * (_SEAT - _BOARD)), (_SEAT, _BOARD), _SEAT_TOP, _BACK_TOP, "wood", _CHAIR)
        for u, v in _corners(_SEAT - _CHAIR_LEG, _SEAT - _CHAIR_LEG):
            yield upright((seat_x + u, seat_y + v), (_CHAIR_LEG, _CHAIR_LEG), 0.0, _SEAT_TOP - _BOARD, "metal", _CHAIR)


def _corners(length: float, depth: float) -> list[Point2]:
    return [(0.5 * length * i, 0.5 * depth * k) for i in (-1, 1) for k in (-1, 1)]


def _floor(tile: float) -> GroundPicture:
    """Tiles, drawn by their joints, from the middle of the room outwards."""
    half_length, half_width = 0.5 * LENGTH, 0.5 * WIDTH
    columns, rows = int(half_length / tile), int(half_width / tile)
    lines = [((k * tile, -half_width), (k * tile, half_width)) for k in range(-columns, columns + 1)]
    lines += [((-half_length, k * tile), (half_length, k * tile)) for k in range(-rows, rows + 1)]
    marks = tuple(Mark(line=line, width=0.01, color=(176, 174, 166)) for line in lines)
    return GroundPicture(size=(LENGTH, WIDTH), color=(206, 204, 196), resolution_m=0.01, marks=marks)
