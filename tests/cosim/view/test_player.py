"""A recorded run in the control station shows the contents of the live page, at any time and at the ordered pace."""

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.feeds import merge
from tests.support.cosim.recorded_run import (
    END_NS,
    SENSORS,
    Run,
    all_of,
    assert_same,
    observer_state,
    recording_state,
)
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.scenario.schema import SetTable
from vcmvsp.cosim.types import Note
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.view.messages import Go, PageUpdate, Seek, Sensors
from vcmvsp.cosim.view.player.recording import FASTEST, Player, Recording

pytestmark = pytest.mark.slow

TIMES = st.integers(0, END_NS)


@pytest.fixture(scope="module")
def recording(run: Run) -> Iterator[Recording]:
    with closing(Recording(run.folder)) as opened:
        yield opened


# --- what is shown ---


@settings(max_examples=60)
@given(TIMES)
def test_at_any_time_it_shows_the_live_contents(run: Run, recording: Recording, time_ns: int) -> None:
    assert_same(
        recording_state(recording.at(time_ns, sensors=SENSORS)), observer_state(run.events, recording.vehicles, time_ns)
    )


def test_the_example_covers_all_contents(recording: Recording) -> None:
    """Otherwise the law above covers less than it states."""
    shown = recording.at(END_NS, sensors=SENSORS)
    assert set(shown.scans) | set(shown.images) == set(SENSORS)
    assert set(shown.fixes) == set(recording.vehicles)
    assert set(shown.places) == set(shown.notes) == {"car2", "car3"} == set(shown.heard_ns)
    assert shown.sent is not None
    assert shown.received is not None
    assert 0 < shown.received.sum() < shown.sent.sum()
    assert next(iter(shown.images.values())).focal_px > 0.0


@given(TIMES, st.one_of(TIMES, st.none()))
def test_omitted_values_are_unchanged(recording: Recording, time_ns: int, other_ns: int | None) -> None:
    first, last = sorted((time_ns, time_ns if other_ns is None else other_ns))
    before, after = recording.at(first, sensors=SENSORS), recording.at(last, first, SENSORS)
    assert_same(all_of(merge(before, after)), all_of(recording.at(last, sensors=SENSORS)))


@given(TIMES)
def test_without_elapsed_time_nothing_new_is_shown(recording: Recording, time_ns: int) -> None:
    halted = recording.at(time_ns).halted
    assert recording.at(time_ns, time_ns, SENSORS) == PageUpdate(time_ns=time_ns, halted=halted)


@settings(max_examples=20)
@given(st.lists(TIMES, min_size=1, max_size=8))
def test_earlier_reads_change_nothing(run: Run, recording: Recording, times_ns: list[int]) -> None:
    for time_ns in times_ns:
        recording.at(time_ns, sensors=SENSORS)
    with closing(Recording(run.folder)) as fresh:
        assert encode(fresh.at(times_ns[-1], sensors=SENSORS)) == encode(recording.at(times_ns[-1], sensors=SENSORS))


def test_interventions_are_shown_from_their_time_on(recording: Recording) -> None:
    def at(time_s: float) -> PageUpdate:
        return recording.at(round(time_s * SECOND_NS))

    assert [at(time_s).halted for time_s in (1.0, 1.2, 2.7, 3.5)] == [(), ("car2",), (), ("car1", "car2", "car3")]
    assert at(1.9).obstacles["crate"] == pytest.approx((-3.0, 2.0, 0.2, 0.0), abs=1e-3)
    assert at(2.1).obstacles["crate"] == pytest.approx((-3.0, -1.0, 0.2, 0.4), abs=1e-3)
    lines = [(line.time_ns / SECOND_NS, line.text) for line in at(4.0).lines]
    assert [time_s for time_s, _ in lines] == sorted(time_s for time_s, _ in lines)
    assert any(time_s == 1.5 and "no radio" in text for time_s, text in lines)
    assert lines[-1] == (4.0, "the run is complete") == (4.0, recording.ending)


