"""Collects the data of a run for its two tables, its metrics and its digest.

What grows with the run, states and frames, is packed into columns outside memory (`cosim.tables.spool`). At the end they are
read block by block into files, metrics and digest: the order of rows, the names in a column and the facts in a file are known
only then. So memory does not grow with the length of a run, except by what metrics need of a reception for a moment.

Values are handled by type (`_takers`). Values that are in neither table enter the digest as MessagePack, in order of arrival:
most types unchanged (`PACKED`), arrays as their bytes.
"""

import hashlib
import math
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from vcmvsp.cosim import types
from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import RunInfo, vehicle_of
from vcmvsp.cosim.metrics.age import age_metrics
from vcmvsp.cosim.metrics.agents import agent_metrics, control_metrics, hardware_metrics
from vcmvsp.cosim.metrics.catalogue import SCHEMA
from vcmvsp.cosim.metrics.energy import BatteryReadings
from vcmvsp.cosim.metrics.formation import Noted, errors_table, formation_metrics
from vcmvsp.cosim.metrics.mission import Mission
from vcmvsp.cosim.metrics.motion import Window, motion, safety_metrics
from vcmvsp.cosim.metrics.radio import Parts, connectivity_metrics, informed, radio_metrics
from vcmvsp.cosim.metrics.routing import COLUMNS as ROUTES
from vcmvsp.cosim.metrics.routing import Routing
from vcmvsp.cosim.recording.scene import DrawnWorld
from vcmvsp.cosim.tables.columns import name_column, names_of, nulls, numbers
from vcmvsp.cosim.tables.radio_frames import Frames
from vcmvsp.cosim.tables.schema import (
    DERIVED,
    NULLABLE,
    NoteRows,
    Placement,
    RunFacts,
    RunTable,
    StateRows,
    Table,
    blocks_of,
    radio_table,
    states_table,
    write_table,
)
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.files import replacing

Take = Callable[[str, int, Any], None]
"""Handles one value, given its key and time (ns)."""
PACKED = (
    *(types.Changed, types.Contact, types.Fix, types.Follows, types.Halted, types.Imu, types.Incident, types.Measured),
    *(types.Message, types.Moved, types.Note, types.Odometry, types.Outage, types.Presence, types.RealStatus),
    *(types.Velocity, types.Waypoint),
)
"""Types that enter the digest unchanged: `Recorder.on` appends them to `packed` as key, time and value."""
HASHED_BYTES = 1 << 16  # bytes hashed at once
_COMMAND = struct.Struct("<5d").pack  # time ns, velocity m/s, yaw rate rad/s; `array.extend` would be half as fast
_NO_COMMAND = (math.nan,) * 4  # a way-point ends the commanded velocity


