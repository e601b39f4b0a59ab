"""Consensus through the whole platform, where an error of one tick in the delay changes stability."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.step_responses import growth, root
from tests.support.validation.fleets import Floats, Table, lossy, poses
from vcmvsp.agents.formation.followers.consensus import Graph, neighbours_of

pytestmark = pytest.mark.slow

KIND = "consensus"
SMALL = 1e-3  # m: growth over many decades before the vehicles' speed limit
GRAPHS: tuple[tuple[Graph, int, int], ...] = (  # graph, members, greatest stable age in ticks at 10 Hz and kappa = 1
    ("complete", 5, 2),
    ("star", 5, 2),
    ("ring", 6, 3),
    ("path", 5, 3),
)


def team(
    start: Floats | Sequence[Sequence[float]],
    duration_s: float,
    *,
    period_s: float = 0.1,
    delay_s: float = 0.0,
    loss: float = 0.0,
    kind: str = "point",
    **agent: Any,
) -> dict[str, Any]:
    """A scenario: vehicles that start at x, y (m) and yaw (rad, if given), each with a consensus agent."""
    places = [(float(x), float(y), float(yaw[0]) if yaw else 0.0) for x, y, *yaw in start]
    return {
        "name": "consensus",
        "duration_s": duration_s,
        "seed": 1,
        "physics": {"kind": "kinematic"},
        "radio": lossy(loss, delay_s),
        "agents": {"period_s": period_s, **agent},
        "record": {"period_s": period_s},
        "vehicles": {"kind": kind},
        "vehicle": [{"name": f"v{i}", "pose": pose, "agent": {"kind": KIND}} for i, pose in enumerate(places)],
    }


def modes_of(graph: Graph, count: int) -> tuple[Floats, Floats]:
    """Eigenvalues of the Laplacian, ascending, and its eigenvectors as columns."""
    matrix = np.zeros((count, count))
    for i in range(count):
        neighbours = list(neighbours_of(graph, i, count))
        matrix[i, i], matrix[i, neighbours] = len(neighbours), -1.0
    values, modes = np.linalg.eigh(matrix)
    return values, modes


def points(scenario: Table, **settings: Any) -> Floats:
    """Positions of the vehicles at every tick, (m, n, 2)."""
    return poses(vcmvsp.run(scenario, set=settings, mcap=False))[1][..., :2]


def sampled(step: float, age: int, ticks: int) -> Floats:
    """y[n + 1] = y[n] - step y[n - age] from 1, at rest until the first report."""
    y = [1.0]
    for n in range(ticks):
        y.append(y[n] - (step * y[n - age] if n >= age else 0.0))
    return np.array(y)


@pytest.mark.parametrize(("graph", "count", "last_stable"), GRAPHS)
def test_the_last_stable_and_the_first_unstable_delay(graph: Graph, count: int, last_stable: int) -> None:
    """Every mode follows its recursion to rounding; from any start the disagreement finally decays, or grows."""
    values, modes = modes_of(graph, count)
    start = SMALL * np.random.default_rng(1).normal(size=(count, 2))
    for age in (last_stable, last_stable + 1):
        way = points(team(start, 15.0, delay_s=0.1 * age, graph=graph, own="delayed"))
        for lam, mode in zip(values, modes.T, strict=True):
            expected = np.outer(sampled(0.1 * lam, age, len(way) - 1), mode @ start)
            assert np.einsum("i,mik->mk", mode, way) == pytest.approx(expected, abs=1e-12 * max(1.0, np.abs(expected).max()))
        fastest = np.einsum("i,mik->mk", modes[:, -1], way)[:, 0]
        assert growth(fastest[90:], 3) ** 10 == pytest.approx(root(0.1 * values[-1], age) ** 10, rel=0.01)
        off = np.linalg.norm(way - way.mean(axis=1, keepdims=True), axis=(1, 2))
        bound = 2.0 * math.sin(math.pi / (2 * (2 * age + 1)))
        assert (off[90:].max() < off[0]) == (0.1 * values[-1] < bound) == (age == last_stable)


@pytest.mark.parametrize(("delay_s", "age"), [(0.0, 1), (0.04, 1), (0.1, 1), (0.101, 2), (0.2, 2), (0.25, 3), (0.3, 3)])
def test_the_age_is_the_delay_rounded_up_to_ticks_and_at_least_one(delay_s: float, age: int) -> None:
    """The recursion of that age, in the stable and in the unstable case."""
    _, modes = modes_of("star", 5)
    way = points(team(SMALL * modes[:, [-1, -1]], 4.0, delay_s=delay_s, graph="star", own="delayed"))
    assert way[..., 0] @ modes[:, -1] == pytest.approx(SMALL * sampled(0.5, age, len(way) - 1), abs=1e-14)


def test_at_the_bound_it_oscillates_with_omega_kappa_lambda_max() -> None:
    """Path of five at 100 Hz, kappa 1, the delay nearest to tau*: 3.618 rad/s."""
    values, modes = modes_of("path", 5)
    age = round(math.pi / (2.0 * values[-1]) / 0.01 - 0.5)  # a command held for a tick: half a tick of delay
    way = points(team(SMALL * modes[:, [-1, -1]], 8.0, period_s=0.01, delay_s=0.01 * age, graph="path", own="delayed"))
    y = way[400:, :, 0] @ modes[:, -1]
    crossings = np.flatnonzero(np.diff(np.sign(y)))
    between = (crossings[-1] - crossings[0]) * 0.01 / (len(crossings) - 1)
    assert math.pi / between == pytest.approx(values[-1], rel=0.02)


@pytest.mark.parametrize(
    ("graph", "count", "lambda_2"), [("complete", 5, 5.0), ("star", 5, 1.0), ("ring", 6, 1.0), ("path", 5, 0.38197)]
)
def test_without_delay_disagreement_decays_with_lambda_2(graph: Graph, count: int, lambda_2: float) -> None:
    """Sampled so fast that the age of one tick costs less than 1 %."""
    values, modes = modes_of(graph, count)
    assert values[1] == pytest.approx(lambda_2, abs=1e-5)
    period_s = round(0.005 / lambda_2, 3)
    scenario = team(np.outer(modes[:, 1], [1.0, 2.0]).tolist(), 400 * period_s, period_s=period_s, graph=graph, own="delayed")
    y = points(scenario)[..., 0] @ modes[:, 1]
    assert math.log(y[100] / y[400]) / (300 * period_s) == pytest.approx(lambda_2, rel=0.01)


@pytest.mark.parametrize(("graph", "count"), [("complete", 5), ("path", 5)])  # fastest and slowest
def test_with_the_own_point_fresh_they_meet_at_any_delay(graph: Graph, count: int) -> None:
    """2 s, T degree < 1: stable, and within the hull of the start; the delayed form is far beyond its bound."""
    start = np.random.default_rng(2).uniform(-1.0, 1.0, (count, 2)).tolist()
    way = points(team(start, 100.0, delay_s=2.0, graph=graph))
    assert np.ptp(way[-1], axis=0).max() < 1e-3
    assert np.all(np.abs(way).max(axis=(0, 1)) <= np.abs(way[0]).max(axis=0) + 1e-12)


@pytest.mark.parametrize("own", ["fresh", "delayed"])
def test_a_formation_forms_and_moves_over_a_lossy_radio(own: str) -> None:
    """Wedge of five that flies east at 0.5 m/s; half of the messages lost, the rest one or two ticks old."""
    start = np.random.default_rng(3).uniform(-4.0, 4.0, (5, 2)).tolist()
    formation = {"shape": "wedge", "spacing": 2.0}
    scenario = team(
        start, 90.0, delay_s=0.15, loss=0.5, graph="ring", gain=0.6, own=own, velocity=(0.5, 0.0), formation=formation
    )
    result = vcmvsp.run(scenario, mcap=False)
    _, moved = poses(result)
    deep = math.sqrt(3.0)
    expected = [(-deep, -1.0), (-deep, 1.0), (-2 * deep, -2.0), (-2 * deep, 2.0)]
    assert moved[-1, 1:, :2] - moved[-1, 0, :2] == pytest.approx(np.array(expected), abs=1e-3)
    assert moved[-1, :, 0] - moved[-101, :, 0] == pytest.approx(np.full(5, 5.0), abs=1e-3)
    assert result.metrics["formation"]["final_m"] < 1e-3


def test_robots_on_wheels_form_a_column_with_their_hand_points() -> None:
    """Column of four that finally heads north-east, from other headings; ten ticks of delay."""
    start = [(0.0, 0.0, 0.0), (-2.0, 1.0, 3.0), (1.0, -3.0, -1.5), (-1.0, -1.0, 1.0)]
    formation = {"shape": "column", "spacing": 0.8}
    params: dict[str, Any] = {"handle": 0.3, "heading": math.pi / 4, "velocity": (0.2, 0.2), "max_speed": 0.8}
    result = vcmvsp.run(
        team(start, 90.0, kind="kinematic", delay_s=1.0, graph="path", formation=formation, **params), mcap=False
    )
    _, moved = poses(result)
    assert moved[-1, :, 2] % math.tau == pytest.approx(np.full(4, math.pi / 4), abs=1e-3)
    apart = np.diff(moved[-1, :, :2], axis=0)
    assert apart == pytest.approx(np.full((3, 2), -0.8 * math.sqrt(0.5)), abs=2e-3)
    assert result.metrics["formation"]["final_m"] < 2e-3
