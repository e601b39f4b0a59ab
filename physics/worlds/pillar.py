"""One pillar on an empty floor: the smallest world with something in the way."""

from dataclasses import dataclass

from vcmvsp.cosim.types import Positive
from vcmvsp.physics.world.solids import Box, Cylinder, Point2, Solid
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings


@dataclass(frozen=True, kw_only=True)
class Pillar(Surroundings):
    """A pillar, round or square (kind ``pillar``)."""

    position: Point2 = (5.0, 0.0)  # of its axis, x, y, m
    radius: Positive = 0.5  # of the pillar, m; half its edge where it is square
    square: bool = False  # whether its sides are flat, along the axes
    height: Positive = 3.0  # of the pillar, m

    def build(self) -> World:
        """The world itself."""
        center, edge = (*self.position, 0.5 * self.height), 2.0 * self.radius
        pillar: Solid = Cylinder(center=center, radius=self.radius, height=self.height)
        if self.square:
            pillar = Box(center=center, size=(edge, edge, self.height))
        return self.complete("pillar", solids=[pillar])
