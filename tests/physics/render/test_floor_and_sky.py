"""The floor in a picture: every pixel against the floor point of its ray."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.physics.render.test_renderer import a_rotation, towards
from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.floor_and_sky import SKY
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.world.floor import GroundPicture, GroundTarget, placed
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World


def floor_points(view: View) -> tuple[Array, Array]:
    """Floor point of each pixel's ray, (h, w, 2) m, and a mask of rays that meet the floor."""
    columns = (np.arange(view.width) + 0.5 - view.width / 2) / view.focal_px
    rows = (np.arange(view.height) + 0.5 - view.height / 2) / view.focal_px
    rays = np.stack([*np.meshgrid(columns, rows), np.ones((view.height, view.width))], axis=-1) @ view.rotation.T
    down = rays[:, :, 2] < 0.0
    far = -view.eye[2] / np.where(down, rays[:, :, 2], -1.0)
    return view.eye[:2] + far[:, :, None] * rays[:, :, :2], down


@pytest.fixture(scope="module")
def slopes(tmp_path_factory: pytest.TempPathFactory) -> World:
    """Ground picture that encodes the position: red increases to the east, green to the north, 100 m x 50 m."""
    east, north = np.meshgrid(np.arange(1000) + 0.5, 500 - (np.arange(500) + 0.5))
    picture = np.stack([np.full((500, 1000), 77), north / 500 * 255, east / 1000 * 255], axis=-1)
    path = tmp_path_factory.mktemp("ground") / "slopes.png"
    cv2.imwrite(str(path), np.rint(picture).astype(np.uint8))
    return World(ground=GroundPicture(picture=str(path), center=(20.0, -5.0), size=(100.0, 50.0), color=(1, 2, 3)))


@pytest.mark.parametrize("seed", range(12))
def test_every_pixel_shows_the_place_that_its_ray_meets_in_any_attitude(slopes: World, seed: int) -> None:
    rng = np.random.default_rng(seed)
    eye = np.array([*rng.uniform(-10, 50, 1), *rng.uniform(-20, 10, 1), rng.uniform(0.3, 30)])
    view = View(eye, a_rotation(rng) if seed % 3 else towards(eye, np.array([20.0, -5, 0]), 0.3), 160, 120, 100.0)
    pixels = render(slopes, view).pixels
    place, down = floor_points(view)
    across, up = (place - [20.0 - 50.0, -5.0 - 25.0]).transpose(2, 0, 1) / np.array([100.0, 50.0])[:, None, None]
    edge = 0.02  # mixed with the surroundings at coarser levels
    inside = down & (np.abs(across - 0.5) < 0.5 - edge) & (np.abs(up - 0.5) < 0.5 - edge)
    outside = down & ((np.abs(across - 0.5) > 0.5 + edge) | (np.abs(up - 0.5) > 0.5 + edge))
    expected = np.stack([across * 255, up * 255, np.full(across.shape, 77)], axis=-1)
    assert (pixels[~down] == SKY).all()
    assert (pixels[outside] == (1, 2, 3)).all()
    assert np.abs(pixels[inside] - expected[inside]).max(initial=0.0) <= 2.0


def test_detail_below_a_pixel_is_averaged(tmp_path: Path) -> None:
    squares = np.indices((512, 512)).sum(axis=0) % 2 * 200
    cv2.imwrite(str(tmp_path / "board.png"), squares.astype(np.uint8))
    world = World(ground=GroundPicture(picture=str(tmp_path / "board.png"), size=(512.0, 512.0)))
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    levels = render(world, View(np.array([0.3, 0.1, 100.0]), down, 64, 64, 25.0)).pixels  # 4 m per pixel
    assert np.abs(levels.astype(int) - 100).max() <= 1


@pytest.mark.parametrize("seed", range(4))
def test_pictures_are_equal_to_the_byte_on_any_thread_count(slopes: World, seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = tuple(
        Box(center=(*rng.uniform(0, 40, 2).tolist(), 1.0), size=(1, 2, 3), color=(int(rng.integers(256)), 0, 9))
        for _ in range(50)
    )
    targets = placed([GroundTarget(place=(20.0, -1.0), size=9.0, color=(9, 9, 9))])
    world = World(ground=slopes.ground, solids=boxes, targets=targets)
    eye = np.array([20.0, -8.0, 6.0])
    view = View(eye, towards(eye, np.array([*rng.uniform(0, 40, 2), 0.0]), float(rng.uniform(-1, 1))), 640, 480, 500.0)
    before = cv2.getNumThreads()
    try:
        pictures = []
        for threads in (1, 2, 5):
            cv2.setNumThreads(threads)
            pictures.append(render(world, view, depth=True))
    finally:
        cv2.setNumThreads(before)
    for other in pictures[1:]:
        assert (other.pixels == pictures[0].pixels).all()
        np.testing.assert_array_equal(other.depth_m, pictures[0].depth_m)


def test_straight_up_there_is_only_sky_and_straight_down_none() -> None:
    up = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert (render(World(), View(np.array([0.0, 0.0, 1.0]), up, 40, 30, 20.0)).pixels == SKY).all()
    down = up * [1.0, -1.0, -1.0]
    assert (render(World(), View(np.array([0.0, 0.0, 1.0]), down, 40, 30, 20.0)).pixels == World().ground.color).all()
    assert math.isclose(np.linalg.det(down), 1.0)
