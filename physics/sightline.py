"""Which solids lie between two points: what the radio asks about walls."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from physics.sightline_outlines import Outlines
from physics.sightline_triangles import Triangles
from physics.solids import AnySolid, Box, Mesh

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NEVER_ZERO = 1e-300  # added to what is divided by: changes nothing but a zero
_TINY = 1e-200  # m
_BLOCK = 8192  # lines x boxes at a time: arrays that stay in the processor's cache
_INSIDE = 1.0 - 1e-12  # boxes are smaller by this, so that a line along a face, or through an edge, does not count


class Sightline:
    """The solids of a world as obstacles of straight lines.

    Attributes:
        materials: what each of the m solids is made of, (m,).
        thickness_m: of each, (m,), as a wall: the shortest edge of a box; the diameter of a cylinder, and the least width of a
            convex prism, or their height if that is less; of other prisms and of meshes what a long wall of that shape has
            (see `Outlines` and `Triangles`).
    """

    def __init__(self, solids: Sequence[AnySolid]) -> None:
        self.materials = tuple(solid.material for solid in solids)
        boxes = [solid for solid in solids if isinstance(solid, Box)]
        self._box_columns = np.array([k for k, solid in enumerate(solids) if isinstance(solid, Box)], np.int64)
        sizes = np.array([box.size for box in boxes], np.float64).reshape(-1, 3)
        x, y, self._z = np.array([box.center for box in boxes], np.float64).reshape(-1, 3).T
        yaw = np.array([box.yaw_rad for box in boxes], np.float64)
        self._half = 0.5 * _INSIDE * sizes.T
        self._cos, self._sin = np.cos(yaw), np.sin(yaw)
        self._x, self._y = x * self._cos + y * self._sin, y * self._cos - x * self._sin  # centres, along the box's own edges
        self.thickness_m: Floats = np.zeros(len(solids))
        self.thickness_m[self._box_columns] = sizes.min(axis=1)
        others = {k: solid for k, solid in enumerate(solids) if not isinstance(solid, Box)}
        outlines = Outlines({k: solid for k, solid in others.items() if not isinstance(solid, Mesh)})
        triangles = Triangles({k: solid for k, solid in others.items() if isinstance(solid, Mesh)})
        self._others = [each for each in (outlines, triangles) if len(each.columns)]
        for each in self._others:
            self.thickness_m[each.columns] = each.thickness_m

    def crossings(self, tx: Floats, rx: Floats) -> tuple[Bools, Floats]:
        """Which solids the straight lines from one point to others pass through, and how far.

        Args:
            tx: (3,) m, world.
            rx: (n, 3) m, world.

        Returns:
            Whether each line passes through each solid, (n, m), and the length inside it, (n, m) m. To touch is not to pass.
        """
        rows = max(1, _BLOCK // max(1, self._z.size))
        blocks = [self._inside(tx, rx[first : first + rows]) for first in range(0, max(1, len(rx)), rows)]
        inside = np.concatenate(blocks)
        if self._others:
            boxes, inside = inside, np.zeros((len(rx), len(self.materials)))
            inside[:, self._box_columns] = boxes
            for each in self._others:
                inside[:, each.columns] = each.inside(tx, rx)
        return inside > 0.0, inside

    def _inside(self, tx: Floats, rx: Floats) -> Floats:
        """Lengths inside the boxes, (n, b) m.

        The slab method (T. L. Kay, J. T. Kajiya, Ray tracing complex scenes, SIGGRAPH 1986): a box is what lies between all
        three pairs of parallel planes; a line is inside from the last plane that it enters by to the first that it leaves by.
        Counted from the middle of the line, so that rounding makes no difference between there and back.
        """
        middle, run = 0.5 * (tx + rx), rx - tx
        run[np.abs(run) < _TINY] = 0.0  # so that nothing makes a zero of what is never zero
        x, y, z = middle[:, :1], middle[:, 1:2], middle[:, 2:]
        dx, dy, dz = run[:, :1], run[:, 1:2], run[:, 2:]
        cos, sin = self._cos, self._sin
        entry, leave = np.full((len(rx), cos.size), -0.5), np.full((len(rx), cos.size), 0.5)  # fractions of the line
        for half, offset, along in (
            (self._half[0], x * cos + y * sin - self._x, dx * cos + dy * sin),
            (self._half[1], y * cos - x * sin - self._y, dy * cos - dx * sin),
            (self._half[2], z - self._z, dz),
        ):
            per_metre = 1.0 / (along + _NEVER_ZERO)
            centre, reach = offset * per_metre, half * np.abs(per_metre)
            np.maximum(entry, -centre - reach, out=entry)
            np.minimum(leave, reach - centre, out=leave)
        length: Floats = np.sqrt((run * run).sum(axis=1))[:, None]
        inside: Floats = np.maximum(leave - entry, 0.0) * length
        return inside