class Accumulators:
    """Collects data during a run and makes tables and metrics after it. Args: see `cosim.recording.recorder.Recorder`."""

    def __init__(
        self, run: RunInfo, agents: Sequence[AgentInfo], world: DrawnWorld | None = None, folder: Path | None = None
    ) -> None:
        self._run, self._world = run, world
        self._now = 0  # ns: time of the newest value; after the run, its end
        self._ticks = {agent.vehicle: agent.ticks for agent in agents}
        self._states, self._frames = StateRows(run.vehicles, folder), Frames(run.vehicles, folder)
        self._follows: list[Placement] = []
        self._noted, self._mission, self._batteries = Noted(), Mission(), BatteryReadings()
        self._notes = NoteRows(run.vehicles, folder)
        self._routing = Routing(run.vehicles)
        self._radios = {name: code for code, name in enumerate(run.radios)}
        self._radio_of = array("h")  # number of the radio by frame; -1: not known
        self._commands = {name: bytearray() for name in run.vehicles}  # packed `_COMMAND` records
        self._presences: list[tuple[str, types.Presence]] = []
        self._statuses: defaultdict[str, list[tuple[int, types.RealStatus]]] = defaultdict(list)  # of real vehicles
        self._incidents: list[tuple[str, types.Incident]] = []
        self._fixes: Counter[str] = Counter()
        self._contacts: Counter[str] = Counter()
        self._packed = bytearray()  # values in no table that are not hashed yet
        self._others = hashlib.sha256()  # hash of all earlier ones
        self._tables: tuple[RunTable, RunTable] | None = None
        self._takers: dict[type, Take] = {
            types.FrameReport: lambda _key, _time_ns, report: self._take_frames((report,)),
            types.Traffic: lambda _key, _time_ns, traffic: self._take_frames(traffic.reports),
            types.Routed: lambda _key, _time_ns, routed: self._routing.take(routed),
            types.Follows: self._take_follows,
            types.Note: self._take_note,
            types.Velocity: lambda key, time_ns, command: self._commands[vehicle_of(key)].extend(
                _COMMAND(time_ns, *command.linear, command.yaw_rate)
            ),
            types.Waypoint: lambda key, time_ns, _: self._commands[vehicle_of(key)].extend(_COMMAND(time_ns, *_NO_COMMAND)),
            types.Contact: lambda key, _time_ns, _contact: self._contacts.update((vehicle_of(key),)),
            types.Presence: self._take_presence,
            types.RealStatus: lambda key, time_ns, status: self._statuses[vehicle_of(key)].append((time_ns, status)),
            types.Incident: lambda key, _time_ns, incident: self._incidents.append((vehicle_of(key), incident)),
            types.Fix: lambda key, _time_ns, _fix: self._fixes.update((vehicle_of(key),)),
            types.Measured: lambda key, _time_ns, reading: self._batteries.take(key, reading),
            types.Scan: lambda key, time_ns, scan: self._add((key, time_ns, scan.time_ns), scan.ranges),
            types.Pushed: lambda key, time_ns, pushed: self._add((key, time_ns), pushed.position, pushed.attitude),
            types.Image: lambda key, time_ns, image: self._add((key, time_ns, image.time_ns), image.pixels),
            types.Looks: lambda key, time_ns, looks: self._add((key, time_ns, looks)),
            **dict.fromkeys((types.ProbabilityMap, types.Sightings, types.Mosaic), self._take_shown),
        }

    def _hash_much(self) -> None:
        """Hash the packed bytes once there are enough: many small updates would double the cost."""
        if len(self._packed) > HASHED_BYTES:
            self._hash()

    @property
    def follows(self) -> tuple[Placement, ...]:
        """Slots of all followers, each with the time from which it holds."""
        return tuple(self._follows)

    @property
    def facts(self) -> RunFacts:
        """Facts about the run that the tables do not contain."""
        run = self._run
        return RunFacts(
            scenario=run.scenario,
            seed=run.seed,
            end_ns=self._now,
            vehicles=run.vehicles,
            follows=self.follows,
            stations=run.stations or msgspec.UNSET,
        )

    @property
    def states(self) -> pa.Table:
        """The table of true states (`cosim.tables.schema.STATES_SCHEMA`), after the run."""
        return self.tables[0].in_memory()

    @property
    def radio(self) -> pa.Table:
        """The table of frames per receiver (`cosim.tables.schema.RADIO_SCHEMA`), after the run."""
        return self.tables[1].in_memory()

    @property
    def notes(self) -> pa.Table:
        """The table of agents' notes (`cosim.tables.schema.NOTES_SCHEMA`)."""
        return self._notes.table(self.facts)

    @property
    def errors(self) -> pa.Table:
        """The table of formation errors (`cosim.tables.schema.ERRORS_SCHEMA`), after the run."""
        return errors_table(self.tables[0], self.facts)

    @property
    def tables(self) -> tuple[RunTable, RunTable]:
        """The tables of states and frames, after the run."""
        if self._tables is None:
            facts, states, frames, routing = self.facts, self._states, self._frames, self._routing

            def radio(columns: Collection[str] | None, rows: tuple[int, int]) -> pa.Table:
                if self._radios:
                    return self._with_radios(facts, columns, rows)
                if not routing or not (columns is None or set(columns) & set(ROUTES)):
                    return radio_table(frames, facts, columns, rows)
                base_columns = None if columns is None else {*columns, "frame", "sent_ns"}
                table = routing.table(radio_table(frames, facts, base_columns, rows))
                return table if columns is None else table.select([*columns])

            self._tables = (
                RunTable(states.rows, lambda columns, rows: states_table(states, facts, columns, rows)),
                RunTable(frames.rows, radio),
            )
        return self._tables

    def _take_frames(self, reports: Sequence[types.FrameReport]) -> None:
        self._frames.extend(reports)
        for report in reports if self._radios else ():
            self._radio_of.extend([-1] * (report.frame + 1 - len(self._radio_of)))
            self._radio_of[report.frame] = self._radios[report.radio or ""]

    def _with_radios(self, facts: RunFacts, columns: Collection[str] | None, rows: tuple[int, int]) -> pa.Table:
        """The table of frames of several radios, with a column of their names."""
        is_routed = bool(self._routing) and (columns is None or bool(set(columns) & set(ROUTES)))
        needed = {"frame", "sent_ns", "sender"} if is_routed else {"frame"}
        base_columns = None if columns is None else needed.union(columns)
        table = radio_table(self._frames, facts, base_columns, rows)
        radio_of = np.array(self._radio_of, np.int32)
        if is_routed:
            table = self._routing.table(table, radio_of)
        table = table.append_column("radio", name_column([*self._radios], radio_of[numbers(table, "frame")]))
        return table if columns is None else table.select([*columns])

    def write_tables(self, folder: Path) -> None:
        """Write ``states.parquet``, ``radio.parquet`` and, if a vehicle follows another, ``errors.parquet``."""
        tables: dict[str, Table] = dict(zip(("states", "radio"), self.tables, strict=True))
        if self.follows:
            tables["errors"] = self.errors
        for name, table in tables.items():
            with replacing(folder / f"{name}.parquet") as path:
                write_table(table, path)

    def metrics(self, *, window: Window) -> dict[str, Any]:
        """The metrics of a finished run (`cosim.metrics.catalogue`); all but counts are taken over the window (s)."""
        (states, radio), end_ns = self.tables, self._now
        self._hash()
        moved, got = motion(states), Parts(radio)
        vehicles, follows, targets = self._run.vehicles, self._follows, () if self._world is None else self._world.targets
        ages = age_metrics(Parts(radio, informed), follows, self._ticks, window, end_ns)
        mobile = moved.without(self._run.stations)
        clearance_m = None if self._world is None else self._world.least_clearance_m(mobile.time_ns, mobile.position)
        commands = {name: np.frombuffer(rows).reshape(-1, 5) for name, rows in self._commands.items()}
        numbers = {
            "schema": SCHEMA,
            "scenario": self._run.scenario,
            "seed": self._run.seed,
            "duration_s": end_ns / SECOND_NS,
            "formation": formation_metrics(moved, follows, window, self._noted, end_ns),
            "radio": radio_metrics(radio, ages),
            "routing": self._routing.metrics(),
            "control": control_metrics(commands, vehicles, window, end_ns),
            "connectivity": connectivity_metrics(got, vehicles, window, end_ns),
            "agents": agent_metrics(self._presences, self._ticks, end_ns, self._run.duration_ns),
            "hardware": hardware_metrics(self._statuses, self._incidents, self._fixes, got),
            "energy": self._batteries.metrics(),
            "safety": safety_metrics(mobile, self._contacts.total(), clearance_m),
            "mission": self._mission.metrics(moved, targets),
            "digest": digest([states, radio], self._others.digest()),
        }
        absent = {"routing": not self._routing, "hardware": not self._statuses, "energy": not self._batteries}
        absent["mission"] = numbers["mission"] is None
        return {name: number for name, number in numbers.items() if not absent.get(name)}

    def _take_follows(self, key: str, time_ns: int, follows: types.Follows) -> None:
        vehicle = vehicle_of(key)
        if follows.leader is not None and follows.leader not in self._run.vehicles:
            names = ", ".join(self._run.vehicles)
            raise ScenarioError(f"{vehicle} follows {follows.leader!r}, which is not a vehicle of this run; vehicles: {names}")
        self._follows.append(Placement(time_ns, vehicle, follows))

    def _take_note(self, key: str, time_ns: int, note: types.Note) -> None:
        vehicle = vehicle_of(key)
        self._notes.append(time_ns, vehicle, note.values)
        self._noted.take(vehicle, time_ns, note.values)
        self._mission.take(vehicle, time_ns, note.values)

    def _take_presence(self, key: str, time_ns: int, presence: types.Presence) -> None:
        vehicle = vehicle_of(key)
        self._presences.append((vehicle, presence))
        (self._mission.restore if presence.state == "back" else self._mission.leave)(vehicle, time_ns)

    def _add(self, value: object, *arrays: types.Array) -> None:
        self._packed += encode(value) + b"".join(each.tobytes() for each in arrays)
        self._hash_much()

    def _take_shown(self, key: str, time_ns: int, value: types.ProbabilityMap | types.Sightings | types.Mosaic) -> None:
        self._add((key, time_ns, value))
        self._mission.see(vehicle_of(key), value)

    def _hash(self) -> None:
        self._others.update(self._packed)
        self._packed.clear()


