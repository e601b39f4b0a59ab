"""Distances along cones of headings against sampling, fences against plain loops, speeds against their distances."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vcmvsp.hardware.safety.obstacles import RETURN_MPS, Obstacles, Others, Polygon, Stadiums
from vcmvsp.hardware.safety.supervisor import fastest, stops_within, swept

pytestmark = pytest.mark.slow

reals = st.floats(-3.0, 3.0)
points = st.tuples(reals, reals)
speeds = st.floats(0.0, 3.0)


def distance(x: np.ndarray, y: np.ndarray, a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
    """Distance from each point to a segment, m."""
    ex, ey = b[0] - a[0], b[1] - a[1]
    length2 = ex * ex + ey * ey
    at = np.clip(((x - a[0]) * ex + (y - a[1]) * ey) / length2, 0.0, 1.0) if length2 > 0.0 else 0.0
    return np.hypot(x - a[0] - at * ex, y - a[1] - at * ey)


@settings(max_examples=300)
@given(
    here=points,
    a=points,
    b=points,
    radius=st.floats(0.05, 1.0),
    lo=st.floats(-7.0, 7.0),
    width=st.floats(0.0, 3.5),
    disc=st.booleans(),
)
def test_a_free_sector_agrees_with_sampling(
    here: tuple[float, float],
    a: tuple[float, float],
    b: tuple[float, float],
    radius: float,
    lo: float,
    width: float,
    disc: bool,
) -> None:
    b = a if disc else b
    assume(disc or math.dist(a, b) > 1e-3)
    away = float(distance(np.array(here[0]), np.array(here[1]), a, b))
    assume(away > radius + 1e-3)
    stadiums = Stadiums(*here, np.array([a]), np.array([b]), np.array([radius]), np.zeros(1))
    free = float(stadiums.free(lo, lo + width)[0])
    assert stadiums.clearance == pytest.approx(away - radius)
    assert free >= stadiums.clearance - 1e-9
    phi = np.linspace(lo, lo + width, 241)[:, None]
    rho = np.linspace(0.0, 1.0, 241)[None, :]
    reach = min(free, 20.0) - 1e-6
    inside = distance(here[0] + reach * rho * np.cos(phi), here[1] + reach * rho * np.sin(phi), a, b)
    assert inside.min() >= radius - 1e-7  # no point of the sector is within the radius
    if math.isfinite(free) and width < math.pi:  # and the sector is the largest one
        arc = distance(here[0] + free * np.cos(phi), here[1] + free * np.sin(phi), a, b)
        assert arc.min() <= radius + free * width / 240 + 1e-6


@given(lo=st.floats(-7.0, 7.0), width=st.floats(0.0, 3.0), more=st.floats(0.0, 3.0), here=points)
def test_a_wider_cone_is_never_freer(lo: float, width: float, more: float, here: tuple[float, float]) -> None:
    others = Others(np.array([[1.0, 1.0], [-2.0, 0.5]]), np.zeros((2, 2)), np.array([0.2, 0.3]))
    arounds: list[Obstacles] = [
        others.around(*here, 0.4),
        Polygon([(-3, -3), (3, -3), (3, 3), (0, 0.5), (-3, 3)]).around(*here, 0.3),
    ]
    for around in arounds:
        assert (around.free(lo - more, lo + width + more) <= around.free(lo, lo + width) + 1e-9).all()


def test_driving_along_a_wall_and_away_from_it_is_free_and_at_it_is_not() -> None:
    fence = Polygon([(0, 0), (10, 0), (10, 5), (0, 5)])
    for near in (0.2, 0.1, 0.01):  # at the margin, and inside it
        around = fence.around(5.0, near, 0.2)
        assert float(around.free(0.0, 0.0).min()) == pytest.approx(4.8)
        assert float(around.free(0.5, 0.5).min()) > 4.8
        assert float(around.free(-0.01, -0.01).min()) == 0.0
        assert float(around.free(-0.01, 0.5).min()) == 0.0


@settings(max_examples=1000)
@given(free=st.floats(0.0, 10.0), u=speeds, c=speeds, hold=st.floats(0.01, 1.0), decel=st.floats(0.1, 5.0))
def test_the_fastest_speed_just_fits(free: float, u: float, c: float, hold: float, decel: float) -> None:
    v = fastest(free, u, c, hold, decel)
    assert v >= 0.0

    def needed(speed: float) -> float:
        return swept(speed, u, hold, decel) + c * (hold + speed / decel)

    if v > max(0.0, u - decel * hold):  # otherwise maximum braking is needed anyway
        assert needed(v) == pytest.approx(free, abs=1e-6)
    if v >= u:
        assert stops_within(free, u, c, decel)
    assert fastest(free, u, c, hold, 2.0 * decel) >= v - 1e-9 or v < u
    assert fastest(0.5 * free, u, c, hold, decel) <= v + 1e-9
    assert fastest(free, u, c + 0.1, hold, decel) <= v + 1e-9


def test_known_braking_distances() -> None:
    assert fastest(0.5, 0.0, 0.0, 1e-9, 0.75) == pytest.approx(math.sqrt(2 * 0.75 * 0.5))  # the dynamic window approach
    assert swept(0.5, 0.5, 0.1, 0.75) == pytest.approx(0.05 + 0.25 / 1.5)
    assert swept(0.0, 0.5, 0.1, 0.75) == pytest.approx(0.25 / 1.5)
    # sqrt(v) slows to 0.45 in 1/15 s and 31.7 mm, continues for 1/30 s, and stops in 135 mm
    assert swept(0.45, 0.5, 0.1, 0.75) == pytest.approx(0.475 / 15 + 0.45 / 30 + 0.45**2 / 1.5)
    assert fastest(math.inf, 0.0, 0.0, 0.1, 1.0) == math.inf


def test_outside_only_a_return_is_free() -> None:
    around = Polygon([(0, 0), (4, 0), (4, 3), (0, 3)]).around(5.0, 1.0, 0.3)
    assert around.speed == RETURN_MPS
    assert around.free(math.pi, math.pi + 0.3).tolist() == [math.inf]
    assert around.free(0.0, 0.0).tolist() == [0.0]
    assert around.free(math.pi - 0.5, math.pi + 1.1).tolist() == [0.0]  # 63 degrees off


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (1, 0)],
        [(0, 0), (1, 0), (2, 0)],
        [(0, 0), (1, 1), (1, 0), (0, 1)],
        [(0, 0), (1, 0), (1, 0), (0, 1)],
        [(0, 0), (4, 0), (4, 2), (2, 0), (0, 2)],
        [(0, 0), (1, 0), (math.nan, 1)],
    ],
)
def test_an_invalid_fence_is_refused(corners: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match="fence"):
        Polygon(corners)


@given(here=points)
def test_inside_agrees_with_angles(here: tuple[float, float]) -> None:
    corners = [(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (0.0, -1.0), (-2.0, 2.0)]
    turns = 0.0
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        px, py, qx, qy = ax - here[0], ay - here[1], bx - here[0], by - here[1]
        assume(distance(np.array(here[0]), np.array(here[1]), (ax, ay), (bx, by)) > 1e-6)
        turns += math.atan2(px * qy - py * qx, px * qx + py * qy)
    for order in (corners, corners[::-1]):
        assert Polygon(order).contains(*here) == (abs(turns) > math.pi)


def test_only_an_approach_counts_as_closing() -> None:
    others = Others(
        np.array([[2.0, 0.0], [0.0, 3.0], [0.0, -1.0]]), np.array([[-0.5, 0.3], [0.0, 1.0], [0.7, 0.0]]), np.full(3, 0.2)
    )
    around = others.around(0.0, 0.0, 0.5)
    assert around.closing.tolist() == [0.5, 0.0, 0.0]
    assert around.clearance == pytest.approx(0.3)
    assert around.free(0.0, 0.0).tolist() == [pytest.approx(1.3), math.inf, math.inf]


def test_no_bit_at_a_wall_lets_a_robot_through() -> None:
    fence = Polygon([(0, 0), (6, 1.5), (0, 3)])
    normal = (-0.25 / math.hypot(1, 0.25), 1 / math.hypot(1, 0.25))
    for along in np.random.default_rng(1).uniform(1.5, 4.0, 600).tolist():
        for bits in range(-2, 3):
            gap = 0.18 + bits * math.ulp(0.18)
            around = fence.around(along + gap * normal[0], 0.25 * along + gap * normal[1], 0.18)
            assert float(around.free(-1.1, -1.1).min()) <= 1e-9
