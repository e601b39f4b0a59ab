"""The feed from a run to a page: newest values, whole messages, and the run never waits for the reader."""

import gc
import tracemalloc
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vcmvsp
from tests.support.cosim.feeds import NAMES, SCENERY, CountedReadings, Reader, at, frame_of, receptions
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import (
    Changed,
    Contact,
    Follows,
    Halted,
    Image,
    Later,
    Mosaic,
    Note,
    Presence,
    Pushed,
    Reading,
    Scan,
    Velocity,
    frozen,
)
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import PERIOD_S, READING_S
from vcmvsp.cosim.view.messages import End, Go, Order, PageUpdate, Sensors
from vcmvsp.cosim.view.scenery import scenery_of

pytestmark = pytest.mark.slow

SCAN = Scan(ranges=frozen([1.0, 2.0], np.float32), angle_min=0.0, angle_step=0.1, range_max=5.0)


@pytest.fixture
def reader() -> Iterator[Reader]:
    """A reader that has read everything at each look."""
    with Reader() as made:
        yield made


@pytest.fixture
def slow() -> Iterator[Reader]:
    """A reader with the smallest socket buffer."""
    with Reader(buffer_bytes=1) as made:
        yield made


def counts(shown: PageUpdate) -> tuple[list[list[int]], list[list[int]]]:
    """Numbers of sent and received frames so far, by sender and receiver."""
    assert shown.sent is not None
    assert shown.received is not None
    return shown.sent.tolist(), shown.received.tolist()


def test_the_newest_values_are_shown(reader: Reader) -> None:
    for k in range(5):
        reader.on(k, "world/states", at(float(k)))
        reader.on(k, "a/follows", Follows(leader="b", slot=(float(k), 0.0)))
        reader.on(k, "a/note", Note(values={"k": float(k), f"only{k}": True}))
        reader.on(k, "radio/receptions", receptions(k))
        reader.on(k, "radio/frame", frame_of(k, "a", {"b": k, "c": None}))
        reader.on(k, "a/command", Velocity())
    reader.wait()
    shown = reader.read()[-1]
    assert shown.time_ns == 4
    assert shown.states is not None
    assert shown.states.position[0, 0] == 4.0
    assert shown.places["a"].slot == (4.0, 0.0)
    assert shown.notes["a"] == {"k": 4.0, **{f"only{k}": True for k in range(5)}}
    assert shown.heard_ns == {"a": 4}
    (link,) = shown.links
    assert (link.sender, link.sent_ns, link.received.tolist()) == ("a", 4, [True, False])
    assert counts(shown) == ([[0, 5, 5], [0, 0, 0], [0, 0, 0]], [[0, 5, 0], [0, 0, 0], [0, 0, 0]])


def test_shown_values_are_not_shown_again(reader: Reader) -> None:
    reader.on(0, "world/states", at(0.0))
    reader.on(0, "radio/frame", frame_of(0, "a", {"b": 1}))
    reader.wait()
    assert len(reader.read()) == 1
    reader.wait()
    assert reader.read() == []
    reader.on(1, "a/follows", Follows(leader=None))
    reader.wait()
    (shown,) = reader.read()
    assert (shown.states, shown.sent, shown.links, [*shown.places]) == (None, None, (), ["a"])


def test_updates_are_limited_to_thirty_per_second(reader: Reader) -> None:
    for k in range(1000):
        reader.on(k, "world/states", at(float(k)))
        reader.now_s += 0.001
    assert 25 <= len(reader.read()) <= 31


def test_a_stalled_reader_costs_no_memory_and_then_gets_whole_messages(slow: Reader) -> None:
    everyone: dict[str, int | None] = {"b": 1, "c": None}

    def go_on(first: int, last: int) -> None:
        for k in range(first, last):
            slow.on(k, "world/states", at(float(k)))
            slow.on(k, "radio/frame", frame_of(k, "a", everyone))
            slow.on(k, "a/contact", Contact(vehicle="a", other=str(k)))
            slow.on(k, "a/note", Note(values={"k": float(k)}))
            slow.now_s += PERIOD_S

    go_on(0, 500)
    tracemalloc.start()
    go_on(500, 1000)
    gc.collect()
    before, _ = tracemalloc.get_traced_memory()
    go_on(1000, 3000)
    gc.collect()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 2000 * 50  # the smallest object is larger
    assert slow.read()[-1].time_ns < 100  # content of the socket
    shown = slow.read_all()
    assert shown.time_ns == 2999
    sent, received = counts(shown)
    assert (sent[0], received[0]) == ([0, 3000, 3000], [0, 3000, 0])
    assert shown.lines[-1].text == "a touches 2999"


