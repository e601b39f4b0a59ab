"""The floor in the browser: a grid that grows, and a picture with what cameras see of it and the soft shadows of the solids.

The picture is opaque, and shadows are part of it: a browser sorts transparent surfaces by their centres, in a wrong order here.
Shadows that the page itself computes end a few metres from its camera and halve the speed of a software renderer.
"""

import math

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Floor, Scenery
from vcmvsp.cosim.view.page.drawing import FLOOR, FLOOR_DARK, NO_SHADOW, SUN

MARGIN_M, WIDE_M = 5.0, 40.0
APART = 0.004  # distance between grid and picture, of the size of the floor: a browser's depths are coarse
FLOOR_Z_M = -0.01  # of the seen floor, so that objects on it are visible
GRID_RGB, SECTION_RGB = (205, 208, 212), (165, 170, 176)
SECTION = 5  # cells
DARKNESS, SOFT_M = 0.35, 0.25  # share of the light that a shadow takes, and standard deviation of the blur of its edge
WIDEST_PX, FINEST_M = 2048, 0.02  # of the picture, and of its pixels
CLOSEST_PX = 3  # distance of two lines of the grid
FLAT_M = 0.02  # triangles below this height cast no shadow
MOST_TRIANGLES = 200_000  # of worlds with shadows


