"""A row of gates: pairs of walls with a gap between them, straight ahead of each other or staggered."""

from dataclasses import dataclass
from typing import Annotated

import msgspec

from cosim.types import Positive
from physics.solids import Box, Color
from physics.world import World
from physics.worlds.surroundings import Surroundings

_COLORS: tuple[Color, Color] = ((208, 72, 56), (56, 104, 184))  # of the walls on the left and on the right


@dataclass(frozen=True, kw_only=True)
class Gates(Surroundings):
    """Gates one after the other along the x axis (kind ``gates``); the first one is ``spacing`` from the origin."""

    number: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 5  # of gates
    width: Positive = 1.5  # of the gap, m
    spacing: Positive = 4.0  # from gate to gate, m
    offset: float = 0.0  # of the gaps from the x axis, m: first to the left, next to the right, and so on
    wall: Positive = 2.0  # length of each of the two walls, m
    thickness: Positive = 0.2  # of the walls, m
    height: Positive = 1.0  # of the walls, m

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thickness >= self.spacing:
            raise ValueError(f"spacing = {self.spacing:g} leaves no room between gates, which are {self.thickness:g} m thick")

    def build(self) -> World:
        """The world itself."""
        solids = []
        for gate in range(self.number):
            x, middle = self.spacing * (gate + 1), self.offset * (1.0 if gate % 2 == 0 else -1.0)
            for side, color in zip((1.0, -1.0), _COLORS, strict=True):
                y = middle + side * 0.5 * (self.width + self.wall)
                size = (self.thickness, self.wall, self.height)
                solids.append(Box(center=(x, y, 0.5 * self.height), size=size, material="wood", color=color))
        return self.complete("gates" if self.offset == 0.0 else "gates-offset", solids=solids)


@dataclass(frozen=True, kw_only=True)
class GatesOffset(Gates):
    """Gates that stand alternately to the left and to the right (kind ``gates-offset``)."""

    offset: float = 0.75  # of the gaps from the x axis, m: first to the left, next to the right, and so on
