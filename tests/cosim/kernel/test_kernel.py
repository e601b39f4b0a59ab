"""Kernel: order of instants, of events and of remote answers, as in the contract of `cosim.federate`."""

import fcntl
import gc
import resource
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.clock import SECOND_NS, SimClock, WallClock
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event, Federate, RunInfo, Slot, Step
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.types import Note

pytestmark = pytest.mark.slow

Log = list[tuple[str, int, list[str]]]  # (federate, time, keys of its inbox)


def note(key: str, when: int, value: float = 0.0) -> Event:
    return Event(key, when, Note(values={"value": value}))


class Script:
    """A federate with a table of events by time; it records every step."""

    def __init__(
        self,
        name: str,
        slot: Slot,
        table: Mapping[int, Sequence[tuple[str, int]]] | None = None,
        *,
        reads: tuple[str, ...] = (),
        wakes: tuple[str, ...] = (),
        latest: tuple[str, ...] = (),
        wake_slot: Slot | None = None,
        answers: Sequence[tuple[str, int]] = (),
        log: Log | None = None,
    ) -> None:
        self.name, self.slot, self.wake_slot = name, slot, slot if wake_slot is None else wake_slot
        self.reads, self.wakes, self.latest = (*reads, *wakes), wakes, latest
        self.table, self.answers, self.log, self.closed = dict(table or {}), answers, log if log is not None else [], 0

    def start(self, run: RunInfo) -> int | None:
        return min(self.table, default=None)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        self.log.append((self.name, now_ns, [event.key for event in inbox]))
        outputs = self.table.pop(now_ns, self.answers if inbox else ())
        return Step([note(key, now_ns + after) for key, after in outputs], min(self.table, default=None))

    def close(self) -> None:
        self.closed += 1


