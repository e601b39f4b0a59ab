"""Search for the paths between two points by the image method, and for what may see what.

The code runs interpreted or compiled, see `cosim.compiled`: it works on single numbers, and allocates nothing.

A path is a row of interactions, each a facet that reflects or an edge that diffracts, with its point. Candidates come from
lists that were made once: the facets and edges which anything in the cell of an end may see, and whether those may see each
other. Each candidate is then constructed exactly and its legs are tested against the obstacles near them, which a grid over the
plan gives
(J. Amanatides, A. Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987).
"""

import math

from vcmvsp.cosim.util.surfaces import OPAQUE, SKIN
from vcmvsp.netsim.propagation.rays.arrays import Terrain, Work
from vcmvsp.netsim.propagation.rays.field import size, weigh

TRACE, LOOK, LOOK_FROM_SITES, BEAMS = 0, 1, 2, 3
"""Tasks of `run`."""

DONE, FULL = 0, 1
"""Results of `run`: all done, or the output is full."""

NEXT, PATHS, PASSES, LEGS, PAIRS, OVERFLOW, SOURCE, CORNERS, SIDES, BEGIN = range(10)
"""Places in `Work.counts`."""

UNKNOWN, SEEN, HIDDEN = range(3)
"""Values of `Work.sees`."""

NEAR_M = 1e-6  # what a line touches for less than this, or at its end, does not stop it
APART_M = 1e-9  # least distance of a point from the plane that reflects it
GROUP = 8  # edges in a sphere
WEAKEST = 1e-30  # power gain: paths with less are left out, e.g. those through metal


def run(w: Terrain, s: Work, what: int) -> int:
    """Trace the pairs from ``counts[NEXT]`` on, or look out of the region or the sites; returns `DONE` or `FULL`."""
    if what == LOOK:
        look(w, s)
        return DONE
    if what == LOOK_FROM_SITES:
        look_from_sites(w, s)
        return DONE
    if what == BEAMS:
        return find_beams(w, s)
    while s.counts[NEXT] < len(s.a):
        paths, passes = s.counts[PATHS], s.counts[PASSES]
        s.counts[OVERFLOW] = 0
        trace(w, s, s.counts[NEXT])
        if s.counts[OVERFLOW]:
            s.counts[PATHS], s.counts[PASSES] = paths, passes
            return FULL
        s.counts[NEXT] += 1
    return DONE


# --- the paths of a pair ---


def trace(w: Terrain, s: Work, p: int) -> None:
    """Find all paths of pair p."""
    a, b = s.a[p], s.b[p]
    s.end_x[0], s.end_y[0], s.end_z[0] = s.site_x[a], s.site_y[a], s.site_z[a]
    s.end_x[1], s.end_y[1], s.end_z[1] = s.site_x[b], s.site_y[b], s.site_z[b]
    if all_clear(w, s, 0):
        emit(w, s, p, 0)
    if s.reflections > 0:
        reflect(w, s, p)
    if s.diffraction:
        mark_edges(w, s, b)
        x, y, z = s.end_x[0], s.end_y[0], s.end_z[0]
        for k in range(s.site_edge_first[a], s.site_edge_first[a + 1]):
            e = s.site_edge[k]
            s.element[0] = -1 - e
            if s.edge_mark[e] != s.counts[PAIRS] or not outside(w, e, x, y, z):
                continue
            if meet(w, s, e, 0, foot(w, e, x, y, z), distance_from(w, e, x, y, z)) and all_clear(w, s, 1):
                emit(w, s, p, 1)
        for end in range(2 if s.reflections > 0 else 0):
            if end == 1:
                mark_edges(w, s, a)
            diffract_and_reflect(w, s, p, end)


def mark_edges(w: Terrain, s: Work, site: int) -> None:
    """Mark the edges that a site may see, and is outside of, with a new stamp, ``counts[PAIRS]``."""
    s.counts[PAIRS] += 1
    x, y, z = s.site_x[site], s.site_y[site], s.site_z[site]
    for k in range(s.site_edge_first[site], s.site_edge_first[site + 1]):
        e = s.site_edge[k]
        if outside(w, e, x, y, z):
            s.edge_mark[e], s.edge_at[e], s.edge_apart[e] = s.counts[PAIRS], foot(w, e, x, y, z), distance_from(w, e, x, y, z)


