"""A row of gates: pairs of walls with a gap between them, straight ahead of each other or staggered."""

from dataclasses import dataclass
from typing import Annotated

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Positive
from vcmvsp.physics.world.solids import Box, Color
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings

_COLORS: tuple[Color, Color] = ((208, 72, 56), (56, 104, 184))  # of the walls on the left and on the right


@dataclass(frozen=True, kw_only=True)
class Gates(Surroundings):
    """Gates one after the other along the x axis (kind ``gates``); the first one is ``spacing`` from the origin."""

    number: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 5  # of gates
    width: Positive = 1.5  # of the gap, m
    spacing: Positive = 4.0  # from gate to gate, m
    offset: float = 0.0  # of the gaps from the x axis, m: first to the left, next to the right, and so on
    offsets: tuple[float, ...] = ()  # of each gap from the x axis, m, left is positive; in place of ``offset``, for all gates
    wall: Positive = 2.0  # length of each of the two walls, m
    thickness: Positive = 0.2  # of the walls, m
    height: Positive = 1.0  # of the walls, m

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thickness >= self.spacing:
            raise ValueError(f"spacing = {self.spacing:g} leaves no room between gates, which are {self.thickness:g} m thick")
        if self.offsets and len(self.offsets) != self.number:
            problem = f"must be as many as there are gates, number = {self.number}, not {len(self.offsets)}"
            raise ScenarioError(problem, key="offsets")
        if self.offsets and self.offset != type(self).offset:
            raise ScenarioError("says where all gaps are, so that offset says nothing; leave one of them out", key="offsets")

    def middles(self) -> tuple[float, ...]:
        """Of the gaps, y m."""
        return self.offsets or tuple(self.offset * (-1.0) ** gate for gate in range(self.number))

    def build(self) -> World:
        """The world itself."""
        solids = []
        for gate, middle in enumerate(self.middles()):
            x = self.spacing * (gate + 1)
            for side, color in zip((1.0, -1.0), _COLORS, strict=True):
                y = middle + side * 0.5 * (self.width + self.wall)
                size = (self.thickness, self.wall, self.height)
                solids.append(Box(center=(x, y, 0.5 * self.height), size=size, material="wood", color=color))
        return self.complete("gates-offset" if any(self.middles()) else "gates", solids=solids)


@dataclass(frozen=True, kw_only=True)
class GatesOffset(Gates):
    """Gates that stand alternately to the left and to the right (kind ``gates-offset``)."""

    offset: float = 0.75  # of the gaps from the x axis, m: first to the left, next to the right, and so on
