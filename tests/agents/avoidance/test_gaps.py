"""Gaps in a scan: each is met once, as wide as it is, wherever the scan begins."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.agents.scans import Wall, ranges_of, view, wall_with_doors
from vcmvsp.agents.avoidance.gap import Gaps, gaps, gaps_ahead
from vcmvsp.cosim.types import Array

L = 2.0
BEAMS = 512


def found(walls: list[Wall], lookahead: float = L, beams: int = BEAMS) -> Gaps:
    return gaps(ranges_of(walls, beams=beams), lookahead, -0.5 * math.pi, math.pi / (beams - 1))


def at(these: Gaps, bearing: float, beams: int = BEAMS) -> int | None:
    """Which of them holds the beam at a bearing, over half a turn."""
    beam = (bearing + 0.5 * math.pi) / (math.pi / (beams - 1))
    held = np.flatnonzero((these.begin <= beam) & (beam < these.end))
    return int(held[0]) if len(held) else None


class Door(NamedTuple):
    distance: float
    width: float
    tilt: float
    left: float

    @property
    def walls(self) -> list[Wall]:
        return wall_with_doors(self.distance, [(self.left - 0.5 * self.width, self.left + 0.5 * self.width)], self.tilt)

    @property
    def jambs(self) -> tuple[float, float]:
        """How far away they are, m: on the right, on the left."""
        (_, right), (left, _) = self.walls
        return math.hypot(*right), math.hypot(*left)

    @property
    def bearing(self) -> float:
        return math.atan2(self.left * math.cos(self.tilt), self.distance - self.left * math.sin(self.tilt))


@given(
    st.floats(0.5, 1.5),
    st.floats(0.4, 1.2),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.sampled_from([256, 512, 1024, 4096]),
)
def test_a_door_is_too_wide_by_the_spacing_of_the_beams_on_either_side(
    distance: float, width: float, tilt: float, left: float, beams: int
) -> None:
    door = Door(distance, width, tilt, left)
    step = math.pi / (beams - 1)
    spacing = [step * jamb**2 / (distance * math.cos(tilt)) for jamb in door.jambs]  # along the wall
    these = found(door.walls, 2.5, beams)
    which = at(these, door.bearing, beams)
    assert which is not None
    assert -1e-9 <= these.width[which] - width <= 1.1 * sum(spacing)


def test_a_wall_with_one_door_has_two_crossings_besides_the_free_sides() -> None:
    these = found(wall_with_doors(1.0, [(-0.4, 0.4)]))
    assert len(these.begin) == 3  # the door, and where the wall is further away than one looks
    inner = np.concatenate([these.begin, these.end])
    inner = inner[(inner > 0) & (inner < BEAMS)]
    aside = math.acos(1.0 / L) / math.pi * (BEAMS - 1)  # beams from the middle to where the wall leaves the look-ahead distance
    assert sum(abs(inner - 255.5) < aside - 1) == 2


def test_a_return_at_the_lookahead_distance_is_no_gap_and_counts_once() -> None:
    ranges = np.array([1.0, 1.0, 2.0, 2.5, 2.0, 3.0, 1.0])
    these = gaps(ranges, 2.0, -1.5, 0.5)
    assert sorted(zip(these.begin.tolist(), these.end.tolist(), strict=True)) == [(3, 4), (5, 6)]


def test_all_free_is_one_gap_and_none_free_is_none() -> None:
    for cyclic in (False, True):
        free = gaps(np.full(8, math.inf), 1.2, -0.5 * math.pi, math.pi / 7, cyclic)
        assert (free.begin.tolist(), free.end.tolist()) == ([0], [8])
        assert free.bearing[0] == pytest.approx(0.0)
        assert free.width[0] == pytest.approx(2.4)
        assert not len(gaps(np.full(8, 1.2), 1.2, -0.5 * math.pi, math.pi / 7, cyclic).begin)


def test_a_gap_at_the_border_is_closed_there_at_the_lookahead_distance() -> None:
    ranges = np.array([9.0, 9.0, 1.0, 1.0, 1.0])
    these = gaps(ranges, 2.0, 0.0, 0.3)
    a, b, delta = 2.0, 1.0, 2 * 0.3
    assert these.width[0] == pytest.approx(math.sqrt(a * a + b * b - 2 * a * b * math.cos(delta)))
    assert these.bearing[0] == pytest.approx(0.15)


def test_seen_under_half_a_turn_or_more_a_gap_is_as_wide_as_both_sides_are_away() -> None:
    ranges = np.full(360, 9.0)
    ranges[10], ranges[100] = 0.5, 0.7
    these = gaps(ranges, 2.0, 0.0, math.radians(1.0), cyclic=True)
    assert these.begin.tolist() == [101, 11]
    assert these.end.tolist() == [370, 100]
    assert these.width.tolist() == pytest.approx([1.2, math.sqrt(0.5**2 + 0.7**2)])
    assert these.bearing[0] == pytest.approx(math.radians(235.0 - 360.0))


Ranges = arrays.arrays(
    float, st.integers(3, 64), elements=st.sampled_from([0.0, 0.3, 1.2, 3.0, math.inf]) | st.floats(0.0, 4.0)
)


def same(one: float, other: float) -> bool:
    return abs((one - other + math.pi) % math.tau - math.pi) < 1e-9


@given(Ranges, st.integers(0, 63))
def test_a_whole_turn_may_begin_anywhere(ranges: Array, by: int) -> None:
    count = len(ranges)
    step, by = math.tau / count, by % count
    if (ranges > 1.2).all():
        return
    one, other = gaps(ranges, 1.2, -math.pi, step, True), gaps(np.roll(ranges, by), 1.2, -math.pi, step, True)
    turned = {(begin + by) % count: k for k, begin in enumerate(one.begin.tolist())}
    assert set(turned) == set(other.begin.tolist())
    for k, begin in enumerate(other.begin.tolist()):
        before = turned[begin]
        assert other.end[k] - begin == one.end[before] - one.begin[before]
        assert other.width[k] == one.width[before]
        assert same(other.bearing[k], one.bearing[before] + by * step)


@given(Ranges, st.booleans())
def test_a_mirrored_scan_has_mirrored_gaps(ranges: Array, cyclic: bool) -> None:
    count = len(ranges)
    step = math.tau / count if cyclic else math.pi / (count - 1)
    first = -0.5 * (count - 1) * step
    one, other = gaps(ranges, 1.2, first, step, cyclic), gaps(ranges[::-1], 1.2, first, step, cyclic)
    mirrored = {(count - end) % count: k for k, end in enumerate(one.end.tolist())}
    assert set(mirrored) == {begin % count for begin in other.begin.tolist()}
    for k, begin in enumerate(other.begin.tolist()):
        assert other.width[k] == pytest.approx(one.width[mirrored[begin % count]], abs=1e-12)
        assert same(other.bearing[k], -one.bearing[mirrored[begin % count]])


@given(Ranges, st.booleans())
def test_gaps_are_the_runs_of_free_beams_the_widest_first(ranges: Array, cyclic: bool) -> None:
    count = len(ranges)
    these = gaps(ranges, 1.2, 0.0, math.tau / count, cyclic)
    held = [beam % count for begin, end in zip(these.begin, these.end, strict=True) for beam in range(begin, end)]
    assert sorted(held) == np.flatnonzero(ranges > 1.2).tolist()
    assert (np.diff(these.width) <= 0.0).all()
    assert (these.width >= 0.0).all()
    assert ((these.begin >= 0) & (these.begin < count)).all()
    if not (ranges > 1.2).all():
        for begin, end in zip(these.begin, these.end, strict=True):
            assert cyclic or begin == 0 or ranges[begin - 1] <= 1.2
            assert cyclic or end == count or ranges[end] <= 1.2
            assert not cyclic or max(ranges[begin - 1], ranges[end % count]) <= 1.2


@pytest.mark.parametrize("turn_deg", [-40, -10, 0, 10, 40])
def test_where_a_gap_at_the_border_is_does_not_depend_on_the_heading(turn_deg: int) -> None:
    """A pillar straight ahead of a vehicle that has turned: the ways around it are thought to be where they were before."""
    turn = math.radians(turn_deg)
    scan = view(ranges_of([((1.0, -0.2), (1.0, 0.2))], (0.0, 0.0, turn)))
    _, places = gaps_ahead(scan, -turn, 1.2)
    aside = 0.5 * (math.atan2(0.2, 1.0) + 0.5 * math.pi)
    assert sorted(places + turn) == pytest.approx([-aside, aside], abs=0.01)


def test_a_whole_turn_is_cut_a_quarter_turn_aside() -> None:
    scan = view(ranges_of([((1.0, -0.2), (1.0, 0.2))], beams=720, fov=math.tau), math.tau)
    these, places = gaps_ahead(scan, 0.0, 1.2)
    aside = 0.5 * (math.atan2(0.2, 1.0) + 0.5 * math.pi)
    assert sorted(these.bearing) == pytest.approx([-aside, aside], abs=0.01)
    assert places.tolist() == these.bearing.tolist()


@pytest.mark.parametrize(("distance", "wanted_deg"), [(0.25, 60.0), (0.3, 60.0), (0.3, 70.0), (0.25, -60.0)])
def test_a_narrow_door_looks_no_wider_where_the_quarter_turn_ends_in_it(distance: float, wanted_deg: float) -> None:
    look = view(ranges_of(wall_with_doors(distance, [(-0.175, 0.175)]), beams=BEAMS))
    ahead, _ = gaps_ahead(look, math.radians(wanted_deg), 1.2)
    assert ahead.width.max() == pytest.approx(0.35, abs=0.02)
    assert (np.diff(ahead.width) <= 0.0).all()


def test_a_post_beside_a_vehicle_that_sees_all_around_closes_nothing() -> None:
    ranges = np.full(360, np.inf)
    ranges[:5] = ranges[-5:] = 0.2
    look = view(ranges, fov=math.tau)
    ahead, _ = gaps_ahead(look, 0.0, 1.2)
    assert ahead.width.min() > 0.6
