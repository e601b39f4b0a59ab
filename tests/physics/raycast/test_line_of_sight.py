"""Lines through boxes, cylinders, prisms and meshes: against sampling, each other and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.support.physics.random_worlds import beyond_box
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import problem_of
from vcmvsp.physics.raycast.line_of_sight import SHEET_M, Sightline, is_closed, slab_m
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Mesh, Prism, rectangle
from vcmvsp.physics.world.world import World

pytestmark = pytest.mark.slow

place = st.tuples(*[st.floats(-10.0, 10.0)] * 3)
whole = st.tuples(*[st.integers(-4, 4).map(float)] * 3)
boxes = st.builds(
    Box, center=place, size=st.tuples(*[st.floats(0.1, 8.0)] * 3), yaw_rad=st.floats(-4.0, 4.0), material=st.sampled_from("ab")
)
COURT = Prism(outline=((0, 0), (6, 0), (6, 6), (0, 6)), holes=(((2, 2), (2, 4), (4, 4), (4, 2)),), height=3.0, material="brick")
L_SHAPE = Prism(outline=((0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)), height=2.0)
TETRAHEDRON = np.array([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)])
FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
WALL = Box(center=(5.0, 0.0, 1.0), size=(0.2, 4.0, 2.0), material="brick")


@given(tx=place, rx=place, box=boxes)
def test_the_length_agrees_with_sampling(tx: tuple[float, ...], rx: tuple[float, ...], box: Box) -> None:
    assume(math.dist(tx, rx) > 1e-3)
    count = 2000
    points = np.array(tx) + (np.arange(count)[:, None] + 0.5) / count * (np.array(rx) - np.array(tx))
    (length,) = lengths(tx, rx, among=(box,))[0]
    share = math.dist(tx, rx) / count
    least, most = ((beyond_box(box, points) < margin).all(axis=1).sum() * share for margin in (-1e-9, 1e-9))
    assert least - 2.0 * share <= length <= most + 2.0 * share


@pytest.mark.parametrize(("lines", "count"), [(0, 3), (3, 0), (40, 1000)])
def test_any_number_of_lines_and_boxes(lines: int, count: int) -> None:
    many = [Box(center=(float(k), 0.0, 0.0), size=(0.5, 2.0, 2.0)) for k in range(count)]
    ends = np.stack([np.arange(lines) - 0.5, np.zeros(lines), np.zeros(lines)], axis=1)
    crossed, inside_m = Sightline(many).crossings(np.array([-0.5, 0.0, 0.0]), ends)
    assert crossed.shape == inside_m.shape == (lines, count)
    assert crossed.sum(axis=1).tolist() == [min(k, count) for k in range(lines)]


def test_many_lines_in_a_town_agree_with_single_lines() -> None:
    """Many lines are sorted by bearing and height first; a single line is tested against all boxes."""
    rng = np.random.default_rng(7)
    corner, size = rng.uniform((-60.0, -60.0, 0.0), (60.0, 60.0, 9.0), (90, 3)), rng.uniform(0.2, 12.0, (90, 3))
    town = [
        Box(center=(x, y, z), size=(a, b, c), yaw_rad=float(k % 5))
        for k, ((x, y, z), (a, b, c)) in enumerate(zip(corner.tolist(), size.tolist(), strict=True))
    ]
    sight = Sightline(town)
    for tx in (np.array([3.0, -4.0, 30.0]), corner[0], np.array([-70.0, 0.0, 2.0])):
        ends = rng.uniform((-70.0, -70.0, 0.0), (70.0, 70.0, 30.0), (40, 3))
        ends[:3] = tx + np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -9.0), (1e-9, -1e-9, 5.0)])  # zero length, down, nearly vertical
        ends[3:40:4, 1] = tx[1]
        crossed, inside_m = sight.crossings(tx, ends)
        alone = np.concatenate([sight.crossings(tx, end[None])[1] for end in ends])
        assert inside_m.tolist() == alone.tolist()
        assert crossed.any()
        assert not crossed[0].any()


def as_prism(box: Box) -> Prism:
    (x, y, z), (length, width, height) = box.center, box.size
    corners = rectangle(x, y, 0.5 * length, 0.5 * width, box.yaw_rad).tolist()
    return Prism(outline=tuple((u, v) for u, v in corners), bottom=z - 0.5 * height, height=height, material=box.material)


def as_mesh(solid: AnySolid) -> Mesh:
    points, triangles = World(solids=(solid,)).mesh()
    return Mesh(triangles=points[triangles], material=solid.material)


def lengths(tx: tuple[float, ...], *rx: tuple[float, ...], among: tuple[AnySolid, ...] = (WALL,)) -> list[list[float]]:
    crossed, inside_m = Sightline(among).crossings(np.array(tx), np.array(rx, float).reshape(-1, 3))
    assert (crossed == (inside_m > 0.0)).all()
    return inside_m.tolist()


@given(tx=whole, rx=whole, size=st.tuples(*[st.integers(1, 3).map(float)] * 3))
def test_lines_through_edges_corners_and_along_faces(
    tx: tuple[float, ...], rx: tuple[float, ...], size: tuple[float, float, float]
) -> None:
    box = Box(center=(0.5, 0.5, 0.5), size=size)  # whole and half numbers: exact hits on edges, corners and diagonals
    mesh, prism = as_mesh(box), as_prism(box)
    as_box, as_prism_m, as_mesh_m = lengths(tx, rx, among=(box, prism, mesh))[0]
    assert as_prism_m == pytest.approx(as_box, abs=1e-7)
    on_a_face = any(a == b and abs(a - c) == 0.5 * s for a, b, c, s in zip(tx, rx, box.center, size, strict=True))
    if not on_a_face:
        assert as_mesh_m == pytest.approx(as_box, abs=1e-7)
    assert [[as_box, as_prism_m, as_mesh_m]] == lengths(rx, tx, among=(box, prism, mesh))


@settings(deadline=None)
@example(tx=(0.0, 2.0, 1.5), rx=(5.0, 0.0, 0.0), radii=[5.0, 4.0, 1.0], bottom=0.0)  # through a corner
@given(tx=place, rx=place, radii=st.lists(st.floats(0.5, 9.0), min_size=3, max_size=11), bottom=st.floats(-6.0, 2.0))
def test_the_length_in_a_prism_agrees_with_sampling(
    tx: tuple[float, ...], rx: tuple[float, ...], radii: list[float], bottom: float
) -> None:
    assume(math.dist(tx, rx) > 1e-3)
    angles = math.tau * np.arange(len(radii)) / len(radii)
    outline = tuple((r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True))
    assume(not problem_of(outline))
    assume(not any(max(abs(tx[2] - z), abs(rx[2] - z)) < 0.05 for z in (bottom, bottom + 4.0)))  # within a face: either result
    prism = Prism(outline=outline, bottom=bottom, height=4.0)
    count = 4000
    points = np.array(tx) + (np.arange(count)[:, None] + 0.5) / count * (np.array(rx) - np.array(tx))
    inside = (points[:, 2] > bottom) & (points[:, 2] < bottom + 4.0) & contains(np.array(outline), points)
    share = math.dist(tx, rx) / count
    (found,) = lengths(tx, rx, among=(prism,))[0]
    assert found == pytest.approx(inside.sum() * share, abs=(len(radii) + 3) * share)
    assert lengths(tx, rx, among=(as_mesh(prism),))[0][0] == pytest.approx(found, abs=1e-5)


def contains(ring: Array, points: Array) -> Array:
    odd = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if ay != by:
            odd ^= ((ay > points[:, 1]) != (by > points[:, 1])) & (
                ax + (points[:, 1] - ay) * (bx - ax) / (by - ay) > points[:, 0]
            )
    return odd


L_MESH = as_mesh(L_SHAPE)


@given(points=st.lists(place | whole, min_size=2, max_size=5), some=st.lists(boxes, max_size=4))
def test_lengths_are_symmetric_and_independent(points: list[tuple[float, ...]], some: list[Box]) -> None:
    among: tuple[AnySolid, ...] = (COURT, *some, L_MESH, L_SHAPE, Cylinder(center=(0, 0, 0), radius=2.0, height=3.0))
    tx, *rx = points
    together = lengths(tx, *rx, among=among)
    assert len(together) == len(rx)
    for end, found in zip(rx, together, strict=True):
        assert [found] == lengths(tx, end, among=among) == lengths(end, tx, among=among)
        assert found == [lengths(tx, end, among=(solid,))[0][0] for solid in among]


def test_a_courtyard_by_hand() -> None:
    found = lengths((-1, 3, 1), (7, 3, 1), (3, 3, 1), (-1, 3, 9), (7, 1, 1), among=(COURT,))
    assert found[0] == [pytest.approx(4.0)]
    assert found[1] == [pytest.approx(2.0)]
    assert found[2] == [0.0]
    assert found[3] == [pytest.approx(5.0 / 8.0 * math.hypot(8.0, 2.0))]
    assert lengths((3, 3, -1), (3, 3, 9), (1, 1, 9), among=(COURT,))[0] == [0.0]
    found = lengths((1, 1, -1), (1, 1, 9), (1, 1, 2), (1, 1, -0.5), among=(COURT,))
    assert found == [[pytest.approx(3.0)], [pytest.approx(2.0)], [0.0]]


def test_lines_along_faces_and_at_corners_stay_outside() -> None:
    for solid in (L_SHAPE, COURT):
        assert lengths((-1, 0, 1), (9, 0, 1), among=(solid,)) == [[0.0]]
        assert lengths((0, -1, 1), (0, 9, 1), among=(solid,)) == [[0.0]]
        assert lengths((-1, 1, 1), (1, -1, 1), among=(solid,)) == [[0.0]]  # over the corner at the origin
        assert lengths((-1, 0.5, 0), (9, 0.5, 0), among=(solid,)) == [[0.0]]
    assert lengths((1, 1, 1), (1, 9, 1), (9, 1, 1), among=(L_SHAPE,)) == [[0.0], [0.0]]
    assert lengths((-1, 1, 1), (9, 1, 1), among=(L_SHAPE,)) == [[pytest.approx(1.0)]]  # along a face, then the other arm


def test_a_line_along_an_inner_cut_is_inside() -> None:
    for x in (1.0, 0.5):
        assert lengths((x - 1e-6, -1, 1), (x - 1e-6, 9, 1), among=(L_SHAPE,)) == [[pytest.approx(3.0, abs=1e-5)]]
    (grazing,) = lengths((-1, 4, 1), (5, -2, 1), among=(COURT,))[0]  # a corner of the court
    assert grazing == pytest.approx(3.0 * math.sqrt(2.0))


def test_a_tetrahedron_and_its_mean_chord() -> None:
    mesh = Mesh(triangles=TETRAHEDRON[FACES])
    assert is_closed(mesh.triangles)
    assert not is_closed(mesh.triangles[:3])
    assert lengths((0.5, 0.5, -1), (0.5, 0.5, 9), among=(mesh,)) == [[pytest.approx(1.0)]]
    assert lengths((0.5, 0.5, 0.5), (0.5, 0.5, 9), among=(mesh,)) == [[pytest.approx(0.5)]]
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(40_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    across = np.linalg.qr(np.stack([directions, *rng.normal(size=(2, 40_000, 3))], axis=2))[0][:, :, 1:]
    radius = 2.0  # isotropic uniform lines: uniform in direction and in place around the middle
    away, angle = radius * np.sqrt(rng.uniform(size=40_000)), rng.uniform(0, math.tau, 40_000)
    disc = away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    start = 0.5 + np.einsum("nij,nj->ni", across, disc) - 5.0 * directions
    sight = Sightline([mesh])
    chords = np.array(
        [sight.crossings(a, (a + 10.0 * d)[None])[1][0, 0] for a, d in zip(start[:1500], directions[:1500], strict=True)]
    )
    hit = chords[chords > 0.0]
    volume, surface = 8.0 / 6.0, 3.0 * 2.0 + 0.5 * math.sqrt(3.0) / 2.0 * 8.0
    assert hit.mean() == pytest.approx(4.0 * volume / surface, rel=0.1)  # Cauchy's mean chord
    assert slab_m(mesh.triangles) == pytest.approx(2.0 * volume / surface)


def test_an_open_mesh_is_made_of_sheets() -> None:
    sheet = Mesh(triangles=np.array([[(0, -1, 0), (0, 1, 0), (0, 0, 2)], [(1, -1, 0), (1, 1, 0), (1, 0, 2)]], float))
    found = lengths((-1, 0.1, 0.5), (5, 0.1, 0.5), (0.5, 0.1, 0.5), (-0.5, 0.1, 0.5), among=(sheet,))
    assert found == [[pytest.approx(2 * SHEET_M)], [pytest.approx(SHEET_M)], [0.0]]
    assert Sightline([sheet]).thickness_m.tolist() == [SHEET_M]


def test_thickness_is_that_of_a_wall() -> None:
    wall = Box(center=(0.0, 0.0, 1.5), size=(20.0, 0.2, 3.0))
    ring = Prism(
        outline=((0, 0), (20, 0), (20, 20), (0, 20)), holes=(((0.2, 0.2), (19.8, 0.2), (19.8, 19.8), (0.2, 19.8)),), height=3.0
    )
    pillars = [Cylinder(center=(0, 0, 0), radius=radius, height=height) for radius, height in ((0.5, 3.0), (5.0, 0.1))]
    found = Sightline([wall, as_prism(wall), as_mesh(wall), ring, *pillars]).thickness_m.tolist()
    assert found[:2] == [pytest.approx(0.2), pytest.approx(0.2)]
    assert found[2] == pytest.approx(0.2, rel=0.1)
    assert found[3] == pytest.approx(0.2, rel=0.01)
    assert found[4:] == [pytest.approx(1.0, abs=0.005), pytest.approx(0.1)]


def test_order_and_materials_are_those_of_the_world() -> None:
    wood = Box(center=(9.0, 0.0, 0.0), size=(1.0, 1.0, 1.0), material="wood")
    glass = Box(center=(12.0, 0.5, 1.0), size=(1.0, 1.0, 1.0), material="glass")
    sight = Sightline((COURT, wood, as_mesh(L_SHAPE), glass))
    assert sight.materials == ("brick", "wood", "concrete", "glass")
    crossed, _ = sight.crossings(np.array([-1.0, 0.5, 1.0]), np.array([[20.0, 0.5, 1.0], [8.0, 0.5, 1.0]]))
    assert crossed.tolist() == [[True, False, True, True], [True, False, True, False]]
    empty, _ = sight.crossings(np.zeros(3), np.empty((0, 3)))
    assert empty.shape == (0, 4)


def test_nothing_between_equal_points() -> None:
    assert lengths((0.5, 0.5, 1), (0.5, 0.5, 1), among=(L_SHAPE, as_mesh(L_SHAPE), COURT)) == [[0.0] * 3]