def reflect(w: Terrain, s: Work, p: int) -> None:
    """All sequences of reflections up to the order, depth first.

    The first facet is one that a may see, the last one that b may see.
    """
    a, b = s.a[p], s.b[p]
    s.counts[PAIRS] += 1
    for k in range(s.site_facet_first[b], s.site_facet_first[b + 1]):
        s.facet_mark[s.site_facet[k]] = s.counts[PAIRS]
    s.image_x[0], s.image_y[0], s.image_z[0] = s.end_x[0], s.end_y[0], s.end_z[0]
    depth = 1
    s.place[1] = s.site_facet_first[a]
    while depth > 0:
        if depth == 1:
            ends = s.site_facet_first[a + 1]
        elif depth == s.reflections:
            ends = s.site_facet_first[b + 1]
        else:
            ends = len(w.plane_at)
        if s.place[depth] == ends:
            depth -= 1
            continue
        f = s.site_facet[s.place[depth]] if depth in (1, s.reflections) else s.place[depth]
        s.place[depth] += 1
        if (depth > 1 and not may_see(w, s, s.chosen[depth - 1], f)) or not mirror(w, s, f, depth):
            continue
        s.chosen[depth] = f
        if s.facet_mark[f] == s.counts[PAIRS]:
            retrace(w, s, p, depth)
        if depth < s.reflections:
            depth += 1
            s.place[depth] = s.site_facet_first[b] if depth == s.reflections else 0


def mirror(w: Terrain, s: Work, f: int, depth: int) -> bool:
    """Set the image over a facet of the image before; False: it lies behind the facet."""
    x, y, z = s.image_x[depth - 1], s.image_y[depth - 1], s.image_z[depth - 1]
    side = w.normal_x[f] * x + w.normal_y[f] * y + w.normal_z[f] * z - w.plane_at[f]
    if side < APART_M and not (w.both_sides[f] and side < -APART_M):
        return False
    s.image_x[depth] = x - 2.0 * side * w.normal_x[f]
    s.image_y[depth] = y - 2.0 * side * w.normal_y[f]
    s.image_z[depth] = z - 2.0 * side * w.normal_z[f]
    return True


def retrace(w: Terrain, s: Work, p: int, count: int) -> None:
    """Find the points of a sequence of reflections from its end; emit the path if it is there."""
    x, y, z = s.end_x[1], s.end_y[1], s.end_z[1]
    for k in range(count, 0, -1):
        if not cross(w, s, s.chosen[k], x, y, z, k, k - 1):
            return
        x, y, z = s.point_x[k - 1], s.point_y[k - 1], s.point_z[k - 1]
    if all_clear(w, s, count):
        for k in range(count):
            s.element[k] = s.chosen[k + 1]
        emit(w, s, p, count)


def cross(w: Terrain, s: Work, f: int, x: float, y: float, z: float, image: int, k: int) -> bool:
    """Set point k where the line from a point to an image behind it meets a facet; False: it does not."""
    ix, iy, iz = s.image_x[image], s.image_y[image], s.image_z[image]
    here = w.normal_x[f] * x + w.normal_y[f] * y + w.normal_z[f] * z - w.plane_at[f]
    if here < APART_M and not (w.both_sides[f] and here < -APART_M):
        return False
    there = w.normal_x[f] * ix + w.normal_y[f] * iy + w.normal_z[f] * iz - w.plane_at[f]
    if here * there >= 0.0:
        return False
    share = here / (here - there)
    px, py, pz = x + share * (ix - x), y + share * (iy - y), z + share * (iz - z)
    if not holds(w, f, px, py, pz):
        return False
    s.point_x[k], s.point_y[k], s.point_z[k] = px, py, pz
    return True


