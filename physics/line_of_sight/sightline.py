"""Solids between two points: obstacles of the radio."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Array
from vcmvsp.physics.line_of_sight.meshes import MeshObstacles
from vcmvsp.physics.line_of_sight.prisms import PrismObstacles
from vcmvsp.physics.raycast.caster import by_bearing
from vcmvsp.physics.world.solids import AnySolid, Box, Mesh
from vcmvsp.physics.world.world import World, made_once

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NEVER_ZERO = 1e-300  # added to what is divided by: changes nothing but a zero
_TINY = 1e-200  # m
_FEW = 2048  # lines x boxes: with fewer, all lines are tested with all boxes
_ROOM_M = 1e-6  # round a box, so that rounding keeps no line away from it
_INSIDE = 1.0 - 1e-12  # boxes are smaller by this, so that a line along a face, or through an edge, does not count


class Sightline:
    """The solids of a world as obstacles of straight lines.

    Attributes:
        materials: of each of the m solids, (m,).
        thickness_m: of each as a wall, (m,): the shortest edge of a box; the diameter of a cylinder, and the least width of a
            convex prism, or their height if that is less; of other prisms and meshes that of a long wall of that shape (see
            `PrismObstacles` and `MeshObstacles`).
    """

    def __init__(self, solids: Sequence[AnySolid]) -> None:
        self.materials = tuple(solid.material for solid in solids)
        boxes = [solid for solid in solids if isinstance(solid, Box)]
        self._box_columns = np.array([k for k, solid in enumerate(solids) if isinstance(solid, Box)], np.int64)
        sizes = np.array([box.size for box in boxes], np.float64).reshape(-1, 3)
        self._centre: Floats = np.array([box.center for box in boxes], np.float64).reshape(-1, 3)
        yaw = np.array([box.yaw_rad for box in boxes], np.float64)
        (x, y, z), cos, sin = self._centre.T, np.cos(yaw), np.sin(yaw)
        middles = x * cos + y * sin, y * cos - x * sin, z  # along the box's own edges
        self._boxes: Floats = np.array([cos, sin, *middles, *(0.5 * _INSIDE * sizes.T)])
        self._around: Floats = 0.5 * np.hypot(sizes[:, 0], sizes[:, 1]) + _ROOM_M
        self._bottom, self._top = z - 0.5 * sizes[:, 2] - _ROOM_M, z + 0.5 * sizes[:, 2] + _ROOM_M
        self.thickness_m: Floats = np.zeros(len(solids))
        self.thickness_m[self._box_columns] = sizes.min(axis=1)
        others = {k: solid for k, solid in enumerate(solids) if not isinstance(solid, Box)}
        outlines = PrismObstacles({k: solid for k, solid in others.items() if not isinstance(solid, Mesh)})
        triangles = MeshObstacles({k: solid for k, solid in others.items() if isinstance(solid, Mesh)})
        self._others = [each for each in (outlines, triangles) if len(each.columns)]
        for each in self._others:
            self.thickness_m[each.columns] = each.thickness_m

    def crossings(self, tx: Floats, rx: Floats) -> tuple[Bools, Floats]:
        """Solids that the straight lines from one point to others pass through, with lengths.

        Args:
            tx: (3,) m, world.
            rx: (n, 3) m, world.

        Returns:
            Whether each line passes through each solid, (n, m), and the length inside it, (n, m) m. Touching is not passing.
        """
        inside = np.zeros((len(rx), len(self.materials)))
        middle, run = 0.5 * (tx + rx), rx - tx
        run[np.abs(run) < _TINY] = 0.0  # so that nothing makes a zero of what is never zero
        lines, length = np.concatenate([middle.T, run.T]), np.sqrt((run * run).sum(axis=1))
        if len(rx) * len(self._centre) <= _FEW:
            inside[:, self._box_columns] = _shares(lines[:, :, None], self._boxes[:, None]) * length[:, None]
        else:
            for line, box in self._near(tx, rx, run):
                shares = _shares(lines.take(line, axis=1), self._boxes.take(box, axis=1))
                inside[line, self._box_columns[box]] = shares * length[line]
        for each in self._others:
            inside[:, each.columns] = each.inside(tx, rx)
        return inside > 0.0, inside

    def _near(self, tx: Floats, rx: Floats, run: Floats) -> Iterator[tuple[Array, Array]]:
        """Candidate pairs (line, box), in portions; no other line meets a box."""
        aside = self._centre[:, :2] - tx[:2]
        away = np.hypot(aside[:, 0], aside[:, 1]) - self._around
        reach = np.hypot(run[:, 0], run[:, 1])
        low, high = np.minimum(tx[2], rx[:, 2]), np.maximum(tx[2], rx[:, 2])
        for line, box in by_bearing(tx, run, self._centre, self._around):
            near = (away[box] <= reach[line]) & (low[line] <= self._top[box]) & (self._bottom[box] <= high[line])
            yield line[near], box[near]


def sightline_of(world: World) -> Sightline:
    """The sightline of a world, made once."""
    return made_once(world, _sightline)


def _sightline(world: World) -> Sightline:
    return Sightline(world.solids)


def _shares(lines: Floats, boxes: Floats) -> Floats:
    """Share of lines inside boxes; the first axes are columns of both, the others broadcast.

    The slab method (T. L. Kay, J. T. Kajiya, Ray tracing complex scenes, SIGGRAPH 1986): a line is inside a box from the last
    plane that it enters by to the first that it leaves by. Counted from the middle of the line: there and back are equal.
    """
    x, y, z, dx, dy, dz = lines
    cos, sin, ahead, left, up, half_length, half_width, half_height = boxes
    entry, leave = np.float64(-0.5), np.float64(0.5)  # fractions of the line
    for half, offset, along in (
        (half_length, x * cos + y * sin - ahead, dx * cos + dy * sin),
        (half_width, y * cos - x * sin - left, dy * cos - dx * sin),
        (half_height, z - up, dz),
    ):
        per_metre = 1.0 / (along + _NEVER_ZERO)
        centre, reach = offset * per_metre, half * np.abs(per_metre)
        entry, leave = np.maximum(entry, -centre - reach), np.minimum(leave, reach - centre)
    shares: Floats = np.maximum(leave - entry, 0.0)
    return shares
