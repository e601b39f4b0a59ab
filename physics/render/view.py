"""View of a camera, and the mapping from its pixels to the floor."""

from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array


class View(NamedTuple):
    """View of a pinhole camera with its principal point in the middle of the picture.

    A pixel samples its middle: column c and row r look along
    ``((c + 0.5 - width / 2) / focal_px, (r + 0.5 - height / 2) / focal_px, 1)`` in the camera's frame.
    """

    eye: Array  # (3,) m, world, above the floor
    rotation: Array  # (3, 3) world_from_camera; camera: x to the right of the picture, y down, z along the optical axis
    width: int  # px
    height: int
    focal_px: float
    reach_m: float = 1000.0  # solids and bodies further away, along the optical axis, are left out

    def columns(self) -> Array:
        """Slope of each column's rays to the right, (width,)."""
        slopes: Array = (np.arange(self.width) + (0.5 - 0.5 * self.width)) / self.focal_px
        return slopes

    def rows(self) -> Array:
        """Slope of each row's rays downwards, (height,)."""
        slopes: Array = (np.arange(self.height) + (0.5 - 0.5 * self.height)) / self.focal_px
        return slopes

    def floor_from_pixel(self) -> Array:
        """Homography (3, 3) from columns and rows to x, y on the floor; behind the camera above the horizon."""
        (x, y, z), rotation = self.eye, self.rotation
        meets = np.stack([x * rotation[2] - z * rotation[0], y * rotation[2] - z * rotation[1], rotation[2]])
        focal, center = self.focal_px, 0.5 / self.focal_px
        ray = np.array(
            [[1 / focal, 0.0, center * (1 - self.width)], [0.0, 1 / focal, center * (1 - self.height)], [0.0, 0.0, 1.0]]
        )
        floor: Array = meets @ ray
        return floor
