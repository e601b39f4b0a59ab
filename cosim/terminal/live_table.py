"""Table of vehicles with their newest values, shown below the progress bar during a run."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.metrics.formation import formation_errors
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.recording.run_state import RunState
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import States
from vcmvsp.cosim.util.text import plain

MOST = 20  # vehicles shown
CELL = 24  # characters
FLIES_M = 0.5  # heights are shown from this height on
GAP = "  "
STATES = {"lost": "lost", "removed": "gone", "back": ""}  # of agents


@dataclass(frozen=True, slots=True)
class _Vehicle:
    by: str
    state: str
    halted: bool
    heard_ns: int | None
    sent: int  # frames that it could have received
    received: int
    position: Sequence[float] = ()
    speed: float = math.nan
    error_m: float = math.nan


class TableLine(NamedTuple):
    """A line of the table and its style: ``head``, ``bad``, ``halted``, ``more`` or none."""

    text: str
    kind: str = ""


class _Column(NamedTuple):
    title: str
    importance: int  # columns of low importance are dropped first if space is short
    cell: Callable[[_Vehicle, int], str]
    align: str = ">"


class LiveTable:
    """Keeps the newest values of each vehicle and formats them as a table.

    Args:
        agents: the kind of agent of each vehicle, if known: shown until the agent notes a commander.
    """

    def __init__(self, agents: Mapping[str, str]) -> None:
        self._agents = agents
        self._run = RunState()
        self.on = self._run.on  # updates from an event
        self._flies = False
        self._widths: dict[str, int] = {}  # the largest so far: columns that move are hard to read

    def lines(self, now_ns: int, width: int, height: int) -> list[TableLine]:
        """The table, within ``width`` characters and ``height`` lines; of too many vehicles, the ones in the worst state."""
        every, most = self._vehicles(), max(1, min(MOST, height - 2))
        names = list(every)
        if not names or width < 1 or height < 3:
            return []
        chosen = names if len(names) <= most else sorted(names, key=lambda name: _rank(every[name], now_ns))[:most]
        vehicles = [every[name] for name in chosen]
        rows = {"vehicle": [name[:CELL] for name in chosen]}
        for column in self._columns():
            rows[column.title] = [column.cell(each, now_ns) for each in vehicles]
        columns = self._fitting(rows, width)
        lines = []
        for cells in zip(*([title, *rows[title]] for title in columns), strict=True):
            aligned = map("{:{}}".format, cells, columns.values())
            lines.append(GAP.join(aligned).rstrip()[:width])
        kinds = ["head", *(_kind(each) for each in vehicles)]
        table = [TableLine(text, kind) for text, kind in zip(lines, kinds, strict=True)]
        rest = len(names) - len(chosen)
        return [*table, TableLine(f"... and {rest} more"[:width], "more")] if rest else table

    def _vehicles(self) -> dict[str, _Vehicle]:
        """All known vehicles, in the order of the run."""
        run, sent, received = self._run, Counter[str](), Counter[str]()
        for (_, receivers), tally in run.tallies.items():
            frames, *arrived = tally.tolist()
            sent.update(dict.fromkeys(receivers, frames))
            received.update(dict(zip(receivers, arrived, strict=True)))
        states: States | None = run.newest["states"].get("")
        motion = {} if states is None else self._motion(states)
        run.settle()
        presence, heard_ns = run.newest["presence"], run.newest["heard_ns"]
        names = dict.fromkeys([*motion, *run.commanders, *presence, *sorted(run.halted), *heard_ns, *sent])
        vehicles = {}
        for name in names:
            by = plain(run.commanders[name], CELL) if name in run.commanders else self._agents.get(name, "")
            state = STATES[presence[name].state] if name in presence else ""
            counts = sent[name], received[name]
            vehicles[name] = _Vehicle(by, state, name in run.halted, heard_ns.get(name), *counts, *motion.get(name, ()))
        return vehicles

    def _motion(self, states: States) -> dict[str, tuple[list[float], float, float]]:
        yaw = yaws_of(states.attitude)
        moved = Motion(np.zeros(1, np.int64), states.names, states.position.T[:, np.newaxis], yaw[np.newaxis])
        placements = [Placement(0, name, follows) for name, follows in self._run.newest["places"].items()]
        errors = {name: float(error[0]) for name, error in formation_errors(moved, placements).items()}
        self._flies = self._flies or bool((states.position[:, 2] > FLIES_M).any())
        speeds = np.linalg.norm(states.velocity, axis=1).tolist()
        rows = zip(states.names, states.position.tolist(), speeds, strict=True)
        return {name: (position, speed, errors.get(name, math.nan)) for name, position, speed in rows}

    def _columns(self) -> tuple[_Column, ...]:
        axes = 3 if self._flies else 2
        return (
            _Column("state", 7, lambda each, _: each.state or _kind(each) or "ok", "<"),
            _Column("by", 1, lambda each, _: each.by, "<"),
            _Column("position [m]", 3, lambda each, _: " ".join(map("{:6.1f}".format, each.position[:axes]))),
            _Column("speed [m/s]", 2, lambda each, _: _number(each.speed, 2)),
            _Column("error [m]", 6, lambda each, _: _number(each.error_m, 3)),
            _Column("heard [s ago]", 5, _age),
            _Column("delivered", 4, lambda each, _: f"{100 * each.received / each.sent:.0f} %" if each.sent else ""),
        )

    def _fitting(self, rows: Mapping[str, Sequence[str]], width: int) -> dict[str, str]:
        """Titles of the columns that contain values and fit, and the format of their cells."""
        for title, cells in rows.items():
            widest = max(map(len, cells))
            if widest:
                self._widths[title] = max(self._widths.get(title, 0), len(title), widest)
        column_of = {column.title: column for column in self._columns()}
        columns = [title for title in rows if title in self._widths]
        while len(columns) > 1 and sum(self._widths[each] + len(GAP) for each in columns) - len(GAP) > width:
            columns.remove(min(columns[1:], key=lambda title: column_of[title].importance))
        align_of = {"vehicle": "<", **{title: column.align for title, column in column_of.items()}}
        return {title: f"{align_of[title]}{self._widths[title]}" for title in columns}


def _rank(vehicle: _Vehicle, now_ns: int) -> tuple[Any, ...]:
    """Sort key, worst first: lost, then halted, then longest without a reception, then highest loss."""
    silent_s = (now_ns - (vehicle.heard_ns or 0)) // SECOND_NS
    return not vehicle.state, not vehicle.halted, -silent_s, vehicle.received / vehicle.sent if vehicle.sent else 1.0


def _kind(vehicle: _Vehicle) -> str:
    if vehicle.state:
        return "bad"
    return "halted" if vehicle.halted else ""


def _age(vehicle: _Vehicle, now_ns: int) -> str:
    if vehicle.heard_ns is None:
        return "never" if vehicle.sent else ""
    return f"{(now_ns - vehicle.heard_ns) / SECOND_NS:.1f}"


def _number(value: float, places: int) -> str:
    return "" if math.isnan(value) else f"{value:.{places}f}"
