"""Targets: positions, appearance from above, occlusion."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.physics.render.test_renderer import a_rotation, towards
from tests.support.physics.sensor_scenes import scene_of
from vcmvsp.agents.reconnaissance.recognition.detector import Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture as Wanted
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.registry import SHIPPED
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.physics.importers.files import File
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.render.world_picture import draw_world, extent, png
from vcmvsp.physics.world.floor import GroundTarget, PlacedTarget, placed
from vcmvsp.physics.world.solids import Box, Hull
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.recreation import RecreationCentre
from vcmvsp.physics.worlds.surroundings import Empty
from vcmvsp.physics.worlds.urban import Urban

pytestmark = pytest.mark.slow

NORTH_UP = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # straight down, upper picture edge to the north
NAMES = ("alpha", "bravo", "charlie")
PICTURES = {name: str(SHIPPED / "targets" / f"{name}.png") for name in NAMES}
RED = (255, 0, 0)
DISC = GroundTarget(color=RED, place=(0.0, 0.0))


def one(**keys: Any) -> PlacedTarget:
    (target,) = placed([GroundTarget(**keys)])
    return target


def of(*targets: GroundTarget, **more: Any) -> World:
    return Empty(targets=targets, **more).build()


def is_red(pixels: Array) -> Array:
    return (pixels[:, :, 0] > 200) & (pixels[:, :, 1] < 100)


# --- where they are -----------------------------------------------------------------------------------------------------------


def test_at_rest_a_target_is_always_at_its_place() -> None:
    target = one(place=(3.0, 4.0), yaw_rad=0.5)
    assert [target.place(t) for t in (0.0, 1e6)] == [(3.0, 4.0)] * 2
    assert target.yaw(7.0) == 0.5


def test_a_target_runs_along_its_way_at_its_speed() -> None:
    target = one(way=((0.0, 0.0), (3.0, 0.0), (3.0, 4.0)), speed=0.5)
    for time_s, place in ((0.0, (0, 0)), (4.0, (2, 0)), (6.0, (3, 0)), (10.0, (3, 2)), (14.0, (3, 4)), (99.0, (3, 4))):
        assert target.place(time_s) == pytest.approx(place)


def test_on_a_loop_it_goes_back_to_the_first_place_and_round_again() -> None:
    target = one(way=((0.0, 0.0), (3.0, 0.0), (3.0, 4.0)), speed=1.0, loop=True)  # legs of 3, 4 and 5 m
    for time_s, place in ((7.0, (3, 4)), (9.5, (1.5, 2)), (12.0, (0, 0)), (13.0, (1, 0)), (24.0 + 5.0, (3, 2))):
        assert target.place(time_s) == pytest.approx(place)


@given(
    way=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=6, unique=True),
    speed=st.floats(0.1, 5.0),
    loop=st.booleans(),
    time_s=st.floats(0.0, 300.0),
)
def test_it_never_exceeds_its_speed(way: Any, speed: float, loop: bool, time_s: float) -> None:
    target = one(way=tuple(way), speed=speed, loop=loop)
    assert math.dist(target.place(time_s), target.place(time_s + 0.5)) <= 0.5 * speed * (1.0 + 1e-9) + 1e-9


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"place": [0, 0], "way": [[0, 0], [1, 0]], "speed": 1}, "either a place or a way"),
        ({"way": [[0, 0]], "speed": 1}, "at least two places"),
        ({"way": [[0, 0], [0, 0]], "speed": 1}, "different from the one before"),
        ({"way": [[0, 0], [1, 0]]}, "needs both way and speed"),
        ({"place": [0, 0], "speed": 1}, "at rest has no way"),
        ({"place": [0, 0], "loop": True}, "or loop"),
        ({}, "needs a place or a way"),
        ({"place": [0, 0], "size": 0}, "> 0"),
        ({"place": [math.nan, 0]}, "finite"),
        ({"place": [0, 0], "picture": "nowhere.png"}, "no picture file nowhere.png"),
        ({"place": [0, 0], "pictur": "x"}, "did you mean 'picture'"),
    ],
)
def test_wrong_targets_are_refused(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        binding.call(Empty, {"targets": [keys]}).build()


def test_a_broken_picture_is_refused_before_a_run_begins(tmp_path: Path) -> None:
    whole = png(np.random.default_rng(1).integers(0, 256, (40, 40, 3), np.uint8))
    (tmp_path / "cut.png").write_bytes(whole[:200])
    picture = str(tmp_path / "cut.png")
    for keys in ({"targets": [{"place": [0, 0], "picture": picture}]}, {"ground": {"picture": picture}}):
        with pytest.raises(ScenarioError, match="is a damaged picture"):
            binding.call(Empty, keys).build()


def test_missing_names_are_generated_and_unique() -> None:
    world = of(DISC, GroundTarget(name="flag", place=(9.0, 0.0)), GroundTarget(place=(0.0, 9.0)))
    assert [each.name for each in world.targets] == ["target1", "flag", "target3"]
    with pytest.raises(ScenarioError, match="two targets are named 'target2'"):
        of(GroundTarget(name="target2", place=(0.0, 0.0)), DISC)


def test_every_kind_of_world_has_targets_and_a_file_too(tmp_path: Path) -> None:
    assert RecreationCentre(targets=(DISC,)).build().targets == of(DISC).targets
    (tmp_path / "pics").mkdir()
    cv2.imwrite(str(tmp_path / "pics" / "own.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "w.toml").write_text(
        "[[targets]]\npicture = 'pics/own.png'\nplace = [1, 2]\n[[targets]]\npicture = 'targets/alpha.png'\nplace = [5, 2]"
    )
    file = File(path=str(tmp_path / "w.toml"))
    assert [target.picture for target in file.build().targets] == [str(tmp_path / "pics" / "own.png"), PICTURES["alpha"]]
    assert [path.name for path in file.files()] == ["own.png", "alpha.png"]  # copied beside the recording
    (tmp_path / "pics" / "own.png").rename(tmp_path / "own.png")
    assert file.build().targets[0].picture == str(tmp_path / "own.png")


# --- how they look ------------------------------------------------------------------------------------------------------------


def pixels_of(eye: Array, rotation: Array, points: Array, focal_px: float, size: tuple[int, int]) -> Array:
    """Pixels (k, 2) of places (k, 3) in a pinhole camera; the centre of the first pixel is 0."""
    away = (points - eye) @ rotation
    return focal_px * away[:, :2] / away[:, 2:] + 0.5 * np.array(size) - 0.5


@pytest.mark.parametrize("yaw", [0.0, 0.5 * math.pi, 2.0])
def test_the_upper_edge_of_a_picture_is_north_before_it_is_turned(tmp_path: Path, yaw: float) -> None:
    quarters = np.zeros((64, 64, 3), np.uint8)
    quarters[:32, 32:] = (0, 0, 255)  # red, upper right
    cv2.imwrite(str(tmp_path / "quarters.png"), quarters)
    world = of(GroundTarget(picture=str(tmp_path / "quarters.png"), place=(5.0, 3.0), size=4.0, yaw_rad=yaw))
    eye = np.array([5.0, 3.0, 20.0])
    floor = np.array([World().ground.color], float)
    levels = render(world, View(eye, NORTH_UP, 201, 201, 400.0)).pixels @ np.linalg.pinv(np.vstack([[RED], floor]))
    red = levels[:, :, 0]  # red share of each pixel
    assert red.sum() == pytest.approx(40.0**2, rel=0.01)
    rows, columns = np.indices(red.shape) - 100
    c, s = math.cos(yaw), math.sin(yaw)
    east, north = c - s, s + c  # centre of the upper right quarter, m
    middle = (columns * red).sum() / red.sum(), -(rows * red).sum() / red.sum()
    assert middle == pytest.approx((20 * east, 20 * north), abs=0.1)


def test_detail_below_a_pixel_is_averaged(tmp_path: Path) -> None:
    board = np.indices((256, 256)).sum(axis=0) % 2 * 200
    cv2.imwrite(str(tmp_path / "board.png"), board.astype(np.uint8))
    world = of(GroundTarget(picture=str(tmp_path / "board.png"), place=(0.0, 0.0), size=4.0))
    for height in (10.0, 23.0, 40.0):
        pixels = render(world, View(np.array([0.1, 0.2, height]), NORTH_UP, 120, 120, 400.0)).pixels.astype(int)
        half = int(2.0 * 400.0 / height) - 14  # well inside the target
        assert np.abs(pixels[60 - half : 60 + half, 60 - half : 60 + half] - 100).max() <= 3


@pytest.mark.parametrize("seed", range(6))
def test_it_is_visible_exactly_where_nothing_hides_it(seed: int) -> None:
    """With and without the target, pictures differ on visible floor only."""
    rng = np.random.default_rng(seed)
    boxes = tuple(
        Box(center=(*rng.uniform(-6, 6, 2).tolist(), 1.5), size=(1.5, 1.5, 3.0), yaw_rad=float(rng.uniform(0, 3)))
        for _ in range(12)
    )
    large = GroundTarget(color=RED, place=(0.0, 0.0), size=10.0)
    eye = np.array([*rng.uniform(-8, 8, 2), rng.uniform(4, 12)])
    view = View(eye, towards(eye, np.zeros(3), float(rng.uniform(-1, 1))), 320, 240, 200.0)
    bare, painted = render(Empty(boxes=boxes).build(), view, depth=True), render(of(large, boxes=boxes), view, depth=True)
    assert bare.depth_m is not None
    np.testing.assert_array_equal(bare.depth_m, painted.depth_m)  # the target is flat
    open_floor = render(of(large), view).pixels
    is_floor = (bare.pixels == World().ground.color).all(axis=2)
    np.testing.assert_array_equal(painted.pixels[is_floor], open_floor[is_floor])
    np.testing.assert_array_equal(painted.pixels[~is_floor], bare.pixels[~is_floor])
    assert 0 < (is_red(painted.pixels)).sum() < is_red(open_floor).sum()  # partly hidden


def test_a_vehicle_hides_it() -> None:
    world = of(DISC)
    hull = Hull((3.0, 3.0, 0.2), (0.0, 0.0, 0.1))
    view = View(np.array([0.0, 0.0, 20.0]), NORTH_UP, 160, 120, 100.0)
    assert is_red(render(world, view).pixels).any()
    assert not is_red(render(world, view, scene=scene_of((0.0, 0.0, 1.0), world=world, hull=hull)).pixels).any()


@pytest.mark.parametrize("seed", range(30))
def test_from_anywhere_it_is_not_in_the_sky_nor_off_its_place(seed: int) -> None:
    """Including targets partly or wholly behind the camera."""
    rng = np.random.default_rng(seed)
    world = of(GroundTarget(color=RED, place=(0.0, 0.0), size=20.0))
    eye = np.array([*rng.uniform(-12, 12, 2), rng.uniform(0.3, 4)])
    view = View(eye, a_rotation(rng), 80, 60, 50.0)
    columns, rows = np.meshgrid(view.columns(), view.rows())
    rays = np.stack([columns, rows, np.ones(rows.shape)], axis=-1) @ view.rotation.T
    down = rays[:, :, 2] < -1e-3
    place = eye[:2] + (eye[2] / np.where(down, -rays[:, :, 2], 1.0))[:, :, None] * rays[:, :, :2]
    away = np.where(down, np.hypot(place[:, :, 0], place[:, :, 1]), np.inf)
    red = is_red(render(world, view).pixels)
    assert red[down & (away < 9.5)].all()
    assert not red[away > 10.5].any()


def test_it_is_at_its_place_at_the_picture_time() -> None:
    moving = GroundTarget(color=RED, way=((-5.0, 0.0), (5.0, 0.0)), speed=1.0)
    world = of(moving)
    view = View(np.array([0.0, 0.0, 20.0]), NORTH_UP, 201, 101, 200.0)
    for time_s in (0.0, 2.5, 10.0):
        for pixels in (
            render(world, view, time_s=time_s).pixels,
            render(world, view, scene=scene_of((99.0, 0.0, 0.0), t=time_s, world=world)).pixels,
        ):
            _, columns = np.nonzero(is_red(pixels))
            assert columns.mean() == pytest.approx(100 + 10 * (time_s - 5.0), abs=0.2)


def test_drawings_of_a_world_show_it_and_its_path() -> None:
    world = of(GroundTarget(color=RED, way=((-30.0, 0.0), (30.0, 0.0)), speed=2.0, size=6.0))
    low, high = extent(world)
    assert low[0] <= -33.0
    assert high[0] >= 33.0
    early, late = (draw_world(world, time_s=time_s) for time_s in (5.0, 25.0))
    for picture in range(2):
        columns = [np.nonzero(is_red(drawing[picture]))[1].mean() for drawing in (early, late)]
        assert columns[1] - columns[0] > 300


# --- the pictures that come with the scenarios --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def town() -> World:
    listed = tuple(GroundTarget(name=name, picture=PICTURES[name]) for name in NAMES)
    return Urban(size=(102.0, 102.0), height_max=20.0, targets=listed, seed=5).build()


def test_shipped_pictures_differ_from_each_other_and_from_roofs(town: World) -> None:
    detector = Detector([Wanted.load(name, PICTURES[name], 2.0) for name in NAMES])
    rng = np.random.default_rng(2)
    for number in range(15):
        target, height = town.targets[number % 3], (22.0, 30.0)[number % 2]
        eye = np.array([*(np.array(target.place(0.0)) + rng.uniform(-5, 5, 2)), height])
        turn = float(rng.uniform(-3, 3))
        c, s = math.cos(turn), math.sin(turn)
        view = View(eye, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ NORTH_UP, 640, 480, 400.0)
        places = np.array([(*each.place(0.0), 0.0) for each in town.targets])
        visible = dict(zip(NAMES, pixels_of(eye, view.rotation, places, 400.0, (640, 480)), strict=True))
        found = {each.target: each for each in detector.detect(render(town, view).pixels, height, 400.0)}
        assert target.name in found
        for name, detection in found.items():
            assert math.dist(detection.centre_px, visible[name]) < 0.05 * 800.0 / height
        assert abs((found[target.name].angle + turn + math.pi) % math.tau - math.pi) < math.radians(1.5)


@pytest.mark.parametrize("name", NAMES)
def test_a_mirrored_shipped_picture_differs(name: str) -> None:
    picture = Wanted.load(name, PICTURES[name], 2.0).picture
    detector = Detector([Wanted(name, picture, 2.0), Wanted("mirrored", np.ascontiguousarray(picture[:, ::-1]), 2.0)])
    floor = of(GroundTarget(picture=PICTURES[name], place=(2.0, 1.0), yaw_rad=0.8))
    pixels = render(floor, View(np.array([0.0, 0.0, 15.0]), NORTH_UP, 640, 480, 400.0)).pixels
    assert [each.target for each in detector.detect(pixels, 15.0, 400.0)] == [name]