def digest(tables: Sequence[Table], rest: bytes = b"") -> str:
    """SHA-256 (hex) over all columns of the tables but `DERIVED`, column by column, and ``rest``.

    The hash is taken over values: it does not depend on chunks, on the order of names or on versions of file formats.
    """
    total = hashlib.sha256()
    for table in tables:
        fields = [field for field in table.schema if field.name not in DERIVED]
        total.update(f"table {table.num_rows} {len(fields)}\n".encode())
        for field in fields:
            for part in _values(table, field):
                total.update(part)
    total.update(rest)
    return total.hexdigest()


def _values(table: Table, field: "pa.Field[Any]") -> Iterator[bytes | memoryview]:
    """What of a column is hashed: its name, kind and names in use, which values are missing, and all values."""
    name, column_type, used = field.name, field.type, list[str]()
    if pa.types.is_dictionary(column_type):
        kind, dtype = "name", "<i4"
        used = sorted({each for block in blocks_of(table, (name,)) for each in _used(block, name)})
    else:
        kind, dtype = ("float64", "<f8") if pa.types.is_floating(column_type) else ("int64", "<i8")
    yield repr((name, kind, used)).encode()
    if name in NULLABLE or not isinstance(table, RunTable):
        for block in blocks_of(table, (name,)):
            yield np.packbits(nulls(block, name)).data
    else:
        yield bytes((table.num_rows + 7) // 8)
    for block in blocks_of(table, (name,)):
        values = _canonical(used, *names_of(block, name)) if kind == "name" else numbers(block, name)
        yield values.astype(dtype, copy=False).data


def _used(table: pa.Table, name: str) -> list[str]:
    names, codes = names_of(table, name)
    return [names[code] for code in np.flatnonzero(np.bincount(codes)).tolist()]


def _canonical(used: Sequence[str], names: Sequence[str], codes: types.Array) -> types.Array:
    """Codes among the names in use, for codes among all names."""
    place = {name: i for i, name in enumerate(used)}
    return np.array([place.get(name, 0) for name in names], "<i4").take(codes)