class ExpectedContents:
    """The expected contents, beside a feed that gets the events."""

    def __init__(self, reader: Reader) -> None:
        self._reader, self._k = reader, -1
        self.notes: dict[str, float | str | bool] = {}
        self.halted: set[str] = set()
        self.lines, self.side = 0, 0
        self.sent, self.received = np.zeros((3, 3), int), np.zeros((3, 3), int)
        self.newest: dict[str, int] = {}

    def go_on(self) -> None:
        self._k += 1
        self._reader.on(self._k, "world/states", at(float(self._k)))

    def read(self, most: int) -> None:
        self._reader.read(most)

    def wait(self, wall_s: float) -> None:
        self._reader.wait(wall_s)

    def note(self, name: str) -> None:
        self.notes[name] = float(self._k)
        self._reader.on(self._k, "b/note", Note(values={name: float(self._k)}))

    def frame(self, ends: tuple[str, bool]) -> None:
        sender, got = ends
        others = {name: self._k if got else None for name in NAMES if name != sender}
        self._reader.on(self._k, "radio/frame", frame_of(self._k, sender, others))
        pairs = NAMES.index(sender), [NAMES.index(name) for name in others]
        self.sent[pairs] += 1
        self.received[pairs] += got
        self.newest[sender] = self._k

    def mosaic(self, side: int) -> None:
        self.side = side
        pixels = np.full((side, side, 3), self._k % 256, np.uint8)
        self._reader.on(self._k, "c/mosaic", Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=pixels))

    def halt(self, order: tuple[str, bool]) -> None:
        name, halted = order
        (self.halted.add if halted else self.halted.discard)(name)
        self.lines += 1
        self._reader.on(self._k, "operator/halted", Halted(vehicles=(name,), halted=halted))


steps = st.lists(
    st.tuples(st.just("read"), st.integers(0, 30_000))
    | st.tuples(st.just("wait"), st.sampled_from([0.0, 0.01, PERIOD_S, 1.0]))
    | st.tuples(st.just("note"), st.sampled_from(["p", "q"]))
    | st.tuples(st.just("frame"), st.tuples(st.sampled_from(NAMES), st.booleans()))
    | st.tuples(st.just("mosaic"), st.integers(1, 120))
    | st.tuples(st.just("halt"), st.tuples(st.sampled_from(NAMES), st.booleans())),
    min_size=1,
    max_size=60,
)


@given(steps)
@settings(max_examples=100)
def test_any_pattern_of_reading_ends_with_the_newest_values(actions: list[tuple[str, Any]]) -> None:
    with Reader(buffer_bytes=1) as reader:
        truth = ExpectedContents(reader)
        for method, value in actions:
            truth.go_on()
            getattr(truth, method)(value)
        shown = reader.read_all()
    assert shown.time_ns == len(actions) - 1
    assert shown.states is not None
    assert shown.states.position[0, 0] == len(actions) - 1
    assert shown.notes.get("b", {}) == truth.notes
    assert len(shown.lines) == truth.lines
    assert {*shown.halted} == truth.halted
    assert {link.sender: link.sent_ns for link in shown.links} == truth.newest
    if truth.newest:
        assert counts(shown) == (truth.sent.tolist(), truth.received.tolist())
    assert (len(shown.mosaics["c"].pixels) if truth.side else 0) == truth.side


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_the_counts_equal_the_recording_and_the_run_is_unchanged(loss: float) -> None:
    changed: dict[str, Any] = {"duration_s": 5.0, "radio.loss": {"kind": "bernoulli", "probability": loss}}
    parsed, source = scenarios.load("study-loss", settings=changed)
    with Reader(scenery=scenery_of(parsed, source)) as reader:

        def observe(event: Event) -> None:
            reader.feed.on(event)
            reader.now_s += 0.01
            reader.read(100)

        result = vcmvsp.run("study-loss", set=changed, observe=observe, mcap=False)
        shown = reader.read_all()
    rows = result.radio.to_pylist()
    names = [craft.name for craft in parsed.vehicle]
    sent, received = np.zeros((len(names),) * 2, int), np.zeros((len(names),) * 2, int)
    for row in rows:
        pair = names.index(row["sender"]), names.index(row["receiver"])
        sent[pair] += 1
        received[pair] += row["outcome"] == "received"
    assert sent.sum() > 0
    assert counts(shown) == (sent.tolist(), received.tolist())
    assert shown.time_ns == 5 * SECOND_NS
    assert {*shown.places} == {"car2", "car3"}
    assert vcmvsp.run("study-loss", set=changed, mcap=False).metrics["digest"] == result.metrics["digest"]


