"""Shadowing field: spread, correlation, reciprocity, no memory."""

import math

import numpy as np
import pytest

from tests.support.netsim.channels import Line
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.shadowing import Shadowing

pytestmark = pytest.mark.slow

LAYER = Shadowing(sigma_db=4.0, correlation_distance_m=10.0)


def in_a_city(rng: np.random.Generator, count: int) -> Floats:
    """Points in 2 km x 2 km x 40 m."""
    return rng.uniform(-1000.0, 1000.0, (count, 3)) * (1.0, 1.0, 0.02)


def shadows(a: Floats, b: Floats, seed: int) -> Floats:
    """Shadowing of pairs of points (n, 3), row by row."""
    return LAYER.loss_db(Line.between(a, b, seed))


@pytest.fixture(scope="module")
def ends() -> tuple[Floats, Floats, Floats]:
    """Both ends of 20 000 links, and a direction for each."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(20_000, 3))
    return in_a_city(rng, 20_000), in_a_city(rng, 20_000), direction / np.linalg.norm(direction, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", [1, 2])
def test_values_are_normal_with_the_configured_sigma(seed: int, ends: tuple[Floats, Floats, Floats]) -> None:
    values = shadows(ends[0], ends[1], seed)
    assert values.std() == pytest.approx(4.0, rel=0.02)
    assert abs(values.mean()) < 0.1
    kurtosis = ((values - values.mean()) ** 4).mean() / values.var() ** 2
    assert kurtosis == pytest.approx(3.0, abs=0.15)  # 3 - 3 / (2 M) for this many cosines, 3 for a normal distribution


def test_where_both_ends_move_correlation_is_the_product(ends: tuple[Floats, Floats, Floats]) -> None:
    a, b, direction = ends
    moved = shadows(a + 3.0 * direction, b + 5.0 * direction[::-1], 1)
    assert np.corrcoef(shadows(a, b, 1), moved)[0, 1] == pytest.approx(math.exp(-0.8), abs=0.03)


@pytest.mark.parametrize("apart", [0.1, 2.0, 10.0])
def test_near_neighbours_have_the_same_sigma(apart: float, ends: tuple[Floats, Floats, Floats]) -> None:
    a, _, direction = ends
    assert shadows(a, a + apart * direction, 1).std() == pytest.approx(4.0, rel=0.04)


def test_independent_seeds_and_links(ends: tuple[Floats, Floats, Floats]) -> None:
    a, b, _ = ends
    one = shadows(a, b, 1)
    assert abs(np.corrcoef(one, shadows(a, b, 2))[0, 1]) < 0.03
    assert abs(np.corrcoef(one, shadows(a[::-1], b, 1))[0, 1]) < 0.03


@pytest.mark.parametrize("place", [0.0, 1.0, 5.0, 200.0])
def test_every_place_varies_alike_from_world_to_world(place: float) -> None:
    """The origin too, where scenarios begin. The standard deviation of a sample of n has the standard error 1 / sqrt(2 n)."""
    layer, seeds = Shadowing(sigma_db=4.0, correlation_distance_m=10.0), 400
    there = np.array([place + 7.0, place, 0.0])
    losses = [layer.loss_db(Line.between(np.array([place, place, 0.0]), there[None], seed))[0] for seed in range(seeds)]
    assert abs(np.std(losses) / 4.0 - 1.0) < 4.0 / np.sqrt(2.0 * seeds)
    assert abs(np.mean(losses)) < 4.0 * 4.0 / np.sqrt(seeds)
