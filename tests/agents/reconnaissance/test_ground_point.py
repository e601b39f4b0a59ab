"""Pixels of a downward camera to ground points and back: against closed forms and the simulated camera."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import present
from vcmvsp.agents.reconnaissance.ground_point import Nadir, nadir_of, turned
from vcmvsp.cosim.frames import product, quaternion_from_yaw
from vcmvsp.cosim.types import Image, VehicleState
from vcmvsp.physics.sensors.camera import NadirCamera

F, WIDTH, HEIGHT = 400.0, 640, 480

Point = tuple[float, float]
angles = st.floats(-math.pi, math.pi)
tilts = st.floats(-0.3, 0.3)
places = st.tuples(st.floats(-8.0, 8.0), st.floats(-6.0, 6.0))


def attitude_of(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> tuple[float, float, float, float]:
    about_y = (math.cos(0.5 * pitch), 0.0, math.sin(0.5 * pitch), 0.0)
    about_x = (math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0)
    return product(quaternion_from_yaw(yaw), product(about_y, about_x))


def nadir(
    x: float = 0.0, y: float = 0.0, height: float = 20.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> Nadir:
    return Nadir((x, y, height), attitude_of(yaw, pitch, roll), F, WIDTH, HEIGHT)


@given(places, angles, tilts, tilts, st.floats(2.0, 60.0))
def test_pixel_and_ground_point_are_inverse_at_any_attitude(
    place: Point, yaw: float, pitch: float, roll: float, height: float
) -> None:
    view = nadir(1.0, 2.0, height, yaw, pitch, roll)
    pixel = view.pixel(place)
    if pixel is None:
        assert math.dist(place, (1.0, 2.0)) > height
    else:
        assert view.ground_point(pixel) == pytest.approx(place, abs=1e-6 * height * (1.0 + max(map(abs, pixel)) / F) ** 2)


def test_above_the_horizon_and_in_the_ground_there_is_no_ground_point() -> None:
    assert nadir(pitch=1.2).ground_point((320.0, 470.0)) is None
    assert nadir(height=0.0).ground_point((320.0, 240.0)) is None
    assert nadir(height=-1.0).ground_point((320.0, 240.0)) is None
    assert nadir().ground_point((math.nan, 240.0)) is None
    assert nadir(pitch=math.pi).pixel((0.0, 0.0)) is None
    assert nadir(pitch=1.2).footprint() is None


def test_the_footprint_is_the_picture_on_the_ground() -> None:
    """640 x 480 px at f 400 and 20 m: 32 m x 24 m, long side across; the first corner is ahead on the left."""
    corners, turned_left = present(nadir().footprint()), present(nadir(yaw=0.5 * math.pi).footprint())
    assert np.array(corners) == pytest.approx(np.array([(12.0, 16.0), (-12.0, 16.0), (-12.0, -16.0), (12.0, -16.0)]))
    assert turned_left[0] == pytest.approx((-16.0, 12.0))


@given(places, angles, tilts, tilts, st.floats(0.1, 5.0), st.floats(0.0, math.tau), st.floats(0.0, 1.0))
def test_a_region_contains_all_pixels_of_its_disc(
    place: Point, yaw: float, pitch: float, roll: float, reach: float, bearing: float, share: float
) -> None:
    view = nadir(yaw=yaw, pitch=pitch, roll=roll)
    near = place[0] + share * reach * math.cos(bearing), place[1] + share * reach * math.sin(bearing)
    pixel, region = view.pixel(near), view.region(place, reach)
    if pixel is None or not (0.0 <= pixel[0] <= WIDTH - 1 and 0.0 <= pixel[1] <= HEIGHT - 1):
        return
    left, top, right, low = present(region)
    assert left - 1e-6 <= pixel[0] <= right - 1 + 1e-6
    assert top - 1e-6 <= pixel[1] <= low - 1 + 1e-6
    assert 0 <= left < right <= WIDTH
    assert 0 <= top < low <= HEIGHT


def test_a_region_has_the_size_of_its_disc_and_none_beyond_the_edge() -> None:
    """2 m around the middle at 20 m: 40 px each way."""
    assert nadir().region((0.0, 0.0), 2.0) == (279, 199, 361, 281)
    assert nadir().region((0.0, 30.0), 2.0) is None


def test_a_region_beyond_the_horizon_is_the_whole_picture() -> None:
    slanted = nadir(height=2.0, pitch=-1.2)
    assert slanted.region((2.0, 0.0), 30.0) == (0, 0, WIDTH, HEIGHT)
    assert slanted.region((-100.0, 0.0), 2.0) is None


def test_the_pinhole_is_where_the_camera_is_mounted() -> None:
    image = Image(pixels=np.zeros((HEIGHT, WIDTH, 3), np.uint8), focal_px=F)
    state = VehicleState(position=(1.0, 2.0, 10.0), attitude=attitude_of(0.5 * math.pi))
    view = nadir_of(image, state, mount=(0.3, 0.1, -0.2), ground_m=2.0)
    assert view.position == pytest.approx((0.9, 2.3, 9.8))
    assert view.height_m == pytest.approx(7.8)
    assert (view.width, view.height, view.focal_px) == (WIDTH, HEIGHT, F)


@given(angles, tilts, tilts)
def test_vectors_are_turned_as_by_the_quaternion_product(yaw: float, pitch: float, roll: float) -> None:
    w, x, y, z = attitude = attitude_of(yaw, pitch, roll)
    expected = product(product(attitude, (0.0, 1.0, -2.0, 3.0)), (w, -x, -y, -z))[1:]
    assert turned(attitude, (1.0, -2.0, 3.0)) == pytest.approx(expected)


@given(st.floats(0.0, 159.0), st.floats(0.0, 119.0), angles, tilts, tilts)
def test_it_agrees_with_the_simulated_camera(u: float, v: float, yaw: float, pitch: float, roll: float) -> None:
    """The renderer's ray of a pixel: its centre is half a pixel from its edges, which begin at 0."""
    camera = NadirCamera()
    ray = ((u + 0.5 - 80.0) / camera.focal_px, (v + 0.5 - 60.0) / camera.focal_px, 1.0)
    x, y, z = turned(attitude_of(yaw, pitch, roll), tuple((camera.body_from_camera @ ray).tolist()))
    image = Image(pixels=np.zeros((120, 160, 3), np.uint8), focal_px=camera.focal_px)
    view = nadir_of(image, VehicleState(position=(0.0, 0.0, 10.0), attitude=attitude_of(yaw, pitch, roll)))
    x0, y0, z0 = view.position
    assert math.dist(view.position, (0.0, 0.0, 10.0)) == pytest.approx(math.hypot(*camera.mount))
    assert view.ground_point((u, v)) == pytest.approx((x0 - x * z0 / z, y0 - y * z0 / z), abs=1e-9)


def test_the_footprint_of_a_part_is_that_of_its_outer_edges() -> None:
    view = nadir(1.0, 2.0, 30.0, 0.3, -0.1, 0.2)
    part = (100, 50, 300, 200)
    corners = [view.ground_point(pixel) for pixel in ((99.5, 49.5), (99.5, 199.5), (299.5, 199.5), (299.5, 49.5))]
    assert view.footprint(part) == tuple(corners)
    assert view.footprint() == view.footprint((0, 0, 640, 480))


@given(angles, st.floats(0.0, 3.0))
def test_upright_is_the_cosine_of_the_tilt_at_any_yaw(yaw: float, tilt: float) -> None:
    assert nadir(yaw=yaw, pitch=tilt).upright == pytest.approx(math.cos(tilt))
    assert nadir(yaw=yaw, roll=tilt).upright == pytest.approx(math.cos(tilt))
