"""The kernel: one SimPy environment, one logical time, and the order in which federates step (see `cosim.federate`).

Each instant with anything to do holds up to five slots; a slot is one SimPy event with the slot's priority. In a slot

1. answers that fall due now are collected from remote federates with a lookahead,
2. events of this time are published: recorded and put into the inboxes of their readers,
3. due remote federates are asked, due local ones are stepped, and the answers are awaited,
4. the resulting events are published; of one key, remote federates' events come first.

Events are published in the order of (time, slot, key, order of giving); a future event belongs to its federate's own slot of
that instant. Neither order depends on where a federate runs or on how long it takes, so a run gives the same bytes in one
process and in many.
"""

import contextlib
import gc
import heapq
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import TypeVar

import simpy
from threadpoolctl import ThreadpoolController

from vcmvsp.cosim.clock import SECOND_NS, Clock, SimClock, WallClock
from vcmvsp.cosim.errors import FederateError, VcmvspError, words_of
from vcmvsp.cosim.federate import (
    Driven,
    Event,
    Federate,
    Polled,
    Prompted,
    Releasable,
    RemoteFederate,
    RunInfo,
    Slot,
    Waiting,
    matches,
)
from vcmvsp.cosim.util.polling import readable

Observer = Callable[[Event], None]
Route = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
"""Readers of a key: federates that read every event, that it wakes, and that keep only the newest."""
Given = dict[str, list[Event]]
"""Events of a slot by key, in the order of giving."""
_time = attrgetter("time_ns")

T = TypeVar("T")

_COLLECTED = 50_000  # net allocations between two garbage collections


class Exchange:
    """The event bus of one run.

    Args:
        federates: publishers and readers of events, numbered in this order.
        wake: schedules a step of a federate at a time (ns), because an event of that time wakes it.
    """

    def __init__(self, federates: Sequence[Federate], wake: Callable[[int, int], None]) -> None:
        self.observe: Observer = lambda _: None
        self._federates, self._wake = federates, wake
        self._inbox: list[list[Event]] = [[] for _ in federates]
        self._newest: list[dict[str, Event]] = [{} for _ in federates]
        self._future: list[tuple[int, Slot]] = []  # heap of the future slots with events
        self._later: dict[tuple[int, Slot], Given] = {}  # events of these slots
        self._present: Given = {}  # events of the current slot
        self._routes: dict[str, Route] = {}
        self._subscriptions = [_Subscriptions(federates, kind) for kind in ("reads", "wakes", "latest")]

    def inbox(self, index: int) -> Sequence[Event]:
        """Take the events that a federate has not read yet, in order of time."""
        inbox, self._inbox[index] = self._inbox[index], []
        if newest := self._newest[index]:
            latest = sorted(newest.values(), key=_time)
            newest.clear()
            if inbox and inbox[-1].time_ns < latest[0].time_ns:  # the usual case: the newest events are of this instant only
                inbox += latest
            else:
                inbox = sorted(latest + inbox, key=_time)
        return inbox

    def give(self, index: int, events: Sequence[Event], now: int, slot: Slot) -> None:
        """Accept the events that a federate gave in a slot, and schedule the steps that they cause."""
        home, routes = self._federates[index].slot, self._routes
        last, by_key = now, self._present
        woken: tuple[int, tuple[int, ...]] = now, ()
        for event in events:
            when, key = event.time_ns, event.key
            route = routes.get(key) or self._route(key)
            if when != last:  # many successive events have one time: commands of a tick
                if when < now:
                    raise FederateError(self._federates[index].name, f"returned {key} with the time {when} ns at {now} ns")
                last, by_key = when, self._present if when == now else self._those_of(when, home)
            if key in by_key:
                by_key[key].append(event)
            else:
                by_key[key] = [event]
            if route[1] and (when, route[1]) != woken:  # many senders wake the radio at once
                woken = when, route[1]
                for each in route[1]:
                    self._check(each, key, slot if when == now else home)
                    self._wake(each, when)

    def publish(self, now: int, slot: Slot) -> None:
        """Publish all events up to this slot of this instant."""
        future, moment = self._future, (now, slot)
        due, self._present = self._present, {}
        while future and future[0] < moment:
            self._tell(self._later.pop(heapq.heappop(future)))
        if future and future[0] == moment:
            present, due = due, self._later.pop(heapq.heappop(future))
            for key, events in present.items():  # earlier events of a key come first
                due[key] = due[key] + events if key in due else events
        if due:
            self._tell(due)

    def _tell(self, by_key: Given) -> None:
        observe, inboxes, newest, routes = self.observe, self._inbox, self._newest, self._routes
        for key in sorted(by_key):
            events, (readers, _, keepers) = by_key[key], routes[key]
            try:
                for event in events:
                    observe(event)
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # user-defined observers may raise anything
                raise FederateError("recording", words_of(error)) from error
            for index in readers:
                inboxes[index] += events
            for index in keepers:
                newest[index][key] = events[-1]

    def _those_of(self, when: int, slot: Slot) -> Given:
        place = when, slot
        by_key = self._later.get(place)
        if by_key is None:
            by_key = self._later[place] = {}
            heapq.heappush(self._future, place)
        return by_key

    def _check(self, index: int, key: str, at: Slot) -> None:
        """Refuse an event that is published too late to wake a federate in its slot."""
        federate = self._federates[index]
        if federate.wake_slot <= at:
            raise FederateError(federate.name, f"{key}, published in {at.name}, is too late for {federate.wake_slot.name}")

    def _route(self, key: str) -> Route:
        route = self._routes.get(key)
        if route is None:
            reads, wakes, latest = (each.readers(key) for each in self._subscriptions)
            route = self._routes[key] = reads, wakes, latest
        return route


