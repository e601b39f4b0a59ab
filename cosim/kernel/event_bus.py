"""The events between federates: who reads what, what is still to come, and what has not been read yet.

Events are published in the order of (time, slot, key, order of giving); one of the future belongs to its giver's own slot of
that instant. Published is: shown to the observer, which is the recording, and put into the inboxes of those who read it.
"""

import heapq
from collections.abc import Callable, Sequence
from operator import attrgetter

from vcmvsp.cosim.errors import FederateError, words_of
from vcmvsp.cosim.federate import Event, Federate, Slot
from vcmvsp.cosim.util.key_expressions import matches

Observer = Callable[[Event], None]
Route = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
"""Of a key: who reads every event, whom it wakes, who keeps only the newest."""
Given = dict[str, list[Event]]
"""Events of a slot by their keys, in the order of giving."""
_time = attrgetter("time_ns")


class Exchange:
    """The events of one run.

    Args:
        federates: who gives and reads them; numbered in this order.
        wake: has one of them stepped at a time (ns), because an event of that time wakes it.
    """

    def __init__(self, federates: Sequence[Federate], wake: Callable[[int, int], None]) -> None:
        self.observe: Observer = lambda _: None
        self._federates, self._wake = federates, wake
        self._inbox: list[list[Event]] = [[] for _ in federates]
        self._newest: list[dict[str, Event]] = [{} for _ in federates]
        self._future: list[tuple[int, Slot]] = []  # heap of the slots to come for which events were given
        self._given: dict[tuple[int, Slot], Given] = {}  # these events
        self._present: Given = {}  # those that belong to the slot that is being worked off
        self._routes: dict[str, Route] = {}

    def inbox(self, index: int) -> Sequence[Event]:
        """What a federate has not read yet, in order of time; now it has."""
        inbox, self._inbox[index] = self._inbox[index], []
        if newest := self._newest[index]:
            kept = sorted(newest.values(), key=_time)
            newest.clear()
            if inbox and inbox[-1].time_ns < kept[0].time_ns:  # as it is with what is known of this instant alone
                inbox += kept
            else:
                inbox = sorted(kept + inbox, key=_time)
        return inbox

    def give(self, index: int, events: Sequence[Event], now: int, slot: Slot) -> None:
        """Take what a federate gave in a slot; an event of the future that wakes someone has its instant scheduled."""
        home, routes = self._federates[index].slot, self._routes
        last, given = now, self._present
        woken: tuple[int, tuple[int, ...]] = now, ()
        for event in events:
            when, key = event.time_ns, event.key
            route = routes.get(key) or self._route(key)
            if when != last:  # many follow each other that are of one time: receptions of a frame
                if when < now:
                    raise FederateError(self._federates[index].name, f"gave {key} of {when} ns at {now} ns")
                last, given = when, self._present if when == now else self._those_of(when, home)
            if key in given:
                given[key].append(event)
            else:
                given[key] = [event]
            if route[1] and (when, route[1]) != woken:  # as many who send at once wake the radio
                woken = when, route[1]
                for each in route[1]:
                    self._check(each, key, slot if when == now else home)
                    self._wake(each, when)

    def publish(self, now: int, slot: Slot) -> None:
        """Publish all events up to this slot of this instant."""
        future, here = self._future, (now, slot)
        due, self._present = self._present, {}
        while future and future[0] < here:
            self._tell(self._given.pop(heapq.heappop(future)))
        if future and future[0] == here:
            present, due = due, self._given.pop(heapq.heappop(future))
            for key, events in present.items():  # of one key, what was given earlier comes first
                due[key] = due[key] + events if key in due else events
        if due:
            self._tell(due)

    def _tell(self, given: Given) -> None:
        """Publish the events of one slot."""
        observe, inboxes, newest, routes = self.observe, self._inbox, self._newest, self._routes
        for key in sorted(given):
            events, (readers, _, keepers) = given[key], routes[key]
            try:
                for event in events:
                    observe(event)
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # whatever somebody's own observer raises
                raise FederateError("recording", words_of(error)) from error
            for index in readers:
                inboxes[index] += events
            for index in keepers:
                newest[index][key] = events[-1]

    def _those_of(self, when: int, slot: Slot) -> Given:
        """The events given for a slot to come."""
        place = when, slot
        given = self._given.get(place)
        if given is None:
            given = self._given[place] = {}
            heapq.heappush(self._future, place)
        return given

    def _check(self, index: int, key: str, at: Slot) -> None:
        """Refuse an event whose slot is not before the one in which it wakes a federate."""
        federate = self._federates[index]
        if federate.wake_slot <= at:
            raise FederateError(federate.name, f"{key}, published in {at.name}, comes too late for {federate.wake_slot.name}")

    def _route(self, key: str) -> Route:
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = (
                self._whose(lambda each: each.reads, key),
                self._whose(lambda each: each.wakes, key),
                self._whose(lambda each: each.latest, key),
            )
        return route

    def _whose(self, expressions: Callable[[Federate], Sequence[str]], key: str) -> tuple[int, ...]:
        """The federates with an expression that matches the key."""
        return tuple(i for i, each in enumerate(self._federates) if any(matches(one, key) for one in expressions(each)))
