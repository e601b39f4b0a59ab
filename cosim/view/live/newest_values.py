"""The newest of everything that a run says: what a `PageUpdate` is made of.

Nothing here grows with the length of a run. Frames are counted one by one, and of each sender the newest is kept.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording import event_text
from vcmvsp.cosim.types import (
    Array,
    Changed,
    Contact,
    Fix,
    Follows,
    FrameReport,
    Halted,
    Image,
    Incident,
    Later,
    Mosaic,
    Moved,
    Note,
    Outage,
    Presence,
    ProbabilityMap,
    Pushed,
    RealStatus,
    Reception,
    Scan,
    Sightings,
    States,
)
from vcmvsp.cosim.view.messages import LinkStatus, LogLine, Pace, PageUpdate, Scenery

MOST_LINES = 200  # between two messages; older ones give way

Pose = tuple[float, float, float, float]
Poses = Mapping[str, Callable[[float], Pose]]
Places = Mapping[str, Callable[[float], tuple[float, float]]]

_BY_VEHICLE: Mapping[type, str] = {
    Follows: "places",
    Fix: "fixes",
    Sightings: "sightings",
    ProbabilityMap: "maps",
    Mosaic: "mosaics",
    RealStatus: "real",
    Presence: "presence",
}
_BY_SENSOR: Mapping[type, str] = {Scan: "scans", Image: "images"}


class Newest:
    """Keeps what is new since it was last told to forget.

    Args:
        scenery: of the run.
        moving: where obstacles are that keep to a time-table, x, y, z m and yaw rad, by name; of the time, s.
        targets: where targets lie, x, y m; likewise.
    """

    def __init__(self, scenery: Scenery, moving: Poses, targets: Places) -> None:
        self._moving, self._targets = moving, targets
        self._rows = {craft.name: row for row, craft in enumerate(scenery.vehicles)}
        self._asked: frozenset[str] = frozenset()
        self._states: States | None = None
        self._values: dict[str, Any] = {}
        self._later: dict[str, Later] = {}
        self._frames: dict[str, FrameReport] = {}
        self._heard: dict[str, int] = {}
        self._noted: set[str] = set()
        self._pushed: dict[str, Pose] = {}
        self._lines: deque[LogLine] = deque(maxlen=MOST_LINES)
        # These are since the start.
        self._notes: dict[str, dict[str, float | str | bool]] = {}
        self._halted: set[str] = set()
        self._sent, self._received = (np.zeros((len(self._rows),) * 2, np.int64) for _ in range(2))
        self._pairs: dict[tuple[str, tuple[str, ...]], tuple[int, Array]] = {}
        self._handlers: dict[type, Callable[[str, int, Any], None]] = {
            States: self._on_states,
            FrameReport: self._on_frame,
            Reception: self._on_reception,
            Note: self._on_note,
            **dict.fromkeys(_BY_VEHICLE, self._on_value),
            **dict.fromkeys(_BY_SENSOR, self._on_reading),
            Later: self._on_later,
            Presence: self._on_presence,
            Incident: self._on_incident,
            Contact: self._on_contact,
            Halted: self._on_halted,
            Pushed: self._on_pushed,
            **dict.fromkeys((Outage, Changed, Moved), self._on_intervention),
        }

    def on(self, event: Event) -> None:
        """Take an event."""
        handler = self._handlers.get(type(event.value))
        if handler is not None:
            handler(event.key, event.time_ns, event.value)

    def say(self, line: LogLine) -> None:
        """Add a line to the log."""
        self._lines.append(line)

    def ask(self, names: Sequence[str]) -> None:
        """Keep the readings of these sensors, ``vehicle/sensor``, and of no others."""
        self._asked = frozenset(names)
        for kept in (self._values, self._later):
            for key in [key for key, value in kept.items() if type(value) in (Later, *_BY_SENSOR) and key not in self._asked]:
                del kept[key]

    def work_out(self, time_ns: int) -> bool:
        """Work out one of the readings that are wanted and nobody has looked at, in turn; whether there was one."""
        if not self._later:
            return False
        key = next(iter(self._later))
        try:
            reading = self._later.pop(key).get()
        except Exception as error:  # it fails again where the run itself looks at it, or nowhere
            self._tell(time_ns, "error", f"{key} could not be worked out: {type(error).__name__}: {error}")
        else:
            if type(reading) in _BY_SENSOR:
                self._values[key] = reading
        return True

    def shown(self, time_ns: int, pace: Pace) -> PageUpdate:
        """All that is new, and what is always told. It holds what is kept here: do not keep it."""
        fields: dict[str, dict[str, Any]] = {}
        for key, value in self._values.items():
            if (field := _BY_SENSOR.get(type(value))) is not None:
                fields.setdefault(field, {})[key] = value
            else:
                fields.setdefault(_BY_VEHICLE[type(value)], {})[_vehicle(key)] = value
        time_s = time_ns / SECOND_NS
        counted = bool(self._frames)
        return PageUpdate(
            time_ns=time_ns,
            states=self._states,
            obstacles={**{name: pose(time_s) for name, pose in self._moving.items()}, **self._pushed},
            targets={name: place(time_s) for name, place in self._targets.items()},
            notes={vehicle: self._notes[vehicle] for vehicle in sorted(self._noted)},
            links=tuple(map(_link, self._frames.values())),
            sent=self._sent if counted else None,
            received=self._received if counted else None,
            heard_ns={_vehicle(key): when for key, when in self._heard.items()},
            halted=tuple(name for name in self._rows if name in self._halted),
            lines=tuple(self._lines),
            pace=pace,
            **fields,
        )

    def forget(self) -> None:
        """What has been shown need not be shown again."""
        self._states = None
        for each in (self._values, self._frames, self._heard, self._noted, self._pushed, self._lines):
            each.clear()

    def _on_states(self, key: str, time_ns: int, states: States) -> None:
        self._states = states

    def _on_frame(self, key: str, time_ns: int, report: FrameReport) -> None:
        row, columns = self._pairs.get((report.sender, report.receivers)) or self._pair(report.sender, report.receivers)
        self._sent[row, columns] += 1
        self._received[row, columns] += report.received_ns >= 0
        self._frames[report.sender] = report

    def _pair(self, sender: str, receivers: tuple[str, ...]) -> tuple[int, Array]:
        """Row and columns of a frame's ends, looked up once."""
        columns = np.array([self._rows[name] for name in receivers], np.intp)
        pair = self._pairs[sender, receivers] = self._rows[sender], columns
        return pair

    def _on_reception(self, key: str, time_ns: int, reception: Reception) -> None:
        self._heard[key] = time_ns

    def _on_note(self, key: str, time_ns: int, note: Note) -> None:
        vehicle = _vehicle(key)
        self._notes.setdefault(vehicle, {}).update(note.values)
        self._noted.add(vehicle)

    def _on_value(self, key: str, time_ns: int, value: object) -> None:
        self._values[key] = value

    def _on_reading(self, key: str, time_ns: int, reading: Scan | Image) -> None:
        if key in self._asked:
            self._values[key] = reading

    def _on_later(self, key: str, time_ns: int, later: Later) -> None:
        if key in self._asked:
            self._later[key] = later

    def _on_presence(self, key: str, time_ns: int, presence: Presence) -> None:
        self._values[key] = presence
        self._tell(time_ns, *event_text.of_presence(_vehicle(key), presence))

    def _on_incident(self, key: str, time_ns: int, incident: Incident) -> None:
        self._tell(time_ns, *event_text.of_incident(_vehicle(key), incident))

    def _on_contact(self, key: str, time_ns: int, contact: Contact) -> None:
        self._tell(time_ns, *event_text.of_contact(contact))

    def _on_halted(self, key: str, time_ns: int, halted: Halted) -> None:
        (self._halted.update if halted.halted else self._halted.difference_update)(halted.vehicles)
        self._on_intervention(key, time_ns, halted)

    def _on_pushed(self, key: str, time_ns: int, pushed: Pushed) -> None:
        for name, place, attitude in zip(pushed.names, pushed.position.tolist(), pushed.attitude.tolist(), strict=True):
            self._pushed[name] = (*place, yaw_of(attitude))

    def _on_intervention(self, key: str, time_ns: int, done: event_text.Intervention) -> None:
        self._tell(time_ns, *event_text.of_intervention(done, time_ns))

    def _tell(self, time_ns: int, level: str, text: str) -> None:
        self.say(LogLine(time_ns=time_ns, level=level, text=text))


def _vehicle(key: str) -> str:
    return key.partition("/")[0]


def _link(report: FrameReport) -> LinkStatus:
    return LinkStatus(
        sender=report.sender,
        sent_ns=report.sent_ns,
        receivers=report.receivers,
        rssi_dbm=report.rssi_dbm,
        received=report.received_ns >= 0,
        outcome=report.outcome,
    )
