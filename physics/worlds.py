"""The worlds that a scenario can name: each has ``build() -> World``."""

from dataclasses import dataclass

from cosim.types import NonNegative
from physics.world import Box, World


@dataclass(frozen=True, kw_only=True)
class Empty:
    """A floor and nothing on it (kind ``empty``)."""

    floor_friction: NonNegative = 1.0

    def build(self) -> World:
        """The world itself."""
        return World(floor_friction=self.floor_friction)


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes as the scenario lists them (kind ``boxes``): ``boxes = [{ center = [2, 0, 0.5], size = [0.2, 4, 1] }]``."""

    boxes: tuple[Box, ...]
    floor_friction: NonNegative = 1.0

    def build(self) -> World:
        """The world itself."""
        return World(boxes=self.boxes, floor_friction=self.floor_friction)
