"""Messages of the control station to its pages, without a browser."""

import math
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from tests.support.cosim import view_pages
from tests.support.cosim.view_pages import (
    RECORDED,
    StationPage,
    moving_state,
    open_station,
    positions_at,
    scenery,
    states,
    station_state,
)
from tests.support.waiting import wait_for
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Mosaic, ProbabilityMap
from vcmvsp.cosim.view.messages import Craft, Floor, PageUpdate, Sensors, ShapePart
from vcmvsp.cosim.view.page.cameras import START, fitted, in_picture
from vcmvsp.cosim.view.page.drawing import FLOOR, FLOOR_DARK, LOST_RGB, TINY, linear, rotated, rssi_colors
from vcmvsp.cosim.view.page.floor import DARKNESS, shaded, squared, tall_of
from vcmvsp.cosim.view.page.ray_paths import LEGS
from vcmvsp.cosim.view.page.scene import MOST_COLORS, axis_m, by_color, crossed, solids_of
from vcmvsp.cosim.view.page.sensors import fan_of, painted, points_of
from vcmvsp.cosim.view.page.vehicles import fresh_links
from vcmvsp.cosim.view.scenery import scenery_of

pytestmark = pytest.mark.sockets

ANGLES = st.floats(-3.0, 3.0)
METRES = st.floats(-50.0, 50.0)


# --- the scene ---


def test_bodies_stand_where_the_vehicles_are() -> None:
    crafts = (
        Craft(name="a", kind="p2dx", size=(0.4, 0.3, 0.2), offset=(-0.1, 0.0, 0.1)),
        Craft(name="b", kind="p2dx", size=(1, 1, 1)),
    )
    with open_station(scenery(vehicles=crafts)) as station_page:
        station_page.station.show(PageUpdate(time_ns=0, states=states([(2.0, 3.0, 0.0)], [math.pi / 2], ("a",))))
        station_page.station.draw()
        bodies = station_page.node("/vehicles/ground")
    assert bodies.batched_positions[0] == pytest.approx((2.0, 2.9, 0.1), abs=1e-6)
    assert bodies.batched_scales[0] == pytest.approx((0.4, 0.3, 0.2))
    assert bodies.batched_scales[1] == pytest.approx((TINY,) * 3)  # position unknown


def test_a_vehicle_is_drawn_with_its_own_shape() -> None:
    corners = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]], np.float32)
    parts = ShapePart(triangles=corners, color=(0, 0, 255)), ShapePart(triangles=2 * corners, color=(9, 9, 9))
    scene = scenery(3)
    car, *others = scene.vehicles
    cart = msgspec.structs.replace(car, shape="cart.urdf")
    with open_station(msgspec.structs.replace(scene, vehicles=(cart, *others), shapes={"cart.urdf": parts})) as station_page:
        station_page.show(1.0)
        first, second = station_page.node("/vehicles/own0/0"), station_page.node("/vehicles/own0/1")
        for node, part in ((first, parts[0]), (second, parts[1])):
            assert node.vertices.tolist() == part.triangles.reshape(-1, 3).tolist()
            assert node.batched_positions[0] == pytest.approx(positions_at(scene, 1.0)[0])
            assert node.batched_scales.tolist() == [[1.0, 1.0, 1.0]]
        assert len(station_page.node("/vehicles/ground").batched_positions) == 2
        assert len(station_page.node("/vehicles/wheels").batched_positions) == 4


def test_flyers_and_cars_are_drawn_differently(live: StationPage) -> None:
    assert len(live.node("/vehicles/ground").batched_positions) == 2
    assert len(live.node("/vehicles/air").batched_positions) == 1
    down = live.node("/heights").points
    assert down[0, 0, 2] == pytest.approx(3.0)
    assert down[0, 1].tolist() == [*down[0, 0, :2].tolist(), 0.0]


def test_unchanged_values_are_not_sent_again(live: StationPage) -> None:
    live.show(5.0)
    live.show(5.0)
    assert live.told(live.station.draw) == []