class DrawnFloor:
    """The floor of a scenery."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server, self._scenery = server, scenery
        west, south, east, north = self.extent = extent_of(scenery)
        size = self.size_m
        self._cell = 1.0 if size <= WIDE_M else 10.0
        self._vertices = np.asarray(scenery.vertices, float)
        self._tall = tall_of(self._vertices, np.asarray(scenery.triangles).astype(int))
        has_picture = scenery.floor is not None or len(self._tall) > 0
        self._picture: viser.ImageHandle | None = None
        self._z = FLOOR_Z_M - (APART * size if has_picture else 0.0)
        self.grid = server.scene.add_grid(
            "/floor",
            width=east - west,
            height=north - south,
            cell_size=self._cell,
            section_size=SECTION * self._cell,
            cell_color=GRID_RGB,
            section_color=SECTION_RGB,
            fade_distance=1e5,
            fade_from="origin",
            shadow_opacity=0.0,
            plane_color=FLOOR,
            plane_opacity=1.0,
            position=(0.5 * (west + east), 0.5 * (south + north), self._z),
        )

    @property
    def size_m(self) -> float:
        """Length of its longer side."""
        west, south, east, north = self.extent
        return max(east - west, north - south)

    def widen(self, west: float, south: float, east: float, north: float) -> None:
        """Extend the grid to these limits, with a margin so that it need not grow again soon."""
        low, high = self.extent[:2], self.extent[2:]
        if low[0] <= west and low[1] <= south and east <= high[0] and north <= high[1]:
            return
        more = MARGIN_M + 0.25 * max(high[0] - low[0], high[1] - low[1])
        west, south = min(low[0], west - more), min(low[1], south - more)
        east, north = max(high[0], east + more), max(high[1], north + more)
        self.extent = west, south, east, north
        self.grid.width, self.grid.height = east - west, north - south
        self.grid.position = (0.5 * (west + east), 0.5 * (south + north), self._z)

    def darken(self, dark: bool) -> None:
        """Draw the floor for a light or a dark page."""
        color = FLOOR_DARK if dark else FLOOR
        self.grid.plane_color = color
        floor = self._scenery.floor
        if floor is None and len(self._tall):
            floor = squared(extent_of(self._scenery), color, self._cell)
        if floor is None or (self._picture is not None and self._scenery.floor is not None):
            return
        pixels = floor.pixels if not len(self._tall) else shaded(floor, self._vertices, self._tall)
        if self._picture is not None:
            self._picture.image = pixels
            return
        (x, y), (length, width) = floor.center, floor.size
        self._picture = self._server.scene.add_image(
            "/floor-picture",
            np.asarray(pixels),
            length,
            width,
            format="jpeg",
            jpeg_quality=85,
            position=(x, y, FLOOR_Z_M),
            wxyz=(0.0, 1.0, 0.0, 0.0),  # rows along -y, seen from above: half a turn about x
            **NO_SHADOW,
        )


def extent_of(scenery: Scenery) -> tuple[float, float, float, float]:
    """West, south, east and north edge of the drawn floor, m."""
    places = [np.asarray(scenery.vertices)[:, :2]] if len(scenery.vertices) else []
    places += [np.array([each.pose[:2]]) for each in scenery.obstacles]
    places += [np.array([(x, y)]) for _, x, y in scenery.targets]
    if scenery.bounds is not None:
        west, south, east, north = scenery.bounds
        places.append(np.array([(west, south), (east, north)]))
    if not places:
        return -20.0, -20.0, 20.0, 20.0
    every = np.concatenate(places)
    (west, south), (east, north) = every.min(axis=0) - MARGIN_M, every.max(axis=0) + MARGIN_M
    return float(west), float(south), float(east), float(north)


def tall_of(vertices: Array, triangles: Array) -> Array:
    """The triangles that cast shadows, (k, 3); none of a world with too many."""
    if not 0 < len(triangles) <= MOST_TRIANGLES:
        return np.zeros((0, 3), int)
    return triangles[(vertices[triangles, 2] > FLAT_M).any(axis=1)]


def squared(extent: tuple[float, float, float, float], color: tuple[int, int, int], cell_m: float) -> Floor:
    """A floor of one colour with the lines of the grid."""
    west, south, east, north = extent
    length, width = east - west, north - south
    pixel_m = max(max(length, width) / WIDEST_PX, FINEST_M)
    columns, rows = math.ceil(length / pixel_m), math.ceil(width / pixel_m)
    pixels = np.full((rows, columns, 3), color, np.uint8)
    for step_m, line in ((cell_m, GRID_RGB), (SECTION * cell_m, SECTION_RGB)):
        pixels[:, _lines(columns, step_m / pixel_m)] = line
        pixels[_lines(rows, step_m / pixel_m)] = line
    return Floor(pixels=pixels, center=(0.5 * (west + east), 0.5 * (south + north)), size=(columns * pixel_m, rows * pixel_m))


def _lines(count: int, step: float) -> Array:
    """Rows or columns of the lines: as in the browser's grid, one goes through the middle. None if they were too close."""
    if step < CLOSEST_PX:
        return np.zeros(0, int)
    each_side = math.floor(0.5 * count / step)
    places = np.floor(0.5 * count + step * np.arange(-each_side, each_side + 1)).astype(int)
    return places[(places >= 0) & (places < count)]


def shaded(floor: Floor, vertices: Array, triangles: Array) -> Array:
    """The picture of a floor, (h, w, 3) uint8, with the shadows of these triangles, (t, 3), of vertices (v, 3) m."""
    import cv2

    rows, columns = np.asarray(floor.pixels).shape[:2]
    per_m = np.array([columns / floor.size[0], rows / floor.size[1]])
    corner = np.array(floor.center) + np.array((-0.5, 0.5)) * floor.size  # north-west: row 0 is the north edge
    cast = vertices[:, :2] - np.maximum(vertices[:, 2:], 0.0) * np.array(SUN[:2]) / SUN[2]
    pixels = ((cast - corner) * per_m * (1.0, -1.0))[triangles]
    shadow = np.zeros((rows, columns), np.uint8)
    for corners in np.round(pixels).astype(np.int32):
        cv2.fillConvexPoly(shadow, corners, 255)
    sigma = SOFT_M * float(per_m.max())
    if sigma > 0.3:
        shadow = np.asarray(cv2.GaussianBlur(shadow, (0, 0), sigma))
    light = 1.0 - DARKNESS / 255.0 * shadow[..., None].astype(np.float32)
    return np.asarray(np.asarray(floor.pixels) * light).astype(np.uint8)
