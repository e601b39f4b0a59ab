"""Stations: fixed places of radios, sensors and agents, without a body."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vcmvsp.physics.vehicles.urdf_shapes import GREY, DrawnPart
from vcmvsp.physics.world.solids import Hull

NO_HULL = Hull((0.0, 0.0, 0.0))
"""Hull of what no scanner meets and no camera sees."""


@dataclass(frozen=True, kw_only=True)
class FixedStation:
    """A fixed place without a body: ground control, a relay, a sensor. Nothing hits it, and no scanner or camera sees it."""

    radius_m: ClassVar[float] = 0.2  # of its mark in drawings
    height_m: ClassVar[float] = 0.4  # of that mark, which stands on its position
    file: ClassVar[str] = "station"  # name of the mark

    @property
    def hull(self) -> Hull:
        """Cylinder around the mark; for drawings only."""
        return Hull((2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m), (0.0, 0.0, 0.5 * self.height_m), "cylinder")

    @property
    def drawn(self) -> tuple[DrawnPart, ...]:
        """The mark of an antenna: a pyramid on its tip."""
        angles = np.arange(5) * (0.5 * np.pi)
        rim = np.column_stack([self.radius_m * np.cos(angles), self.radius_m * np.sin(angles), np.full(5, self.height_m)])
        tip, top = np.zeros((4, 3)), np.repeat([(0.0, 0.0, self.height_m)], 4, axis=0)
        sides = np.stack([tip, rim[1:], rim[:-1]], axis=1)
        return (DrawnPart(np.concatenate([sides, np.stack([top, rim[:-1], rim[1:]], axis=1)]), GREY),)
