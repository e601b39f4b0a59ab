"""A camera that watches for targets: each picture is processed once and placed by the pose at its exposure."""

import math
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import T, info, present
from vcmvsp.agents.reconnaissance.ground_point import MOUNT, Nadir, Poses, nadir_of
from vcmvsp.agents.reconnaissance.recognition.ground import FOCAL_PX, SyntheticFrame, frame, glyph, tilted
from vcmvsp.agents.reconnaissance.watch import GroundDisc, Wanted, Watch, Watching
from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw
from vcmvsp.cosim.types import Image, Scan, Vec3, VehicleState

pytestmark = pytest.mark.slow

T_NS = round(T * 1e9)
RATE = st.floats(-1.0, 1.0)
UNIT = st.tuples(*[RATE] * 4).filter(lambda q: math.hypot(*q) > 0.1)
AXIS = st.tuples(*[RATE] * 3).filter(lambda axis: math.hypot(*axis) > 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("targets")
    assert cv2.imwrite(str(folder / "glyph.png"), glyph()[:, :, ::-1])
    return folder


@pytest.fixture
def watch(folder: Path) -> Watch:
    with registry.looking_in(folder):
        made = Watch(Watching(targets=(Wanted(name="glyph", picture="glyph.png"),)))
    made.start(info("me", body=BODY, sensors=("camera",)))
    return made


def seen(tick: int, position: Vec3, attitude: Quaternion = (1.0, 0.0, 0.0, 0.0), **readings: Any) -> Observation:
    """Observation of a vehicle that moves at 4 m/s and 1 rad/s."""
    rates: tuple[Vec3, Vec3] = (4.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    state = VehicleState(position=position, velocity=rates[0], attitude=attitude, angular_velocity=rates[1])
    return Observation(vehicle="me", time_ns=tick * T_NS, state=state, readings=readings)


def image_of(made: SyntheticFrame, time_ns: int) -> Image:
    return Image(pixels=made.image, time_ns=time_ns, focal_px=FOCAL_PX)


# --- pose of the vehicle ---


@given(UNIT, AXIS, st.floats(0.0, 3.0), st.floats(-20.0, 20.0), st.floats(0.0, 1.0), st.booleans())
def test_interpolation_between_ticks_is_exact_at_constant_acceleration(
    first: Quaternion, axis: Vec3, rate: float, acceleration: float, share: float, other_sign: bool
) -> None:
    """Of the position, and of a rotation about one axis, for either quaternion of an attitude."""
    norm, length = math.hypot(*first), math.hypot(*axis)
    w, x, y, z = (each / norm for each in first)
    unit = tuple(each / length for each in axis)

    def state(time_s: float, sign: float = 1.0) -> VehicleState:
        angle, spin = rate * time_s + 0.5 * acceleration * time_s**2, rate + acceleration * time_s
        a, b, c = (math.sin(0.5 * angle) * each for each in unit)
        attitude = product((w, x, y, z), (math.cos(0.5 * angle), a, b, c))
        return VehicleState(
            position=(1.0 + angle, -angle, 2.0),
            velocity=(spin, -spin, 0.0),
            attitude=tuple(sign * each for each in attitude),  # type: ignore[arg-type]
            angular_velocity=tuple(spin * each for each in unit),  # type: ignore[arg-type]
        )

    poses = Poses(T)
    for tick, sign in ((0, 1.0), (1, -1.0 if other_sign else 1.0)):
        seen_then = Observation(vehicle="me", time_ns=tick * T_NS, state=state(tick * T, sign), readings={})
        poses.add(seen_then)
    time_ns = round(share * T_NS)
    found, expected = present(poses.at(time_ns)), state(time_ns / 1e9)
    assert found.position == pytest.approx(expected.position, abs=1e-6)
    assert abs(sum(a * b for a, b in zip(found.attitude, expected.attitude, strict=True))) == pytest.approx(1.0, abs=1e-9)
    assert math.hypot(*found.attitude) == pytest.approx(1.0)


def test_poses_exist_between_two_ticks_and_not_before_after_or_in_gaps() -> None:
    poses = Poses(T)
    for tick in (2, 3, 8, 9):
        poses.add(seen(tick, (0.4 * tick, 0.0, 5.0)))
    for ticks in (2.0, 2.3, 3.0, 8.0, 8.5):
        assert present(poses.at(round(ticks * T_NS))).position == pytest.approx((0.4 * ticks, 0.0, 5.0))
    assert [poses.at(round(ticks * T_NS)) for ticks in (1.9, 5.0, 9.1)] == [None] * 3
    for tick in range(10, 300):
        poses.add(seen(tick, (0.4 * tick, 0.0, 5.0)))
    assert poses.at(8 * T_NS) is None  # too old
    assert poses.at(200 * T_NS) is not None


# --- pictures ---


@pytest.mark.parametrize("late", [0.0, 0.5, 1.0, 3.4])
def test_a_late_picture_is_placed_by_the_pose_at_its_exposure(watch: Watch, late: float) -> None:
    """At 4 m/s and 1 rad/s the present pose would be off by metres."""

    def pose(time_s: float) -> tuple[Vec3, Quaternion]:
        return (4.0 * time_s, -1.0, 20.0), quaternion_from_yaw(time_s)

    made = frame(np.random.default_rng(3), 20.0 + MOUNT[2])
    at = 8.0 - late  # ticks
    then = VehicleState(position=pose(at * T)[0], attitude=pose(at * T)[1])
    for tick in range(8):
        assert watch.look(seen(tick, *pose(tick * T))) is None
    shown = present(watch.look(seen(8, *pose(8 * T), camera=image_of(made, round(at * T_NS)))))
    (truth,), (sighting,) = made.seen.truths, shown.sightings
    place = present(nadir_of(image_of(made, 0), then).ground_point((truth.u, truth.v)))
    assert sighting.place == pytest.approx(place, abs=0.05)
    assert math.dist(sighting.centre_px, (truth.u, truth.v)) < 2.0
    assert math.remainder(sighting.angle - truth.angle, math.tau) == pytest.approx(0.0, abs=0.05)
    assert (sighting.target, shown.time_ns) == ("glyph", round(at * T_NS))
    assert 0.75 <= sighting.score <= 1.0
    assert sighting.side_px == pytest.approx(made.side_px, rel=0.05)


def test_each_picture_is_processed_once_with_one_result_a_tick(watch: Watch) -> None:
    picture = image_of(frame(np.random.default_rng(3), 20.0), 0)
    first = seen(0, (0.0, 0.0, 20.0), camera=picture)
    assert watch.look(first) is present(watch.look(first))
    assert watch.look(seen(1, (0.0, 0.0, 20.0), camera=picture)) is None
    assert watch.look(seen(2, (0.0, 0.0, 20.0))) is None
    assert watch.look(seen(3, (0.0, 0.0, 20.0), camera=image_of(frame(np.random.default_rng(3), 20.0), 3 * T_NS))) is not None


def test_a_picture_without_a_pose_is_ignored(watch: Watch) -> None:
    picture = image_of(frame(np.random.default_rng(3), 20.0), 5 * T_NS)
    assert watch.look(seen(0, (0.0, 0.0, 20.0))) is None
    assert watch.look(seen(9, (0.0, 0.0, 20.0), camera=picture)) is None


@pytest.mark.parametrize(
    ("tilt", "sees", "reliable"), [(0.1, True, True), (0.25, True, True), (0.45, None, False), (0.6, False, False)]
)
def test_detections_of_a_tilted_camera_are_placed_correctly(
    watch: Watch, tilt: float, sees: bool | None, reliable: bool
) -> None:
    for tick in range(8):
        rng = np.random.default_rng(tick)
        place = (float(320 + rng.uniform(-60, 60)), float(240 + rng.uniform(-40, 40)))
        level, about = frame(rng, 20.0, places=[place], distractors=False), float(rng.uniform(-3.0, 3.0))
        true = present(Nadir((0.0, 0.0, 20.0), (1.0, 0.0, 0.0, 0.0), FOCAL_PX, 640, 480).ground_point(place))
        a, b = math.cos(0.5 * tilt), math.sin(0.5 * tilt)
        attitude = a, b * math.sin(about), b * math.cos(about), 0.0
        (x, y, z), made = _camera_at((0.0, 0.0, 20.0), attitude), tilted(level, tilt, about)
        shown = present(watch.look(seen(tick, (x, y, z), attitude, camera=image_of(made, tick * T_NS))))
        assert (shown.looked is not None) == reliable
        if sees is not None:
            assert bool(shown.sightings) == sees
        assert all(each.place == pytest.approx(true, abs=0.1) for each in shown.sightings)


def _camera_at(position: Vec3, attitude: Quaternion) -> Vec3:
    """Position of a vehicle whose camera is at a position."""
    at = nadir_of(Image(pixels=np.zeros((2, 2, 3), np.uint8)), VehicleState(position=position, attitude=attitude)).position
    return tuple(2.0 * p - q for p, q in zip(position, at, strict=True))  # type: ignore[return-value]


# --- region that is searched ---


def test_only_the_set_region_of_the_ground_is_searched(watch: Watch) -> None:
    made = frame(np.random.default_rng(3), 20.0 + MOUNT[2], places=[(300.0, 200.0)], distractors=False)
    shown = present(watch.look(seen(0, (0.0, 0.0, 20.0), camera=image_of(made, 0))))
    assert shown.whole
    x, y = shown.nadir.ground_point((300.0, 200.0)) or (math.nan, math.nan)
    for tick, (aside, found) in enumerate([(0.0, 1), (1.9, 1), (2.2, 0)], start=1):
        watch.region = GroundDisc((x + aside, y), 2.0)
        part = present(watch.look(seen(tick, (0.0, 0.0, 20.0), camera=image_of(made, tick * T_NS))))
        assert (len(part.sightings), part.whole) == (found, False)
        corners = np.array(part.footprint)
        assert corners.min(axis=0) == pytest.approx((x + aside - 2.0, y - 2.0), abs=0.1)  # one or two pixels
        assert corners.max(axis=0) == pytest.approx((x + aside + 2.0, y + 2.0), abs=0.1)
    watch.region = GroundDisc((x + 90.0, y), 2.0)
    part = present(watch.look(seen(4, (0.0, 0.0, 20.0), camera=image_of(made, 4 * T_NS))))
    assert (part.sightings, part.looked, part.footprint) == ((), None, None)


def test_a_target_at_the_edge_does_not_count_as_missed(watch: Watch) -> None:
    """The region that counts as looked at ends half a side of a target from the edges of the picture."""
    made = frame(np.random.default_rng(3), 20.0 + MOUNT[2])
    shown = present(watch.look(seen(0, (5.0, 0.0, 20.0), camera=image_of(made, 0))))
    assert shown.looked == (21, 21, 619, 459)  # side: 400 * 2 / 19.95 px
    across, ahead = 598 * 19.95 / 400.0, 438 * 19.95 / 400.0
    corners = np.array(shown.footprint)
    assert np.ptp(corners, axis=0) == pytest.approx((ahead, across))
    assert corners.mean(axis=0) == pytest.approx((5.0, 0.0))


def test_too_high_for_recognition_no_region_counts_as_looked_at(watch: Watch) -> None:
    """At least 12 px: the size of a 2 m target at 400 px from 66.7 m."""
    image = Image(pixels=np.zeros((480, 640, 3), np.uint8), focal_px=400.0)
    for tick, (height, looked) in enumerate([(66.0, True), (67.0, False)]):
        made = msgspec.structs.replace(image, time_ns=tick * T_NS)
        shown = present(watch.look(seen(tick, (0.0, 0.0, height - MOUNT[2]), camera=made)))
        assert (shown.looked is not None) is looked


# --- refusals ---


def test_bad_cameras_are_refused(watch: Watch) -> None:
    with pytest.raises(ValueError, match=r"watching.camera = 'camera': me has no such sensor; its sensors: scan"):
        watch.start(info("me", sensors=("scan",)))
    scan = Scan(ranges=np.ones(3, np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)
    with pytest.raises(TypeError, match="gives a Scan, not pictures"):
        watch.look(seen(0, (0.0, 0.0, 5.0), camera=scan))


def test_bad_targets_are_refused_by_their_keys(folder: Path) -> None:
    good = Wanted(name="glyph", picture="glyph.png")
    with registry.looking_in(folder):
        for targets, key in (((good, good), "w.targets"), ((good, Wanted(name="x", picture="x.png")), "w.targets[1].picture")):
            with pytest.raises(ScenarioError) as raised:
                Watch(Watching(targets=targets), key="w")
            assert raised.value.key == key
