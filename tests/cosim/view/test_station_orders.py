"""Orders of the control station and when they are offered, without a browser."""

import math

import pytest
import viser

from tests.support.cosim.view_pages import LIVE, RECORDED, StationPage, moving_state, open_station, scenery
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.scenario.schema import HaltTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.view.messages import End, Go, Order, Pace, Seek

pytestmark = pytest.mark.sockets

MOVE = MoveTable(at_s=0.0, obstacle="crate", position=(1.0, -2.0), yaw=0.2)


LABELS = {
    "pace": "Pause",
    "halt": "Stop all vehicles",
    "outage": "Inject outage",
    "move": "Move obstacle",
    "set": "Set",
    "end": "End the run",
    "seek": "Time [s]",
    "sensors": "ring (ring)",
}


@pytest.mark.parametrize("may", [(), ("sensors",), ("pace", "seek"), ("halt", "outage"), LIVE])
def test_only_permitted_orders_are_offered(may: tuple[str, ...]) -> None:
    with open_station(scenery(2, may=may, keys={"radio.loss.probability": 0.2})) as station_page:
        assert {tag for tag, label in LABELS.items() if station_page.has(label)} == set(may)


@pytest.mark.parametrize(
    ("acts", "order"),
    [
        ([("Stop all vehicles", True)], HaltTable(at_s=0.0, halted=True)),
        ([("Release all vehicles", True)], HaltTable(at_s=0.0, halted=False)),
        ([("Vehicle", "v2"), ("Stop this vehicle", True)], HaltTable(at_s=0.0, vehicles=("v2",), halted=True)),
        ([("Release this vehicle", True)], HaltTable(at_s=0.0, vehicles=("v1",), halted=False)),
        ([("Pause", True)], Go(paused=True, speed=1.0)),
        ([("Step 0.1 s", True)], Go(paused=True, speed=1.0, step_ns=100_000_000)),
        ([("Speed", "0.2x")], Go(paused=False, speed=0.2)),
        ([("Speed", "as fast as it can")], Go(paused=False, speed=None)),
        ([("Inject outage", True)], OutageTable(at_s=0.0, vehicles=(), for_s=5.0)),
        (
            [("Frames from and to", "v3"), ("are lost for [s]", 2.5), ("Inject outage", True)],
            OutageTable(at_s=0.0, vehicles=("v3",), for_s=2.5),
        ),
        ([("x [m]", 1.0), ("y [m]", -2.0), ("Move obstacle", True)], MOVE),
        ([("New value", 0.5), ("Set", True)], SetTable(at_s=0.0, key="radio.loss.probability", value=0.5)),
    ],
)
def test_controls_give_their_orders(live: StationPage, acts: list[tuple[str, object]], order: Order) -> None:
    before = {label: live.part(label).value for label, _ in acts}
    live.orders.clear()
    live.show(8.0)  # pace 1x
    for label, value in acts:
        live.use(label, value)
    assert live.orders == [order]
    for label, value in before.items():
        live.part(label)._impl.value = value
    live.use("Vehicle", "v1")


def test_a_dragged_obstacle_is_ordered_to_its_last_place(live: StationPage) -> None:
    live.orders.clear()
    live.use("Drag")
    gizmo = live.node("/gizmo")
    assert gizmo.visible
    gizmo.position, gizmo.wxyz = (2.5, 3.5, 0.3), quaternion_from_yaw(-0.4)
    for phase in ("start", "update", "end"):
        for callback in gizmo._impl_aux.update_cb:
            callback(viser.TransformControlsEvent(client=None, client_id=1, target=gizmo, phase=phase))
    assert live.orders == [MoveTable(at_s=0.0, obstacle="crate", position=(2.5, 3.5), yaw=-0.4)]
    live.use("Drag", False)
    assert not gizmo.visible


def test_unlisted_names_and_invalid_numbers_give_no_orders(live: StationPage) -> None:
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
    assert live.orders == [HaltTable(at_s=0.0, vehicles=("v1",), halted=True)]
    for label, value in (("Vehicle", "v1"), ("Obstacle", "crate"), ("Links", "all"), ("are lost for [s]", 5.0), ("x [m]", 0.0)):
        live.use(label, value)