class Remote(Script):
    """A remote `Script`: keeps its answers until they are requested."""

    def __init__(self, *args: Any, lookahead_ns: int = 0, calls: list[str] | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.lookahead_ns, self.calls = lookahead_ns, calls if calls is not None else []
        self._waiting: list[Sequence[Event]] = []

    def ask(self, now_ns: int, inbox: Sequence[Event]) -> int | None:
        self.calls.append(f"ask {self.name}")
        step = self.step(now_ns, inbox)
        self._waiting.append(step.events)
        return step.next_ns

    def release(self) -> None:
        self.calls.append(f"release {self.name}")

    def answer(self) -> Sequence[Event]:
        self.calls.append(f"answer {self.name}")
        return self._waiting.pop(0)


def kernel_of(*federates: Federate, duration: int = 100, starts: bool = True, **options: Any) -> Kernel:
    """The kernel of a run, which is started."""
    kernel = Kernel(RunInfo(scenario="test", seed=0, duration_ns=duration, vehicles=()), federates, **options)
    if starts:
        kernel.start()
    return kernel


def run(*federates: Federate, **options: Any) -> list[tuple[int, str]]:
    """All events in the order of publication."""
    events: list[tuple[int, str]] = []
    kernel = kernel_of(*federates, **options)
    kernel.run(lambda event: events.append((event.time_ns, event.key)))
    kernel.close()
    return events


def test_an_instant_goes_world_radio_agent_send_apply() -> None:
    log: Log = []
    world = Script("world", Slot.WORLD, {10: [("car/state", 0)]}, wakes=("car/command",), wake_slot=Slot.APPLY, log=log)
    radio = Script("radio", Slot.RADIO, {10: [("car/heard", 0)]}, wakes=("car/send",), wake_slot=Slot.SEND, log=log)
    agent = Script("agent", Slot.AGENT, {10: [("car/send", 0), ("car/command", 0)]}, reads=("car/state", "car/heard"), log=log)
    assert run(agent, radio, world) == [(10, "car/state"), (10, "car/heard"), (10, "car/command"), (10, "car/send")]
    assert log == [
        ("world", 10, []),
        ("radio", 10, []),
        ("agent", 10, ["car/state", "car/heard"]),
        ("radio", 10, ["car/send"]),
        ("world", 10, ["car/command"]),
    ]


def test_within_a_slot_federates_step_by_name() -> None:
    log: Log = []
    run(*(Script(name, Slot.AGENT, {5: []}, log=log) for name in ("b", "c", "a")))
    assert [name for name, _, _ in log] == ["a", "b", "c"]


def test_a_future_event_is_delivered_at_its_time() -> None:
    log: Log = []
    radio = Script("radio", Slot.RADIO, {0: [("car/heard", 10), ("car/heard", 15), ("car/heard", 20)]})
    run(radio, Script("agent", Slot.AGENT, {10: [], 14: [], 20: []}, reads=("car/heard",), log=log))
    assert [len(inbox) for _, _, inbox in log] == [1, 0, 2]


def test_of_latest_keys_only_the_newest_event_is_delivered() -> None:
    log: Log = []
    world = Script("world", Slot.WORLD, {when: [("car/scan", 0), ("car/heard", 0)] for when in (0, 10, 20, 30)})
    run(world, Script("agent", Slot.AGENT, {20: [], 25: [], 30: []}, reads=("car/heard",), latest=("*/scan",), log=log))
    assert [sorted(inbox) for _, _, inbox in log] == [["car/heard"] * 3 + ["car/scan"], [], ["car/heard", "car/scan"]]


def test_a_future_event_wakes_at_its_own_time_and_cancels_no_own_step() -> None:
    log: Log = []
    agent = Script("agent", Slot.AGENT, {10: [("car/command", 7)], 20: [("car/command", 0)]})
    robot = Script("robot", Slot.WORLD, {0: [], 50: []}, wakes=("*/command",), wake_slot=Slot.APPLY, log=log)
    assert run(agent, robot) == [(17, "car/command"), (20, "car/command")]
    command = ["car/command"]
    assert log == [("robot", 0, []), ("robot", 17, command), ("robot", 20, command), ("robot", 50, [])]


def test_agents_do_not_step_at_the_end() -> None:
    log: Log = []
    federates = [Script(slot.name, slot, {99: [], 100: [], 101: []}, log=log) for slot in (Slot.WORLD, Slot.RADIO, Slot.AGENT)]
    run(*federates)
    before, at_the_end = [("WORLD", 99), ("RADIO", 99), ("AGENT", 99)], [("WORLD", 100), ("RADIO", 100)]
    assert [(name, when) for name, when, _ in log] == [*before, *at_the_end]


def test_nothing_due_after_the_end_is_published() -> None:
    radio = Script("radio", Slot.RADIO, {90: [("a/heard", 10), ("b/heard", 11)]})
    assert run(radio) == [(100, "a/heard")]


def test_all_remote_federates_are_asked_before_any_is_awaited() -> None:
    order: list[str] = []
    hosts = [Remote(f"host-{n}", Slot.AGENT, {0: []}, calls=order) for n in range(3)]
    run(*hosts)
    everyone = [f"host-{n}" for n in range(3)]
    assert order == [f"{verb} {name}" for verb in ("ask", "answer", "release") for name in everyone]


def test_with_a_lookahead_the_answer_is_awaited_only_when_it_takes_effect() -> None:
    order: list[str] = []

    class Physics(Script):
        def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
            order.append(f"physics {now_ns}")
            return super().step(now_ns, inbox)

    host = Remote("host", Slot.AGENT, {0: [("car/command", 25)], 10: [("car/command", 25)]}, lookahead_ns=25, calls=order)
    events = run(Physics("world", Slot.WORLD, {0: [], 10: [], 20: [], 30: []}), host, duration=50)
    assert events == [(25, "car/command"), (35, "car/command")]
    assert order[:4] == ["physics 0", "ask host", "physics 10", "ask host"]
    assert order.index("answer host") > order.index("physics 20")


@given(
    plan=st.lists(
        st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(0, 8), st.lists(st.integers(0, 12), max_size=3)),
        max_size=12,
        unique_by=lambda each: each[:2],
    ),
    lookahead=st.sampled_from([0, 3]),
)
def test_where_agents_run_does_not_change_the_order(plan: list[tuple[str, int, list[int]]], lookahead: int) -> None:
    tables: dict[str, dict[int, list[tuple[str, int]]]] = {"a": {}, "b": {}, "c": {}}
    for name, when, delays in plan:
        tables[name][10 * when] = [(f"{name}/command", lookahead + delay) for delay in delays]

    def radio() -> Script:
        return Script("radio", Slot.RADIO, wakes=("*/command",), wake_slot=Slot.SEND, answers=[("x/heard", 1), ("x/heard", 4)])

    def world() -> Script:
        return Script("world", Slot.WORLD, {when: [("x/state", 0)] for when in range(0, 100, 3)})

    together: dict[int, list[tuple[str, int]]] = {}
    for table in tables.values():
        for when, events in table.items():
            together.setdefault(when, []).extend(events)
    local = run(world(), Script("all", Slot.AGENT, together), radio())
    hosts = [Remote(name, Slot.AGENT, table, lookahead_ns=lookahead) for name, table in tables.items()]
    assert run(world(), *hosts, radio()) == local
    assert local == sorted(local, key=lambda event: event[0])


