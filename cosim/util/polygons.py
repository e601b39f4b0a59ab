"""Polygons in the plane, with holes: validity of outlines, convex parts, depth of overlaps."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from vcmvsp.cosim.types import Array

Point = tuple[float, float]
_ROUNDING = 4e-16  # of a turn, against its two products (J. R. Shewchuk, Adaptive precision predicates, 1997: 3.33e-16)


def outward(corners: Array) -> Array:
    """Outward unit normals (..., k, 2) of the edges of counter-clockwise polygons."""
    along = np.roll(corners, -1, axis=-2) - corners
    return np.asarray(np.stack([along[..., 1], -along[..., 0]], axis=-1) / np.hypot(along[..., :1], along[..., 1:]))


def overlap_m(a: Array, b: Array) -> float:
    """Shortest way out of each other, m, of two convex polygons, (k, 2) and (j, 2) m; 0: they share no area.

    The smallest overlap of their shadows over all directions across their edges (separating axis theorem).
    """
    depth = math.inf
    for polygon in (a, b):
        axes = outward(polygon).T
        shadows_a, shadows_b = a @ axes, b @ axes
        ahead, behind = shadows_a.max(axis=0) - shadows_b.min(axis=0), shadows_b.max(axis=0) - shadows_a.min(axis=0)
        depth = min(depth, float(np.minimum(ahead, behind).min()))
    return max(depth, 0.0)


def area_m2(outline: Array) -> float:
    """Area of a polygon, (k, 2) m; negative if it runs clockwise."""
    x, y = (outline - outline[0]).T  # without loss of precision far from the origin
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def width_m(outline: Array) -> float:
    """Least width of a convex polygon, (k, 2) m.

    One of its edges lies along the narrowest gap (M. E. Houle, G. T. Toussaint, Computing the width of a set, 1988).
    """
    shadows: Array = outline @ outward(outline).T
    return float((shadows.max(axis=0) - shadows.min(axis=0)).min())


def problem_of(outline: Sequence[Point], holes: Sequence[Sequence[Point]] = ()) -> str:
    """Reason why an outline with holes is no polygon; empty: it is one."""
    for ring in (outline, *holes):
        if len(ring) < 3:
            return f"needs at least three corners, not {len(ring)}"
        points = np.array(ring, float)
        if not np.isfinite(points).all():
            return "has a corner that is not finite"
        if (points == np.roll(points, -1, axis=0)).all(axis=1).any():
            return "has two equal corners next to each other"
    edges = _Edges([outline, *holes])
    if edges.crossing is not None:
        return "crosses or touches itself at {} and {}".format(*edges.crossing)
    if any(area_m2(np.array(ring, float)) == 0.0 for ring in (outline, *holes)):
        return "has no area"
    for number, hole in enumerate(holes):
        if not edges.inside(np.array(hole[0], float), without=number + 1):
            return f"has a hole (number {number}) outside its outline"
    return ""


class _Edges:
    """The edges of several rings, the outline's first."""

    def __init__(self, rings: Sequence[Sequence[Point]]) -> None:
        points = [np.array(ring, float) for ring in rings]
        self._ring = np.repeat(np.arange(len(rings)), [len(each) for each in points])
        self._number = np.concatenate([np.arange(len(each)) for each in points])
        self.start = np.concatenate(points)
        self.end = np.concatenate([np.roll(each, -1, axis=0) for each in points])

    @property
    def crossing(self) -> tuple[str, str] | None:
        """The first two edges that share a point without being neighbours; edge i begins at corner i."""
        low, high = np.minimum(self.start, self.end), np.maximum(self.start, self.end)
        near = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=2)  # boxes around edges meet
        i, j = np.nonzero(np.triu(near, 1))
        length = np.bincount(self._ring)[self._ring[i]]
        apart = (self._number[j] - self._number[i]) % length
        neighbours = (self._ring[i] == self._ring[j]) & ((apart == 1) | (apart == length - 1))
        i, j = i[~neighbours], j[~neighbours]
        meeting = np.flatnonzero(_meet(self.start[i], self.end[i], self.start[j], self.end[j]))
        if not len(meeting):
            return None
        return self._name(i[meeting[0]]), self._name(j[meeting[0]])

    def _name(self, edge: int) -> str:
        hole = f" of hole {self._ring[edge] - 1}" if self._ring[edge] else ""
        return f"edge {self._number[edge]}{hole}"

    def inside(self, point: Array, without: int) -> bool:
        """Whether a point is inside, ignoring one ring: an odd number of edges lies east of it."""
        a, b = self.start[self._ring != without] - point, self.end[self._ring != without] - point
        above = (a[:, 1] > 0.0) != (b[:, 1] > 0.0)
        a, b = a[above], b[above]
        return bool((a[:, 0] - a[:, 1] * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1]) > 0.0).sum() % 2)

    def clear(self, p: Point, q: Point) -> bool:
        """Whether the line between two corners meets edges only at its ends."""
        a, b = np.array(p), np.array(q)
        ends = [(each == corner).all(axis=1) for each in (self.start, self.end) for corner in (a, b)]
        others = ~np.logical_or.reduce(ends)
        start, end = self.start[others], self.end[others]
        met = _meet(np.broadcast_to(a, start.shape), np.broadcast_to(b, start.shape), start, end)
        return not met.any() and not any(_lies_between(p, q, (x, y)) for x, y in self.start.tolist())

    def add(self, p: Point, q: Point) -> None:
        """Add an edge for `clear`."""
        self.start, self.end = np.concatenate([self.start, [p]]), np.concatenate([self.end, [q]])


