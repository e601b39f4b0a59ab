"""Cameras: places in the picture, brightness, depth, and refused parameters."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.physics.sensor_scenes import scene_of
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Image
from vcmvsp.physics.render.floor_and_sky import SKY
from vcmvsp.physics.sensors.camera import LOWEST_M, Camera, NadirCamera
from vcmvsp.physics.world.solids import Box, Hull, Prism
from vcmvsp.physics.world.world import Light, Scene, World

RED, GREEN = (220, 30, 30), (30, 200, 40)
RNG = np.random.default_rng(0)


def cube(x: float, y: float, z: float, edge: float, color: tuple[int, int, int] = RED) -> Box:
    return Box(center=(x, y, z), size=(edge, edge, edge), color=color)


def picture(camera: Camera, scene: Scene) -> Image:
    image = camera.measure(scene, 0, stream(1, "camera"))
    assert isinstance(image, Image)
    return image


def red_mask(image: Image) -> Array:
    levels = image.pixels.astype(int)
    return (levels[:, :, 0] > 100) & (levels[:, :, 1] < 40)


def middle_of(mask: Array) -> tuple[float, float]:
    """Mean column and row of a set of pixels; the centre of the first pixel is (0.5, 0.5)."""
    rows, columns = np.nonzero(mask)
    return float(columns.mean() + 0.5), float(rows.mean() + 0.5)


def test_an_empty_world_is_floor_and_sky_and_the_horizon_lies_in_the_middle_of_a_level_camera() -> None:
    image = picture(Camera(mount=(0, 0, 1)), scene_of())
    assert image.pixels.shape == (120, 160, 3)
    assert image.pixels.dtype == np.uint8
    assert not image.pixels.flags.writeable
    assert (image.pixels[:60] == SKY).all()
    assert (image.pixels[60:] == World().ground.color).all()


def test_nothing_below_the_floor_is_visible() -> None:
    cellar = tuple(Box(center=(3.0, 0.0, -5.0), size=(1.0, 1.0, 1.0)) for _ in range(5))
    wedges = tuple(Prism(outline=((5, -1), (6, 0), (5, 1)), height=1.0, bottom=z) for z in (0.0, -4.0, -4.0))
    camera, above = Camera(mount=(0, 0, 1), pitch=0.2), scene_of(world=World(solids=wedges[:1]))
    image = picture(camera, scene_of(world=World(solids=(*wedges, *cellar))))
    assert (image.pixels == picture(camera, above).pixels).all()
    assert (image.pixels != picture(camera, scene_of()).pixels).any()


def test_the_upper_edge_of_a_nadir_picture_is_ahead_and_its_left_is_left() -> None:
    for yaw in (0.0, 0.5 * math.pi, 2.0):
        ahead, left = (math.cos(yaw), math.sin(yaw)), (-math.sin(yaw), math.cos(yaw))
        places = np.multiply(3.0, ahead) + np.multiply(2.0, left)
        scene = scene_of((0, 0, 10), yaw=yaw, world=World(solids=(cube(float(places[0]), float(places[1]), 0.1, 0.2),)))
        camera = NadirCamera(mount=(0, 0, 0))
        column, row = middle_of(red_mask(picture(camera, scene)))
        assert column == pytest.approx(80 - camera.focal_px * 2 / 9.9, abs=1.0)
        assert row == pytest.approx(60 - camera.focal_px * 3 / 9.9, abs=1.0)


@pytest.mark.parametrize("seed", range(20))
def test_known_points_project_within_half_a_pixel(seed: int) -> None:
    """Corners of a box, found as the outermost pixels of its colour, against the pinhole equation."""
    rng = np.random.default_rng(seed)
    place, attitude = np.array([*rng.uniform(-3, 3, 2), rng.uniform(2, 6)]), rng.standard_normal(4)
    attitude = np.array([1.0, 0, 0, 0]) + 0.1 * attitude
    attitude /= np.linalg.norm(attitude)
    camera = Camera(width=320, height=240, mount=(0.1, -0.05, 0.2), yaw=0.2, pitch=0.1, roll=-0.1, depth=True)
    scene = scene_of(place.tolist(), attitude=attitude)
    eye = place + scene.rotation(0) @ np.array(camera.mount)
    body_from_camera = Rotation.from_euler("ZYX", (0.2, 0.1, -0.1)).as_matrix() @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    turn = scene.rotation(0) @ body_from_camera
    target = eye + turn @ [*rng.uniform(-1.5, 1.5, 2), 8.0]
    box = Box(center=tuple(target.tolist()), size=(1.0, 1.0, 1.0), color=RED)
    scene = scene_of(place.tolist(), attitude=attitude, world=World(solids=(box,)))
    corners = target + 0.5 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = (corners - eye) @ turn
    columns = 160 + camera.focal_px * points[:, 0] / points[:, 2]
    rows = 120 + camera.focal_px * points[:, 1] / points[:, 2]
    image = picture(camera, scene)
    mask = red_mask(image)
    across, down = np.nonzero(mask.any(axis=0))[0], np.nonzero(mask.any(axis=1))[0]
    found = np.array([across[0], across[-1] + 1, down[0], down[-1] + 1])  # edges of pixels
    expected = np.clip([columns.min(), columns.max(), rows.min(), rows.max()], 0, [320, 320, 240, 240])
    # a tip narrower than a pixel may fall between pixels: never outside its true extent, at most 1.5 pixels inside
    assert (np.abs(found - expected) <= 1.5).all()
    assert found[0] + 0.5 >= expected[0] - 1e-6
    assert found[1] - 0.5 <= expected[1] + 1e-6
    assert image.depth_m is not None
    assert points[:, 2].min() - 1e-3 <= image.depth_m[mask].min()
    assert image.depth_m[mask].max() <= points[:, 2].max() + 1e-3


def test_other_vehicles_have_their_place_and_size_the_own_one_is_omitted() -> None:
    body = Hull((0.4, 0.6, 0.2), (0.0, 0.0, 0.1), "box", RED)
    camera = Camera(mount=(0, 0, 0.1), width=320, height=240)
    image = picture(camera, scene_of((0, 0, 0), (5.2, 0.5, 0.0), hull=body))
    mask = red_mask(image)
    scale = camera.focal_px / 5.0  # its rear is 5 m away
    assert middle_of(mask) == pytest.approx((160 - 0.5 * scale, 120), abs=1.0)
    assert abs(mask.any(axis=0).sum() - 0.6 * scale) <= 1.5
    assert abs(mask.any(axis=1).sum() - 0.2 * scale) <= 1.5
    alone = picture(Camera(mount=(-1.0, 0.0, 0.1)), scene_of((0, 0, 0), hull=body))
    assert not red_mask(alone).any()


def test_brightness_follows_the_angle_to_the_sun() -> None:
    light = Light(direction=(-1.0, 0.0, 1.0), ambient=0.3)
    gray = Box(center=(5, 0, 0.5), size=(1, 20, 1), color=(200, 100, 50))
    image = picture(Camera(mount=(0, 0, 2)), scene_of(world=World(solids=(gray,), light=light)))
    colors = {tuple(color) for color in image.pixels.reshape(-1, 3).tolist()}
    both = 0.3 + 0.7 * math.sqrt(0.5)  # equal for top and west side
    assert tuple(round(level * both) for level in (200, 100, 50)) in colors
    away = picture(Camera(mount=(0, 0, 0.5), yaw=math.pi), scene_of((10, 0, 0), world=World(solids=(gray,), light=light)))
    assert tuple(round(level * 0.3) for level in (200, 100, 50)) in {tuple(c) for c in away.pixels.reshape(-1, 3).tolist()}


def test_depths_of_floor_sky_and_beyond_the_reach() -> None:
    camera = Camera(mount=(0, 0, 1), depth=True, range_max=30.0)
    depth = picture(camera, scene_of(world=World(solids=(cube(40, 0, 1, 4.0),)))).depth_m
    assert depth is not None
    assert depth.dtype == np.float32
    assert np.isinf(depth[:60]).all()
    slope = (np.arange(60, 120) + 0.5 - 60) / camera.focal_px
    expected = np.where(1.0 / slope <= 30.0, 1.0 / slope, np.inf)
    np.testing.assert_allclose(depth[60:, 80], expected, rtol=1e-6)
    assert picture(Camera(), scene_of()).depth_m is None


def test_a_camera_is_never_under_the_floor() -> None:
    camera = Camera(mount=(0, 0, -3.0), depth=True)
    assert camera.view(scene_of(), 0).eye[2] == LOWEST_M
    image = picture(camera, scene_of())
    assert (image.pixels[60:] == World().ground.color).all()


def test_noise_has_the_stated_deviation_and_is_repeatable() -> None:
    camera = Camera(noise=4.0, mount=(0, 0, 1))
    clean = picture(Camera(mount=(0, 0, 1)), scene_of()).pixels.astype(float)
    noisy = picture(camera, scene_of()).pixels
    error = noisy - clean
    assert error.std() == pytest.approx(math.sqrt(16.0 + 1.0 / 12.0), rel=0.01)  # rounding adds 1/12
    assert error.mean() == pytest.approx(0.0, abs=0.05)
    assert (picture(camera, scene_of()).pixels == noisy).all()
    bright = World(solids=(cube(1.0, 0, 1, 1.0, (255, 255, 255)),))
    assert picture(Camera(noise=200.0, mount=(0, 0, 1)), scene_of(world=bright)).pixels.max() == 255


@pytest.mark.parametrize(
    ("key", "value"),
    [("width", 0), ("height", 0), ("width", -4), ("field_of_view", 0.0), ("field_of_view", 3.2), ("noise", -1.0)],
)
def test_impossible_cameras_are_refused_by_their_key(key: str, value: Any) -> None:
    with pytest.raises(ScenarioError, match=f"vehicle.car.sensors.eye.{key}"):
        binding.call(Camera, {key: value}, key="vehicle.car.sensors.eye")
    if key != "noise":
        with pytest.raises(ScenarioError, match=key):
            Camera(**{key: value})


def test_image_has_focal_length_and_time() -> None:
    image = picture(Camera(width=200, field_of_view=0.5 * math.pi), scene_of(t=1.5))
    assert image.focal_px == pytest.approx(100.0)
    assert image.time_ns == 1_500_000_000
