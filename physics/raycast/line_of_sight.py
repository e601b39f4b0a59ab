"""Solids between two points: obstacles of the radio."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import area_m2, is_convex, outward, width_m
from vcmvsp.physics.raycast.caster import by_bearing
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Mesh, Prism
from vcmvsp.physics.world.world import World, cached_on_world

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NEVER_ZERO = 1e-300  # added to divisors: changes only zeros
_TINY = 1e-200  # m
_FEW = 2048  # lines x boxes: with fewer, all lines are tested with all boxes
_ROOM_M = 1e-6  # margin around a box against rounding
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
        outlines = PrismObstacles({k: solid for k, solid in enumerate(solids) if isinstance(solid, Cylinder | Prism)})
        triangles = MeshObstacles({k: solid for k, solid in enumerate(solids) if isinstance(solid, Mesh)})
        self._others = [each for each in (outlines, triangles) if len(each.columns)]
        for each in self._others:
            self.thickness_m[each.columns] = each.thickness_m

    def crossings(self, tx: Floats, rx: Floats) -> tuple[Bools, Floats]:
        """Solids that the straight lines from ``tx`` (3,) m to each of ``rx`` (n, 3) m, world, pass through.

        Returns:
            Whether each line passes through each solid, (n, m), and the length inside it, (n, m) m. Touching is not passing.
        """
        inside = np.zeros((len(rx), len(self.materials)))
        middle, run = 0.5 * (tx + rx), rx - tx
        run[np.abs(run) < _TINY] = 0.0  # so that adding `_NEVER_ZERO` gives no zero
        lines, length = np.concatenate([middle.T, run.T]), np.sqrt((run * run).sum(axis=1))
        if len(rx) * len(self._centre) <= _FEW:
            inside[:, self._box_columns] = _box_shares(lines[:, :, None], self._boxes[:, None]) * length[:, None]
        else:
            for line, box in self._near(tx, rx, run):
                shares = _box_shares(lines.take(line, axis=1), self._boxes.take(box, axis=1))
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


@cached_on_world
def sightline_of(world: World) -> Sightline:
    """The sightline of a world."""
    return Sightline(world.solids)


def _box_shares(lines: Floats, boxes: Floats) -> Floats:
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
    return np.asarray(np.maximum(leave - entry, 0.0))


_SKIN_M = 1e-9  # solids are smaller by this all round, so that a line along a face does not count
_SHORT_M = 1e-9  # length of a touch after rounding
_PAIRS = 1 << 15  # lines x solids, and pairs x edges, at a time


class PrismObstacles:
    """Upright solids by their rings, counter-clockwise, and clockwise round holes.

    A line is inside from each edge where it enters to the one where it leaves, and between bottom and top. Prisms are not cut
    into convex pieces: a line along a cut is inside both, or none.

    Attributes:
        columns: numbers of the solids among the world's, (c,).
        thickness_m: (c,). Of a convex outline its least width, e.g. a cylinder's diameter; of another twice its area per length
            of all rings, as for a long wall; at most the height.
    """

    def __init__(self, solids: Mapping[int, Cylinder | Prism]) -> None:
        self.columns = np.array(list(solids), np.int64)
        pieces = [(column, *piece) for column, solid in enumerate(solids.values()) for piece in _pieces(solid)]
        self._column = np.array([column for column, *_ in pieces], np.int64)
        self.thickness_m: Floats = np.full(len(solids), np.inf)
        for column, rings, bottom, top in pieces:
            self.thickness_m[column] = min(self.thickness_m[column], top - bottom, _prism_thickness_m(rings))
        self._bottom = np.array([bottom for *_, bottom, _ in pieces], np.float64) + _SKIN_M
        self._top = np.array([top for *_, top in pieces], np.float64) - _SKIN_M
        shrunk = [[*map(_shrunk, rings)] for _, rings, *_ in pieces]
        starts = [np.concatenate(each) for each in shrunk]
        ends = [np.roll(ring, -1, axis=0) for each in shrunk for ring in each]
        self._count = np.array([len(each) for each in starts], np.int64)
        self._first = np.cumsum(self._count) - self._count
        self._start = np.concatenate([np.empty((0, 2)), *starts])
        self._end = np.concatenate([np.empty((0, 2)), *ends])
        boxes = np.array([(each.min(axis=0), each.max(axis=0)) for each in starts]).reshape(-1, 2, 2)
        self._middle, self._half = 0.5 * (boxes[:, 0] + boxes[:, 1]), 0.5 * (boxes[:, 1] - boxes[:, 0])

    def inside(self, tx: Floats, rx: Floats) -> Floats:
        """Lengths inside each solid, (n, c) m, of the lines from ``tx`` (3,) to each of ``rx`` (n, 3)."""
        result = np.zeros((len(rx), len(self.columns)))
        rows = max(1, _PAIRS // len(self._column))
        for first in range(0, len(rx), rows):
            middle, run = 0.5 * (tx + rx[first : first + rows]), rx[first : first + rows] - tx
            back = (run[:, 0] < 0.0) | ((run[:, 0] == 0.0) & (run[:, 1] < 0.0))
            run = np.where(back[:, None], -run, run)  # one direction for both ways: corners count alike
            run[np.abs(run) < _SKIN_M**4] = 0.0
            run[(run[:, :2] * run[:, :2]).sum(axis=1) < _SKIN_M**2, :2] = 0.0  # upright: nothing to divide by
            line, piece = self._near(middle, run)
            pairs = max(1, _PAIRS // int(self._count.max()))
            for start in range(0, len(line), pairs):
                some, of = line[start : start + pairs], piece[start : start + pairs]
                share = self._shares(middle[some], run[some], of)
                length = share * np.sqrt((run[some] * run[some]).sum(axis=1))
                length[length < _SHORT_M] = 0.0
                np.add.at(result, (first + some, self._column[of]), length)
        return result

    def _near(self, middle: Floats, run: Floats) -> tuple[Array, Array]:
        """Pairs of lines and pieces with a common part of bounding box and heights."""
        low, high = np.full((len(run), len(self._column)), -0.5), np.full((len(run), len(self._column)), 0.5)
        floor, ceiling = 0.5 * (self._top + self._bottom), 0.5 * (self._top - self._bottom)
        slabs = (*zip(self._middle.T, self._half.T, strict=True), (floor, ceiling))
        for k, (centre, half) in enumerate(slabs):
            per_metre = 1.0 / (run[:, k : k + 1] + _NEVER_ZERO)
            offset, reach = (middle[:, k : k + 1] - centre) * per_metre, half * np.abs(per_metre)
            np.maximum(low, -offset - reach, out=low)
            np.minimum(high, reach - offset, out=high)
        line, piece = np.nonzero(high > low)
        return line, piece

    def _shares(self, middle: Floats, run: Floats, of: Array) -> Floats:
        """Share of each line inside the piece of its pair, (p,).

        Crossed edges count from the middle of the line: plus at exits, minus at entries, each clipped to the line's part
        between bottom and top. A line exactly through a corner counts as passing it on the left: it crosses one edge there, or
        two, or none, like a line beside it.
        """
        count = self._count[of]
        pair = np.repeat(np.arange(len(of)), count)
        edge = np.repeat(self._first[of] - np.cumsum(count) + count, count) + np.arange(len(pair))
        a, b = self._start[edge] - middle[pair, :2], self._end[edge] - middle[pair, :2]
        dx, dy = run[pair, 0], run[pair, 1]
        side_a, side_b = dx * a[:, 1] - dy * a[:, 0], dx * b[:, 1] - dy * b[:, 0]
        out = (side_a < 0.0) & (side_b >= 0.0)  # from the right of the line to its left: an exit
        into = (side_a >= 0.0) & (side_b < 0.0)
        crossed = np.flatnonzero(out | into)
        along_a, along_b = (dx * p[:, 0] + dy * p[:, 1] for p in (a, b))
        weight = side_a[crossed] / (side_a[crossed] - side_b[crossed])
        place = along_a[crossed] + weight * (along_b[crossed] - along_a[crossed])
        place /= (dx * dx + dy * dy)[crossed]
        at = pair[crossed]
        low, high = self._between(middle[:, 2], run[:, 2], of)
        signed = np.where(out[crossed], 1.0, -1.0) * np.clip(place, low[at], high[at])
        share: Floats = np.maximum(np.bincount(at, signed, len(of)), 0.0)
        upright = np.flatnonzero((run[:, 0] == 0.0) & (run[:, 1] == 0.0))
        if len(upright):  # no edge is crossed: the whole line is at one place in the outline
            share[upright] = np.where(self._holds(a, b, pair, len(of))[upright], (high - low)[upright], 0.0)
        return share

    def _between(self, z: Floats, rise: Floats, of: Array) -> tuple[Floats, Floats]:
        """Limits of the line's part between bottom and top, in shares of the line from its middle."""
        per_metre = 1.0 / (rise + _NEVER_ZERO)
        centre, reach = (0.5 * (self._top + self._bottom)[of] - z) * per_metre, 0.5 * (self._top - self._bottom)[of]
        low, high = np.maximum(centre - reach * np.abs(per_metre), -0.5), np.minimum(centre + reach * np.abs(per_metre), 0.5)
        return low, np.maximum(high, low)

    @staticmethod
    def _holds(a: Floats, b: Floats, pair: Array, count: int) -> Array:
        """Whether the origin is inside, by pair: an odd number of edges lies east of it."""
        above = (a[:, 1] > 0.0) != (b[:, 1] > 0.0)
        slope = (b[:, 0] - a[:, 0]) / np.where(above, b[:, 1] - a[:, 1], 1.0)
        east = above & (a[:, 0] - a[:, 1] * slope > 0.0)
        return np.asarray(np.bincount(pair, east, count) % 2.0 == 1.0)


