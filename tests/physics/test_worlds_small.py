"""Corridors, gates, pillars: open where they should be, closed elsewhere."""

import itertools
import math

import numpy as np
import pytest

from cosim.errors import ScenarioError
from cosim.types import Array
from physics.solids import Cylinder
from physics.worlds import Corridor, Gates, GatesOffset, Pillar


def disc(x: float, y: float, radius: float) -> Array:
    angles = math.tau * np.arange(16) / 16
    return np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])


@pytest.mark.parametrize("bends", [(), (0.5,), (0.7, -1.2, 1.57), (-1.0, -1.0)])
def test_a_corridor_is_as_wide_as_asked_for_everywhere(bends: tuple[float, ...]) -> None:
    corridor = Corridor(length=30.0, width=2.0, bends=bends)
    world, middle = corridor.build(), corridor.middle()
    assert np.hypot(*np.diff(middle, axis=0).T).sum() == pytest.approx(30.0)
    for a, b in itertools.pairwise(middle):
        for share in np.linspace(0.0, 1.0, 40).tolist():
            x, y = a + share * (b - a)
            assert world.blocking(disc(x, y, 0.999), 0.0, 2.0) is None
        assert world.blocking(disc(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 1.05), 0.0, 2.0) is not None


def test_a_closed_corridor_ends() -> None:
    assert Corridor(closed=True).build().blocking(disc(20.1, 0.0, 0.05), 0.0, 1.0) is not None
    assert Corridor().build().blocking(disc(20.1, 0.0, 0.05), 0.0, 1.0) is None


@pytest.mark.parametrize(("bends", "words"), [((2.0,), ""), ((1.5,) * 4, "run into itself"), ((3.13,), "too short")])
def test_corridors_that_cannot_be(bends: tuple[float, ...], words: str) -> None:
    if not words:
        Corridor(bends=bends).build()
        return
    with pytest.raises(ScenarioError, match=words) as caught:
        Corridor(length=16.0, bends=bends).build()
    assert caught.value.key == "bends"


def test_gates_are_open_where_they_should_be() -> None:
    for gates, offset in ((Gates(number=3), 0.0), (GatesOffset(number=3), 0.75)):
        world = gates.build()
        for gate in range(3):
            y = offset * (-1.0) ** gate
            assert world.blocking(disc(4.0 * (gate + 1), y, 0.74), 0.0, 0.5) is None
            for side in (-0.76, 0.76, 2.7, -2.7):
                assert world.blocking(disc(4.0 * (gate + 1), y + side, 0.05), 0.0, 0.5) is not None


def test_a_pillar_stands_where_it_was_put() -> None:
    world = Pillar(position=(3.0, 1.0), radius=0.5).build()
    solid, depth = world.blocking(disc(3.0, 0.3, 0.3), 0.0, 0.5) or (None, 0.0)
    assert isinstance(solid, Cylinder)
    assert depth == pytest.approx(0.1, abs=0.02)  # 0.7 m apart, radii 0.5 and 0.3
    assert world.blocking(disc(3.0, 0.3, 0.19), 0.0, 0.5) is None
