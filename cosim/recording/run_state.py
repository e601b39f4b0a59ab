"""The newest values of a run, updated by each event, for the terminal table and the control station.

Memory does not grow with the length of a run: frames are counted, everything else keeps its newest value.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim import types
from vcmvsp.cosim.federate import Event, vehicle_of
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording import event_text

MOST_LINES = 200  # log lines kept
MOST_BATCHES = 256  # of receptions that wait
COMMANDERS = ("commander", "mode")  # names under which agents note their commander
LOGGED_NOTES = "found", "lost", "task", "target", "commander", "mode", "shape", "status"
"""Names of the notes whose changes are log lines: what a vehicle does or has found."""
LOGGED_NOTES_SET = frozenset(LOGGED_NOTES)
BY_VEHICLE: Mapping[type, str] = {
    types.Follows: "places",
    types.Fix: "fixes",
    types.Sightings: "sightings",
    types.ProbabilityMap: "maps",
    types.Mosaic: "mosaics",
    types.RealStatus: "real",
    types.Presence: "presence",
}
"""Types with a newest value per vehicle, and the name of each collection."""


class LogLine(types.Value, frozen=True, kw_only=True):
    """A line of the log."""

    time_ns: int
    level: str  # debug, info, warning, error, fatal
    text: str


def changes(vehicle: str, time_ns: int, before: Mapping[str, Any], noted: Mapping[str, Any]) -> Iterator[LogLine]:
    """A log line for each of `LOGGED_NOTES` that differs from the vehicle's earlier notes."""
    for name in LOGGED_NOTES:
        value = noted.get(name)
        if value and not isinstance(value, float) and value != before.get(name):
            yield LogLine(time_ns=time_ns, level="info", text=f"{vehicle}: {name} {value}")


class RunState:
    """The newest values of a run.

    Attributes:
        newest: collections of values by key: those in `BY_VEHICLE`; ``notes`` and ``heard_ns`` (last arrival) per vehicle;
            ``frames`` per sender; ``pushed``, the pose of each obstacle (x, y, z m, yaw rad); ``states``.
        fresh: collection and key of each value since the reader last cleared it, in order.
        tallies: by sender and receivers: frames, and frames received by each receiver, (1 + receivers,) int64.
        commanders: commander of each vehicle, as its agent notes it.
        halted: vehicles stopped by the operator.
        handlers: by the types of values that count here.
        lines: log lines of incidents, operator actions and `LOGGED_NOTES`.
    """

    def __init__(self) -> None:
        collections = (*BY_VEHICLE.values(), "notes", "heard_ns", "frames", "pushed", "states")
        self.newest: dict[str, dict[str, Any]] = {name: {} for name in collections}
        self.fresh: dict[tuple[str, str], None] = {}
        self.tallies: dict[tuple[str, tuple[str, ...]], types.Array] = {}
        self.commanders: dict[str, str] = {}
        self.halted: set[str] = set()
        self.lines: deque[LogLine] = deque(maxlen=MOST_LINES)
        self._receptions: list[types.Receptions] = []  # not in ``heard_ns`` yet
        self.handlers: dict[type, Callable[[str, int, Any], None]] = {  # by the key, time and value of an event
            types.States: lambda _, __, states: self.keep("states", "", states),
            types.FrameReport: self._on_frame,
            types.Receptions: self._on_receptions,
            types.Note: self._on_note,
            **dict.fromkeys(BY_VEHICLE, self._on_newest),
            types.Presence: self._on_presence,
            **dict.fromkeys((types.Incident, types.Contact, types.Outage, types.Changed, types.Moved), self._tell),
            types.Halted: self._on_halted,
            types.Pushed: self._on_pushed,
        }

    def on(self, event: Event) -> None:
        """Update from an event; times never decrease."""
        handler = self.handlers.get(type(event.value))
        if handler is not None:
            handler(event.key, event.time_ns, event.value)

    def keep(self, collection: str, key: str, value: object) -> None:
        """Store a value as the newest of its key."""
        self.newest[collection][key] = value
        self.fresh[collection, key] = None

    def say(self, time_ns: int, level: str, text: str) -> None:
        """Add a log line."""
        self.lines.append(LogLine(time_ns=time_ns, level=level, text=text))

    def _on_frame(self, _: str, time_ns: int, report: types.FrameReport) -> None:
        ends = report.sender, report.receivers
        tally = self.tallies.get(ends)
        if tally is None:
            tally = self.tallies[ends] = np.zeros(1 + len(report.receivers), np.int64)
        tally[0] += 1
        tally[1:] += report.received_ns >= 0
        self.keep("frames", report.sender, report)

    def settle(self) -> None:
        """Bring ``heard_ns`` up to date: call it before reading, since each reception costs too much by itself."""
        batches, self._receptions = self._receptions, []
        if batches:
            newest_ns = np.full(len(batches[0].names), -1)
            receiver = np.concatenate([batch.receiver for batch in batches])
            np.maximum.at(newest_ns, receiver, np.concatenate([batch.arrival_ns for batch in batches]))
            for row in np.flatnonzero(newest_ns >= 0).tolist():
                self.keep("heard_ns", batches[0].names[row], int(newest_ns[row]))

    def _on_receptions(self, _: str, time_ns: int, batch: types.Receptions) -> None:
        self._receptions.append(batch)
        if len(self._receptions) > MOST_BATCHES:
            self.settle()

    def _on_note(self, key: str, time_ns: int, note: types.Note) -> None:
        vehicle, values = vehicle_of(key), note.values
        newest = self.newest["notes"].get(vehicle, {})
        changed = [name for name in LOGGED_NOTES_SET.intersection(values) if values[name] != newest.get(name)]
        if changed:  # rarely: agents note their mode at every tick
            self.lines.extend(changes(vehicle, time_ns, newest, values))
            for name in COMMANDERS:
                if name in values:
                    self.commanders[vehicle] = str(values[name])
        newest.update(values)
        self.keep("notes", vehicle, newest)

    def _on_newest(self, key: str, time_ns: int, value: object) -> None:
        self.keep(BY_VEHICLE[type(value)], vehicle_of(key), value)

    def _on_presence(self, key: str, time_ns: int, presence: types.Presence) -> None:
        self._on_newest(key, time_ns, presence)
        self._tell(key, time_ns, presence)

    def _on_halted(self, key: str, time_ns: int, halted: types.Halted) -> None:
        (self.halted.update if halted.halted else self.halted.difference_update)(halted.vehicles)
        self._tell(key, time_ns, halted)

    def _on_pushed(self, _: str, time_ns: int, pushed: types.Pushed) -> None:
        for name, place, attitude in zip(pushed.names, pushed.position.tolist(), pushed.attitude.tolist(), strict=True):
            self.keep("pushed", name, (*place, yaw_of(attitude)))

    def _tell(self, key: str, time_ns: int, event: event_text.Told) -> None:
        self.say(time_ns, *event_text.of_event(vehicle_of(key), event, time_ns))