def _meet(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Which of the closed segments ab and cd, (n, 2) each, share a point."""

    def side(a: Array, b: Array, c: Array) -> Array:
        """On which side of a line through a and b each c lies: 1 left, -1 right, 0 on it."""
        first, second = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]), (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        return np.asarray(np.sign(first - second))

    boxes = (np.minimum(a, b) <= np.maximum(c, d)) & (np.minimum(c, d) <= np.maximum(a, b))
    crossed: Array = (side(a, b, c) * side(a, b, d) <= 0.0) & (side(c, d, a) * side(c, d, b) <= 0.0)
    return crossed & boxes.all(axis=1)


def _lies_between(p: Point, q: Point, r: Point) -> bool:
    if r in (p, q) or _turn(p, q, r) != 0.0:
        return False
    return 0.0 < (r[0] - p[0]) * (q[0] - p[0]) + (r[1] - p[1]) * (q[1] - p[1]) < (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2


def convex_parts(outline: Sequence[Point], holes: Sequence[Sequence[Point]] = ()) -> list[Array]:
    """Convex polygons, (k, 2) m counter-clockwise, that fill a polygon without overlap.

    Holes are joined to the outline by bridges; ears are cut off (G. H. Meisters, Polygons have ears, 1975); parts are merged
    where they stay convex (S. Hertel, K. Mehlhorn, Fast triangulation of simple polygons, 1983).
    """
    ring = _turned(outline, counter_clockwise=True)
    turns = _turns(ring)
    if not holes and min(turns) >= 0.0:
        return [np.array([corner for corner, turn in zip(ring, turns, strict=True) if turn > 0.0])]
    ring = _bridged(ring, [_turned(hole, counter_clockwise=False) for hole in holes])
    corners = list(dict.fromkeys(ring))
    number = {corner: k for k, corner in enumerate(corners)}
    parts = _triangles(corners, [number[corner] for corner in ring])
    i = 0
    while i < len(parts):  # a part takes in neighbours until none fits any more
        for j in range(i + 1, len(parts)):
            whole = _together(corners, parts[i], parts[j])
            if whole is not None:
                parts[i] = whole
                del parts[j]
                break
        else:
            i += 1
    points = np.array(corners)
    return [points[part] for part in parts]


def is_convex(outline: Sequence[Point]) -> bool:
    """Whether a polygon without crossings, either way round, is convex; corners in a line are allowed."""
    return min(_turns(_turned(outline, counter_clockwise=True))) >= 0.0


def _turns(ring: Sequence[Point]) -> list[float]:
    return [_turn(ring[k - 1], ring[k], ring[(k + 1) % len(ring)]) for k in range(len(ring))]


def _turned(ring: Sequence[Point], *, counter_clockwise: bool) -> list[Point]:
    corners = [(float(x), float(y)) for x, y in ring]
    return corners if (area_m2(np.array(corners)) > 0.0) == counter_clockwise else corners[::-1]


def _bridged(ring: list[Point], holes: list[list[Point]]) -> list[Point]:
    """One ring along the outline and, over bridges there and back, round all holes."""
    edges, rest = _Edges([ring, *holes]), list(holes)
    while rest:
        places = [(k, m, q) for k, hole in enumerate(rest) for m, q in enumerate(hole)]
        ways = [(math.dist(p, q), i, k, m) for i, p in enumerate(ring) for k, m, q in places]
        for _, i, k, m in sorted(ways):
            p, q = ring[i], rest[k][m]
            if _opens(ring[i - 1], p, ring[(i + 1) % len(ring)], q) and edges.clear(p, q):
                hole = rest.pop(k)
                ring = [*ring[: i + 1], *hole[m:], *hole[: m + 1], *ring[i:]]
                edges.add(p, q)
                break
        else:
            raise ValueError("holes touch or cross the outline or each other")
    return ring


def _opens(before: Point, corner: Point, after: Point, to: Point) -> bool:
    """Whether the line from a corner to another place begins inside: a ring may pass the same corner several times."""
    sides = _turn(before, corner, to) > 0.0, _turn(corner, after, to) > 0.0
    return all(sides) if _turn(before, corner, after) > 0.0 else any(sides)


def _turn(p: Point, q: Point, r: Point) -> float:
    """Twice the area of a triangle: positive if it runs counter-clockwise; exact sign."""
    first, second = (p[0] - r[0]) * (q[1] - r[1]), (p[1] - r[1]) * (q[0] - r[0])
    turn = first - second
    if abs(turn) > _ROUNDING * (abs(first) + abs(second)):
        return turn
    px, py, qx, qy, rx, ry = map(Fraction, (*p, *q, *r))
    exact = (px - rx) * (qy - ry) - (py - ry) * (qx - rx)
    return math.copysign(max(abs(float(exact)), 5e-324), exact) if exact else 0.0


def _triangles(corners: Sequence[Point], ring: Sequence[int]) -> list[list[int]]:
    rest, triangles = list(ring), []
    while len(rest) > 3:
        for k in range(len(rest)):
            a, b, c = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            turn = _turn(corners[a], corners[b], corners[c])
            if turn < 0.0 or (turn > 0.0 and _any_inside(corners, (a, b, c), rest)):
                continue
            if turn > 0.0:
                triangles.append([a, b, c])
            del rest[k]  # also the middle one of three corners in a line
            break
        else:
            raise ValueError("an outline crosses itself")
    p, q, r = (corners[k] for k in rest)
    return [*triangles, rest] if _turn(p, q, r) > 0.0 else triangles


def _any_inside(corners: Sequence[Point], triangle: tuple[int, int, int], ring: Sequence[int]) -> bool:
    a, b, c = (corners[k] for k in triangle)
    (low_x, _, high_x), (low_y, _, high_y) = (sorted(axis) for axis in zip(a, b, c, strict=True))
    places = (corners[k] for k in ring if k not in triangle)
    near = (p for p in places if low_x <= p[0] <= high_x and low_y <= p[1] <= high_y)
    return any(_turn(a, b, p) >= 0.0 and _turn(b, c, p) >= 0.0 and _turn(c, a, p) >= 0.0 for p in near)


def _together(corners: Sequence[Point], first: list[int], second: list[int]) -> list[int] | None:
    """The union of two polygons with a common edge, if it is convex."""
    for i, a in enumerate(first):
        b = first[(i + 1) % len(first)]
        if a in second and b in second and second[(second.index(b) + 1) % len(second)] == a:
            j = second.index(b)
            rest = second[j:] + second[:j]  # b, a, ...
            whole = first[: i + 1] + rest[2:] + first[i + 1 :]
            if min(_turns([corners[k] for k in whole])) >= 0.0:
                return whole
    return None
