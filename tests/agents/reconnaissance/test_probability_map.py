"""Cells, looks and Bayes' rule: against the rule as printed, brute force, and the exact test of a single cell."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor, decisions, log_odds, probability
from vcmvsp.cosim.types import Array

GRID = Grid(Rectangle(-10.0, 5.0, 21.0, 25.0), 2.0)  # 31 m is no multiple of 2 m
EVERY = np.arange(GRID.rows * GRID.columns)


def bayes(prior: float, sensor: Sensor, looks: list[bool]) -> float:
    """P after looks, applied one by one."""
    p, q, belief = sensor.p, sensor.q, prior
    for hit in looks:
        if hit:
            belief = p * belief / (p * belief + q * (1 - belief))
        else:
            belief = (1 - p) * belief / ((1 - p) * belief + (1 - q) * (1 - belief))
    return belief


@given(
    prior=st.floats(0.01, 0.99), q=st.floats(0.05, 0.6), more=st.floats(0.05, 0.3), looks=st.lists(st.booleans(), max_size=12)
)
def test_counts_equal_bayes_rule_step_by_step(prior: float, q: float, more: float, looks: list[bool]) -> None:
    sensor = Sensor(q + more, q)
    evidence = sensor.evidence(np.array(sum(looks)), np.array(len(looks) - sum(looks)))
    assert float(probability(log_odds(prior) + evidence)) == pytest.approx(bayes(prior, sensor, looks), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("p", "q"), [(0.5, 0.5), (0.3, 0.6), (1.0, 0.1), (0.9, 0.0), (math.nan, 0.1), (1.1, 0.1)])
def test_a_sensor_without_information_or_error_is_refused(p: float, q: float) -> None:
    with pytest.raises(ValueError, match="0 < q < p < 1"):
        Sensor(p, q)


@pytest.mark.parametrize("prior", [0.0, 1.0, math.nan, -0.1])
def test_a_prior_of_0_or_1_is_refused(prior: float) -> None:
    with pytest.raises(ValueError, match="> 0 and < 1"):
        log_odds(prior)


@pytest.mark.parametrize(("p", "net", "wrong", "looks"), [(0.9, 3, 0.00137, 3.740), (0.8, 4, 0.00389, 6.615)])
def test_decisions_of_a_cell_agree_with_the_sequential_test(p: float, net: int, wrong: float, looks: float) -> None:
    """Random walk of hits minus misses at a target, absorbed at `decisions`: exact, by linear algebra."""
    sensor, span = Sensor(p, 1 - p), np.arange(-8, 9)
    decided = decisions(sensor.evidence(np.maximum(span, 0), np.maximum(-span, 0)))
    assert span[decided == 1].min() == net
    assert span[decided == -1].max() == -net

    open_ = span[decided == 0]
    stay = np.diag(np.full(len(open_) - 1, p), 1) + np.diag(np.full(len(open_) - 1, 1 - p), -1)
    visits = np.linalg.inv(np.eye(len(open_)) - stay)[np.flatnonzero(open_ == 0)[0]]  # Kemeny and Snell: the fundamental matrix
    assert visits[0] * (1 - p) == pytest.approx(wrong, abs=5e-6)
    assert visits[0] * (1 - p) == pytest.approx(1 / (1 + (p / (1 - p)) ** net))
    assert visits.sum() == pytest.approx(looks, abs=5e-4)


def test_decisions_are_strict() -> None:
    odds = np.array([log_odds(0.99), log_odds(0.9901), 0.0, log_odds(0.01), log_odds(0.0099), 20.0, -20.0])
    assert decisions(odds).tolist() == [0, 1, 0, 0, -1, 1, -1]


def test_cells_are_numbered_by_row_from_the_bottom_left() -> None:
    assert (GRID.columns, GRID.rows) == (16, 10)
    assert GRID.at(-10.0, 5.0) == 0
    assert GRID.at(-7.9, 7.1) == GRID.columns + 1
    assert GRID.centres(np.array([GRID.columns + 1])).tolist() == [[-7.0, 8.0]]
    assert Grid(Rectangle(0.0, 0.0, 0.3, 0.6), 0.1).columns == 3  # though 0.3 / 0.1 is above 3


@pytest.mark.parametrize("point", [(-10.1, 6.0), (22.1, 6.0), (0.0, 4.9), (0.0, 25.1), (math.nan, 6.0), (0.0, math.inf)])
def test_points_outside_have_no_cell(point: tuple[float, float]) -> None:
    assert GRID.at(*point) is None


@given(cell=st.integers(0, len(EVERY) - 1), dx=st.floats(-0.99, 0.99), dy=st.floats(-0.99, 0.99))
def test_every_point_of_a_cell_is_in_it(cell: int, dx: float, dy: float) -> None:
    ((x, y),) = GRID.centres(np.array([cell]))
    assert GRID.at(x + dx, y + dy) == cell


@given(x=st.floats(-30, 40), y=st.floats(-20, 50), radius=st.floats(0, 40))
def test_a_disc_contains_the_cells_with_centres_in_it(x: float, y: float, radius: float) -> None:
    middles = GRID.centres(EVERY)
    expected = EVERY[(middles[:, 0] - x) ** 2 + (middles[:, 1] - y) ** 2 <= radius**2]
    assert GRID.within(x, y, radius).tolist() == expected.tolist()


@given(
    x=st.floats(-30, 40), y=st.floats(-20, 50), yaw=st.floats(-4, 4), across=st.floats(0.5, 40), along=st.floats(0.5, 40),
    mirrored=st.booleans(),
)  # fmt: skip
def test_a_footprint_contains_the_cells_with_centres_in_it(
    x: float, y: float, yaw: float, across: float, along: float, mirrored: bool
) -> None:
    def ahead_and_aside(points: Array) -> Array:
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        return (points - (x, y)) @ turn.T

    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (along / 2, across / 2)
    corners = corners @ np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]) + (x, y)
    off = np.abs(ahead_and_aside(GRID.centres(EVERY))) - (along / 2, across / 2)
    cells = GRID.inside(corners[::-1] if mirrored else corners)
    assert set(EVERY[(off < -1e-9).all(axis=1)]) <= set(cells.tolist()) <= set(EVERY[(off <= 1e-9).all(axis=1)])
    assert cells.tolist() == sorted(set(cells.tolist()))


def test_a_footprint_may_be_concave() -> None:
    corners = np.array([[-10, 5], [22, 5], [22, 25], [6, 9], [-10, 25]])
    cells = set(GRID.inside(corners).tolist())
    assert GRID.at(6.0, 8.0) in cells
    assert GRID.at(6.0, 12.0) not in cells
    assert {GRID.at(-9.0, 20.0), GRID.at(21.0, 20.0)} <= cells


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_corners_at_infinity_or_fewer_than_three_contain_no_cells(bad: float) -> None:
    for corners in ([[0, 6], [4, 6], [4, bad], [0, 10]], [], [[0, 6]], [[0, 6], [4, 10]]):
        assert GRID.inside(np.array(corners)).size == 0
    assert GRID.within(bad, 10.0, 5.0).size == 0
    assert GRID.within(0.0, 10.0, bad).size == 0


@pytest.mark.parametrize(
    ("area", "cell"),
    [((0.0, 0.0, 0.0, 1.0), 1.0), ((0.0, 1.0, 1.0, 0.0), 1.0), ((0.0, 0.0, math.inf, 1.0), 1.0), ((0.0, 0.0, 1.0, 1.0), 0.0)],
)
def test_an_area_or_cells_without_size_are_refused(area: tuple[float, float, float, float], cell: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        Grid(Rectangle(*area), cell)