def holds(w: Terrain, f: int, x: float, y: float, z: float) -> bool:
    """Whether a facet holds a point of its plane."""
    for k in range(w.facet_first[f], w.facet_first[f + 1]):
        if w.cut_x[k] * x + w.cut_y[k] * y + w.cut_z[k] * z < w.cut_at[k]:
            return False
    return True


def diffract_and_reflect(w: Terrain, s: Work, p: int, end: int) -> None:
    """Paths with an edge, marked, and a reflection, which is nearer to a (end 0) or to b (1)."""
    near = s.a[p] if end == 0 else s.b[p]
    s.image_x[0], s.image_y[0], s.image_z[0] = s.end_x[end], s.end_y[end], s.end_z[end]
    for i in range(s.site_facet_first[near], s.site_facet_first[near + 1]):
        f = s.site_facet[i]
        if not mirror(w, s, f, 1):
            continue
        # The image takes the place of the end: the edge is met between it and the other end.
        for k in range(s.beam_first[i], s.beam_first[i + 1]):
            e = s.beam_edge[k]
            if s.edge_mark[e] != s.counts[PAIRS] or not meet(w, s, e, 1 - end, s.beam_at[k], s.beam_apart[k]):
                continue
            if not cross(w, s, f, s.point_x[1 - end], s.point_y[1 - end], s.point_z[1 - end], 1, end):
                continue
            if all_clear(w, s, 2):
                s.element[end], s.element[1 - end] = f, -1 - e
                emit(w, s, p, 2)


def find_beams(w: Terrain, s: Work) -> int:
    """Set the beams of the sites from ``counts[NEXT]`` on; returns `DONE` or `FULL`.

    A beam holds the edges that a partner of the site may see, that the facet may see, and that the image of the site sees
    through the facet, at least in part.
    """
    while s.counts[NEXT] < len(s.site_x):
        n = s.counts[NEXT]
        wanted = mark_edges_of_partners(s, n)
        s.image_x[0], s.image_y[0], s.image_z[0] = s.site_x[n], s.site_y[n], s.site_z[n]
        for i in range(s.site_facet_first[n], s.site_facet_first[n + 1]):
            s.beam_first[i + 1] = s.beam_first[i]
            f = s.site_facet[i]
            if not mirror(w, s, f, 1):
                continue
            if s.beam_first[i] + wanted > len(s.beam_edge):
                return FULL
            bound(w, s, f)
            at, row = s.beam_first[i], f * s.sees_row + len(w.plane_at)
            for g in range(len(w.group_radius)):
                if s.group_mark[g] != s.counts[PAIRS] or group_is_beside(w, s, g):
                    continue
                for e in range(g * GROUP, min((g + 1) * GROUP, len(w.length))):
                    if s.edge_mark[e] != s.counts[PAIRS] or s.sees[row + e] == HIDDEN or beside(w, s, e):
                        continue
                    x, y, z = s.image_x[1], s.image_y[1], s.image_z[1]
                    if outside(w, e, x, y, z) and may_see(w, s, f, len(w.plane_at) + e):
                        s.beam_edge[at], s.beam_at[at] = e, foot(w, e, x, y, z)
                        s.beam_apart[at] = distance_from(w, e, x, y, z)
                        at += 1
            s.beam_first[i + 1] = at
        s.counts[NEXT] += 1
    return DONE