def _pieces(solid: Cylinder | Prism) -> list[tuple[list[Array], float, float]]:
    """Rings, bottom and top of the parts of a solid; a prism is one part."""
    if isinstance(solid, Prism):
        return [(solid.rings(), solid.bottom, solid.bottom + solid.height)]
    return [([corners], bottom, top) for corners, bottom, top in solid.uprights()]


def _prism_thickness_m(rings: Sequence[Array]) -> float:
    if len(rings) == 1 and is_convex(rings[0].tolist()):
        return width_m(rings[0])
    around = math.fsum(float(np.hypot(*(ring - np.roll(ring, 1, axis=0)).T).sum()) for ring in rings)
    return 2.0 * math.fsum(area_m2(ring) for ring in rings) / around


def _shrunk(ring: Array) -> Array:
    """A ring with its edges moved inwards by the skin; at sharp corners by at most ten skins."""
    inwards = -outward(ring)
    before = np.roll(inwards, 1, axis=0)
    total = before + inwards
    scale = np.maximum((total * total).sum(axis=1), 0.04)  # 2 (1 + cos of the turn)
    return np.asarray(ring + 2.0 * _SKIN_M * total / scale[:, None])


SHEET_M = 0.01  # thickness of a mesh that is not closed, assumed
_STEP_M = 1e-7  # displacement of a line through a corner
_MESH_PAIRS = 1 << 16  # lines x triangles at a time
_ASIDE = np.array([0.5377, 0.7241, 0.4319])  # displacement of a line exactly through an edge: no mesh has this direction


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
        """Lengths inside each mesh, and the lines with unequal numbers of entries and exits of closed meshes."""
        result, balance = np.zeros((2, len(rx), len(self.columns)))
        rows = max(1, _MESH_PAIRS // max(1, len(self._of)))
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

        signs = np.zeros(len(run))
        for k, (p, q) in enumerate(((a, b), (b, c), (c, a))):
            x = p[:, 1] * q[:, 2] - p[:, 2] * q[:, 1]
            y = p[:, 2] * q[:, 0] - p[:, 0] * q[:, 2]
            z = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
            sign = np.sign(run[:, 0] * x + run[:, 1] * y + run[:, 2] * z)
            (even,) = np.nonzero(sign == 0.0)
            edge = corners[even, k] - corners[even, (k + 1) % 3]
            sign[even] = np.sign((np.cross(edge, run[even]) * _ASIDE).sum(axis=1))
            signs += sign
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
