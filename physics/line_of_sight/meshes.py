"""Lengths of straight lines inside meshes, from the triangles that they cross."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import Mesh

Floats = NDArray[np.float64]

SHEET_M = 0.01  # thickness of what has no inside: a mesh that is not closed, assumed
_SHORT_M = 1e-9  # what is left of a touch after rounding
_STEP_M = 1e-7  # aside, for a line through a corner
_BLOCK = 1 << 16  # lines x triangles at a time
_ASIDE = np.array(
    [0.5377, 0.7241, 0.4319]
)  # where a line is moved to that runs exactly through an edge: no mesh has this direction


class MeshObstacles:
    """Meshes, closed or not.

    A closed mesh is a body: a line is inside from each triangle where it enters to the one where it leaves. A mesh with an open
    edge has no inside: each of its triangles is a sheet of 1 cm. A line within a face may count as inside or not, the same from
    both ends.

    Attributes:
        columns: numbers of the meshes among the world's solids, (c,).
        thickness_m: (c,): twice the volume per surface, as for a long wall; for open meshes that of a sheet.
    """

    def __init__(self, meshes: Mapping[int, Mesh]) -> None:
        self.columns = np.array(list(meshes), np.int64)
        solids = list(meshes.values())
        corners = np.concatenate([np.empty((0, 3, 3)), *(mesh.triangles for mesh in solids)])
        self._of = np.repeat(np.arange(len(solids)), [len(mesh.triangles) for mesh in solids])
        self._closed = np.array([is_closed(mesh.triangles) for mesh in solids], bool)
        self._corners = corners
        self._middle = corners.mean(axis=1)
        offsets = corners - self._middle[:, None]
        self._radius2 = (offsets * offsets).sum(axis=2).max(axis=1, initial=0.0) * (1.0 + 1e-9) + 1e-18
        self.thickness_m: Floats = np.full(len(solids), SHEET_M)
        for number in np.flatnonzero(self._closed).tolist():
            self.thickness_m[number] = slab_m(solids[number].triangles)

    def inside(self, tx: Floats, rx: Floats) -> Floats:
        """Lengths inside each mesh, (n, c) m, of the lines from ``tx`` (3,) to each of ``rx`` (n, 3).

        A line through a corner may, by rounding, miss all triangles there. It then enters a body more or less often than it
        leaves, and is computed again a tenth of a micrometre aside.
        """
        result, uneven = self._inside(tx, rx)
        if len(uneven):
            result[uneven], _ = self._inside(tx + _STEP_M * _ASIDE, rx[uneven] + _STEP_M * _ASIDE)
        return result

    def _inside(self, tx: Floats, rx: Floats) -> tuple[Floats, Array]:
        """These lengths, and the lines with unequal numbers of entries and exits of closed meshes."""
        result, balance = np.zeros((2, len(rx), len(self.columns)))
        rows = max(1, _BLOCK // max(1, len(self._of)))
        for first in range(0, len(rx), rows):
            run = rx[first : first + rows] - tx
            length = np.sqrt((run * run).sum(axis=1))
            line, triangle = self._near(tx, run)
            crossed, place, sign = self._crossed(0.5 * (tx + rx[first + line]), run[line], self._corners[triangle])
            line, of = line[crossed], self._of[triangle[crossed]]
            within = np.abs(place) <= 0.5
            share = np.where(self._closed[of], sign * np.clip(place, -0.5, 0.5) * length[line], np.where(within, SHEET_M, 0.0))
            np.add.at(result, (first + line, of), share)
            np.add.at(balance, (first + line, of), sign * self._closed[of])
        result[result < _SHORT_M] = 0.0
        return result, np.flatnonzero(balance.any(axis=1))

    def _near(self, tx: Floats, run: Floats) -> tuple[Array, Array]:
        """Pairs of endless lines and triangles within the triangle's radius."""
        to = self._middle - tx
        along = run @ to.T
        run2 = (run * run).sum(axis=1)[:, None]
        apart2 = (to * to).sum(axis=1) * run2 - along * along  # times run2
        slack = 1e-12 * (to * to).sum(axis=1) * run2
        line, triangle = np.nonzero((apart2 <= self._radius2 * run2 + slack) & (run2 > 0.0))
        return line, triangle

    @staticmethod
    def _crossed(middle: Floats, run: Floats, corners: Floats) -> tuple[Array, Floats, Floats]:
        """Triangles that their lines cross, the places (share of the line from its middle), and exits (1) or entries (-1).

        The side on which a line passes an edge is the sign of a volume (R. J. Segura, F. R. Feito, Algorithms to test ray-
        triangle intersection, WSCG 2001), the same to the last bit, but for the sign, in both triangles of the edge: no line
        slips through between them. A line exactly through an edge is moved aside by an infinitesimal step, the same for all.
        """
        a, b, c = (corners[:, k] - middle for k in range(3))

        def side(p: Floats, q: Floats) -> Floats:
            x = p[:, 1] * q[:, 2] - p[:, 2] * q[:, 1]
            y = p[:, 2] * q[:, 0] - p[:, 0] * q[:, 2]
            z = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
            volume: Floats = run[:, 0] * x + run[:, 1] * y + run[:, 2] * z
            return volume

        def decided(volume: Floats, p: Floats, q: Floats) -> Floats:
            even = np.flatnonzero(volume == 0.0)
            signs = np.sign(volume)
            signs[even] = np.sign((np.cross((p - q)[even], run[even]) * _ASIDE).sum(axis=1))
            return signs

        ab, bc, ca = side(a, b), side(b, c), side(c, a)
        signs = decided(ab, corners[:, 0], corners[:, 1]) + decided(bc, corners[:, 1], corners[:, 2])
        signs += decided(ca, corners[:, 2], corners[:, 0])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slope = (normal * run).sum(axis=1)
        crossed = np.flatnonzero((np.abs(signs) == 3.0) & (slope != 0.0))
        place = (normal * a).sum(axis=1)[crossed] / slope[crossed]
        return crossed, place, np.sign(slope[crossed])


def is_closed(triangles: Array) -> bool:
    """Whether each edge is run equally often both ways: the triangles are the whole surface of a body."""
    _, number = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    corner = number.reshape(-1, 3)
    edges = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    count = int(corner.max(initial=0)) + 1
    there, back = np.sort(edges[:, 0] * count + edges[:, 1]), np.sort(edges[:, 1] * count + edges[:, 0])
    return bool(np.array_equal(there, back)) and len(edges) > 0


def slab_m(triangles: Array) -> float:
    """Twice the volume of a closed mesh per surface, m: the thickness of a plate much longer and wider than thick.

    (The mean length of all chords is twice that, 4 V / S; but walls count as crossed straight.)
    """
    a, b, c = (triangles[:, k] - triangles[0, 0] for k in range(3))
    cross = np.cross(b - a, c - a)
    surface = 0.5 * np.sqrt((cross * cross).sum(axis=1)).sum()
    volume = (a * np.cross(b, c)).sum() / 6.0
    return float(2.0 * abs(volume) / surface)
