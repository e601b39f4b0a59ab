"""Shapes for any number of vehicles: places in the frame of the leader.

Slots are centres in the frame of the leader, x forward, y left, m. With spacing s, member i = 0, 1, 2, ... and k = ceil(i / 2):

=========== ==================================================================================================
shape       slot of member i
=========== ==================================================================================================
``column``  ``(-i s, 0)``
``line``    ``(0, (-1)^i k s)``: by turns on the right and on the left of the leader
``echelon`` ``(-i s / sqrt 2, -i s / sqrt 2)``: back to the right
``wedge``   ``(-(sqrt 3 / 2) k s, (-1)^i k s / 2)``: equilateral, by turns right and left; three make the standard triangle
``box``     ``(-(i div m) s, -(i mod m) s)``, m = ceil(sqrt N): rows of m, the leader on the left of the first
``diamond`` rows of 1, 2, ..., m, ..., 2, 1; row r at ``x = -r s / sqrt 2``, its c members at ``y = (c - 1 - 2 j) s / sqrt 2``
``own``     as ``offsets`` say
=========== ==================================================================================================

Of a diamond that is not full, the last places are empty. Neighbours are ``s`` apart in all of them.
"""

import math
from collections.abc import Callable, Sequence
from typing import get_args

from vcmvsp.agents.formation.team.formation import ShapeName

Slot = tuple[float, float]  # x forward, y left, m
Slots = tuple[Slot, ...]


def slots(shape: ShapeName, count: int, spacing: float, offsets: Sequence[Slot] = ()) -> Slots:
    """Where ``count`` members belong, m in the leader's frame; the first is the leader's own place, (0, 0).

    Raises:
        ValueError: ``offsets`` of the shape ``own`` that are too few, do not begin with [0, 0], or name a place twice.
    """
    if shape == "own":
        return _own(count, offsets)
    unit = _UNIT[shape](count)
    # + 0.0: no negative zeros
    return ((0.0, 0.0), *((spacing * x + 0.0, spacing * y + 0.0) for x, y in unit[1:count]))


def width(places: Sequence[Slot], body: float) -> float:
    """How wide a lane the shape needs when all drive straight ahead, m, with bodies ``body`` m wide."""
    across = [y for _, y in places]
    return max(across) - min(across) + body


def _own(count: int, offsets: Sequence[Slot]) -> Slots:
    points = tuple((float(x), float(y)) for x, y in offsets)
    if len(points) < count:
        raise ValueError(f"shape 'own' needs the offsets of all {count} members, but there are {len(points)}")
    if points[0] != (0.0, 0.0):
        raise ValueError(f"the first of the offsets is the leader's own place and must be [0, 0], not {list(points[0])}")
    for number, place in enumerate(points):
        if place in points[:number]:
            raise ValueError(f"offsets has the place {list(place)} twice, as its items {points.index(place)} and {number}")
    return points[:count]


def _column(count: int) -> list[Slot]:
    return [(-float(i), 0.0) for i in range(count)]


def _line(count: int) -> list[Slot]:
    return [(0.0, _side(i) * _rank(i)) for i in range(count)]


def _echelon(count: int) -> list[Slot]:
    return [(-i * math.sqrt(0.5), -i * math.sqrt(0.5)) for i in range(count)]


def _wedge(count: int) -> list[Slot]:
    return [(-math.sqrt(0.75) * _rank(i), _side(i) * 0.5 * _rank(i)) for i in range(count)]


def _box(count: int) -> list[Slot]:
    m = _edge(count)
    return [(-float(i // m), -float(i % m)) for i in range(count)]


def _diamond(count: int) -> list[Slot]:
    m = _edge(count)
    rows = [*range(1, m + 1), *range(m - 1, 0, -1)]
    half = math.sqrt(0.5)
    return [(-r * half, (c - 1 - 2 * j) * half) for r, c in enumerate(rows) for j in range(c)]


def _side(i: int) -> float:
    return 1.0 if i % 2 == 0 else -1.0


def _rank(i: int) -> int:
    return (i + 1) // 2


def _edge(count: int) -> int:
    """Least m with m m >= count."""
    return 1 + math.isqrt(count - 1)


_UNIT: dict[ShapeName, Callable[[int], list[Slot]]] = {
    "column": _column,
    "line": _line,
    "echelon": _echelon,
    "wedge": _wedge,
    "box": _box,
    "diamond": _diamond,
}

SHAPES: tuple[ShapeName, ...] = get_args(ShapeName)
