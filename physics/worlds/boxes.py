"""Worlds of the solids in the scenario."""

from dataclasses import dataclass, field

from vcmvsp.physics.world.floor import GroundPicture
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import BARE, Bounds, Surroundings


@dataclass(frozen=True, kw_only=True)
class Empty(Surroundings):
    """A floor with the listed surroundings only (kind ``empty``)."""

    ground: GroundPicture = BARE  # how the floor looks
    bounds: Bounds | None = None  # west, south, east, north end, m: vehicles start inside; None: no end

    def build(self) -> World:
        """The world itself."""
        return self.complete("empty", ground=self.ground, bounds=self.bounds)


@dataclass(frozen=True, kw_only=True)
class Boxes(Empty):
    """Boxes as the scenario lists them (kind ``boxes``): ``boxes = [{ center = [2, 0, 0.5], size = [0.2, 4, 1] }]``."""

    boxes: tuple[Box, ...] = field()  # required here

    def build(self) -> World:
        """The world itself."""
        return self.complete("boxes", ground=self.ground, bounds=self.bounds)
