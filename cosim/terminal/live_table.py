"""The vehicles of a run as lines of text, with the newest values only: what stands below the bar while the run goes on.

An event costs a look into a dictionary and, where it tells something of a vehicle, a store; all else is done when the lines are
asked for.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.formation import formation_errors
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import Array, Follows, FrameReport, Halted, Note, Presence, Reception, States
from vcmvsp.cosim.util.text import plain

MOST = 20  # vehicles that are shown
CELL = 24  # characters
FLIES_M = 0.5  # from this height on heights are shown
GAP = "  "
COMMANDERS = ("commander", "mode")  # what agents call in their notes who commands


@dataclass(slots=True)
class _Vehicle:
    """What is known of a vehicle."""

    by: str = ""
    state: str = ""
    halted: bool = False
    heard_ns: int | None = None
    sent: int = 0  # frames that it could have heard
    received: int = 0
    position: Sequence[float] = ()
    speed: float = math.nan
    error_m: float = math.nan


class TableLine(NamedTuple):
    """A line, and what it is: ``head``, ``bad``, ``halted``, ``more`` or nothing of these."""

    text: str
    kind: str = ""


class _Column(NamedTuple):
    title: str
    importance: int  # where there is no room, the columns of the least go first
    cell: Callable[[_Vehicle, int], str]
    left: bool = False


class LiveTable:
    """Keeps the newest of each vehicle.

    Args:
        agents: the kind of agent of each vehicle, where it is known: shown until the agent notes who commands.
    """

    def __init__(self, agents: Mapping[str, str]) -> None:
        self._agents = agents
        self._vehicles: dict[str, _Vehicle] = {}
        self._states: States | None = None
        self._follows: dict[str, Follows] = {}
        self._frames: list[FrameReport] = []
        self._heard: dict[str, int] = {}
        self._flies = False
        self._widths: dict[str, int] = {}  # the largest so far: columns that move about are hard to read
        self._handlers: dict[type, Callable[[str, int, Any], None]] = {
            States: self._on_states,
            FrameReport: self._on_frame,
            Reception: self._on_reception,
            Follows: self._on_follows,
            Note: self._on_note,
            Presence: self._on_presence,
            Halted: self._on_halted,
        }

    def on(self, event: Event) -> None:
        """Take an event."""
        value = event.value
        handler = self._handlers.get(type(value))
        if handler is not None:
            handler(event.key, event.time_ns, value)

    def lines(self, now_ns: int, width: int, height: int) -> list[TableLine]:
        """The table, at most so many characters wide and lines high; of too many vehicles those that are worst off."""
        self._work_out()
        names, most = list(self._vehicles), max(1, min(MOST, height - 2))
        if not names or width < 1 or height < 3:
            return []
        shown = names if len(names) <= most else sorted(names, key=lambda name: _rank(self._vehicles[name], now_ns))[:most]
        vehicles = [self._vehicles[name] for name in shown]
        rows = {column.title: [column.cell(each, now_ns) for each in vehicles] for column in self._columns()}
        rows = {"vehicle": [name[:CELL] for name in shown], **rows}
        columns = self._fitting(rows, width)
        lines = [_joined([(title, self._widths[title], left) for title, left in columns], width)]
        for row in range(len(shown)):
            cells = [(rows[title][row], self._widths[title], left) for title, left in columns]
            lines.append(_joined(cells, width))
        kinds = ["head", *(_kind(each) for each in vehicles)]
        table = [TableLine(text, kind) for text, kind in zip(lines, kinds, strict=True)]
        rest = len(names) - len(shown)
        return [*table, TableLine(f"... and {rest} more"[:width], "more")] if rest else table

    # --- events -------------------------------------------------------------------------------------------------------------

    def _on_states(self, key: str, time_ns: int, states: States) -> None:
        self._states = states

    def _on_frame(self, key: str, time_ns: int, report: FrameReport) -> None:
        self._frames.append(report)

    def _on_reception(self, key: str, time_ns: int, reception: Reception) -> None:
        self._heard[key] = time_ns

    def _on_follows(self, key: str, time_ns: int, follows: Follows) -> None:
        self._follows[key.partition("/")[0]] = follows

    def _on_note(self, key: str, time_ns: int, note: Note) -> None:
        for name in COMMANDERS:
            if name in note.values:
                self._of(key).by = plain(str(note.values[name]), CELL)

    def _on_presence(self, key: str, time_ns: int, presence: Presence) -> None:
        self._of(key).state = {"lost": "lost", "removed": "gone", "back": ""}[presence.state]

    def _on_halted(self, key: str, time_ns: int, halted: Halted) -> None:
        for name in halted.vehicles:
            self._vehicle(name).halted = halted.halted

    def _of(self, key: str) -> _Vehicle:
        return self._vehicle(key.partition("/")[0])

    def _vehicle(self, name: str) -> _Vehicle:
        if name not in self._vehicles:
            self._vehicles[name] = _Vehicle(by=self._agents.get(name, ""))
        return self._vehicles[name]

    # --- the table ----------------------------------------------------------------------------------------------------------

    def _work_out(self) -> None:
        """Bring all vehicles up to date."""
        if self._states is not None:
            states, self._states = self._states, None
            self._vehicles = {name: self._vehicle(name) for name in states.names} | self._vehicles  # in the order of the run
            speeds = np.linalg.norm(states.velocity, axis=1).tolist()
            errors = self._errors(states)
            for name, position, speed in zip(states.names, states.position.tolist(), speeds, strict=True):
                vehicle = self._vehicle(name)
                vehicle.position, vehicle.speed, vehicle.error_m = position, speed, errors.get(name, math.nan)
            self._flies = self._flies or bool((states.position[:, 2] > FLIES_M).any())
        counts: dict[tuple[str, ...], Array] = {}  # by receivers: frames, and how many each of them received
        for report in self._frames:
            if report.receivers not in counts:
                counts[report.receivers] = np.zeros((2, len(report.receivers)), np.int64)
            counts[report.receivers] += (np.ones(len(report.receivers), np.int64), report.received_ns >= 0)
        self._frames.clear()
        for key, time_ns in self._heard.items():
            self._of(key).heard_ns = time_ns
        self._heard.clear()
        for receivers, (sent, received) in counts.items():
            for name, more, heard in zip(receivers, sent.tolist(), received.tolist(), strict=True):
                vehicle = self._vehicle(name)
                vehicle.sent += more
                vehicle.received += heard

    def _errors(self, states: States) -> dict[str, float]:
        """How far each follower is off its place now, m."""
        w, x, y, z = states.attitude.T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        moved = Motion(np.zeros(1, np.int64), states.names, states.position.T[:, np.newaxis], yaw[np.newaxis])
        placements = [Placement(0, name, follows) for name, follows in self._follows.items()]
        return {name: float(error[0]) for name, error in formation_errors(moved, placements).items()}

    def _columns(self) -> tuple[_Column, ...]:
        axes = 3 if self._flies else 2
        return (
            _Column("state", 7, lambda each, _: each.state or ("halted" if each.halted else "ok"), left=True),
            _Column("by", 1, lambda each, _: each.by, left=True),
            _Column("position [m]", 3, lambda each, _: " ".join(f"{value:6.1f}" for value in each.position[:axes])),
            _Column("speed [m/s]", 2, lambda each, _: _number(each.speed, 2)),
            _Column("error [m]", 6, lambda each, _: _number(each.error_m, 3)),
            _Column("heard [s ago]", 5, _age),
            _Column("delivered", 4, lambda each, _: f"{100 * each.received / each.sent:.0f} %" if each.sent else ""),
        )

    def _fitting(self, rows: Mapping[str, Sequence[str]], width: int) -> list[tuple[str, bool]]:
        """Titles of the columns that have anything to say and for which there is room, and whether they begin at the left."""
        for title, cells in rows.items():
            widest = max(map(len, cells))
            if widest:
                self._widths[title] = max(self._widths.get(title, 0), len(title), widest)
        known = {column.title: column for column in self._columns()}
        columns = [title for title in rows if title in self._widths]
        while len(columns) > 1 and sum(self._widths[each] + len(GAP) for each in columns) - len(GAP) > width:
            columns.remove(min(columns[1:], key=lambda title: known[title].importance))
        return [(title, title == "vehicle" or known[title].left) for title in columns]


def _rank(vehicle: _Vehicle, now_ns: int) -> tuple[Any, ...]:
    """The worst first: lost, then halted, then who has heard nothing for most seconds, then who loses most."""
    silent_s = (now_ns - (vehicle.heard_ns or 0)) // SECOND_NS
    return not vehicle.state, not vehicle.halted, -silent_s, vehicle.received / vehicle.sent if vehicle.sent else 1.0


def _kind(vehicle: _Vehicle) -> str:
    return "bad" if vehicle.state else "halted" if vehicle.halted else ""


def _age(vehicle: _Vehicle, now_ns: int) -> str:
    if vehicle.heard_ns is None:
        return "never" if vehicle.sent else ""
    return f"{(now_ns - vehicle.heard_ns) / SECOND_NS:.1f}"


def _number(value: float, places: int) -> str:
    return "" if math.isnan(value) else f"{value:.{places}f}"


def _joined(cells: Sequence[tuple[str, int, bool]], width: int) -> str:
    return GAP.join(text.ljust(wide) if left else text.rjust(wide) for text, wide, left in cells).rstrip()[:width]
