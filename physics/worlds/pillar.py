"""One pillar on an empty floor: the smallest world with something in the way."""

from dataclasses import dataclass

from cosim.types import Positive
from physics.solids import Cylinder, Point2
from physics.world import World
from physics.worlds.surroundings import Surroundings


@dataclass(frozen=True, kw_only=True)
class Pillar(Surroundings):
    """A round pillar (kind ``pillar``)."""

    position: Point2 = (5.0, 0.0)  # of its axis, x, y, m
    radius: Positive = 0.5  # of the pillar, m
    height: Positive = 3.0  # of the pillar, m

    def build(self) -> World:
        """The world itself."""
        pillar = Cylinder(center=(*self.position, 0.5 * self.height), radius=self.radius, height=self.height)
        return self.complete("pillar", solids=[pillar])
