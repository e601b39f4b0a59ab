"""What the control station tells its pages, and what it orders: without a browser."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from cosim.clock import SECOND_NS
from cosim.frames import quaternion_from_yaw
from cosim.types import Follows, Mosaic, Presence, ProbabilityMap, RealStatus, States
from cosim.view.shown import Change, Craft, End, Go, Halt, Line, Move, Order, Outage, Pace, Scenery, Seek, Sensors, Shown
from cosim.view.station_charts import POINTS, History, round_above
from cosim.view.station_known import Known
from cosim.view.station_links import fresh_links
from cosim.view.station_look import LOST_RGB, TINY, linear, rotated, rssi_colors
from cosim.view.station_panel import log_page, run_page, vehicle_page
from cosim.view.station_places import places_of
from cosim.view.station_readings import painted, points_of
from cosim.view.station_scene import MOST_COLORS, by_color
from tests.cosim import viewing
from tests.cosim.viewing import LIVE, RECORDED, Looking, looking, scenery, shown

ANGLES = st.floats(-3.0, 3.0)
Notes = dict[str, dict[str, float | str | bool]]
METRES = st.floats(-50.0, 50.0)


@pytest.fixture(scope="module")
def live() -> Iterator[Looking]:
    """A station of a live run of two robots and a quadrotor."""
    with looking(scenery(3, flying=1)) as looked:
        looked.show(0.0)
        yield looked


def known_of(scene: Scenery, *messages: Shown) -> Known:
    known = Known(scene)
    for message in messages:
        known.take(message)
    return known


def states(positions: list[tuple[float, float, float]], yaws: list[float], names: tuple[str, ...]) -> States:
    zero = np.zeros((len(names), 3))
    attitude = np.array([quaternion_from_yaw(yaw) for yaw in yaws])
    return States(names=names, position=np.array(positions), velocity=zero, attitude=attitude, angular_velocity=zero)


# --- what is known ---


def test_what_is_left_out_is_as_it_was() -> None:
    scene = scenery(3)
    known = known_of(scene, shown(scene, 1.0), Shown(time_ns=2 * SECOND_NS))
    assert np.array_equal(known.position, shown(scene, 1.0).states.position)  # type: ignore[union-attr]
    assert known.places.keys() == {"v2", "v3"}
    assert known.sent is not None
    assert known.time_ns == 2 * SECOND_NS


def test_of_each_key_the_newest_counts() -> None:
    scene = scenery(2)
    old: Notes = {"v1": {"mode": "old"}, "v2": {"mode": "old"}}
    new: Notes = {"v2": {"mode": "new"}}
    known = known_of(scene, Shown(time_ns=0, notes=old), Shown(time_ns=1, notes=new))
    assert known.notes == {"v1": {"mode": "old"}, "v2": {"mode": "new"}}


def test_where_time_goes_back_only_what_is_shown_then_counts() -> None:
    scene = scenery(3)
    lines = tuple(Line(time_ns=second * SECOND_NS, level="info", text=f"line {second}") for second in range(5))
    late = Shown(time_ns=4 * SECOND_NS, presence={"v1": Presence(state="lost", since_ns=3 * SECOND_NS)}, lines=lines)
    known = known_of(scene, late, Shown(time_ns=2 * SECOND_NS, lines=lines[2:3]))
    assert known.presence == {}
    assert [line.text for line in known.lines] == ["line 0", "line 1", "line 2"]
    assert known.times_back == 1


def test_vehicles_are_found_by_name_in_any_order_and_strangers_left_out() -> None:
    scene = scenery(3)
    told = states([(3.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.0, 0.0, 0.0)], [0.0] * 3, ("v3", "stranger", "v1"))
    known = known_of(scene, Shown(time_ns=0, states=told))
    assert known.position[[0, 2], 0].tolist() == [1.0, 3.0]
    assert np.isnan(known.position[1]).all()


# --- formation ---


@given(yaw=ANGLES, x=METRES, y=METRES, ahead=METRES, left=METRES, own=ANGLES, off=METRES, handle=st.floats(0.0, 1.0))
def test_who_is_in_place_and_turned_as_its_leader_has_no_error(
    yaw: float, x: float, y: float, ahead: float, left: float, own: float, off: float, handle: float
) -> None:
    scene = scenery(2)
    c, s = math.cos(yaw), math.sin(yaw)
    place = (x + c * ahead - s * left, y + s * ahead + c * left, 0.5)
    follows = {"v2": Follows(leader="v1", slot=(ahead, left), handle_m=handle)}
    there = states([(x, y, 0.0), place], [yaw, yaw], ("v1", "v2"))
    exact = places_of(known_of(scene, Shown(time_ns=0, states=there, places=follows)))
    assert exact.place[0] == pytest.approx(place, abs=1e-9)
    assert exact.error_m[0] == pytest.approx(0.0, abs=1e-9)
    away = states([(x, y, 0.0), (place[0] + off, place[1], place[2])], [yaw, own], ("v1", "v2"))
    places = places_of(known_of(scene, Shown(time_ns=0, states=away, places=follows)))
    error = places.error_m[0]
    assert math.dist(places.place[0], (place[0] + off, *place[1:])) == pytest.approx(
        error, abs=1e-9
    )  # what is seen is the error
    handles = handle * math.hypot(math.cos(own) - c, math.sin(own) - s)
    assert abs(off) - handles - 1e-9 <= error <= abs(off) + handles + 1e-9


def test_who_follows_nobody_any_more_has_no_place() -> None:
    scene = scenery(3)
    follows = {"v2": Follows(leader=None), "v3": Follows(leader="v1")}
    assert places_of(known_of(scene, shown(scene, 0.0, places=follows))).row.tolist() == [2]


# --- the scene ---


def test_bodies_stand_where_the_vehicles_are() -> None:
    crafts = (
        Craft(name="a", kind="p2dx", size=(0.4, 0.3, 0.2), offset=(-0.1, 0.0, 0.1)),
        Craft(name="b", kind="p2dx", size=(1, 1, 1)),
    )
    with looking(scenery(vehicles=crafts)) as looked:
        looked.station.show(Shown(time_ns=0, states=states([(2.0, 3.0, 0.0)], [math.pi / 2], ("a",))))
        looked.station.draw()
        bodies = looked.node("/vehicles/ground")
    assert bodies.batched_positions[0] == pytest.approx((2.0, 2.9, 0.1), abs=1e-6)
    assert bodies.batched_scales[0] == pytest.approx((0.4, 0.3, 0.2))
    assert bodies.batched_scales[1] == pytest.approx((TINY,) * 3)  # nobody knows where it is


def test_what_flies_is_drawn_otherwise_than_what_drives(live: Looking) -> None:
    assert len(live.node("/vehicles/ground").batched_positions) == 2
    assert len(live.node("/vehicles/air").batched_positions) == 1
    down = live.node("/heights").points
    assert down[0, 0, 2] == pytest.approx(3.0)
    assert down[0, 1].tolist() == [*down[0, 0, :2].tolist(), 0.0]


def test_what_has_not_changed_is_not_told_again(live: Looking) -> None:
    live.show(5.0)
    live.show(5.0)
    assert live.told(live.station.draw) == []


def test_who_comes_late_in_a_long_run_is_told_no_more_than_who_comes_early() -> None:
    with looking(scenery(3, flying=1)) as looked:
        looked.use("ring (ring)")
        looked.use("down (nadir_camera)")
        kept = []
        for step in range(121):
            color = (step, 0, 0)
            looked.show(0.1 * step, scans={"v1/ring": viewing.scan(1.0 + step)}, images={"v1/down": viewing.picture(color)})
            kept.append(len(looked.server._websock_server._broadcast_buffer.message_from_id))
        assert kept[60] == kept[120]


def test_many_vehicles_take_hardly_more_messages_than_few() -> None:
    counts = []
    for count in (4, 100):
        with looking(scenery(count, flying=count // 2)) as looked:
            looked.show(0.0)
            looked.now_s += 0.01  # only what is told each time
            looked.station.show(shown(looked.scene, 0.03))
            counts.append(len(looked.told(looked.station.draw)))
    assert counts[1] <= counts[0] + 16 - 4  # names, 16 at most at a time


@pytest.mark.parametrize("count", [0, 1])
def test_runs_of_one_vehicle_or_none_are_shown(count: int) -> None:
    with looking(scenery(count)) as looked:
        looked.show(0.0)
        looked.show(0.5)


def test_a_vehicle_is_chosen_by_a_click_at_its_body(live: Looking) -> None:
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
    assert live.node("/chosen").position[:2] == pytest.approx(shown(live.scene, 6.0).states.position[2, :2])  # type: ignore[union-attr]
    live.use("Vehicle", "v1")


def test_obstacles_and_targets_go_where_they_are_said_to_be(live: Looking) -> None:
    live.show(7.0, obstacles={"crate": (1.0, 2.0, 0.3, 0.5)}, targets={"red": (5.0, 6.0)})
    assert live.node("/obstacles/crate").position == pytest.approx((1.0, 2.0, 0.3))
    assert live.node("/obstacles/crate").wxyz == pytest.approx(quaternion_from_yaw(0.5))
    assert live.node("/targets/red").position == pytest.approx((5.0, 6.0, 0.0))


def test_there_is_floor_under_every_vehicle_wherever_it_goes() -> None:
    with looking(scenery(1)) as looked:
        for x, y in ((0.0, 0.0), (500.0, -20.0), (-3.0, 900.0), (510.0, 0.0)):
            looked.show(1.0, states=states([(x, y, 0.0)], [0.0], ("v1",)))
            floor = looked.node("/floor")
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
    with looking(scenery(2, may=RECORDED)) as looked:
        for second in range(400):
            looked.station.show(shown(looked.scene, float(second)))
        looked.show(400.0)
        ends = looked.node("/trails").points.reshape(2, -1, 2, 3)
        assert ends[0, -1, 1] == pytest.approx(shown(looked.scene, 400.0).states.position[0], abs=1e-5)  # type: ignore[union-attr]
        size = ends.size
        looked.show(10.0)
        points = looked.node("/trails").points
        assert points.size == size
        assert np.ptp(points.reshape(2, -1, 3), axis=1).max() == 0.0


# --- the radio ---


def test_links_of_the_last_second_are_drawn_half_way_in_the_colour_of_their_power() -> None:
    with looking(scenery(2)) as looked:
        looked.show(3.0)
        points, colors = looked.node("/links").points, looked.node("/links").colors
        tops = [(0.0, 0.0, each.offset[2] + 0.5 * each.size[2]) for each in looked.scene.vehicles]
        here, there = shown(looked.scene, 3.0).states.position + np.array(tops)  # type: ignore[union-attr]
        assert points[0] == pytest.approx(np.stack([here, 0.5 * (here + there)]), abs=1e-5)
        assert colors[0, 0].tolist() == linear(rssi_colors(np.array([-90.0])))[0].tolist()
        assert colors[1, 0].tolist() == linear(np.array(LOST_RGB, np.uint8)).tolist()
        looked.show(4.5, links=())
        assert np.ptp(looked.node("/links").points, axis=1).max() == 0.0


def test_a_lost_frame_blinks() -> None:
    with looking(scenery(2)) as looked:
        looked.show(3.0)
        lengths = []
        for quarter in range(4):
            looked.now_s = 10.0 + 0.25 * quarter
            looked.station.draw()
            lengths.append(float(np.ptp(looked.node("/links").points[1], axis=0).max()))
    assert lengths[0] == lengths[2] > 0.0
    assert lengths[1] == lengths[3] == 0.0


def test_of_too_many_links_the_newest_are_drawn() -> None:
    scene = scenery(6)
    names = tuple(each.name for each in scene.vehicles)
    links = tuple(viewing.link(names, sender, 2.0 - 0.1 * sender) for sender in range(6))
    known = known_of(scene, shown(scene, 2.0, links=links))
    assert set(fresh_links(known, 10)[0].tolist()) == {0, 1}
    assert len(fresh_links(known, 100)[0]) == 30
    assert all(2 in pair for pair in zip(*fresh_links(known, 100, of=2), strict=True))


def test_colours_of_links_end_where_the_legend_says() -> None:
    ends = rssi_colors(np.array([-200.0, -95.0, -40.0, 0.0]))
    assert ends[0].tolist() == ends[1].tolist() == [68, 1, 84]
    assert ends[2].tolist() == ends[3].tolist() == [112, 207, 87]


# --- readings ---


@given(yaw=ANGLES, x=METRES, y=METRES, range_m=st.floats(0.1, 8.0))
def test_beams_end_where_they_hit(yaw: float, x: float, y: float, range_m: float) -> None:
    points = points_of(viewing.scan(range_m), np.array([x, y, 0.2]), np.array(quaternion_from_yaw(yaw)))
    assert len(points) == 3  # one sees nothing
    assert points[0] == pytest.approx((x + range_m * math.cos(yaw), y + range_m * math.sin(yaw), 0.2), abs=1e-4)
    assert np.hypot(*(points[:, :2] - (x, y)).T) == pytest.approx([range_m] * 3, abs=1e-3)


def test_readings_are_ordered_of_the_chosen_vehicle_alone_and_only_while_somebody_looks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with looking(scenery(3)) as looked:
        looked.use("ring (ring)")
        assert looked.orders == []
        looked.looked_at(monkeypatch)
        looked.use("down (nadir_camera)")
        looked.use("Vehicle", "v2")
        looked.use("ring (ring)", False)
        looked.use("down (nadir_camera)", False)
        assert looked.orders == [
            Sensors(names=("v1/ring", "v1/down")),
            Sensors(names=("v2/ring", "v2/down")),
            Sensors(names=("v2/down",)),
            Sensors(names=()),
        ]


def test_scans_and_pictures_are_shown_while_they_are_wanted() -> None:
    with looking(scenery(2)) as looked:
        scans, images = {"v1/ring": viewing.scan()}, {"v1/down": viewing.picture((200, 0, 0))}
        looked.show(0.0, scans=scans, images=images)
        assert looked.server.scene.get_handle_by_name("/scans/v1/ring") is None
        looked.use("ring (ring)")
        looked.use("down (nadir_camera)")
        looked.show(1.0)
        assert looked.node("/scans/v1/ring").visible
        (image,) = looked.parts(viser.GuiImageHandle)
        assert image.visible
        first = image.image
        looked.show(2.0, images={"v1/down": viewing.picture((0, 200, 0))})
        assert not np.array_equal(first, image.image)
        looked.use("Vehicle", "v2")
        looked.show(3.0)
        assert not looked.node("/scans/v1/ring").visible
        assert not image.visible


def test_an_empty_map_is_white_and_a_sure_target_dark() -> None:
    chances = np.array([[0, 255]], np.uint8)
    pixels = painted(ProbabilityMap(left=0.0, bottom=0.0, cell_m=1.0, probability=chances, seen=chances > 0))
    assert pixels[0, 0, :3].tolist() == [255, 255, 255]
    assert pixels[0, 1, :3].tolist() == [0x5E, 0x2A, 0x84]


def test_what_was_never_seen_of_a_mosaic_is_left_out() -> None:
    pixels = painted(Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=np.array([[(0, 0, 0), (9, 9, 9)]], np.uint8)))
    assert pixels[0, :, 3].tolist() == [0, 255]


# --- words ---


def test_what_others_say_is_text_and_no_part_of_the_page() -> None:
    bad = "<script>alert(1)</script>\x1b[31m"
    crafts = (Craft(name="v1", kind=bad, size=(1, 1, 1), agent=bad),)
    scene = scenery(vehicles=crafts, scenario=bad)
    known = known_of(
        scene,
        Shown(
            time_ns=0,
            notes={"v1": {"mode": bad, bad: bad}},
            presence={"v1": Presence(state="lost", since_ns=0, why=bad)},
            real={"v1": RealStatus(link=1, age_s=0.1, causes=(bad,))},
            lines=(Line(time_ns=0, level=bad, text=bad),),
            pace=Pace(over=bad),
        ),
    )
    for page in (vehicle_page(known, 0), run_page(known), log_page(known)):
        assert "<script" not in page
        assert "\x1b" not in page
        assert "alert(1)" in page


def test_the_chosen_vehicle_is_described_in_full() -> None:
    scene = scenery(3)
    known = known_of(
        scene,
        shown(
            scene,
            2.0,
            notes={"v2": {"mode": "avoid", "gap": 1.25}},
            real={"v2": RealStatus(link=1, age_s=0.1, battery_v=11.9, late_s=0.004)},
            presence={"v2": Presence(state="back", since_ns=SECOND_NS)},
            heard_ns={"v2": SECOND_NS},
            halted=("v2",),
        ),
    )
    page = vehicle_page(known, 1)
    for words in (
        "v2",
        "p2dx",
        "follow, every 0.1 s",
        "avoid",
        "1.25",
        "0.60 m/s",
        "11.9 V",
        "back since 1.00 s",
        "1.00 s ago",
    ):
        assert words in page
    for words in ("by the operator", "4 ms", "to 21/21 (100 %), from 21/21 (100 %)", "to 21/21 (100 %), from 10/21 (48 %)"):
        assert words in page


def test_the_run_says_when_and_how_fast_it_is() -> None:
    scene = scenery(1)
    pace = Pace(speed=2.0, achieved=1.5)
    page = run_page(known_of(scene, shown(scene, 1.5, pace=pace)))
    assert "<b>1.50 s</b> of 60 s" in page
    assert "running at 2x, reaches 1.5x" in page
    assert "over: Ctrl-C" in run_page(known_of(scene, shown(scene, 1.5, pace=Pace(over="Ctrl-C"))))


# --- curves ---


def test_delivery_is_that_of_the_last_five_seconds() -> None:
    scene = scenery(2)
    history = History(scene)
    known = Known(scene)
    for second in range(21):  # all is received in the first ten seconds, nothing in the next ten
        sent, received = np.full((2, 2), 10 * second), np.full((2, 2), 10 * min(second, 10))
        known.take(Shown(time_ns=second * SECOND_NS, sent=sent, received=received))
        history.sample(known)
    delivery = np.array(history.numbers[2])[:, 0]
    assert delivery[[5, 10]].tolist() == [100.0, 100.0]
    assert delivery[[12, 20]].tolist() == [60.0, 0.0]


def test_curves_are_bounded_and_begin_anew_where_time_goes_back() -> None:
    scene = scenery(2)
    history, known = History(scene), Known(scene)
    for second in range(2 * POINTS):
        known.take(shown(scene, float(second)))
        assert history.sample(known)
    assert len(history.time_s) == len(history.numbers[0]) == POINTS
    assert not history.sample(known)  # nothing new
    known.take(shown(scene, 3.0))
    assert history.sample(known)
    assert list(history.time_s) == [3.0]


def test_charts_show_the_first_vehicles_and_the_chosen_one_and_none_of_what_nobody_knows() -> None:
    with looking(scenery(9)) as looked:
        for second in range(3):
            looked.show(float(second), places={}, sent=None)
        (speed,) = looked.parts(viser.GuiUplotHandle)
        assert speed.title == "Speed [m/s]"
        assert [each["label"] for each in speed.series[1:]] == [f"v{index}" for index in range(1, 8)]
        assert speed.data[0].tolist() == [0.0, 1.0, 2.0]
        assert speed.data[1] == pytest.approx([0.3 * 2.25] * 3)
        looked.use("Vehicle", "v9")
        looked.show(3.0, sent=None)
        speed, error = looked.parts(viser.GuiUplotHandle)
        assert [each["label"] for each in speed.series[1:]][-1] == "v9"
        assert error.title == "Formation error [m]"


@given(st.floats(0.011, 1e6))
def test_axes_end_little_above_what_they_show(number: float) -> None:
    top = round_above(number)
    assert number * (1.0 - 1e-6) <= top <= 2.5 * number * (1.0 + 1e-6)
    assert round_above(top) == top


# --- orders ---

LABELS = {
    "pace": "Pause",
    "halt": "STOP ALL",
    "outage": "Inject outage",
    "move": "Move obstacle",
    "set": "Set",
    "end": "End the run",
    "seek": "Time [s]",
    "sensors": "ring (ring)",
}


@pytest.mark.parametrize("may", [(), ("sensors",), ("pace", "seek"), ("halt", "outage"), LIVE])
def test_only_what_is_obeyed_can_be_ordered(may: tuple[str, ...]) -> None:
    with looking(scenery(2, may=may, keys={"radio.loss.probability": 0.2})) as looked:
        assert {tag for tag, label in LABELS.items() if looked.has(label)} == set(may)


@pytest.mark.parametrize(
    ("acts", "order"),
    [
        ([("STOP ALL", True)], Halt(halted=True)),
        ([("Let all go", True)], Halt(halted=False)),
        ([("Vehicle", "v2"), ("Stop this vehicle", True)], Halt(vehicles=("v2",), halted=True)),
        ([("Let it go", True)], Halt(vehicles=("v1",), halted=False)),
        ([("Pause", True)], Go(paused=True, speed=1.0)),
        ([("Go on", True)], Go(paused=False, speed=1.0)),
        ([("Step 0.1 s", True)], Go(paused=True, speed=1.0, step_ns=100_000_000)),
        ([("Speed", "0.2x")], Go(paused=False, speed=0.2)),
        ([("Speed", "as fast as it can")], Go(paused=False, speed=None)),
        ([("Inject outage", True)], Outage(vehicles=(), for_s=5.0)),
        (
            [("Frames from and to", "v3"), ("are lost for [s]", 2.5), ("Inject outage", True)],
            Outage(vehicles=("v3",), for_s=2.5),
        ),
        ([("x [m]", 1.0), ("y [m]", -2.0), ("Move obstacle", True)], Move(obstacle="crate", position=(1.0, -2.0), yaw=0.2)),
        ([("New value", 0.5), ("Set", True)], Change(key="radio.loss.probability", value=0.5)),
    ],
)
def test_controls_give_their_orders(live: Looking, acts: list[tuple[str, object]], order: Order) -> None:
    before = {label: live.part(label).value for label, _ in acts}
    live.orders.clear()
    live.show(8.0)  # says that the pace is 1x
    for label, value in acts:
        live.use(label, value)
    assert live.orders == [order]
    for label, value in before.items():
        live.part(label)._impl.value = value
    live.use("Vehicle", "v1")


def test_an_obstacle_that_was_dragged_is_ordered_where_it_was_let_go(live: Looking) -> None:
    live.orders.clear()
    live.use("Drag")
    gizmo = live.node("/gizmo")
    assert gizmo.visible
    gizmo.position, gizmo.wxyz = (2.5, 3.5, 0.3), quaternion_from_yaw(-0.4)
    for phase in ("start", "update", "end"):
        for callback in gizmo._impl_aux.update_cb:
            callback(viser.TransformControlsEvent(client=None, client_id=1, target=gizmo, phase=phase))
    assert live.orders == [Move(obstacle="crate", position=(2.5, 3.5), yaw=-0.4)]
    live.use("Drag", False)
    assert not gizmo.visible


def test_what_no_list_offers_and_no_number_is_orders_nothing_of_the_kind(live: Looking) -> None:
    live.orders.clear()
    live.use("Vehicle", "stranger")
    live.use("Obstacle", "stranger")
    live.use("Links", "stranger")
    live.use("On the floor", "stranger")
    live.show(9.0)
    for number in (math.nan, math.inf):
        live.use("are lost for [s]", number)
        live.use("Inject outage")
        live.use("x [m]", number)
        live.use("Move obstacle")
    assert live.orders == []
    live.use("Stop this vehicle")
    assert live.orders == [Halt(vehicles=("v1",), halted=True)]
    for label, value in (("Vehicle", "v1"), ("Obstacle", "crate"), ("Links", "all"), ("are lost for [s]", 5.0), ("x [m]", 0.0)):
        live.use(label, value)


def test_a_run_is_ended_only_when_it_was_said_twice() -> None:
    with looking(scenery(1)) as looked:
        assert not looked.part("Yes, end it now").visible
        looked.use("End the run")
        looked.use("No, let it go on")
        assert not looked.part("Yes, end it now").visible
        looked.use("End the run")
        assert looked.orders == []
        looked.use("Yes, end it now")
        assert looked.orders == [End()]


def test_a_recording_is_sought_by_hand_and_plays_by_itself() -> None:
    with looking(scenery(2, may=RECORDED)) as looked:
        looked.show(5.0)
        assert looked.part("Time [s]").value == 5.0
        assert looked.orders == []  # what the station sets is no order
        looked.use("Time [s]", 30.0)
        assert looked.orders == [Seek(time_ns=30 * SECOND_NS)]
        looked.station.show(shown(looked.scene, 5.1))
        looked.station.draw()
        assert looked.part("Time [s]").value == 30.0  # the hand is on it still
        looked.show(30.0)
        looked.use("Pause")
        assert looked.orders[1:] == [Go(paused=True, speed=1.0)]
        assert not looked.has("Step 0.1 s")


def test_a_speed_that_is_not_offered_is_shown_and_kept() -> None:
    with looking(scenery(1)) as looked:
        looked.show(1.0, pace=Pace(speed=3.3))
        assert looked.part("Speed").value == "3.3x"
        looked.use("Pause")
        assert looked.orders == [Go(paused=True, speed=3.3)]


def test_when_a_run_is_over_nothing_can_be_ordered_any_more() -> None:
    with looking(scenery(2)) as looked:
        looked.show(1.0, pace=Pace(over="done"), halted=("v1",))
        labels = [
            "STOP ALL",
            "Let all go",
            "Pause",
            "Go on",
            "Step 0.1 s",
            "Inject outage",
            "Move obstacle",
            "Set",
            "End the run",
        ]
        assert [label for label in [*labels, "Stop this vehicle", "Let it go"] if not looked.part(label).disabled] == []


def test_what_is_stopped_is_marked() -> None:
    with looking(scenery(3)) as looked:
        looked.show(1.0, halted=("v2",))
        assert (looked.node("/stopped").batched_scales[:, 0] > 0.1).tolist() == [False, True, False]
        assert looked.part("Let all go").disabled is False
        looked.show(2.0)
        assert looked.node("/stopped").batched_scales[:, 0].max() < 0.1


# --- geometry ---


@given(yaw=ANGLES, x=METRES, y=METRES)
def test_turning_vectors_is_a_rotation(yaw: float, x: float, y: float) -> None:
    turned = rotated(np.array([quaternion_from_yaw(yaw)]), np.array([(x, y, 1.0)]))[0]
    c, s = math.cos(yaw), math.sin(yaw)
    assert turned == pytest.approx((c * x - s * y, s * x + c * y, 1.0), abs=1e-9)