def test_readings_are_computed_only_on_request_and_in_turn(reader: Reader) -> None:
    scans, pictures = CountedReadings(SCAN), CountedReadings(Image(pixels=frozen(np.zeros((2, 2, 3), np.uint8))))

    def go_on(seconds: float) -> Sequence[PageUpdate]:
        for _ in range(round(seconds / 0.01)):
            time_ns = round(reader.now_s * SECOND_NS)
            reader.on(time_ns, "a/scan", scans.later())
            reader.on(time_ns, "b/camera", pictures.later())
            reader.on(time_ns, "c/scan", SCAN)
            reader.now_s += 0.01
        return reader.read()

    assert not any(shown.scans or shown.images for shown in go_on(2.0))
    assert (scans.times, pictures.times) == (0, 0)
    reader.order(codec.encode(Sensors(names=("a/scan", "b/camera"))))
    shown = go_on(4.0)
    assert 0 < scans.times + pictures.times <= 4.0 / READING_S + 1
    assert abs(scans.times - pictures.times) <= 1
    assert {key for each in shown for key in (*each.scans, *each.images)} == {"a/scan", "b/camera"}
    reader.order(codec.encode(Sensors(names=("c/scan",))))
    go_on(0.5)
    before = scans.times + pictures.times
    assert {key for each in go_on(2.0) for key in (*each.scans, *each.images)} == {"c/scan"}
    assert scans.times + pictures.times == before


def test_a_failed_reading_is_reported(reader: Reader) -> None:
    def fail() -> Reading:
        raise RuntimeError("no light")

    reader.order(codec.encode(Sensors(names=("a/scan",))))
    reader.wait()
    reader.on(1, "a/scan", Later(fail))
    reader.wait(1.0)
    assert [line.text for line in reader.known().lines] == ["a/scan could not be computed: RuntimeError: no light"]


def test_orders_keep_order_and_bad_ones_are_reported(reader: Reader) -> None:
    orders: list[Order] = [Go(paused=True), End(), Go(speed=2.0)]
    for each in orders:
        reader.order(codec.encode(each))
        reader.order(b"\xc1")
        reader.order(codec.encode({"type": "no such order"}))
    assert reader.feed.orders() == orders
    assert reader.feed.orders() == []
    reader.wait()
    assert {line.text for line in reader.known().lines} == {"the control station sent an invalid command"}


def test_unread_orders_do_not_pile_up(reader: Reader) -> None:
    for k in range(1000):
        reader.order(codec.encode(Go(speed=float(k))))
        reader.wait()
    orders = reader.feed.orders()
    assert len(orders) <= 200
    assert orders[-1] == Go(speed=999.0)


def test_an_invalid_stream_ends_the_view_and_not_the_run(reader: Reader) -> None:
    reader.sock.sendall(b"\xff" * 100)
    assert reader.feed.orders() == []
    assert not reader.feed.open
    assert "4294967295 bytes" in reader.feed.problem
    reader.on(5, "world/states", at(0.0))
    reader.wait()


def test_a_pages_problem_is_kept(reader: Reader) -> None:
    reader.order(codec.encode(protocol.Down(problem="no memory")))
    assert reader.feed.orders() == []
    assert (reader.feed.open, reader.feed.problem) == (False, "no memory")


def test_a_closed_reader_is_not_awaited(reader: Reader) -> None:
    reader.sock.close()
    for k in range(3):
        reader.on(k, "world/states", at(0.0))
        reader.wait()
    assert not reader.feed.open
    reader.feed.close("the run is complete")


def test_a_slow_reader_gets_the_end(slow: Reader) -> None:
    for k in range(200):
        slow.on(k, "world/states", at(float(k)))
        slow.wait()
    slow.read()
    slow.feed.close("the run is complete")
    shown = slow.known()
    assert (shown.pace.over, shown.time_ns) == ("the run is complete", 199)


