"""Occlusion: pictures against single rays, in worlds without a valid painting order."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.support.physics import ray_renderer as oracle
from tests.support.physics.sensor_scenes import scene_of
from vcmvsp.cosim.types import Array
from vcmvsp.physics.render import renderer
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View, pieces_of, visible_pieces
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Hull, Mesh, Prism
from vcmvsp.physics.world.world import Scene, World, rotations

pytestmark = pytest.mark.slow

Rng = np.random.Generator


def a_color(rng: Rng) -> tuple[int, int, int]:
    red, green, blue = (int(level) for level in rng.integers(0, 256, 3))
    return red, green, blue


def a_rotation(rng: Rng) -> Array:
    """A uniformly random rotation."""
    q = rng.standard_normal(4)
    return np.asarray(rotations(q[None] / np.linalg.norm(q))[0])


def towards(eye: Array, aim: Array, roll: float = 0.0) -> Array:
    """world_from_camera of a camera aimed at a point, rotated by ``roll`` (right side down)."""
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    c, s = math.cos(roll), math.sin(roll)
    return np.column_stack([c * right + s * down, c * down - s * right, ahead])


def scattered(rng: Rng) -> list[AnySolid]:
    """Boxes that intersect each other."""
    found: list[AnySolid] = []
    for _ in range(40):
        center, size = (*rng.uniform(-10, 10, 2).tolist(), float(rng.uniform(0, 4))), tuple(rng.uniform(0.3, 5, 3).tolist())
        found.append(Box(center=center, size=size, yaw_rad=float(rng.uniform(0, 7)), color=a_color(rng)))
    return found


def stacked(rng: Rng) -> list[AnySolid]:
    """A wall of bricks in contact."""
    return [
        Box(center=(x, y, z + 0.5), size=(1, 1, 1), color=a_color(rng)) for x in range(-3, 4) for y in (0, 1) for z in range(3)
    ]


def woven(rng: Rng) -> list[AnySolid]:
    """Beams along x, y and z close to each other, with cyclic occlusion."""
    found: list[AnySolid] = []
    for i in range(-2, 3):
        for j in range(3):
            found += [
                Box(center=(0, i, j + 0.5), size=(8, 0.4, 0.4), color=a_color(rng)),
                Box(center=(i + 0.5, 0, j + 1.0), size=(0.4, 8, 0.4), color=a_color(rng)),
                Box(center=(i, 2 * j - 1.5, 2), size=(0.4, 0.4, 4), color=a_color(rng)),
            ]
    return found


def mixed(rng: Rng) -> list[AnySolid]:
    """Every kind of solid."""
    found: list[AnySolid] = []
    for _ in range(12):
        x, y = rng.uniform(-10, 10, 2).tolist()
        height = float(rng.uniform(0.5, 5))
        angle = rng.uniform(0, 7)
        turn = rotations(np.array([[np.cos(angle), 0, 0, np.sin(angle)]]))[0, :2, :2]
        corner = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]]) @ turn
        outline = tuple((x + a, y + b) for a, b in corner.tolist())
        found += [
            Cylinder(center=(x + 3, y, height / 2), radius=float(rng.uniform(0.05, 1)), height=height, color=a_color(rng)),
            Prism(outline=outline, height=height, bottom=float(rng.uniform(-1, 1)), color=a_color(rng)),
        ]
        corners = rng.uniform(-2, 2, (6, 3, 3)) + np.array([x, y, 1.0])
        found.append(Mesh(triangles=corners, color=a_color(rng)))
    return found


def mismatches(
    world: World, view: View, rng: Rng, number: int, scene: Scene | None = None, without: int = -1
) -> tuple[int, int]:
    """Numbers of sampled pixels with a colour and with a depth other than those of their rays."""
    picture = render(world, view, scene=scene, without=without, depth=True)
    assert picture.depth_m is not None
    found, colors, depths = oracle.things(world, scene, without), 0, 0
    for _ in range(number):
        row, column = int(rng.integers(view.height)), int(rng.integers(view.width))
        hit = oracle.look(world, found, view, row, column)
        colors += bool(np.abs(picture.pixels[row, column] - hit.color).max() > 2.0)
        got = picture.depth_m[row, column]
        depths += bool(not math.isclose(got, hit.depth if hit.depth < view.reach_m else math.inf, rel_tol=1e-5))
    return colors, depths


@pytest.mark.parametrize("make", [scattered, woven, mixed])
def test_large_and_small_faces_agree(make: Callable[[Rng], list[AnySolid]], monkeypatch: pytest.MonkeyPatch) -> None:
    """All faces as large ones, then none: equal pictures except pixels whose centre lies on an edge."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        world = World(solids=tuple(make(rng)))
        eye = np.append(rng.uniform(-14, 14, 2), rng.uniform(0.5, 8))
        view = View(eye, towards(eye, rng.uniform(-4, 4, 3), float(rng.uniform(-0.5, 0.5))), 320, 240, 200.0)
        pictures = []
        for limit in (-1, 10**9):
            monkeypatch.setattr(renderer, "LARGE_PX", limit)
            pictures.append(render(world, view, depth=True))
        assert (pictures[0].pixels != pictures[1].pixels).any(axis=2).sum() <= 4  # of 76 800
        one, other = (each.depth_m for each in pictures)
        assert one is not None
        assert other is not None
        assert (~np.isclose(one, other, rtol=1e-6)).sum() <= 4
        assert mismatches(world, view, rng, 40)[0] <= 1