def faulty(**change: Any) -> Script:
    script = Script("faulty", Slot.AGENT, {0: [], 10: []})
    for name, value in change.items():
        setattr(script, name, value)
    return script


@pytest.mark.parametrize(
    ("federate", "words"),
    [
        (lambda: faulty(step=lambda now, inbox: Step([], now)), "requested at 0 ns its next step at 0 ns"),
        (lambda: faulty(step=lambda now, inbox: Step([note("x", now - 1)], None)), "returned x with the time -1 ns at 0 ns"),
        (lambda: faulty(step=lambda now, inbox: 1 / 0), "ZeroDivisionError: division by zero"),
        (lambda: faulty(start=lambda run: int("none")), "ValueError: invalid literal"),
    ],
)
def test_a_faulty_federate_is_named(federate: Callable[[], Script], words: str) -> None:
    with pytest.raises(FederateError, match=words) as raised:
        run(federate())
    assert raised.value.federate == "faulty"


def test_an_event_too_late_for_the_slot_that_it_wakes_is_refused() -> None:
    radio = Script("radio", Slot.RADIO, wakes=("car/command",), wake_slot=Slot.RADIO)
    with pytest.raises(FederateError, match="car/command, published in AGENT, is too late for RADIO"):
        run(Script("agent", Slot.AGENT, {0: [("car/command", 0)]}), radio)


def test_all_are_closed_even_if_one_fails() -> None:
    good, bad = Script("z", Slot.WORLD), Script("a", Slot.WORLD)
    bad.close = lambda: 1 / 0  # type: ignore[method-assign, assignment]
    with pytest.raises(FederateError, match="a: ZeroDivisionError"):
        kernel_of(good, bad, starts=False).close()
    assert good.closed == 1


def test_a_failed_release_still_closes_all() -> None:
    remote, good = Remote("a", Slot.AGENT), Script("z", Slot.WORLD)
    remote.release = lambda: 1 / 0  # type: ignore[method-assign, assignment]
    with pytest.raises(FederateError, match="a: ZeroDivisionError"):
        kernel_of(good, remote, starts=False).close()
    assert (remote.closed, good.closed) == (1, 1)


