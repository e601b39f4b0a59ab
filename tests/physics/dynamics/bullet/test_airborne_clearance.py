"""Whoever is not said to be near something cannot touch it before the next look."""

import math

import numpy as np

from vcmvsp.physics.dynamics.bullet.quadrotors import REACH_M, SolidsMap, near_each_other
from vcmvsp.physics.world.solids import Box, Mesh
from vcmvsp.physics.world.world import World


def test_the_map_misses_nothing_that_is_within_the_margin() -> None:
    rng = np.random.default_rng(5)
    solids = tuple(
        Box(center=(*rng.uniform(-40, 40, 2), 3.0), size=(*rng.uniform(0.2, 9.0, 2), 6.0), yaw_rad=float(rng.uniform(0, 3)))
        for _ in range(40)
    )
    world = World(solids=solids)
    places = np.column_stack([rng.uniform(-45, 45, (4000, 2)), rng.uniform(0.3, 9.0, 4000)])
    margin = rng.uniform(0.1, REACH_M, 4000)
    near = SolidsMap(world.shapes).near(places, margin)
    distance = np.full(4000, np.inf)
    for box in solids:
        c, s = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
        d = places - np.array(box.center)
        local = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
        beyond = np.maximum(np.abs(local) - 0.5 * np.array(box.size), 0.0)
        distance = np.minimum(distance, np.sqrt((beyond * beyond).sum(axis=1)))
    assert near[distance < margin].all()
    assert not near[distance > 1.75 * margin].any()  # at corners it errs on the safe side
    assert 0.05 < (distance < margin).mean() < 0.95


def test_the_map_knows_meshes_too() -> None:
    rng = np.random.default_rng(7)
    middles = rng.uniform(-8.0, 8.0, (300, 1, 3))
    sizes = np.where(np.arange(300) % 3, 0.3, 2.0)[:, None, None]
    triangles = middles + sizes * rng.uniform(-1.0, 1.0, (300, 3, 3))
    places, margin = rng.uniform(-9.0, 9.0, (500, 3)), rng.uniform(0.1, 1.0, 500)
    near = SolidsMap(World(solids=(Mesh(triangles=triangles),)).shapes).near(places, margin)
    weights = rng.dirichlet((1.0, 1.0, 1.0), 60)
    points = np.concatenate([(weights @ each) for each in triangles])  # many of each triangle
    distance = np.array([np.sqrt(np.square(points - place).sum(axis=1).min()) for place in places])
    assert near[distance < margin].all()
    assert not near[distance > margin + 4.0].any()


def test_pairs_that_can_meet_before_the_next_look_are_near() -> None:
    rng = np.random.default_rng(6)
    position, velocity, radius = rng.uniform(0, 12, (60, 3)), rng.normal(0, 4, (60, 3)), rng.uniform(0.1, 0.3, 60)
    near = near_each_other(position, velocity, radius, 0.05, 0.1)
    for a in range(60):
        gaps = [
            np.linalg.norm(position[a] - position[b])
            - np.linalg.norm(velocity[a] - velocity[b]) * 0.05
            - radius[a]
            - radius[b]
            - 0.1
            for b in range(60)
            if b != a
        ]
        assert near[a] == (min(gaps) < 0.0)
