"""A lane is free if and only if no return lies in it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.agents.scans import ranges_of, view
from vcmvsp.agents.avoidance.view import ASIDE, Point, View, free_m, lane_free, ways
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array

Ranges = arrays.arrays(float, 36, elements=st.sampled_from([0.0, 0.5, math.inf]) | st.floats(0.0, 3.0))


def towards(bearing: float) -> Point:
    return math.cos(bearing), math.sin(bearing)


def lane_occupied(scan: View, bearing: float, half: float, length: float) -> bool:
    """Whether a return lies in the lane, beam by beam."""
    for distance, angle in zip(scan.ranges.tolist(), scan.bearings.tolist(), strict=True):
        if distance < math.inf:
            ahead, aside = math.cos(angle - bearing), abs(math.sin(angle - bearing))
            if ahead >= ASIDE and distance * ahead <= length and distance * aside < half:
                return True
    return False


@given(Ranges, st.floats(-4.0, 4.0), st.floats(0.0, 1.0), st.floats(0.0, 2.0), st.sampled_from([math.pi, math.tau]))
def test_a_lane_is_free_of_returns(ranges: Array, bearing: float, half: float, length: float, fov: float) -> None:
    scan = view(ranges, fov)
    free, rounding = lane_free(scan, bearing, half, length), 1e-9
    if lane_occupied(scan, bearing, half - rounding, length - rounding):
        assert not free
    if not lane_occupied(scan, bearing, half + rounding, length + rounding):
        assert free
    if free:
        assert lane_free(scan, bearing, 0.5 * half, 0.5 * length)
    else:
        assert not lane_free(scan, bearing, half + 0.1, length + 0.1)


@given(Ranges, st.floats(0.05, 0.6), st.floats(0.1, 2.0), st.sampled_from([math.pi, math.tau]), st.sampled_from([0.0, 2.9]))
def test_ways_are_the_bearings_open_to_a_disc(ranges: Array, half: float, length: float, fov: float, first: float) -> None:
    """Beam by beam, and against the free distance of a disc."""
    scan = view(ranges, fov, first)
    for bearing, free in zip(scan.bearings.tolist(), ways(scan, half, length).tolist(), strict=True):
        near = [(d, b) for d, b in zip(scan.ranges.tolist(), scan.bearings.tolist(), strict=True) if d <= length]
        room = [abs(wrap(b - bearing)) - math.asin(min(1.0, half / max(d, half))) for d, b in near]
        if min(room, default=1.0) > 1e-6:
            assert free
            assert free_m(scan, towards(bearing), half, length) == math.inf
        if min(room, default=1.0) < -1e-6:
            assert not free
            assert free_m(scan, towards(bearing), half, length) <= length


def test_how_far_a_disc_gets_to_a_wall() -> None:
    scan = view(ranges_of([((1.0, -9.0), (1.0, 9.0))], beams=2048))
    assert free_m(scan, (1.0, 0.0), 0.3, 3.0) == pytest.approx(0.7, abs=1e-3)
    assert free_m(scan, (1.0, 0.0), 0.3, 0.9) == math.inf
    assert free_m(scan, towards(1.0), 0.3, 3.0) == pytest.approx(0.7 / math.cos(1.0), abs=2e-2)
    assert free_m(view(np.zeros(181)), (1.0, 0.0), 0.3, 3.0) <= 0.0


def test_a_return_at_90_degrees_is_in_the_lane() -> None:
    """With rounding of quarter turns."""
    ranges = np.full(181, math.inf)
    ranges[[0, 180]] = 0.2
    assert not lane_free(view(ranges), 0.0, 0.3, 1.0)
    assert lane_free(view(ranges), 0.0, 0.19, 1.0)