def test_obstacles_and_targets_keep_to_their_time_table(recording: Recording) -> None:
    assert recording.at(0).obstacles["cart"] == (-4.0, -3.0, 0.3, 0.0)
    assert recording.at(SECOND_NS * 3 // 2).obstacles["cart"] == pytest.approx((0.0, -3.0, 0.3, 0.5))
    assert recording.at(2 * SECOND_NS).targets == {"alpha": pytest.approx((1.0, 5.0))}
    assert "cart" not in recording.at(END_NS, SECOND_NS * 7 // 2).obstacles  # it is at rest


def test_the_scenery_is_that_of_the_run(recording: Recording) -> None:
    scenery = recording.scenery
    assert (scenery.scenario, scenery.duration_ns, scenery.live) == ("shown-again", END_NS, False)
    assert set(scenery.may) == {"pace", "seek", "sensors"}
    assert [each.name for each in scenery.vehicles] == list(recording.vehicles)
    assert {each.kind for each in scenery.vehicles} == {"p2dx"}
    assert dict(scenery.vehicles[0].sensors) == {"scan": "lms", "camera": "nadir_camera"}
    assert [each.name for each in scenery.obstacles] == ["crate", "cart"]
    assert len(scenery.triangles) > 0


# --- the player ---


class ManualClock:
    """A clock that moves only when set."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def wall() -> ManualClock:
    return ManualClock()


@pytest.fixture
def player(recording: Recording, wall: ManualClock) -> Player:
    return Player(recording, wall)


def test_it_pauses_at_the_start_until_ordered_to_go(player: Player, wall: ManualClock) -> None:
    assert (player.show().time_ns, player.show().pace.paused) == (0, True)
    wall.now_s += 5.0
    assert player.show().time_ns == 0
    player.order(Go(speed=2.0))
    assert player.show().time_ns == 0
    wall.now_s += 0.75
    shown = player.show()
    assert (shown.time_ns, shown.pace.speed, shown.pace.paused, shown.pace.over) == (SECOND_NS * 3 // 2, 2.0, False, "")


def test_pause_resume_and_speed_keep_the_time(player: Player, wall: ManualClock) -> None:
    player.order(Go(speed=1.0))
    player.show()
    wall.now_s += 1.0
    player.order(Go(paused=True, speed=1.0))
    assert player.show().time_ns == SECOND_NS
    wall.now_s += 9.0
    assert player.show().time_ns == SECOND_NS
    player.order(Go(speed=0.5))
    player.show()
    wall.now_s += 1.0
    assert player.show().time_ns == SECOND_NS * 3 // 2
    player.order(Go(speed=None))
    player.show()
    wall.now_s += 0.01
    assert player.show().time_ns == SECOND_NS * 3 // 2 + FASTEST * SECOND_NS // 100


def test_a_step_is_as_long_as_ordered(player: Player, wall: ManualClock) -> None:
    player.order(Go(paused=True, speed=1.0, step_ns=SECOND_NS // 10))
    player.show()
    wall.now_s += 3.0
    shown = player.show()
    assert (shown.time_ns, shown.pace.paused) == (SECOND_NS // 10, True)


def test_at_the_end_it_pauses_and_restarts_only_on_order(player: Player, wall: ManualClock) -> None:
    player.order(Go(speed=1.0))
    player.show()
    wall.now_s += 60.0
    shown = player.show()
    assert (shown.time_ns, shown.pace.paused, shown.pace.over) == (END_NS, True, "the run is complete")
    wall.now_s += 60.0
    assert player.show().time_ns == END_NS
    player.order(Seek(time_ns=SECOND_NS))
    shown = player.show()
    assert (shown.time_ns, shown.pace.paused, shown.pace.over) == (SECOND_NS, True, "")
    player.order(Seek(time_ns=10 * END_NS))
    assert player.show().time_ns == END_NS
    player.order(Go(speed=1.0))
    assert player.show().time_ns == 0


@pytest.mark.parametrize(
    "order", [SetTable(at_s=0.0, key="radio.loss.probability", value=0.5), Go(speed=-1.0), Go(speed=math.nan)]
)
def test_it_ignores_orders_for_live_runs(player: Player, wall: ManualClock, order: Any) -> None:
    player.order(Go(speed=1.0))
    player.show()
    player.order(order)
    wall.now_s += 0.5
    assert (player.show().time_ns, player.show().pace.speed) == (SECOND_NS // 2, 1.0)


def test_it_seeks_no_further_back_than_the_start(player: Player) -> None:
    player.order(Seek(time_ns=-5))
    assert player.show().time_ns == 0


def test_readings_are_shown_on_request_and_then_when_new(player: Player, wall: ManualClock) -> None:
    player.order(Seek(time_ns=SECOND_NS * 13 // 10))
    assert not player.show().scans
    player.order(Sensors(names=("car1/camera", "car1/scan", "car9/scan", "car1/nothing", "car1/odometry")))
    shown = player.show()
    assert (set(shown.images), set(shown.scans)) == ({"car1/camera"}, {"car1/scan"})
    assert not player.show().images
    player.order(Go(speed=1.0))
    player.show()
    wall.now_s += 0.15
    assert (set(player.show().images), set(player.show().scans)) == (set(), set())
    player.order(Sensors(names=()))
    wall.now_s += 2.0
    assert not player.show().scans


@settings(max_examples=30)
@given(
    orders=st.lists(
        st.one_of(TIMES.map(lambda t: Seek(time_ns=t)), st.sampled_from([Go(speed=1.0), Go(speed=3.0, paused=True)])),
        max_size=8,
    )
)
def test_seeking_back_and_forth_gives_the_contents_of_the_time(recording: Recording, orders: list[Any]) -> None:
    wall = ManualClock()
    known: PageUpdate | None = None
    player = Player(recording, wall)
    for order in [*orders, Sensors(names=SENSORS)]:
        player.order(order)
        wall.now_s += 0.35
        shown = player.show()
        known = merge(None if known is None or shown.time_ns < known.time_ns else known, shown)  # going back, all is shown
    assert known is not None
    assert_same(all_of(known), all_of(recording.at(known.time_ns, sensors=SENSORS)))


def note_lines(events: Sequence[Event]) -> list[LogLine]:
    """Expected lines of changed notes on tasks and finds."""
    newest: dict[tuple[str, str], object] = {}
    lines = []
    for event in events:
        if isinstance(event.value, Note):
            vehicle = event.key.partition("/")[0]
            for name in ("found", "lost", "task", "target", "commander", "mode", "shape", "status"):
                value = event.value.values.get(name)
                if value and newest.get((vehicle, name)) != value:
                    newest[vehicle, name] = value
                    lines.append(LogLine(time_ns=event.time_ns, level="info", text=f"{vehicle}: {name} {value}"))
    return lines


@given(TIMES)
def test_at_any_time_changes_of_notes_are_lines_with_the_times_of_their_events(
    run: Run, recording: Recording, time_ns: int
) -> None:
    """Also after a seek, when the time of the page is later."""
    every = note_lines(run.events)
    assert len(every) >= 4
    assert [line for line in recording.at(time_ns).lines if line in every] == [
        line for line in every if line.time_ns <= time_ns
    ]


def test_lines_are_shown_once(run: Run, player: Player, wall: ManualClock) -> None:
    player.order(Go(speed=1.0))
    lines: list[LogLine] = []
    for _ in range(50):
        lines += player.show().lines
        wall.now_s += 0.1
    notes = set(note_lines(run.events))
    assert len(lines) == len(set(lines)) == 6 + len(notes)
    assert notes < set(lines)