def test_obstacles_and_targets_have_positions() -> None:
    door = {"door": lambda time_s: (time_s, 0.0, 1.0, 0.5)}
    with Reader(moving=door, targets={"alpha": lambda time_s: (0.0, 2.0 * time_s)}) as reader:
        turn = quaternion_from_yaw(0.25)
        pushed = Pushed(names=("crate",), position=np.array([[7.0, 8.0, 0.5]]), attitude=np.array([turn]))
        reader.on(SECOND_NS, "world/pushed", pushed)
        shown = reader.read_all()
    assert shown.obstacles == {"door": (1.0, 0.0, 1.0, 0.5), "crate": (7.0, 8.0, 0.5, pytest.approx(0.25))}
    assert shown.targets == {"alpha": (0.0, 2.0)}


def test_a_reader_that_joins_late_gets_everything() -> None:
    with Reader(whole_s=1.0) as early, Reader() as reader:
        for each in (early, reader):
            each.on(0, "world/states", at(1.0))
            each.on(0, "a/follows", Follows(leader="b", slot=(1.0, 0.0)))
            each.on(0, "a/note", Note(values={"mode": "search"}))
            each.on(0, "radio/frame", frame_of(0, "a", {"b": 5, "c": None}))
            each.wait()
        known = msgspec.structs.replace(reader.known(), crafts=SCENERY.vehicles)
        assert codec.encode(known) == codec.encode(early.known())
        assert known.lines
        for _ in range(3):
            for each in (early, reader):
                each.wait(1.1)
            assert reader.read() == []  # each value once
            (whole,) = early.read()
            assert codec.encode(msgspec.structs.replace(whole, pace=known.pace)) == codec.encode(known)


def test_events_are_lines_of_the_log(reader: Reader) -> None:
    reader.on(1, "a/host", Presence(state="lost", since_ns=1, why="no answer"))
    reader.on(2, "a/contact", Contact(vehicle="a", other=None))
    reader.on(3, "operator/changed", Changed(key="radio.loss.probability", value=0.5))
    reader.wait()
    shown = reader.known()
    assert shown.presence["a"].state == "lost"
    assert [(line.time_ns, line.level, line.text) for line in shown.lines] == [
        (1, "warning", "a has lost its agent: no answer"),
        (2, "warning", "a touches something that stands still"),
        (3, "info", "operator: radio.loss.probability = 0.5"),
    ]


def test_only_changed_notes_of_tasks_and_finds_are_lines_of_the_log(reader: Reader) -> None:
    def note(second: int, **values: float | str) -> None:
        reader.on(second * SECOND_NS, "v1/note", Note(values=dict(values)))

    note(1, task="search", z=0.1)
    note(2, task="search", z=0.2)
    note(3, found="red")
    note(4, task="track")
    reader.wait()
    lines = reader.known().lines
    assert [(line.time_ns // SECOND_NS, line.text) for line in lines] == [
        (1, "v1: task search"),
        (3, "v1: found red"),
        (4, "v1: task track"),
    ]


def test_an_unsendable_event_is_only_reported(reader: Reader) -> None:
    reader.on(0, "a/note", Note(values={"odd": object()}))  # type: ignore[dict-item]  # of a user's federate
    reader.wait()
    (line,) = reader.known().lines
    assert line.text.startswith("the view cannot show an event")
    reader.on(1, "world/states", at(1.0))
    reader.wait()
    assert reader.known().states is not None


def test_a_too_large_event_is_only_reported(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "LARGEST", 5000)
    reader.on(0, "c/mosaic", Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=np.zeros((100, 100, 3), np.uint8)))
    reader.feed.close("the run is complete")
    (line,) = reader.known().lines
    assert "bytes are too many" in line.text
    assert reader.known().pace.over == "the run is complete"


def test_the_achieved_speed_is_of_the_last_second(reader: Reader) -> None:
    for k in range(1, 200):
        reader.on(k * SECOND_NS // 10, "world/states", at(0.0))
        reader.now_s += 0.05 if k < 100 else 0.2
        if k == 99:
            assert reader.known().pace.achieved == pytest.approx(2.0, rel=0.1)
    assert reader.known().pace.achieved == pytest.approx(0.5, rel=0.1)