def test_a_wait_that_fails_is_over() -> None:
    remote = Remote("a", Slot.AGENT, {0: []})
    remote.answer = lambda: [note("x", 1 // 0)]  # type: ignore[method-assign]
    kernel = kernel_of(remote)
    with pytest.raises(FederateError):
        kernel.run(lambda _: None)
    assert not kernel.waiting


class Slow(Script):
    """A `Script` whose steps take 10 ns of a wall clock, and the one at 1000 ns more; the clock moves by sleeping, too."""

    def __init__(self, *args: Any, most_ns: int) -> None:
        super().__init__(*args)
        self.wall_ns, self.most_ns = 0, most_ns

    def clock(self, speed: float) -> WallClock:
        return WallClock(speed, now=lambda: self.wall_ns, sleep=self.sleep)

    def sleep(self, seconds: float) -> None:
        self.wall_ns += round(seconds * 1e9)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        self.wall_ns += self.most_ns if now_ns == 1000 else 10
        return super().step(now_ns, inbox)


def test_the_wall_clock_waits_for_every_instant_and_notes_lateness() -> None:
    slow = Slow("slow", Slot.WORLD, {0: [], 1000: [], 1100: [], 2000: []}, most_ns=300)
    kernel = kernel_of(slow, duration=2000, clock=slow.clock(2.0))
    kernel.run(lambda _: None)
    assert kernel.late_ns == [0, 0, 250, 0]  # 1100 is due at wall time 550; the step before took until 800
    assert slow.wall_ns >= 1000


def test_lateness_counts_at_ticks_only_despite_slips_and_answers_between() -> None:
    slow = Slow("agent", Slot.AGENT, {0: [], 1000: [], 2000: [], 3000: []}, most_ns=500)
    host = Remote("host", Slot.AGENT, {0: [], 1000: [], 2000: [], 3000: []}, lookahead_ns=300)
    world, clock = Script("world", Slot.WORLD, {1100: [], 1300: [], 2600: []}), slow.clock(1.0)
    kernel = kernel_of(slow, host, world, duration=4000, clock=clock, tolerance_ns=100)
    kernel.run(lambda _: None)
    assert clock.slipped_ns == 400  # at 1100, which is not a tick
    assert kernel.late_ns == [0, 0, 400, 0]  # start of the next tick, relative to the schedule before the slip


def test_a_polled_federate_is_stepped_first_in_the_instant() -> None:
    """Even at an instant at which no federate of its slot is due."""
    log: Log = []

    class PolledScript(Script):
        def poll(self, now_ns: int) -> bool:
            return now_ns in (30, 70)

    polled_federate = PolledScript("asked", Slot.WORLD, {40: []}, log=log)
    world = Script("world", Slot.WORLD, {0: [], 50: []}, log=log)
    radio = Script("radio", Slot.RADIO, {30: [], 70: []}, log=log)
    run(world, radio, polled_federate)
    steps = [(name, when) for name, when, _ in log if when in (30, 70)]
    assert steps == [("asked", 30), ("radio", 30), ("asked", 70), ("radio", 70)]


def test_the_clock_is_called_before_any_step_of_an_instant() -> None:
    log: Log = []

    class Stop(Exception):
        pass

    class Stopping(SimClock):
        def wait_until(self, due_ns: int) -> int:
            if due_ns == 50:
                raise Stop
            return 0

    kernel = kernel_of(Script("world", Slot.WORLD, {0: [], 50: []}, log=log), clock=Stopping())
    with pytest.raises(Stop):
        kernel.run(lambda _: None)
    assert (kernel.now_ns, [when for _, when, _ in log]) == (0, [0])


class SocketScript(Script):
    """A federate with a socket: each byte that it reads, a letter, is an event of the current instant."""

    def __init__(self, inside: socket.socket, **kwargs: Any) -> None:
        super().__init__("door", Slot.WORLD, **kwargs)
        self.inside, self.letters = inside, 0
        inside.setblocking(False)

    def fileno(self) -> int:
        return self.inside.fileno()

    def poll(self, now_ns: int) -> bool:
        try:
            self.letters += len(self.inside.recv(100))
        except BlockingIOError:
            return False
        return True

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        letters, self.letters = self.letters, 0
        return Step([note("door/letter", now_ns)] * letters, super().step(now_ns, inbox).next_ns)


class Wall:
    """A wall clock that moves only by sleeping; letters arrive during a sleep, at their own times."""

    def __init__(self, outside: socket.socket, letters: Sequence[int]) -> None:
        self.now_ns, self.outside, self.letters = 0, outside, list(letters)

    def watch(self, clock: WallClock, kernel: Kernel) -> None:
        wake = clock.sleep

        def sleep(seconds: float) -> bool | None:
            until_ns = self.now_ns + round(seconds * SECOND_NS)
            if self.letters and self.letters[0] <= until_ns:
                self.now_ns = self.letters.pop(0)
                self.outside.send(b"!")
            else:
                self.now_ns = until_ns
            return wake(0.0)

        clock.sleep = sleep


@pytest.fixture(params=[False, True], ids=["", "many files open"])
def letter_box(request: pytest.FixtureRequest) -> Iterator[tuple[socket.socket, socket.socket]]:
    inside, outside = socket.socketpair()
    with inside, outside:
        if not request.param:
            yield inside, outside
            return
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
        try:
            with socket.socket(fileno=fcntl.fcntl(inside.fileno(), fcntl.F_DUPFD, 1500)) as high:
                yield high, outside
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_failed_poll_names_the_federate() -> None:
    class Torn(Script):
        def poll(self, now_ns: int) -> bool:
            raise RuntimeError("torn")

    with pytest.raises(FederateError, match="door: RuntimeError: torn"):
        run(Torn("door", Slot.WORLD, {0: []}))


def test_a_run_stopped_in_a_poll_does_not_wait_for_the_next_instant(
    letter_box: tuple[socket.socket, socket.socket],
) -> None:
    inside, outside = letter_box

    class Stopping(SocketScript):
        def poll(self, now_ns: int) -> bool:
            if now_ns and super().poll(now_ns):
                kernel.stop = True
            return False

    long_ns = 60 * SECOND_NS
    world = Script("world", Slot.WORLD, {0: [], long_ns: []})
    outside.send(b"!")
    kernel = kernel_of(Stopping(inside), world, duration=long_ns, clock=WallClock())
    with pytest.raises(KeyboardInterrupt):
        kernel.run(lambda _: None)
    assert kernel.now_ns < long_ns


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_a_letter_between_two_instants_has_its_own_instant(
    letter_box: tuple[socket.socket, socket.socket], speed: float
) -> None:
    inside, outside = letter_box
    wall = Wall(outside, [10, 25, 40])
    clock = WallClock(speed, now=lambda: wall.now_ns)
    world = Script("world", Slot.WORLD, {each: [("world/tick", 0)] for each in (0, 50, 100)})
    kernel = kernel_of(SocketScript(inside), world, clock=clock)
    listen = kernel._listen

    def then_watch() -> None:
        listen()
        wall.watch(clock, kernel)

    kernel._listen = then_watch  # type: ignore[method-assign]
    events: list[tuple[int, str]] = []
    kernel.run(lambda event: events.append((event.time_ns, event.key)))
    letters = [(round(each * speed), "door/letter") for each in (10, 25, 40) if each * speed < 100]
    ticks = [(each, "world/tick") for each in (0, 50, 100)]
    assert events == sorted([*letters, *ticks], key=lambda each: (each[0], each[1]))


def test_without_waits_letters_are_read_at_the_next_instant(
    letter_box: tuple[socket.socket, socket.socket],
) -> None:
    inside, outside = letter_box
    outside.send(b"!!")
    world = Script("world", Slot.WORLD, {0: [("world/tick", 0)], 60: [("world/tick", 0)]})
    assert run(SocketScript(inside), world) == [(0, "door/letter"), (0, "door/letter"), (0, "world/tick"), (60, "world/tick")]


@pytest.mark.parametrize("names", [("a", "z"), ("z", "a")])
def test_remote_events_of_a_key_are_published_first(names: tuple[str, str]) -> None:
    """A vehicle's agent may run on a remote host, or locally under a name that sorts before other senders of its key."""
    here, elsewhere = names
    values: list[object] = []

    class Local(Script):
        def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
            return Step([note("car/send", now_ns, 1.0)])

    class Away(Remote):
        def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
            return Step([note("car/send", now_ns, 2.0)])

    kernel = kernel_of(Local(here, Slot.AGENT, {0: []}), Away(elsewhere, Slot.AGENT, {0: []}))
    kernel.run(lambda event: values.append(event.value))
    assert values == [Note(values={"value": 2.0}), Note(values={"value": 1.0})]


def test_a_run_leaves_the_collector_of_its_process_as_it_was() -> None:
    before, during = gc.get_threshold(), list[int]()
    kernel = kernel_of(Script("a", Slot.WORLD, {0: [("a/note", 0)]}))

    def observe(_: Event) -> None:
        during.append(gc.get_threshold()[0])
        raise ValueError("the disk is full")

    with pytest.raises(FederateError, match="the disk is full"):
        kernel.run(observe)
    assert during[0] >= before[0]
    assert gc.get_threshold() == before