class _Subscriptions:
    """Key expressions of one kind, of all federates; plain keys are looked up, as each vehicle has some."""

    def __init__(self, federates: Sequence[Federate], kind: str) -> None:
        self._plain: defaultdict[str, list[int]] = defaultdict(list)
        self._patterns: list[tuple[str, int]] = []
        for index, federate in enumerate(federates):
            for each in getattr(federate, kind):
                if "*" in each:
                    self._patterns.append((each, index))
                else:
                    self._plain[each].append(index)

    def readers(self, key: str) -> tuple[int, ...]:
        """Federates with an expression that matches a key, in their order."""
        matching = [index for expression, index in self._patterns if matches(expression, key)]
        return tuple(sorted({*matching, *self._plain.get(key, ())}))


class Kernel:
    """Runs federates from time 0 to ``run.duration_ns``.

    Agents act at 0 <= t < duration; at the duration itself the world publishes once more and the run ends.
    """

    def __init__(
        self,
        run: RunInfo,
        federates: Sequence[Federate],  # with unique names
        *,
        clock: Clock | None = None,  # pace of the run; default: as fast as possible
        tolerance_ns: int | None = None,  # allowed lag of an instant behind the wall clock; None: any
        strict: bool = False,  # a lag beyond the tolerance ends the run; else the run slips against the wall clock
    ) -> None:
        self.run_info, self.now_ns = run, 0
        self.late_ns: list[int] = []  # lag of each tick of agents, including the slip since the previous tick
        self._slipped_ns = 0  # since the previous tick
        self._has_agents = any(each.slot is Slot.AGENT for each in federates)
        self._federates = sorted(federates, key=lambda each: each.name)
        self._blames = [_blame(each) for each in self._federates]
        self._remote = {i: each for i, each in enumerate(self._federates) if isinstance(each, RemoteFederate)}
        self._driven = {i: each for i, each in enumerate(self._federates) if isinstance(each, Driven)}
        self._half: tuple[int, Slot, list[tuple[int, Sequence[Event]]]] | None = None  # a slot that waits for the caller
        self._last_ns = -1  # the last instant
        self._waiting = frozenset(i for i, each in enumerate(self._federates) if isinstance(each, Waiting) and each.waits)
        self._polled = {i: each for i, each in enumerate(self._federates) if isinstance(each, Polled)}
        self._clock, self._tolerance_ns, self._strict = clock or SimClock(), tolerance_ns, strict
        self._events = Exchange(self._federates, self._wake)
        self._released, self._parted = False, list[VcmvspError]()  # errors while federates were released
        self.waiting = False  # the kernel waits for the clock or for an answer and may be interrupted
        self.stop = False  # set to end the run before the next slot, as with Ctrl-C
        self._env = simpy.Environment(initial_time=0)
        self._due: dict[tuple[int, Slot], dict[int, bool]] = {}  # (time, slot) -> {federate: woken by an event?}
        self._next: list[int | None] = [None] * len(self._federates)
        self._open: dict[tuple[int, Slot], list[int]] = {}  # (time, slot) -> federates with an answer due there

    def start(self) -> None:
        """Start all federates; errors in their set-up are raised here."""
        for index, federate in enumerate(self._federates):
            with self._blames[index]:
                self._schedule(index, self._await(lambda: federate.start(self.run_info)))  # noqa: B023  called at once

    def run(self, observe: Observer, *, on_instant: Callable[[int], None] | None = None) -> None:
        """Step the started federates until the end; the caller closes them (`close`).

        Args:
            observe: called with every event, in the order of publication (the recording).
        """
        self.begin(observe)
        while self.advance(on_instant):
            pass

    def begin(self, observe: Observer) -> None:
        """Prepare for `advance`; arguments as of `run`."""
        self._events.observe = observe
        self._libraries = ThreadpoolController()  # of linear algebra
        self._clock.start()
        self._listen()

    def advance(self, on_instant: Callable[[int], None] | None = None) -> bool:
        """Step the federates until one of them waits for the caller (`Driven`): True; or until the end: False."""
        with self._libraries.limit(limits=1), _seldom_collected():  # sums do not depend on the number of cores
            return self._advance(on_instant)

    def _advance(self, on_instant: Callable[[int], None] | None) -> bool:
        if self._half is not None:
            half, self._half = self._half, None
            self._end_slot(*half)
        last, end_ns = self._last_ns, self.run_info.duration_ns
        while (now := self._env.peek()) <= end_ns:
            if now != last:
                last = self._last_ns = self._wait_until(last, int(now))
                if on_instant:
                    on_instant(last)
                self._poll(last)
            if self.stop:
                raise KeyboardInterrupt
            if self._env.peek() <= last:  # else the federate that woke the clock needs no step
                self._env.step()
                if self._half is not None:
                    return True
        self.now_ns = end_ns
        self._events.publish(end_ns, Slot.RADIO)
        for index, federate in self._driven.items():
            with self._blames[index]:
                federate.finish(end_ns, self._events.inbox(index))
        return False

    def _poll(self, now_ns: int) -> None:
        for index, federate in self._polled.items():
            with self._blames[index]:
                when = federate.poll(now_ns)
            if when:
                self._schedule(index, now_ns)

    def _listen(self) -> None:
        doors = [each.fileno() for each in self._federates if isinstance(each, Prompted)]
        open_ = [each for each in doors if each >= 0]
        if open_ and isinstance(self._clock, WallClock):
            self._clock.sleep = lambda seconds: bool(readable(open_, seconds))

    def _wait_until(self, last: int, when: int) -> int:
        """Wait for the next instant; returns its time, which is earlier if a prompted federate became readable."""
        late_ns = self._await(lambda: self._clock.wait_until(when))
        if late_ns < 0:
            self.now_ns = max(last + 1, when + late_ns)
            return self.now_ns
        self.now_ns = when
        self._note_late(when, late_ns)
        return when

    def _note_late(self, when: int, late_ns: int) -> None:
        too_late = self._tolerance_ns is not None and late_ns > self._tolerance_ns
        if self._clock.speed is not None and self._is_tick(when):
            self.late_ns.append(self._slipped_ns + late_ns)
            self._slipped_ns = 0
        elif too_late:
            self._slipped_ns += late_ns
        if too_late and not self._strict:
            self._clock.slip(late_ns)
        elif too_late:
            late = f"{when / SECOND_NS:.3f} s began {late_ns / SECOND_NS:.3f} s late, more than clock.tolerance_s"
            raise FederateError("clock", f"{late}; use fewer or faster agents, a faster machine, or clock.late = 'slip'")

    def _is_tick(self, when: int) -> bool:
        if not self._has_agents:
            return True
        due = self._due.get((when, Slot.AGENT), ())  # the slot may also hold a due answer or woken agents
        return when < self.run_info.duration_ns and any(self._next[index] == when for index in due)

    def _await(self, wait: Callable[[], T]) -> T:
        self.waiting = True
        try:
            return wait()
        finally:
            self.waiting = False

    def close(self) -> None:
        """Close every federate, even if one of them fails; the first failure is raised at the end."""
        self.release()
        for federate in self._federates:
            self._part(federate, federate.close)
        if self._parted:
            raise self._parted[0]

    def release(self) -> None:
        """Tell federates with remote parts that the run is over, so that a robot stops before any file is written."""
        if not self._released:
            self._released = True
            for federate in self._federates:
                if isinstance(federate, Releasable):
                    self._part(federate, federate.release)

    def _part(self, federate: Federate, farewell: Callable[[], None]) -> None:
        try:
            with _blame(federate):
                farewell()
        except VcmvspError as error:
            self._parted.append(error)

    def _schedule(self, index: int, when: int | None) -> None:
        self._next[index] = when
        if when is not None:
            self._slot(when, self._federates[index].slot).setdefault(index, False)

    def _slot(self, when: int, slot: Slot) -> dict[int, bool]:
        """The entry of a slot; a new one is put into SimPy's queue."""
        entry = self._due.get((when, slot))
        if entry is None:
            entry = self._due[when, slot] = {}
            event = simpy.Event(self._env)
            event._ok, event._value = True, None  # noqa: SLF001  triggered, as simpy.Timeout does it
            event.callbacks.append(lambda _: self._run_slot(when, slot))
            self._env.schedule(event, priority=slot, delay=when - self._env.now)  # type: ignore[arg-type]  # any integer sorts
        return entry

    def _wake(self, index: int, when: int) -> None:
        self._slot(when, self._federates[index].wake_slot)[index] = True

    def _run_slot(self, now: int, slot: Slot) -> None:
        entry = self._due.pop((now, slot))
        if now == self.run_info.duration_ns and slot >= Slot.AGENT:
            return  # at the end only the world steps
        self._collect(now, slot)
        self._events.publish(now, slot)
        due = sorted([index for index, woken in entry.items() if woken or self._next[index] == now])
        for index in due if self._remote else ():
            if index in self._remote:
                self._ask(index, now)
        steps = [(index, self._step(index, now)) for index in due if index not in self._remote]
        if not self._driven or self._driven.keys().isdisjoint(due):
            self._end_slot(now, slot, steps)
        else:
            self._half = now, slot, steps

    def _end_slot(self, now: int, slot: Slot, steps: Sequence[tuple[int, Sequence[Event]]]) -> None:
        self._collect(now, slot)  # before local events: a federate may be remote in one run and local in another
        for index, events in steps:
            self._events.give(index, events, now, slot)
        self._events.publish(now, slot)

    def _step(self, index: int, now: int) -> Sequence[Event]:
        with self._blames[index]:
            federate, inbox = self._federates[index], self._events.inbox(index)
            step = self._await(lambda: federate.step(now, inbox)) if index in self._waiting else federate.step(now, inbox)
        self._schedule_next(index, step.next_ns, now)
        return step.events

    def _ask(self, index: int, now: int) -> None:
        federate = self._remote[index]
        with self._blames[index]:
            next_ns = federate.ask(now, self._events.inbox(index))
        self._open.setdefault((now + federate.lookahead_ns, federate.slot), []).append(index)
        if federate.lookahead_ns:
            self._slot(now + federate.lookahead_ns, federate.slot)
        self._schedule_next(index, next_ns, now)

    def _schedule_next(self, index: int, when: int | None, now: int) -> None:
        if when is not None and when <= now:
            raise FederateError(self._federates[index].name, f"requested at {now} ns its next step at {when} ns (not later)")
        self._schedule(index, when)

    def _collect(self, now: int, slot: Slot) -> None:
        for index in sorted(self._open.pop((now, slot), ())) if self._open else ():
            with self._blames[index]:
                events = self._await(self._remote[index].answer)
            self._events.give(index, events, now, slot)


@contextlib.contextmanager
def _seldom_collected() -> Iterator[None]:
    """Make garbage collections rare: events hold no cycles, and thousands of them wait at a time."""
    before = gc.get_threshold()
    gc.set_threshold(max(before[0], _COLLECTED), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


class _blame:  # noqa: N801  reads as a word: with _blame(federate)
    """Names the federate in any exception of its block, unless that is a `VcmvspError` already."""

    def __init__(self, federate: Federate) -> None:
        self._name = federate.name

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if error is not None and not isinstance(error, VcmvspError | KeyboardInterrupt):
            details = "".join(traceback.format_exception(error))
            raise FederateError(self._name, words_of(error), details=details) from error
