"""Lines through boxes against what sampling finds, and by hand."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vcmvsp.physics.line_of_sight import Sightline
from vcmvsp.physics.world.solids import Box

place = st.tuples(*[st.floats(-10.0, 10.0)] * 3)
boxes = st.builds(
    Box, center=place, size=st.tuples(*[st.floats(0.1, 8.0)] * 3), yaw_rad=st.floats(-4.0, 4.0), material=st.sampled_from("ab")
)
WALL = Box(center=(5.0, 0.0, 1.0), size=(0.2, 4.0, 2.0), material="brick")


def inside(box: Box, points: NDArray[np.float64], margin: float) -> NDArray[np.bool_]:
    """Which points are in the box, grown by the margin."""
    offset = points - np.array(box.center)
    c, s = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
    local = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]], axis=1)
    within: NDArray[np.bool_] = (np.abs(local) < 0.5 * np.array(box.size) + margin).all(axis=1)
    return within


def lengths(tx: tuple[float, ...], *rx: tuple[float, ...], among: tuple[Box, ...] = (WALL,)) -> list[list[float]]:
    crossed, inside_m = Sightline(among).crossings(np.array(tx), np.array(rx))
    assert (crossed == (inside_m > 0.0)).all()
    result: list[list[float]] = inside_m.tolist()
    return result


def test_straight_slanting_past_over_and_short_of_a_wall() -> None:
    found = lengths((0, 0, 1), (10, 0, 1), (10, 5, 1), (10, 0, 4), (10, 9, 1), (10, 0, 5), (4.9, 0, 1), (5, 0, 1), (-9, 0, 1))
    slant = 0.2 * math.hypot(1.0, 0.5)  # the slope is 1/2: at x = 5 it is at y = 2.5 > 2, past the edge
    assert found[0] == pytest.approx([0.2])
    assert found[1] == [0.0]
    assert lengths((0, 0, 1), (10, 3, 1))[0] == pytest.approx([0.2 * math.hypot(1.0, 0.3)])
    assert lengths((0, -1, 1), (10, 4, 1))[0] == pytest.approx([slant])
    assert found[2:5] == [[0.0], [0.0], [0.0]]  # above the wall at x = 5, beside it, above it
    assert found[5:] == [[0.0], [pytest.approx(0.1)], [0.0]]  # touches it, ends inside it, goes the other way


def test_along_a_face_or_through_an_edge_is_not_through_the_box() -> None:
    assert lengths((4.9, -9, 1), (4.9, 9, 1)) == [[0.0]]
    assert lengths((5.1, -9, 1), (5.1, 9, 1)) == [[0.0]]
    assert lengths((5, -9, 2), (5, 9, 2)) == [[0.0]]
    assert lengths((4.8, 1.9, 1), (5.0, 2.1, 1)) == [[0.0]]
    assert lengths((5, -9, 1), (5, 9, 1))[0] == pytest.approx([4.0])
    assert lengths((5, 0, -9), (5, 0, 9))[0] == pytest.approx([2.0])


@given(tx=place, rx=place, box=boxes)
def test_the_length_is_what_sampling_finds(tx: tuple[float, ...], rx: tuple[float, ...], box: Box) -> None:
    assume(math.dist(tx, rx) > 1e-3)
    count = 2000
    points = np.array(tx) + (np.arange(count)[:, None] + 0.5) / count * (np.array(rx) - np.array(tx))
    (length,) = lengths(tx, rx, among=(box,))[0]
    share = math.dist(tx, rx) / count
    assert (
        inside(box, points, -1e-9).sum() * share - 2.0 * share
        <= length
        <= inside(box, points, 1e-9).sum() * share + 2.0 * share
    )


@given(points=st.lists(place, min_size=2, max_size=8), among=st.lists(boxes, max_size=6).map(tuple))
def test_the_same_there_and_back_and_each_for_itself(points: list[tuple[float, ...]], among: tuple[Box, ...]) -> None:
    tx, *rx = points
    together = lengths(tx, *rx, among=among)
    assert len(together) == len(rx)
    for end, found in zip(rx, together, strict=True):
        assert [found] == lengths(tx, end, among=among) == lengths(end, tx, among=among)
        assert found == [lengths(tx, end, among=(box,))[0][0] for box in among]


@pytest.mark.parametrize(("lines", "count"), [(0, 3), (3, 0), (40, 1000)])
def test_any_number_of_lines_and_boxes(lines: int, count: int) -> None:
    many = [Box(center=(float(k), 0.0, 0.0), size=(0.5, 2.0, 2.0)) for k in range(count)]
    ends = np.stack([np.arange(lines) - 0.5, np.zeros(lines), np.zeros(lines)], axis=1)
    crossed, inside_m = Sightline(many).crossings(np.array([-0.5, 0.0, 0.0]), ends)
    assert crossed.shape == inside_m.shape == (lines, count)
    assert crossed.sum(axis=1).tolist() == [min(k, count) for k in range(lines)]


def test_a_crowd_of_lines_in_a_town_meets_what_each_meets_alone() -> None:
    """Many lines are sorted by bearing and height first; a line alone is tested with all boxes."""
    rng = np.random.default_rng(7)
    corner, size = rng.uniform((-60.0, -60.0, 0.0), (60.0, 60.0, 9.0), (90, 3)), rng.uniform(0.2, 12.0, (90, 3))
    town = [
        Box(center=(x, y, z), size=(a, b, c), yaw_rad=float(k % 5))
        for k, ((x, y, z), (a, b, c)) in enumerate(zip(corner.tolist(), size.tolist(), strict=True))
    ]
    sight = Sightline(town)
    for tx in (np.array([3.0, -4.0, 30.0]), corner[0], np.array([-70.0, 0.0, 2.0])):
        ends = rng.uniform((-70.0, -70.0, 0.0), (70.0, 70.0, 30.0), (40, 3))
        ends[:3] = tx + np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -9.0), (1e-9, -1e-9, 5.0)])  # nowhere, straight down, nearly up
        ends[3:40:4, 1] = tx[1]
        crossed, inside_m = sight.crossings(tx, ends)
        alone = np.concatenate([sight.crossings(tx, end[None])[1] for end in ends])
        assert inside_m.tolist() == alone.tolist()
        assert crossed.any()
        assert not crossed[0].any()


def test_materials_and_thickness() -> None:
    sight = Sightline([WALL, Box(center=(0.0, 0.0, 0.0), size=(3.0, 2.0, 1.5))])
    assert sight.materials == ("brick", "concrete")
    assert sight.thickness_m.tolist() == [0.2, 1.5]
