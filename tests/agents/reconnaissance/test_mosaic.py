"""Pictures rectified and laid side by side: every cell shows the picture at the cell's centre."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Uav, present
from tests.support.agents.fake_cameras import T_NS, FakeWatch, at_rest, positions_over, started_agent
from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.picture_recording import Mosaicking, Sheet
from vcmvsp.agents.reconnaissance.probability_map import Rectangle
from vcmvsp.agents.reconnaissance.track import TrackTarget
from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Array, Image, Mosaic, Sightings, Velocity

SECOND = 10**9
AREA = Rectangle(-20.0, -10.0, 20.0, 30.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)

u, v = np.meshgrid(np.arange(640), np.arange(480))
RAMP = np.stack([u * 0.375, v * 0.5, np.full(u.shape, 200.0)], axis=-1).astype(np.uint8)  # colours encode pixel coordinates
RED = np.full((480, 640, 3), (255, 0, 0), np.uint8)


def frame(pixels: Array, time_ns: int, position: tuple[float, float, float], attitude: tuple[float, ...]) -> WatchFrame:
    nadir = Nadir(position, attitude, 400.0, 640, 480)  # type: ignore[arg-type]
    return WatchFrame(time_ns, nadir, (), Image(pixels=pixels, time_ns=time_ns, focal_px=400.0), None, True)


def attitude(yaw: float, tilt: float, about: float) -> tuple[float, ...]:
    c, s, a, b = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(tilt / 2), math.sin(tilt / 2)
    x, y = b * math.cos(about), b * math.sin(about)
    return c * a, c * x - s * y, c * y + s * x, s * a  # tilt first, then yaw


ANGLES = st.floats(-math.pi, math.pi)


@settings(max_examples=20)
@given(st.floats(-20.0, 20.0), st.floats(-10.0, 30.0), st.floats(12.0, 40.0), ANGLES, st.floats(0.0, 0.4), ANGLES)
def test_every_cell_shows_the_picture_at_its_centre(
    x: float, y: float, height: float, yaw: float, tilt: float, about: float
) -> None:
    sheet = Sheet(Mosaicking(area=AREA, cell_m=1.0))
    one = frame(RAMP, 0, (x, y, height), attitude(yaw, tilt, about))
    sheet.lay(one)
    shown = present(sheet.due_mosaic(0))
    assert shown.pixels.shape == (40, 40, 3)
    for row in range(0, 40, 4):
        for column in range(0, 40, 4):
            pixel = one.nadir.pixel((AREA.left + column + 0.5, AREA.bottom + row + 0.5))
            red, green, blue = shown.pixels[row, column].tolist()
            if pixel is None or not (-60.0 <= pixel[0] <= 700.0 and -60.0 <= pixel[1] <= 540.0):
                assert blue == 0
            elif 40 < pixel[0] < 600 and 40 < pixel[1] < 440:
                assert (red, green, blue) == pytest.approx((pixel[0] * 0.375, pixel[1] * 0.5, 200.0), abs=3.0)


def test_the_newest_picture_lies_on_top_and_the_rest_stays() -> None:
    sheet = Sheet(Mosaicking(area=AREA, cell_m=0.5))
    sheet.lay(frame(RAMP, 0, (0.0, 0.0, 20.0), LEVEL))
    before = present(sheet.due_mosaic(0))
    sheet.lay(frame(RED, SECOND, (8.0, 0.0, 8.0), LEVEL))  # covers 9.6 m ahead (east) and 12.8 m across
    after = present(sheet.due_mosaic(11 * SECOND))
    red = (after.pixels == (255, 0, 0)).all(axis=-1)
    middles = np.arange(80) * 0.5 + 0.25
    inside = (abs(middles - 10.0)[:, None] < 6.4) & (abs(middles - 20.0 - 8.0)[None, :] < 4.8)
    wrong = red != inside
    edge = (abs(abs(middles - 10.0) - 6.4) < 0.5)[:, None] | (abs(abs(middles - 28.0) - 4.8) < 0.5)[None, :]
    assert not (wrong & ~edge).any()
    assert (after.pixels[~red] == before.pixels[~red]).all()


def test_one_picture_a_second_is_laid_and_none_with_horizon_or_far_away() -> None:
    sheet = Sheet(Mosaicking(area=AREA))
    sheet.lay(frame(RED, 0, (0.0, 0.0, 20.0), attitude(0.0, 1.2, 0.3)))
    assert sheet.due_mosaic(0) is None
    sheet.lay(frame(RED, 0, (500.0, 0.0, 20.0), LEVEL))
    sheet.lay(frame(RED, SECOND - 1, (0.0, 0.0, 20.0), LEVEL))
    shown = present(sheet.due_mosaic(SECOND))
    assert not shown.pixels.any()
    assert sheet.due_mosaic(2 * SECOND) is None  # once per 10 s
    sheet.lay(frame(RED, SECOND, (0.0, 0.0, 20.0), LEVEL))
    assert present(sheet.due_mosaic(11 * SECOND)).pixels.any()
    assert not shown.pixels.any()  # a mosaic already shown does not change


def test_a_cell_is_the_mean_of_its_ground() -> None:
    """A checkerboard much finer than the cells becomes grey."""
    board = np.repeat((np.indices((480, 640)).sum(axis=0) % 2 * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    sheet = Sheet(Mosaicking(area=AREA, cell_m=1.0))
    sheet.lay(frame(cv2.GaussianBlur(board, (3, 3), 0), 0, (0.0, 10.0, 40.0), LEVEL))
    assert abs(present(sheet.due_mosaic(0)).pixels[5:35, 5:35].astype(float) - 127.5).max() < 10.0


# --- regions that a tracking agent searches, as commander and in stand-by, and the values that it shows ---


def test_in_sight_it_searches_around_the_target_and_the_whole_picture_every_second() -> None:
    eye = FakeWatch(lambda time_s: {"alpha": (1.0, 0.0)} if time_s < 4.0 else {})
    positions_over(started_agent(TrackTarget(), eye), Uav((0.0, 0.0, 30.0)), 80)
    assert eye.regions[:3] == [None] * 3
    tracked = eye.regions[3:40]
    assert 3 <= tracked.count(None) <= 4
    assert all(each is None or (each.place == pytest.approx((1.0, 0.0)) and each.reach_m >= 2.0) for each in tracked)
    assert eye.regions[72:] == [None] * 8  # lost: anywhere


def test_other_targets_are_found_while_it_tracks_one() -> None:
    alpha, both = {"alpha": (1.0, 0.0)}, {"alpha": (1.0, 0.0), "bravo": (9.0, 3.0)}
    track = started_agent(TrackTarget(), FakeWatch(lambda time_s: both if time_s > 2.0 else alpha))
    uav, radio, found = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other")), {}
    for tick in range(80):
        uav.move(command) if isinstance(command := track.act(uav.see(tick * T_NS), radio), Velocity) else None
        if name := track.drain_notes().get("found"):
            found[name] = tick
    assert found["alpha"] == 2
    assert 40 <= found["bravo"] <= 55  # three pictures, 1 s apart
    assert present(track.claim).target == "alpha"


def test_in_stand_by_it_continues_to_observe() -> None:
    track = started_agent(TrackTarget(), FakeWatch(lambda time_s: {"alpha": (0.5 * time_s, 0.0)}), alone=False)
    uav, radio = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other"))
    for tick in range(60):
        obs = uav.see(tick * T_NS)
        if tick == 3:
            track.begin(obs, (0.0, 0.0))
        track.stand_by(obs, radio)
    assert track.goal == pytest.approx((0.5 * 5.9, 0.0), abs=1e-3)
    assert track.facts(uav.see(60 * T_NS))["seen_ns"] == 60 * T_NS
    assert radio.drain() == []


def test_every_picture_with_a_target_is_shown_and_its_pixels_once_a_second() -> None:
    eye = FakeWatch(lambda time_s: {"alpha": (1.0, 0.0)} if 7.0 <= time_s < 9.0 else {})
    track = started_agent(TrackTarget(), eye, alone=False)
    uav, shown = Uav((0.0, 0.0, 30.0)), {}
    for tick in range(150):
        track.facts(uav.see(tick * T_NS))
        if (each := track.drain_shown().get("sightings")) is not None:
            assert isinstance(each, Sightings)
            assert (each.sensor, each.time_ns, each.width, each.height) == ("eye", tick * T_NS, 640, 480)
            shown[tick] = (len(each.found), each.jpeg[:2] == b"\xff\xd8")
    assert {tick for tick, each in shown.items() if each[0]} == set(range(70, 90))
    assert {tick for tick, each in shown.items() if each[1]} == {0, 50, 70, 80, 130}


def test_the_mosaic_is_shown_as_often_as_asked() -> None:
    mosaic = Mosaicking(area=Rectangle(-20.0, -20.0, 20.0, 20.0), cell_m=0.5, every_s=5.0)
    track = started_agent(TrackTarget(mosaic=mosaic), FakeWatch(at_rest()), alone=False)
    uav, shown = Uav((0.0, 0.0, 30.0)), []
    for tick in range(120):
        track.facts(uav.see(tick * T_NS))
        if (each := track.drain_shown().get("mosaic")) is not None:
            assert isinstance(each, Mosaic)
            assert each.pixels.shape == (80, 80, 3)
            shown.append(tick)
    assert shown == [0, 50, 100]
