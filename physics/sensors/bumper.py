"""Bumper: contacts of the sides of the hull."""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.types import Measured, Vec3
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

_FLOOR_M = 0.01  # what touches the world below this height touches the floor


@dataclass(kw_only=True)
class Bumper(Sensor):
    """1 for each segment of the hull that touches a solid or another body, else 0. The floor does not count.

    Four segments are called ``front``, ``left``, ``back`` and ``right``, and are the sides of a box; any other number ``s0``,
    ``s1``, ... counter-clockwise, with the middle of ``s0`` ahead. They share the outline evenly by bearing from its centre
    after it has been stretched to a square.
    """

    segments: Annotated[int, msgspec.Meta(ge=1, le=360)] = 4  # how many

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """Segments with a contact now. No draws."""
        n = self.segments
        names = ["front", "left", "back", "right"]
        if n != 4:
            names = [f"s{number}" for number in range(n)]
        values = dict.fromkeys(names, 0.0)
        for a, b, place in scene.touching:
            if row in (a, b) and (b is not None or place[2] > _FLOOR_M):
                values[names[round(self._bearing(scene, row, place) * n / math.tau) % n]] = 1.0
        return Measured(time_ns=scene.now_ns, values=values)

    def _bearing(self, scene: Scene, row: int, place: Vec3) -> float:
        """Bearing of a place from the middle of the hull, stretched to a square, rad counter-clockwise from ahead."""
        hull = scene.hulls[row]
        x, y, _ = ((np.array(place) - scene.position[row]) @ scene.rotation(row) - hull.offset).tolist()
        return math.atan2(y / hull.size[1], x / hull.size[0])