def test_late_clients_get_no_more_messages_than_early_ones() -> None:
    with open_station(scenery(3, flying=1)) as station_page:
        station_page.use("ring (ring)")
        station_page.use("down (nadir_camera)")
        message_counts = []
        for step in range(121):
            color = (step, 0, 0)
            station_page.show(
                0.1 * step, scans={"v1/ring": view_pages.scan(1.0 + step)}, images={"v1/down": view_pages.picture(color)}
            )
            message_counts.append(len(station_page.server._websock_server._broadcast_buffer.message_from_id))
        assert message_counts[60] == message_counts[120]


def test_many_vehicles_take_hardly_more_messages_than_few() -> None:
    counts = []
    for count in (4, 100):
        with open_station(scenery(count, flying=count // 2)) as station_page:
            station_page.show(0.0)
            station_page.now_s += 0.01  # only the repeated messages
            station_page.station.show(moving_state(station_page.scene, 0.03))
            counts.append(len(station_page.told(station_page.station.draw)))
    assert counts[1] <= counts[0] + 16 - 4  # names, at most 16 at a time


@pytest.mark.parametrize("count", [0, 1])
def test_runs_of_one_vehicle_or_none_are_shown(count: int) -> None:
    with open_station(scenery(count)) as station_page:
        station_page.show(0.0)
        station_page.show(0.5)


def test_a_vehicle_is_chosen_by_a_click_at_its_body(live: StationPage) -> None:
    (entry,) = live.node("/vehicles/air")._impl.click_cb
    entry.callback(
        viser.SceneNodePointerEvent(
            client=None,  # type: ignore[arg-type]
            client_id=1,
            event="click",
            target=live.node("/vehicles/air"),
            ray_origin=(0, 0, 0),
            ray_direction=(0, 0, -1),
            screen_pos=(0.5, 0.5),
            instance_index=0,
            modifier=None,
        )
    )
    assert live.part("Vehicle").value == "v3"
    live.show(6.0)
    assert live.node("/chosen").position[:2] == pytest.approx(positions_at(live.scene, 6.0)[2, :2])
    live.use("Vehicle", "v1")


def test_obstacles_and_targets_move_to_their_positions(live: StationPage) -> None:
    live.show(7.0, obstacles={"crate": (1.0, 2.0, 0.3, 0.5)}, targets={"red": (5.0, 6.0)})
    assert live.node("/obstacles/crate").position == pytest.approx((1.0, 2.0, 0.3))
    assert live.node("/obstacles/crate").wxyz == pytest.approx(quaternion_from_yaw(0.5))
    assert live.node("/targets/red").position == pytest.approx((5.0, 6.0, 0.0))


@pytest.mark.parametrize(("size_m", "step_m"), [(3.0, 0.5), (40.0, 5.0), (220.0, 20.0), (1000.0, 200.0)])
def test_the_axes_have_a_round_length_that_is_a_share_of_the_floor(size_m: float, step_m: float) -> None:
    assert axis_m(size_m) == pytest.approx(step_m)


def test_the_axes_stand_in_the_corner_of_a_floor_that_grew() -> None:
    with open_station(scenery(1)) as page:
        page.show(0.0)
        before = page.node("/axes").position
        page.show(1.0, states=states([(300.0, -300.0, 0.0)], [0.0], ("v1",)))
        west, south = page.node("/axes").position[:2]
        assert before[1] > -10.0
        assert west <= before[0]
        assert south < -300.0
        assert page.node("/axes/east").position[0] == pytest.approx(50.0)


def test_a_shadow_lies_away_from_the_sun_and_has_a_soft_edge() -> None:
    """Wall 2 m high along the y axis, sun in the south-east: the shadow of its top is 0.8 m to the west."""
    corners = np.array([(0.0, y, z) for z in (0.0, 2.0) for y in (-3.0, 3.0)])
    wall = np.array([(0, 1, 3), (0, 3, 2)])
    floor = Floor(pixels=np.full((1000, 1000, 3), 200, np.uint8), center=(1.0, 0.0), size=(10.0, 10.0))
    picture = shaded(floor, corners, tall_of(corners, wall))

    def light(x: float, y: float) -> float:
        return float(picture[int((5.0 - y) * 100.0), int((x + 4.0) * 100.0), 0]) / 200.0

    assert light(-0.4, 0.7) == pytest.approx(1.0 - DARKNESS, abs=0.05)
    assert 1.0 - DARKNESS < light(-0.8, 0.0) < 1.0  # its edge
    assert light(-2.0, 0.0) == light(1.0, 0.0) == light(-0.4, -4.0) == 1.0
    assert not len(tall_of(0.001 * corners, wall))  # markings on the floor cast none


def test_the_floor_of_a_world_with_solids_is_a_picture_with_the_lines_of_the_grid() -> None:
    with open_station(scenery(1)) as station_page:
        assert station_page.node("/floor-picture").position[2] > station_page.node("/floor").position[2]
        station_page.use("Dark")
        assert station_page.node("/floor").plane_color == FLOOR_DARK
    floor = squared((-2.0, -1.0, 2.0, 1.0), FLOOR, 1.0)
    pixels = np.asarray(floor.pixels)
    columns, rows = ((pixels != FLOOR).any(axis=2).all(axis=axis).sum() for axis in (0, 1))
    assert floor.size == pytest.approx((4.0, 2.0))
    assert (columns, rows) == (4, 2)  # at -2, -1, 0, 1 and -1, 0 m: the last would lie at the edge
    vast = np.asarray(squared((-1e9, -1e9, 1e9, 1e9), FLOOR, 10.0).pixels)
    assert (vast == FLOOR).all()  # lines would cover it
    empty = scenery(1, vertices=np.zeros((0, 3), np.float32), triangles=np.zeros((0, 3), np.uint32))
    with open_station(msgspec.structs.replace(empty, colors=np.zeros((0, 3), np.uint8))) as station_page:
        assert station_page.server.scene.get_handle_by_name("/floor-picture") is None


def test_there_is_floor_under_every_vehicle_at_any_place() -> None:
    with open_station(scenery(1)) as station_page:
        for x, y in ((0.0, 0.0), (500.0, -20.0), (-3.0, 900.0), (510.0, 0.0)):
            station_page.show(1.0, states=states([(x, y, 0.0)], [0.0], ("v1",)))
            floor = station_page.node("/floor")
            assert abs(x - floor.position[0]) <= 0.5 * floor.width
            assert abs(y - floor.position[1]) <= 0.5 * floor.height


@given(st.integers(1, 400), st.integers(0, 2**32 - 1))
def test_every_triangle_has_a_colour_near_its_own_out_of_few(count: int, seed: int) -> None:
    colors = np.random.default_rng(seed).integers(0, 256, (count, 3), dtype=np.uint8)
    kinds, which = by_color(colors)
    assert len(kinds) <= MOST_COLORS
    assert which.shape == (count,)
    if len(np.unique(colors, axis=0)) <= MOST_COLORS:
        assert np.array_equal(kinds[which], colors)


def test_trails_are_bounded_and_begin_anew_where_time_goes_back() -> None:
    with open_station(scenery(2, may=RECORDED)) as station_page:
        for second in range(400):
            station_page.station.show(moving_state(station_page.scene, float(second)))
        station_page.show(400.0)
        ends = station_page.node("/trails").points.reshape(2, -1, 2, 3)
        assert ends[0, -1, 1] == pytest.approx(positions_at(station_page.scene, 400.0)[0], abs=1e-5)
        size = ends.size
        station_page.show(10.0)
        points = station_page.node("/trails").points
        assert points.size == size
        assert np.ptp(points.reshape(2, -1, 3), axis=1).max() == 0.0


# --- the radio ---


def test_a_link_is_an_arrow_from_the_sender_to_the_receiver_in_the_colour_of_its_outcome() -> None:
    with open_station(scenery(2)) as station_page:
        station_page.show(3.0)
        points, colors = station_page.node("/links").points, station_page.node("/links").colors
        here, there = positions_at(station_page.scene, 3.0)
        start, tip = points[0]
        along = (there - here) / np.linalg.norm(there - here)
        assert (start - here) @ along < 0.1 * np.linalg.norm(there - here)
        assert (there - tip) @ along < 0.1 * np.linalg.norm(there - here)
        assert points[1:3, 1] == pytest.approx(np.stack([tip, tip]))
        assert ((tip - points[1:3, 0]) @ along > 0.0).all()  # both barbs point ahead
        assert colors[0, 0].tolist() == linear(rssi_colors(np.array([-90.0])))[0].tolist()
        assert colors[3, 0].tolist() == linear(np.array(LOST_RGB, np.uint8)).tolist()
        station_page.show(4.5, links=())
        assert np.ptp(station_page.node("/links").points, axis=1).max() == 0.0


def test_the_paths_of_the_wave_to_another_vehicle_are_drawn_and_listed() -> None:
    """Over open ground: the straight line, and the reflection half-way between antennas of equal height."""
    radio = {"preset": "wifi-g-6", "path_loss": {"kind": "rays", "frequency_hz": 2.4e9}}
    cars = [{"name": name, "kind": "p2dx"} for name in ("v1", "v2")]
    site = scenery_of(*scenarios.load({"name": "open", "duration_s": 1.0, "radio": radio, "vehicle": cars})).site
    with open_station(scenery(2, site=site)) as station_page:
        station_page.use("Paths to", "v2")

        def drawn() -> bool:
            station_page.show(3.0)
            return bool(station_page.node("/paths").points.any())

        wait_for(drawn)
        here, there = positions_at(station_page.scene, 3.0) + np.array((0.0, 0.0, 0.5))
        points = station_page.node("/paths").points.reshape(-1, LEGS, 2, 3)
        middle = 0.5 * (here + there) * (1.0, 1.0, 0.0)
        assert points[0, 0] == pytest.approx(np.stack([here, there]), abs=1e-4)
        assert points[1, :2] == pytest.approx(np.stack([[here, middle], [middle, there]]), abs=1e-4)
        assert not points[2:].any()
        (text,) = [each.content for each in station_page.parts(viser.GuiHtmlHandle) if "reflection" in each.content]
        assert text.index("direct") < text.index("reflection") < text.index("2 paths")
        station_page.use("Paths to", "nobody")
        wait_for(lambda: not drawn())


def test_without_rays_there_are_no_paths_to_choose() -> None:
    with open_station(scenery(2)) as station_page:
        assert not station_page.has("Paths to")


def test_a_lost_frame_is_shown_for_a_second_from_its_first_update() -> None:
    with open_station(scenery(2)) as station_page:
        station_page.show(3.0)
        assert np.ptp(station_page.node("/links").points[3], axis=0).max() > 0.0
        station_page.show(3.9, links=())
        assert np.ptp(station_page.node("/links").points[3], axis=0).max() > 0.0


def test_the_slot_of_a_follower_is_marked_and_a_line_goes_to_its_leader() -> None:
    with open_station(scenery(3)) as station_page:
        places = [(0.0, 0.0, 0.0), (-3.0, 2.0, 0.0), (-9.0, 0.0, 0.0)]
        station_page.show(1.0, states=states(places, [math.pi / 2] * 3, ("v1", "v2", "v3")))
        assert station_page.node("/places/marks").batched_positions[1, :2] == pytest.approx(
            (-1.0, -1.5), abs=1e-5
        )  # slot (-1.5, 1)
        assert station_page.node("/places/leaders").points[1] == pytest.approx(np.array([places[1], places[0]]), abs=1e-5)
        assert np.ptp(station_page.node("/places/leaders").points[0]) == 0.0  # the first vehicle has no leader


def test_of_too_many_links_the_newest_are_drawn() -> None:
    scene = scenery(6)
    names = tuple(each.name for each in scene.vehicles)
    links = tuple(view_pages.link(names, sender, 2.0 - 0.1 * sender) for sender in range(6))
    known = station_state(scene, moving_state(scene, 2.0, links=links))
    assert set(fresh_links(known, 10)[0].tolist()) == {0, 1}
    assert len(fresh_links(known, 100)[0]) == 30
    assert all(2 in pair for pair in zip(*fresh_links(known, 100, of=2), strict=True))


def test_colours_of_links_end_like_the_legend() -> None:
    ends = rssi_colors(np.array([-200.0, -95.0, -40.0, 0.0]))
    assert ends[0].tolist() == ends[1].tolist() == [68, 1, 84]
    assert ends[2].tolist() == ends[3].tolist() == [112, 207, 87]


# --- readings ---


@given(yaw=ANGLES, x=METRES, y=METRES, range_m=st.floats(0.1, 8.0))
def test_beams_end_where_they_hit(yaw: float, x: float, y: float, range_m: float) -> None:
    points = points_of(view_pages.scan(range_m), np.array([x, y, 0.2]), np.array(quaternion_from_yaw(yaw)))
    assert len(points) == 3  # one beam has no return
    assert points[0] == pytest.approx((x + range_m * math.cos(yaw), y + range_m * math.sin(yaw), 0.2), abs=1e-4)
    assert np.hypot(*(points[:, :2] - (x, y)).T) == pytest.approx([range_m] * 3, abs=1e-3)


def test_the_free_space_of_a_scan_ends_at_the_return_or_at_the_maximum_range() -> None:
    vertices, faces = fan_of(view_pages.scan(2.0), np.array([5.0, 6.0, 0.2]), np.array(quaternion_from_yaw(0.7)))
    assert vertices[0] == pytest.approx((5.0, 6.0, 0.2))
    reach = np.linalg.norm(vertices[faces[:, 1:]] - vertices[0], axis=2)
    assert reach == pytest.approx(np.array([[2.0, 2.0], [2.0, 2.0], [8.0, 8.0], [2.0, 2.0]]), abs=1e-4)
    middle = vertices[faces[0, 1:]].mean(axis=0) - vertices[0]
    assert math.atan2(middle[1], middle[0]) == pytest.approx(0.7, abs=1e-4)


def test_only_open_pages_order_readings_of_the_chosen_vehicle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with open_station(scenery(3)) as station_page:
        station_page.use("ring (ring)")
        assert station_page.orders == []
        station_page.looked_at(monkeypatch)
        station_page.use("down (nadir_camera)")
        station_page.use("Vehicle", "v2")
        station_page.use("ring (ring)", False)
        station_page.use("down (nadir_camera)", False)
        assert station_page.orders == [
            Sensors(names=("v1/ring", "v1/down")),
            Sensors(names=("v2/ring", "v2/down")),
            Sensors(names=("v2/down",)),
            Sensors(names=()),
        ]


def test_scans_and_pictures_are_shown_while_selected() -> None:
    with open_station(scenery(2)) as station_page:
        scans, images = {"v1/ring": view_pages.scan()}, {"v1/down": view_pages.picture((200, 0, 0))}
        station_page.show(0.0, scans=scans, images=images)
        assert station_page.server.scene.get_handle_by_name("/scans/v1/ring") is None
        station_page.use("ring (ring)")
        station_page.use("down (nadir_camera)")
        station_page.show(1.0)
        assert station_page.node("/scans/v1/ring").visible
        assert station_page.node("/fans/v1/ring").visible
        (image,) = station_page.parts(viser.GuiImageHandle)
        assert image.visible
        first = image.image
        station_page.show(2.0, images={"v1/down": view_pages.picture((0, 200, 0))})
        assert not np.array_equal(first, image.image)
        pyramid = station_page.node("/cameras/v1/down")
        assert pyramid.visible
        assert np.array_equal(pyramid.image, image.image)
        station_page.use("Vehicle", "v2")
        station_page.show(3.0)
        assert not station_page.node("/scans/v1/ring").visible
        assert not station_page.node("/fans/v1/ring").visible
        assert not image.visible
        assert not pyramid.visible


@given(ANGLES, METRES)
def test_the_pyramid_of_a_camera_moves_with_its_vehicle(live: StationPage, yaw: float, x: float) -> None:
    """The camera of the scenery is 0.1 m ahead and looks down; the picture's upper edge is ahead."""
    live.use("Vehicle", "v1")
    live.part("down (nadir_camera)").value = True
    where = [(x, 2.0, 0.5), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
    moved = states(where, [yaw, 0.0, 0.0], ("v1", "v2", "v3"))
    live.show(1.0, states=moved, images={"v1/down": view_pages.picture((200, 0, 0))})
    pyramid = live.node("/cameras/v1/down")
    ahead = np.array((math.cos(yaw), math.sin(yaw), 0.0))
    assert pyramid.position == pytest.approx(np.array(where[0]) + 0.1 * ahead, abs=1e-4)  # smaller changes are not sent
    (axis, up) = (rotated(np.array([pyramid.wxyz]), np.array([each]))[0] for each in ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))
    assert axis == pytest.approx((0.0, 0.0, -1.0), abs=1e-4)
    assert up == pytest.approx(ahead, abs=1e-4)


def test_an_empty_map_is_white_and_a_sure_target_dark() -> None:
    chances = np.array([[0, 255]], np.uint8)
    pixels = painted(ProbabilityMap(left=0.0, bottom=0.0, cell_m=1.0, probability=chances, seen=chances > 0))
    assert pixels[0, 0, :3].tolist() == [255, 255, 255]
    assert pixels[0, 1, :3].tolist() == [0x5E, 0x2A, 0x84]


def test_unseen_parts_of_a_mosaic_are_transparent() -> None:
    pixels = painted(Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=np.array([[(0, 0, 0), (9, 9, 9)]], np.uint8)))
    assert pixels[0, :, 3].tolist() == [0, 255]


# --- geometry ---


@given(st.lists(st.tuples(METRES, METRES, st.floats(0.0, 20.0)), min_size=1), st.floats(0.4, 1.4), st.floats(0.4, 3.0))
def test_a_camera_that_is_fitted_has_every_vehicle_in_its_picture(
    places: list[tuple[float, float, float]], fov: float, aspect: float
) -> None:
    middle, distance = fitted(np.array(places), START, fov, aspect)
    offset = np.array(places) - (middle + distance * START)
    depth = -offset @ START
    right = np.cross((0.0, 0.0, 1.0), START)
    right /= np.linalg.norm(right)
    slope = math.tan(0.5 * fov)
    assert (depth > 0.0).all()
    assert (np.abs(offset @ right) <= aspect * slope * depth).all()
    assert (np.abs(offset @ np.cross(START, right)) <= slope * depth).all()
    camera: Any = SimpleNamespace(position=middle + distance * START, look_at=middle, fov=fov, aspect=aspect)
    assert in_picture(np.array(places), camera)
    assert not in_picture(middle + 1.2 * distance * START[None], camera)  # behind it


def test_a_line_crosses_the_wall_that_it_goes_through_and_no_other() -> None:
    scene = scenery(1)
    corners = np.asarray(scene.vertices, float)[np.asarray(scene.triangles)]
    through = crossed(corners, np.array((0.0, 9.0, 0.5)), np.array((0.0, 3.0, 0.5)))
    assert through.any()
    assert not crossed(corners, np.array((0.0, 9.0, 1.5)), np.array((0.0, 3.0, 1.5))).any()  # above it
    assert not crossed(corners, np.array((0.0, 9.0, 0.5)), np.array((0.0, 7.0, 0.5))).any()  # ends before it
    assert len(np.unique(solids_of(np.asarray(scene.triangles), len(corners) * 3))) == 1


@given(yaw=ANGLES, x=METRES, y=METRES)
def test_turning_vectors_is_a_rotation(yaw: float, x: float, y: float) -> None:
    turned = rotated(np.array([quaternion_from_yaw(yaw)]), np.array([(x, y, 1.0)]))[0]
    c, s = math.cos(yaw), math.sin(yaw)
    assert turned == pytest.approx((c * x - s * y, s * x + c * y, 1.0), abs=1e-9)
