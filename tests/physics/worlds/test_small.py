"""Corridors, gates, pillars: open where they should be, closed elsewhere."""

import itertools
import math

import numpy as np
import pytest

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import Box, Cylinder
from vcmvsp.physics.worlds.obstacle_courses import Corridor, Gates, GatesOffset, Pillar


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


@pytest.mark.parametrize("bends", [(), (0.7, -1.2)])
def test_a_corridor_may_begin_anywhere_on_its_axis(bends: tuple[float, ...]) -> None:
    plain, moved = Corridor(bends=bends, closed=True), Corridor(bends=bends, closed=True, start=-2.5)
    assert moved.middle() == pytest.approx(plain.middle() - (2.5, 0.0))
    for one, other in zip(plain.build().shapes.groups, moved.build().shapes.groups, strict=True):
        assert other.corners == pytest.approx(one.corners - (2.5, 0.0))


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


@pytest.mark.parametrize("kind", [Gates, GatesOffset])
def test_gates_stand_where_each_was_put(kind: type[Gates]) -> None:
    """Gaps of 0.9 m every 3.5 m; ``offset`` does not count then."""
    offsets = (0.0, 0.8, -0.5)
    world = kind(number=3, spacing=3.5, width=0.9, offsets=offsets).build()
    assert world.name == "gates-offset"
    for gate, y in enumerate(offsets):
        x = 3.5 * (gate + 1)
        assert world.blocking(disc(x, y, 0.449), 0.0, 0.5) is None
        for side in (-0.46, 0.46, 2.4, -2.4):
            assert world.blocking(disc(x, y + side, 0.02), 0.0, 0.5) is not None
    same = Gates(number=2, offsets=(0.75, -0.75)).build()
    assert same.solids == GatesOffset(number=2).build().solids
    assert Gates(number=2, offsets=(0.0, 0.0)).build().name == "gates"


@pytest.mark.parametrize("kind", [Gates, GatesOffset])
def test_one_offset_beside_those_of_all_gates_is_refused(kind: type[Gates]) -> None:
    with pytest.raises(ScenarioError, match="so that offset says nothing") as caught:
        kind(number=2, offset=0.4, offsets=(0.0, 0.8))
    assert caught.value.key == "offsets"


@pytest.mark.parametrize("offsets", [(0.0,), (0.0, 0.8, -0.5, 0.1)])
def test_as_many_offsets_as_gates_are_asked_for(offsets: tuple[float, ...]) -> None:
    with pytest.raises(ScenarioError, match=rf"as many as there are gates, number = 3, not {len(offsets)}") as caught:
        Gates(number=3, offsets=offsets)
    assert caught.value.key == "offsets"


def test_a_pillar_stands_where_it_was_put() -> None:
    world = Pillar(position=(3.0, 1.0), radius=0.5).build()
    solid, depth = world.blocking(disc(3.0, 0.3, 0.3), 0.0, 0.5) or (None, 0.0)
    assert isinstance(solid, Cylinder)
    assert depth == pytest.approx(0.1, abs=0.02)  # 0.7 m apart, radii 0.5 and 0.3
    assert world.blocking(disc(3.0, 0.3, 0.19), 0.0, 0.5) is None


def test_a_square_pillar_has_corners() -> None:
    """Its edge is twice the radius: 5 cm from its side, and outside the circle at its corner."""
    world = Pillar(position=(3.0, 1.0), radius=0.25, square=True).build()
    assert world.solids == (Box(center=(3.0, 1.0, 1.5), size=(0.5, 0.5, 3.0)),)
    assert world.blocking(disc(3.0, 0.5, 0.2), 0.0, 0.5) is None
    assert world.blocking(disc(3.24, 1.24, 0.005), 0.0, 0.5) is not None
    assert Pillar(position=(3.0, 1.0), radius=0.25).build().blocking(disc(3.24, 1.24, 0.005), 0.0, 0.5) is None