def test_ending_a_run_requires_a_confirmation() -> None:
    with open_station(scenery(1)) as station_page:
        assert not station_page.part("Yes, end it now").visible
        station_page.use("End the run")
        station_page.use("No, continue")
        assert not station_page.part("Yes, end it now").visible
        station_page.use("End the run")
        assert station_page.orders == []
        station_page.use("Yes, end it now")
        assert station_page.orders == [End()]


def test_a_recording_is_sought_by_hand_and_plays_by_itself() -> None:
    with open_station(scenery(2, may=RECORDED)) as station_page:
        station_page.show(5.0)
        assert station_page.part("Time [s]").value == 5.0
        assert station_page.orders == []  # values set by the station are no orders
        station_page.use("Time [s]", 30.0)
        assert station_page.orders == [Seek(time_ns=30 * SECOND_NS)]
        station_page.station.show(moving_state(station_page.scene, 5.1))
        station_page.station.draw()
        assert station_page.part("Time [s]").value == 30.0  # still held by the operator
        station_page.show(30.0)
        station_page.use("Pause")
        assert station_page.orders[1:] == [Go(paused=True, speed=1.0)]
        assert not station_page.has("Step 0.1 s")


def test_a_recording_goes_from_event_to_event_and_marks_them_on_its_slider() -> None:
    events_ns = (4 * SECOND_NS, 12 * SECOND_NS, 40 * SECOND_NS, 12_100_000_000)
    with open_station(scenery(may=RECORDED, events_ns=events_ns)) as station_page:
        marks = [mark.value for mark in station_page.part("Time [s]")._marks]
        assert marks == [4.0, 12.0, 40.0]  # further apart than a pixel or two
        for time_s, previous_s, next_s in ((0.0, None, 4.0), (12.0, 4.0, 12.1), (40.0, 12.1, None)):
            for which, there_s in (("previous", previous_s), ("next", next_s)):
                station_page.show(time_s)
                station_page.orders.clear()
                station_page.use("Event", which)
                assert station_page.orders == ([] if there_s is None else [Seek(time_ns=round(there_s * SECOND_NS))])
    with open_station(scenery(may=RECORDED)) as station_page:
        assert not station_page.has("Event")  # no events


@pytest.mark.parametrize(("may", "resume"), [(LIVE, "Resume"), (RECORDED, "Play")])
def test_one_button_pauses_and_resumes_and_names_its_effect(may: tuple[str, ...], resume: str) -> None:
    with open_station(scenery(1, may=may)) as station_page:
        station_page.show(1.0, pace=Pace(speed=1.0))
        assert not station_page.has(resume)
        station_page.use("Pause")
        station_page.show(1.0, pace=Pace(speed=1.0, paused=True))
        assert not station_page.has("Pause")
        station_page.use(resume)
        assert station_page.orders == [Go(paused=True, speed=1.0), Go(paused=False, speed=1.0)]


def test_a_speed_that_is_not_offered_is_shown_and_kept() -> None:
    with open_station(scenery(1)) as station_page:
        station_page.show(1.0, pace=Pace(speed=3.3))
        assert station_page.part("Speed").value == "3.3x"
        station_page.use("Pause")
        assert station_page.orders == [Go(paused=True, speed=3.3)]


def test_after_a_run_nothing_can_be_ordered() -> None:
    with open_station(scenery(2)) as station_page:
        station_page.show(1.0, pace=Pace(over="done"), halted=("v1",))
        labels = {label for tag, label in LABELS.items() if tag not in ("seek", "sensors")}
        labels |= {"Release all vehicles", "Step 0.1 s", "Stop this vehicle", "Release this vehicle"}
        assert {label for label in labels if not station_page.part(label).disabled} == set()


def test_stopped_vehicles_are_marked() -> None:
    with open_station(scenery(3)) as station_page:
        station_page.show(1.0, halted=("v2",))
        assert (station_page.node("/stopped").batched_scales[:, 0] > 0.1).tolist() == [False, True, False]
        assert station_page.part("Release all vehicles").disabled is False
        station_page.show(2.0)
        assert station_page.node("/stopped").batched_scales[:, 0].max() < 0.1
