"""Leaving out what is hidden changes no pixel, and leaves out most of a city that is seen from its streets."""

import math

import numpy as np
import pytest

from tests.physics.render.test_depth import Rng, a_color, towards
from vcmvsp.physics.render import renderer
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View, pieces_of, shown
from vcmvsp.physics.world.solids import AnySolid, Box
from vcmvsp.physics.world.world import World


def city(rng: Rng, pitch: float) -> World:
    """Buildings of all heights, some with another one on top, some on stilts, some that touch their neighbours."""
    solids: list[AnySolid] = []
    for i in range(-6, 6):
        for j in range(-6, 6):
            x, y = pitch * (i + 0.5), pitch * (j + 0.5)
            (length, width), height = rng.uniform(4.0, 10.0, 2).tolist(), float(rng.uniform(2.0, 15.0))
            bottom = float(rng.integers(2)) * float(rng.integers(3))
            yaw = float(rng.uniform(-0.5, 0.5)) * (pitch > 10.0)
            solids += [
                Box(center=(x, y, bottom + height / 2), size=(length, width, height), yaw_rad=yaw, color=a_color(rng)),
                Box(center=(x, y, bottom + height + 1.0), size=(length / 2, width / 2, 2.0), yaw_rad=yaw, color=a_color(rng)),
            ]
    return World(solids=tuple(solids))


@pytest.mark.parametrize("pitch", [10.0, 16.0])
def test_pictures_are_the_same_with_and_without_what_is_hidden(pitch: float, monkeypatch: pytest.MonkeyPatch) -> None:
    left_out = 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        world = city(rng, pitch)
        eye = np.append(pitch * rng.integers(-4, 5, 2) + rng.uniform(-0.2, 0.2, 2), rng.choice([0.3, 1.7, 6.0, 12.0]))
        aim = eye + np.append(rng.uniform(-1, 1, 2), rng.uniform(-0.1, 0.1))
        view = View(eye, towards(eye, aim, float(rng.uniform(-0.2, 0.2))), 320, 240, 160.0)
        quick = render(world, view, depth=True)
        with monkeypatch.context() as patch:
            patch.setattr(renderer, "shown", lambda pieces, near, view: near)
            whole = render(world, view, depth=True)
        np.testing.assert_array_equal(quick.pixels, whole.pixels)
        np.testing.assert_array_equal(quick.depth_m, whole.depth_m)
        every = np.arange(len(world.solids))
        left_out += len(every) - len(shown(pieces_of(world), every, view))
    assert left_out > 25 * 20


def test_a_lower_one_behind_a_higher_one_is_hidden_and_a_higher_one_is_not() -> None:
    wall = Box(center=(5, 0, 2), size=(1, 20, 4))
    rest = [Box(center=(8, 0.01 * n, 0.2), size=(0.2, 0.2, 0.4)) for n in range(60)]
    lower, higher = Box(center=(10, 0, 1), size=(1, 1, 2)), Box(center=(10, 3, 10), size=(1, 1, 20))
    pieces = pieces_of(World(solids=(wall, lower, higher, *rest)))
    view = View(np.array([0.0, 0.0, 1.5]), towards(np.array([0.0, 0.0, 1.5]), np.array([5.0, 0.0, 1.5])), 160, 120, 100.0)
    assert shown(pieces, np.arange(63), view).tolist() == [0, 2]
    above = view._replace(eye=np.array([0.0, 0.0, 30.0]))
    assert len(shown(pieces, np.arange(63), above)) == 63
    assert math.isclose(pieces.high[2, 2], 20.0)
