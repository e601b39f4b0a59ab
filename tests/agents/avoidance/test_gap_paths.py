"""Going through gaps leads around things, with a scanner that errs by 2 cm, and never into them."""

import itertools
import math

import numpy as np
import pytest

from tests.support.agents.scans import SMALL, box, driven, wall_with_doors
from vcmvsp.agents.avoidance import Gap


@pytest.mark.parametrize("fov", [math.pi, 4.0, math.tau])
@pytest.mark.parametrize("seed", range(4))
def test_it_gets_around_a_pillar_and_through_a_door(fov: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, goal = (-3.0, rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3)), (2.0, rng.uniform(-0.4, 0.4))
    beside = rng.uniform(-0.5, 0.5)
    for walls in (box(0.0, 0.0, 0.5), wall_with_doors(0.0, [(beside - 0.35, beside + 0.35)], half=3.0)):
        poses, modes, least = driven(Gap().method(SMALL, 0.1), walls, pose, goal, fov=fov, noise=rng)
        assert math.dist(poses[-1][:2], goal) < 0.1
        assert least > SMALL.radius_m
        assert sum(a != b for a, b in itertools.pairwise(modes)) <= 8


def test_where_there_is_no_way_it_never_goes_through() -> None:
    room = box(0.0, 0.0, 4.0)
    poses, _, least = driven(Gap().method(SMALL, 0.1), room, (-1.0, 0.3, 0.2), (5.0, 0.0), fov=math.pi)
    assert all(max(abs(x), abs(y)) < 2.0 for x, y, _ in poses)
    assert least > SMALL.radius_m