def mark_edges_of_partners(s: Work, n: int) -> int:
    """Mark the edges that a partner of a site may see with a new stamp; returns their number."""
    s.counts[PAIRS] += 1
    marked = 0
    for i in range(s.partner_first[n], s.partner_first[n + 1]):
        for k in range(s.site_edge_first[s.partner[i]], s.site_edge_first[s.partner[i] + 1]):
            if s.edge_mark[s.site_edge[k]] != s.counts[PAIRS]:
                s.edge_mark[s.site_edge[k]] = s.group_mark[s.site_edge[k] // GROUP] = s.counts[PAIRS]
                marked += 1
    return marked


def bound(w: Terrain, s: Work, f: int) -> None:
    """Set the planes through the image and the sides of a facet, ``counts[SIDES]`` of them, with unit normals into the beam."""
    first, count = w.facet_first[f], w.facet_first[f + 1] - w.facet_first[f]
    s.counts[SIDES] = 0
    if count > len(s.beam_x):
        return
    ix, iy, iz = s.image_x[1], s.image_y[1], s.image_z[1]
    for k in range(count):
        a, b, c = first + k, first + (k + 1) % count, first + (k + 2) % count
        ax, ay, az = w.corner_x[a] - ix, w.corner_y[a] - iy, w.corner_z[a] - iz
        bx, by, bz = w.corner_x[b] - ix, w.corner_y[b] - iy, w.corner_z[b] - iz
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        inside = x * (w.corner_x[c] - ix) + y * (w.corner_y[c] - iy) + z * (w.corner_z[c] - iz)
        by = max(size(x, y, z), 1e-300) * (1.0 if inside > 0.0 else -1.0)
        s.beam_x[k], s.beam_y[k], s.beam_z[k] = x / by, y / by, z / by
    s.counts[SIDES] = count


def beside(w: Terrain, s: Work, e: int) -> bool:
    """Whether an edge lies outside one side of the beam."""
    x, y, z = w.start_x[e] - s.image_x[1], w.start_y[e] - s.image_y[1], w.start_z[e] - s.image_z[1]
    to_x, to_y, to_z = x + w.length[e] * w.along_x[e], y + w.length[e] * w.along_y[e], z + w.length[e] * w.along_z[e]
    for k in range(s.counts[SIDES]):
        here = s.beam_x[k] * x + s.beam_y[k] * y + s.beam_z[k] * z
        there = s.beam_x[k] * to_x + s.beam_y[k] * to_y + s.beam_z[k] * to_z
        if here < 0.0 and there < 0.0:
            return True
    return False


def group_is_beside(w: Terrain, s: Work, g: int) -> bool:
    """Whether a sphere round edges lies outside one side of the beam."""
    x, y, z = w.group_x[g] - s.image_x[1], w.group_y[g] - s.image_y[1], w.group_z[g] - s.image_z[1]
    for k in range(s.counts[SIDES]):  # noqa: SIM110  numba has no generators
        if s.beam_x[k] * x + s.beam_y[k] * y + s.beam_z[k] * z < -w.group_radius[g]:
            return True
    return False


def meet(w: Terrain, s: Work, e: int, k: int, a_at: float, a_apart: float) -> bool:
    """Set point k where the shortest way over an edge between two points meets it; False: that is beyond its ends.

    Both legs have the same angle with the edge (J. B. Keller, Geometrical theory of diffraction, JOSA 52, 1962). One point is
    the site that the edges are marked for, the other has the foot and the distance given, in m.
    """
    b_at, b_apart = s.edge_at[e], s.edge_apart[e]
    if (a_at < 0.0 and b_at < 0.0) or (a_at > w.length[e] and b_at > w.length[e]) or a_apart < NEAR_M or b_apart < NEAR_M:
        return False
    at = (a_at * b_apart + b_at * a_apart) / (a_apart + b_apart)
    if at < 0.0 or at > w.length[e]:
        return False
    s.point_x[k] = w.start_x[e] + at * w.along_x[e]
    s.point_y[k] = w.start_y[e] + at * w.along_y[e]
    s.point_z[k] = w.start_z[e] + at * w.along_z[e]
    return True


def foot(w: Terrain, e: int, x: float, y: float, z: float) -> float:
    """Place on the line of an edge that is nearest to a point, from its start, m."""
    return (x - w.start_x[e]) * w.along_x[e] + (y - w.start_y[e]) * w.along_y[e] + (z - w.start_z[e]) * w.along_z[e]


def distance_from(w: Terrain, e: int, x: float, y: float, z: float) -> float:
    """Distance of a point from the line of an edge, m."""
    at = foot(w, e, x, y, z)
    return size(
        x - w.start_x[e] - at * w.along_x[e], y - w.start_y[e] - at * w.along_y[e], z - w.start_z[e] - at * w.along_z[e]
    )


def outside(w: Terrain, e: int, x: float, y: float, z: float) -> bool:
    """Whether a point is before one of the faces of an edge."""
    f, g = w.first_face[e], w.second_face[e]
    if f == g:
        return True
    first = w.normal_x[f] * x + w.normal_y[f] * y + w.normal_z[f] * z - w.plane_at[f]
    second = w.normal_x[g] * x + w.normal_y[g] * y + w.normal_z[g] * z - w.plane_at[g]
    return first > APART_M or second > APART_M


# --- the legs of a path ---


def all_clear(w: Terrain, s: Work, count: int) -> bool:
    """Whether nothing stops a path over the first ``count`` points; what it passes is noted."""
    passes = s.counts[BEGIN] = s.counts[PASSES]
    s.point_x[count], s.point_y[count], s.point_z[count] = s.end_x[1], s.end_y[1], s.end_z[1]
    x, y, z = s.end_x[0], s.end_y[0], s.end_z[0]
    for k in range(count + 1):
        if not is_clear(w, s, x, y, z, s.point_x[k], s.point_y[k], s.point_z[k], k):
            s.counts[PASSES] = passes
            return False
        x, y, z = s.point_x[k], s.point_y[k], s.point_z[k]
    return True


def is_clear(w: Terrain, s: Work, ax: float, ay: float, az: float, bx: float, by: float, bz: float, leg: int) -> bool:
    """Whether nothing stops a leg; what it passes is noted."""
    s.counts[LEGS] += 1
    cell = first_cell(w, s, ax, ay, bx, by)
    while cell >= 0:
        for k in range(w.cell_first[cell], w.cell_first[cell + 1]):
            item = w.cell_item[k]
            if item >= 0:
                if stopped(w, item, ax, ay, az, bx, by, bz):
                    return False
            elif s.facet_leg[-1 - item] != s.counts[LEGS]:
                s.facet_leg[-1 - item] = s.counts[LEGS]
                if not passed(w, s, -1 - item, ax, ay, az, bx, by, bz, leg):
                    return False
        cell = next_cell(w, s)
    return True


COLUMN, ROW, LAST_COLUMN, LAST_ROW, EASTWARDS, NORTHWARDS = range(6)
"""Places in `Work.cell`."""

NEXT_X, NEXT_Y, EACH_X, EACH_Y, FINISH = range(5)
"""Places in `Work.share`: shares of the line."""


def first_cell(w: Terrain, s: Work, ax: float, ay: float, bx: float, by: float) -> int:
    """The first square of the grid under a line; -1: there is none."""
    dx, dy = bx - ax, by - ay
    begin, finish = within(w, ax, ay, dx, dy)
    if begin > finish:
        return -1
    s.cell[COLUMN], s.cell[ROW] = column_of(w, ax + begin * dx), row_of(w, ay + begin * dy)
    s.cell[LAST_COLUMN], s.cell[LAST_ROW] = column_of(w, ax + finish * dx), row_of(w, ay + finish * dy)
    s.cell[EASTWARDS] = 1 if dx > 0.0 else -1
    s.cell[NORTHWARDS] = 1 if dy > 0.0 else -1
    s.share[NEXT_X] = next_share(w.west, w.cell_m, s.cell[COLUMN], ax, dx)
    s.share[NEXT_Y] = next_share(w.south, w.cell_m, s.cell[ROW], ay, dy)
    s.share[EACH_X], s.share[EACH_Y] = w.cell_m / max(abs(dx), 1e-300), w.cell_m / max(abs(dy), 1e-300)
    s.share[FINISH] = finish
    return s.cell[ROW] * w.columns + s.cell[COLUMN]


def next_cell(w: Terrain, s: Work) -> int:
    """The next square under the line; -1: that was the last."""
    if s.cell[COLUMN] == s.cell[LAST_COLUMN] and s.cell[ROW] == s.cell[LAST_ROW]:
        return -1
    if min(s.share[NEXT_X], s.share[NEXT_Y]) > s.share[FINISH]:
        return -1
    if s.share[NEXT_X] < s.share[NEXT_Y]:
        s.cell[COLUMN] += s.cell[EASTWARDS]
        s.share[NEXT_X] += s.share[EACH_X]
    else:
        s.cell[ROW] += s.cell[NORTHWARDS]
        s.share[NEXT_Y] += s.share[EACH_Y]
    column, row = s.cell[COLUMN], s.cell[ROW]
    return row * w.columns + column if 0 <= column < w.columns and 0 <= row < w.rows else -1


def within(w: Terrain, ax: float, ay: float, dx: float, dy: float) -> tuple[float, float]:
    """Share of a line over the grid: from, to; to is less than from if none is."""
    begin, finish = 0.0, 1.0
    low, high = w.west - ax, w.west + w.columns * w.cell_m - ax
    if dx != 0.0:
        begin, finish = max(begin, min(low / dx, high / dx)), min(finish, max(low / dx, high / dx))
    elif low > 0.0 or high < 0.0:
        return 1.0, 0.0
    low, high = w.south - ay, w.south + w.rows * w.cell_m - ay
    if dy != 0.0:
        begin, finish = max(begin, min(low / dy, high / dy)), min(finish, max(low / dy, high / dy))
    elif low > 0.0 or high < 0.0:
        return 1.0, 0.0
    return begin, finish


def column_of(w: Terrain, x: float) -> int:
    """Column of the grid at x, or the nearest."""
    return min(max(math.floor((x - w.west) / w.cell_m), 0), w.columns - 1)


def row_of(w: Terrain, y: float) -> int:
    """Row of the grid at y, or the nearest."""
    return min(max(math.floor((y - w.south) / w.cell_m), 0), w.rows - 1)


def next_share(origin: float, cell_m: float, number: int, at: float, run_m: float) -> float:
    """Share of a line up to the end of a column or row."""
    if run_m > 0.0:
        return (origin + (number + 1) * cell_m - at) / run_m
    if run_m < 0.0:
        return (origin + number * cell_m - at) / run_m
    return 1e300


def stopped(w: Terrain, v: int, ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> bool:
    """Whether a body stops a line: a part of it lies inside (M. Cyrus, J. Beck, Computers and Graphics 3, 1978)."""
    if max(az, bz) < w.bottom[v] or min(az, bz) > w.top[v]:
        return False
    begin, finish = 0.0, 1.0
    if az != bz:
        low, high = (w.bottom[v] - az) / (bz - az), (w.top[v] - az) / (bz - az)
        begin, finish = max(begin, min(low, high)), min(finish, max(low, high))
    for k in range(w.side_first[v], w.side_first[v + 1]):
        here = w.side_x[k] * ax + w.side_y[k] * ay - w.side_at[k]
        there = w.side_x[k] * bx + w.side_y[k] * by - w.side_at[k]
        if here > 0.0:
            if there > 0.0:
                return False
            begin = max(begin, here / (here - there))
        elif there > 0.0:
            finish = min(finish, here / (here - there))
        if begin >= finish:
            return False
    inside = finish - begin
    return inside > 0.0 and inside * size(bx - ax, by - ay, bz - az) > NEAR_M


def passed(w: Terrain, s: Work, f: int, ax: float, ay: float, az: float, bx: float, by: float, bz: float, leg: int) -> bool:
    """Whether a leg gets through a facet, or past it; a passage is noted."""
    here = w.normal_x[f] * ax + w.normal_y[f] * ay + w.normal_z[f] * az - w.plane_at[f]
    there = w.normal_x[f] * bx + w.normal_y[f] * by + w.normal_z[f] * bz - w.plane_at[f]
    if here * there >= 0.0:
        return True
    share = here / (here - there)
    length = size(bx - ax, by - ay, bz - az)
    if min(share, 1.0 - share) * length < NEAR_M:
        return True
    if not holds(w, f, ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)):
        return True
    if w.passage[f] == OPAQUE or not s.transmission:
        return False
    if w.passage[f] == SKIN and here < 0.0:  # on leaving; it counts on entering
        return True
    if s.counts[PASSES] >= len(s.pass_path):
        s.counts[OVERFLOW] = 1
        return False
    n = s.counts[PASSES]
    s.pass_path[n], s.pass_leg[n], s.pass_facet[n], s.pass_at[n] = s.counts[PATHS], leg, f, share
    s.counts[PASSES] += 1
    return True


def most(s: Work) -> int:
    """Greatest number of interactions."""
    return max(s.reflections, 2)


def emit(w: Terrain, s: Work, p: int, count: int) -> None:
    """Note the path under test, over the first ``count`` points, unless it is too weak; call it after `all_clear`."""
    sort_passes(s)
    weigh(w, s, count, s.counts[BEGIN], s.counts[PASSES])
    if s.wave[0] * s.wave[0] + s.wave[1] * s.wave[1] < WEAKEST:
        s.counts[PASSES] = s.counts[BEGIN]
        return
    n = s.counts[PATHS]
    if n >= len(s.path_pair):
        s.counts[OVERFLOW] = 1
        return
    s.path_pair[n], s.path_count[n] = p, count
    s.path_real[n], s.path_imag[n], s.path_length[n] = s.wave[0], s.wave[1], s.wave[2]
    for k in range(count):
        at = n * most(s) + k
        s.path_x[at], s.path_y[at], s.path_z[at] = s.point_x[k], s.point_y[k], s.point_z[k]
        s.path_element[at] = s.element[k]
    s.counts[PATHS] += 1


def sort_passes(s: Work) -> None:
    """Sort the passages of the path under test by their place."""
    for last in range(s.counts[BEGIN] + 1, s.counts[PASSES]):
        leg, facet, at = s.pass_leg[last], s.pass_facet[last], s.pass_at[last]
        k = last
        while k > s.counts[BEGIN] and (s.pass_leg[k - 1] > leg or (s.pass_leg[k - 1] == leg and s.pass_at[k - 1] > at)):
            s.pass_leg[k], s.pass_facet[k], s.pass_at[k] = s.pass_leg[k - 1], s.pass_facet[k - 1], s.pass_at[k - 1]
            k -= 1
        s.pass_leg[k], s.pass_facet[k], s.pass_at[k] = leg, facet, at


# --- what may be seen from a region ---


def look(w: Terrain, s: Work) -> None:
    """Set `Work.seen` for all facets, and the edges behind them, and a region.

    The region is the convex hull of the first ``counts[CORNERS]`` corners, or everything if there are none;
    ``counts[SOURCE]`` is the facet that it is, or -1. What one body hides from all corners of the region at all corners of the
    target, it hides from all points of the region at all points of the target: only such targets, and those behind a plane, are
    left out.
    """
    for target in range(len(w.plane_at) + len(w.length)):
        s.seen[target] = SEEN if sees(w, s, target) else HIDDEN


def look_from_sites(w: Terrain, s: Work) -> None:
    """Set the lists of all sites: what each may see, of what its cell may see."""
    s.counts[SOURCE], s.counts[CORNERS] = -1, 1
    all_facets, facets, edges = len(w.plane_at), 0, 0
    for n in range(len(s.site_x)):
        s.region_x[0], s.region_y[0], s.region_z[0] = s.site_x[n], s.site_y[n], s.site_z[n]
        for k in range(s.view_first[s.site_cell[n]], s.view_first[s.site_cell[n] + 1]):
            target = s.view_target[k]
            if not sees(w, s, target):
                continue
            if target < all_facets:
                s.site_facet[facets] = target
                facets += 1
            else:
                s.site_edge[edges] = target - all_facets
                edges += 1
        s.site_facet_first[n + 1], s.site_edge_first[n + 1] = facets, edges


def may_see(w: Terrain, s: Work, f: int, target: int) -> bool:
    """Whether a facet may see another one, or an edge (numbered behind the facets); looked up when it is asked first."""
    at = f * s.sees_row + target
    if s.sees[at] == UNKNOWN:
        first, count = w.facet_first[f], w.facet_first[f + 1] - w.facet_first[f]
        s.counts[SOURCE], s.counts[CORNERS] = f, 0
        if count <= len(s.region_x):  # one of many corners counts as if it were everywhere
            s.counts[CORNERS] = count
            for k in range(count):
                s.region_x[k], s.region_y[k] = w.corner_x[first + k], w.corner_y[first + k]
                s.region_z[k] = w.corner_z[first + k]
        s.sees[at] = SEEN if sees(w, s, target) else HIDDEN
    return s.sees[at] == SEEN


def sees(w: Terrain, s: Work, target: int) -> bool:
    """Whether the region may see a facet, or an edge (numbered behind the facets)."""
    count = 2
    if target < len(w.plane_at):
        first = w.facet_first[target]
        count = w.facet_first[target + 1] - first
        if target == s.counts[SOURCE] or not faces(w, s, target):
            return False
        if count == 0 or count > len(s.target_x):  # the ground, and facets of many corners
            return True
        for k in range(count):
            s.target_x[k], s.target_y[k] = w.corner_x[first + k], w.corner_y[first + k]
            s.target_z[k] = w.corner_z[first + k]
    else:
        e = target - len(w.plane_at)
        s.target_x[0], s.target_y[0], s.target_z[0] = w.start_x[e], w.start_y[e], w.start_z[e]
        s.target_x[1] = w.start_x[e] + w.length[e] * w.along_x[e]
        s.target_y[1] = w.start_y[e] + w.length[e] * w.along_y[e]
        s.target_z[1] = w.start_z[e] + w.length[e] * w.along_z[e]
    return ahead(w, s, count) and not is_hidden(w, s, count, target)


def faces(w: Terrain, s: Work, f: int) -> bool:
    """Whether some corner of the region is before a facet."""
    if s.counts[CORNERS] == 0 or w.both_sides[f]:
        return True
    for k in range(s.counts[CORNERS]):
        side = w.normal_x[f] * s.region_x[k] + w.normal_y[f] * s.region_y[k] + w.normal_z[f] * s.region_z[k]
        if side - w.plane_at[f] > APART_M:
            return True
    return False


def ahead(w: Terrain, s: Work, count: int) -> bool:
    """Whether some corner of the target is before the facet that looks, if one does."""
    if s.counts[SOURCE] < 0:
        return True
    for k in range(count):  # noqa: SIM110  numba has no generators
        if is_before(w, s.counts[SOURCE], s.target_x[k], s.target_y[k], s.target_z[k]):
            return True
    return False


def is_before(w: Terrain, f: int, x: float, y: float, z: float) -> bool:
    """Whether a point is on a side of a facet that reflects."""
    side = w.normal_x[f] * x + w.normal_y[f] * y + w.normal_z[f] * z - w.plane_at[f]
    return side > APART_M or (w.both_sides[f] != 0 and side < -APART_M)


def is_hidden(w: Terrain, s: Work, count: int, target: int) -> bool:
    """Whether one body hides all ``count`` corners of the target from all corners of the region.

    The body that hid the target from the last region is tried first: regions are asked for in rows.
    """
    corners = s.counts[CORNERS]
    if corners == 0 or count == 0:
        return False
    if s.hider[target] < len(w.bottom) and hides(w, s, s.hider[target], count):
        return True
    s.counts[LEGS] += 1
    ax, ay = 0.0, 0.0
    for k in range(corners):
        ax, ay = ax + s.region_x[k] / corners, ay + s.region_y[k] / corners
    bx, by = 0.0, 0.0
    for k in range(count):
        bx, by = bx + s.target_x[k] / count, by + s.target_y[k] / count
    cell = first_cell(w, s, ax, ay, bx, by)
    while cell >= 0:
        for k in range(w.cell_first[cell], w.cell_first[cell + 1]):
            v = w.cell_item[k]
            if v >= 0 and s.body_leg[v] != s.counts[LEGS]:
                s.body_leg[v] = s.counts[LEGS]
                if hides(w, s, v, count):
                    s.hider[target] = v
                    return True
        cell = next_cell(w, s)
    return False


def hides(w: Terrain, s: Work, v: int, count: int) -> bool:
    """Whether a body stops all lines from the corners of the region to those of the target."""
    for i in range(s.counts[CORNERS]):
        for k in range(count):
            if not stopped(w, v, s.region_x[i], s.region_y[i], s.region_z[i], s.target_x[k], s.target_y[k], s.target_z[k]):
                return False
    return True