def test_any_lens_in_any_place_agrees_with_single_rays() -> None:
    """From one pixel to a large picture, from telephoto to almost 180 degrees, close to walls and inside them."""
    colors = depths = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        world = World(solids=tuple((scattered, stacked, woven, mixed)[seed % 4](rng)))
        eye = np.append(rng.uniform(-6, 6, 2), rng.uniform(0.005, 5))
        rotation = a_rotation(rng) if seed % 2 else towards(eye, rng.uniform(-4, 4, 3), float(rng.uniform(-3, 3)))
        width, height = ((1, 1), (160, 120), (640, 480), (33, 200), (320, 240))[seed % 5]
        focal = 0.5 * width / math.tan(0.5 * float(rng.uniform(0.05, 3.1)))
        c, d = mismatches(world, View(eye, rotation, width, height, focal, 100.0), rng, 40)
        colors, depths = colors + c, depths + d
    assert colors <= 2  # of 1600: 99.9 %
    assert depths <= 2


def crowd(rng: Rng, count: int = 30) -> Scene:
    """Bodies in any attitude, some of them half below the floor, among boxes."""
    attitude = rng.standard_normal((count, 4))
    attitude /= np.linalg.norm(attitude, axis=1)[:, None]
    world, hulls = World(solids=tuple(scattered(rng)[:10])), []
    for _ in range(count // 2):
        sizes: Any = {"cylinder": (0.8, 0.8, 0.3), "box": tuple(rng.uniform(0.2, 2, 3).tolist())}
        for kind, size in sizes.items():
            hulls.append(Hull(size, tuple(rng.uniform(-0.2, 0.2, 3).tolist()), kind, a_color(rng)))
    places = np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(0, 3, count)])
    return scene_of(*places, attitude=attitude, world=world, hulls=hulls)


def test_bodies_in_any_attitude_agree_with_single_rays_without_the_own_one() -> None:
    colors = depths = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        scene = crowd(rng)
        eye = scene.position[3] + [0.0, 0.0, 0.3]
        view = View(eye, towards(eye, np.zeros(3)), 160, 120, 90.0)
        c, d = mismatches(scene.world, view, rng, 250, scene, 3)
        colors, depths = colors + c, depths + d
    assert colors <= 1
    assert depths <= 6  # cylinder sides are flat in the picture: a few mm


def city(rng: Rng, pitch: float) -> World:
    """Buildings of random height, with a second block on top, some raised, some in contact with their neighbours."""
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
def test_hidden_solids_change_no_picture(pitch: float, monkeypatch: pytest.MonkeyPatch) -> None:
    left_out = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world = city(rng, pitch)
        eye = np.append(pitch * rng.integers(-4, 5, 2) + rng.uniform(-0.2, 0.2, 2), rng.choice([0.3, 1.7, 6.0, 12.0]))
        aim = eye + np.append(rng.uniform(-1, 1, 2), rng.uniform(-0.1, 0.1))
        view = View(eye, towards(eye, aim, float(rng.uniform(-0.2, 0.2))), 320, 240, 160.0)
        quick = render(world, view, depth=True)
        with monkeypatch.context() as patch:
            patch.setattr(renderer, "visible_pieces", lambda pieces, near, view: near)
            whole = render(world, view, depth=True)
        np.testing.assert_array_equal(quick.pixels, whole.pixels)
        np.testing.assert_array_equal(quick.depth_m, whole.depth_m)
        every = np.arange(len(world.solids))
        left_out += len(every) - len(visible_pieces(pieces_of(world), every, view))
    assert left_out > 25 * 20


def test_only_a_lower_solid_behind_a_higher_one_is_hidden() -> None:
    wall = Box(center=(5, 0, 2), size=(1, 20, 4))
    rest = [Box(center=(8, 0.01 * n, 0.2), size=(0.2, 0.2, 0.4)) for n in range(60)]
    lower, higher = Box(center=(10, 0, 1), size=(1, 1, 2)), Box(center=(10, 3, 10), size=(1, 1, 20))
    pieces = pieces_of(World(solids=(wall, lower, higher, *rest)))
    view = View(np.array([0.0, 0.0, 1.5]), towards(np.array([0.0, 0.0, 1.5]), np.array([5.0, 0.0, 1.5])), 160, 120, 100.0)
    assert visible_pieces(pieces, np.arange(63), view).tolist() == [0, 2]
    above = view._replace(eye=np.array([0.0, 0.0, 30.0]))
    assert len(visible_pieces(pieces, np.arange(63), above)) == 63
    assert math.isclose(pieces.high[2, 2], 20.0)
