"""Beams against hulls of bodies, in any attitude."""

import math

import numpy as np
import pytest

from tests.support.physics.random_worlds import Floats, attitudes, cast_bodies, hulls, scene
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import Scene, World

INF = math.inf
BOX = Hull(size=(2.0, 1.0, 0.5), offset=(0.5, 0.0, 0.25))
CAN = Hull(size=(1.0, 1.0, 2.0), kind="cylinder")


def quaternion(axis: int, angle: float) -> Floats:
    found = np.zeros((1, 4))
    found[0, 0], found[0, 1 + axis] = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return found


def one(body: Scene, start: tuple[float, ...], toward: tuple[float, ...], reach: float = INF) -> float:
    direction = np.array([toward]) / math.hypot(*toward)
    return float(cast_bodies(body, np.array([start], float), direction, reach).distance[0])


def test_a_box_that_stands_turned_and_tilted() -> None:
    level = scene(World(), [(5.0, 0.0, 0.0)], hulls=[BOX])  # from 4.5 to 6.5, half a metre high
    assert one(level, (0, 0, 0.1), (1, 0, 0)) == pytest.approx(4.5)
    assert one(level, (0, 0, 0.6), (1, 0, 0)) == INF
    assert one(level, (9, 0, 0.1), (-1, 0, 0)) == pytest.approx(2.5)
    assert one(level, (5, 0, 9), (0, 0, -1)) == pytest.approx(8.5)
    assert one(level, (5, 0, 0.1), (0, 0, -1)) == 0.0  # from inside
    assert one(level, (0, 0, 0.1), (1, 0, 0), 4.4) == INF
    turned = scene(World(), [(5.0, 0.0, 0.0)], quaternion(2, 0.5 * math.pi), [BOX])  # half a metre to the left
    assert one(turned, (0, 1, 0.1), (1, 0, 0)) == pytest.approx(4.5)
    assert one(turned, (0, -0.6, 0.1), (1, 0, 0)) == INF
    upright = scene(World(), [(5.0, 0.0, 0.0)], quaternion(1, -0.5 * math.pi), [BOX])  # nose up: from -0.5 to 1.5 m
    assert one(upright, (0, 0, 1.4), (1, 0, 0)) == pytest.approx(4.5)  # its top looks back
    assert one(upright, (0, 0, 1.6), (1, 0, 0)) == INF


def test_a_cylinder_is_round() -> None:
    standing = scene(World(), [(5.0, 0.0, 0.0)], hulls=[CAN])
    for aside in np.linspace(-0.499, 0.499, 15).tolist():
        assert one(standing, (0, aside, 0.5), (1, 0, 0)) == pytest.approx(5.0 - math.sqrt(0.25 - aside * aside), abs=1e-9)
    assert one(standing, (0, 0.501, 0.5), (1, 0, 0)) == INF
    assert one(standing, (0, 0, 1.1), (1, 0, 0)) == INF
    assert one(standing, (5.3, 0.3, 3.0), (0, 0, -1)) == pytest.approx(2.0)  # along its axis
    assert one(standing, (5.4, 0.4, 3.0), (0, 0, -1)) == INF
    assert one(standing, (4.0, 0.0, 2.0), (1, 0, -1)) == pytest.approx(math.sqrt(2.0))  # on its lid, at the middle
    lying = scene(World(), [(5.0, 0.0, 0.5)], quaternion(0, 0.5 * math.pi), [CAN])  # along y
    assert one(lying, (0, 0.9, 0.5), (1, 0, 0)) == pytest.approx(4.5)
    assert one(lying, (0, 0.9, 0.9), (1, 0, 0)) == pytest.approx(4.7)
    assert one(lying, (0, 1.1, 0.5), (1, 0, 0)) == INF


def surface(hull: Hull, points: Floats) -> Floats:
    """Signed distance-like measure of points in the frame of a hull: 0 on its surface, less inside."""
    offset = np.abs(points - np.array(hull.offset))
    half = 0.5 * np.array(hull.size)
    if hull.kind == "cylinder":
        offset[:, 0], half[1] = np.hypot(offset[:, 0], offset[:, 1]), np.inf
    found: Floats = (offset - half).max(axis=1)
    return found


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_beams_end_on_the_surface_and_meet_nothing_before(kind: str) -> None:
    rng = np.random.default_rng(5)
    hull = hulls(rng, 2)[0 if kind == "cylinder" else 1]
    assert hull.kind == kind
    for attitude in attitudes(rng, 30, 1.5):
        body = scene(World(), [(1.0, 2.0, 3.0)], attitude[None], [hull])
        directions = rng.normal(size=(100, 3))
        directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True))
        origins = np.array([1.0, 2.0, 3.0]) - 3.0 * directions + rng.uniform(-1.0, 1.0, (100, 3))
        distance = cast_bodies(body, origins, directions, INF).distance

        def local(along: Floats, body: Scene = body, origins: Floats = origins, directions: Floats = directions) -> Floats:
            found: Floats = (origins + along[:, None] * directions - body.position[0]) @ body.rotation(0)
            return found

        hit = np.isfinite(distance)
        assert 4 < hit.sum() < 100
        outside = distance > 0.0
        end = local(np.where(hit, distance, 0.0))[hit & outside]
        assert np.abs(surface(hull, end)).max() < 1e-9
        for share in np.linspace(0.0, 0.999, 40):
            before = surface(hull, local(share * np.where(hit, distance, 8.0)))
            assert before[outside].min() > -1e-9
