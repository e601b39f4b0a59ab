"""Targets of searches: flat pictures or discs on the ground; some of them move."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise

import msgspec
import numpy as np

from vcmvsp.cosim.types import FileName, Positive
from vcmvsp.physics.world.solids import Color, Point2


class GroundTarget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A target of a search, flat on the ground: a picture or a disc, at rest or moving."""

    name: str = ""  # its label; empty: target1, target2 and so on
    picture: FileName = ""  # an image file, made square; its upper edge is north before it is turned. Empty: a disc
    color: Color = (224, 32, 160)  # of the disc
    size: Positive = 2.0  # edge of the picture or diameter of the disc, m
    place: Point2 | None = None  # where its middle lies, x, y, m; default: somewhere on a street of a town
    yaw_rad: float = 0.0  # the picture is turned by this, counter-clockwise, and stays so on its way
    way: tuple[Point2, ...] = ()  # it moves instead: from the first of these places, x, y, m, straight to the next, and so on
    speed: Positive | None = None  # along its way, m/s; default: it has none
    loop: bool = False  # from the last place it goes back to the first, and so on; else it stays there

    def __post_init__(self) -> None:
        numbers = (*(self.place or ()), self.yaw_rad, *(value for place in self.way for value in place))
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"place, yaw_rad and way of a target must be finite, not {numbers}")
        if self.way and self.place is not None:
            raise ValueError("a target has a place or a way, not both")
        if self.way and (len(self.way) < 2 or any(a == b for a, b in pairwise(self.way))):
            raise ValueError("the way of a target needs two places or more, each unlike the one before")
        if bool(self.way) != (self.speed is not None) or (self.loop and not self.way):
            raise ValueError("a target that moves needs way and speed; one at rest has neither, nor loop")


@dataclass(frozen=True, kw_only=True)
class PlacedTarget:
    """A target in a world."""

    name: str  # unique among the targets of the world
    size_m: float  # edge of the picture, or diameter of the disc
    picture: str  # an image file; empty: a disc
    color: Color  # of the disc
    yaw_rad: float  # the picture is turned by this
    way: tuple[Point2, ...]  # corners of its way, x, y, m; the only one of a target at rest
    speed: float = 0.0  # along the way, m/s
    loop: bool = False  # it goes round

    def place(self, time_s: float) -> Point2:
        """Its middle at a time, x, y, m."""
        if len(self.way) == 1:
            return self.way[0]
        corners, run = self._corners, self.speed * max(time_s, 0.0)
        if self.loop:
            run %= self._runs[-1]
        x, y = (float(np.interp(run, self._runs, column)) for column in zip(*corners, strict=True))
        return x, y

    def yaw(self, time_s: float) -> float:
        """Its yaw at a time, rad."""
        return self.yaw_rad

    @cached_property
    def _corners(self) -> tuple[Point2, ...]:
        return (*self.way, self.way[0]) if self.loop else self.way

    @cached_property
    def _runs(self) -> list[float]:
        return [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(self._corners))]


def names(targets: Sequence[GroundTarget]) -> list[str]:
    """Names of targets."""
    return [each.name or f"target{number}" for number, each in enumerate(targets, start=1)]


def placed(targets: Sequence[GroundTarget]) -> tuple[PlacedTarget, ...]:
    """Targets with a place or a way, as they lie in a world."""
    in_world = []
    for name, each in zip(names(targets), targets, strict=True):
        way = each.way if each.place is None else (each.place,)
        in_world.append(
            PlacedTarget(
                name=name,
                size_m=each.size,
                picture=each.picture,
                color=each.color,
                yaw_rad=each.yaw_rad,
                way=way,
                speed=each.speed or 0.0,
                loop=each.loop,
            )
        )
    return tuple(in_world)
