"""The tables of a run, in memory (Arrow) and on disk (Parquet), and reading of a run directory.

``states``: a row per recorded instant and vehicle, instants in order, vehicles in the order of the run.
``radio``: a row per frame and intended receiver, in the order in which frames entered the channel.
``errors``: a row per recorded instant and follower, made from the states (`cosim.metrics.formation.errors_table`).
``notes``: a row per value that an agent notes, in memory only; the recording has the notes, too.
The schema metadata of all contain the facts of the run (`RunFacts`), so that each file is self-contained.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.tables.columns import column, joined
from vcmvsp.cosim.tables.radio_frames import CHUNK_ROWS, NAMED, PATHS, UNDER_WAY, Frames, Names, PackedRows, dtype_of
from vcmvsp.cosim.types import Array, Follows, FrameReport, States
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json

NAME = pa.dictionary(pa.int32(), pa.string())
ATTITUDE = ("qw", "qx", "qy", "qz")
STATE_VALUES = ("x", "y", "z", *ATTITUDE, "vx", "vy", "vz", "wx", "wy", "wz")
_WHEN = [("time_ns", pa.int64()), ("vehicle", NAME)]
STATES_SCHEMA = pa.schema(_WHEN + [(name, pa.float64()) for name in (*STATE_VALUES, "yaw")])
"""Time ns; position m, attitude (world_from_body), velocity m/s: world; angular velocity rad/s: body; yaw rad, of attitude."""
ERRORS_SCHEMA = pa.schema([*_WHEN, ("leader", NAME), *((name, pa.float64()) for name in ("error_m", "ahead_m", "left_m"))])
"""The formation error z of a follower: its length; its place from the handle, in the follower's frame."""
NOTES_SCHEMA = pa.schema([*_WHEN, ("name", NAME), ("value", pa.float64()), ("text", NAME)])
"""A noted number (true: 1, false: 0), null for a text and NaN; a noted text, empty for a number."""


def _radio_field(name: str) -> "pa.Field[Any]":
    return pa.field(name, NAME if name in NAMED else pa.from_numpy_dtype(np.dtype(dtype_of(name))))


RADIO_SCHEMA = pa.schema(
    [
        *map(_radio_field, ("frame", "sender", "receiver", "sent_ns", "received_ns", "size_bytes", "distance_m", "rssi_dbm")),
        *map(_radio_field, ("outcome", "delay_ns", "copy_ns", "snr_db", "sinr_db", "path_loss_db", "walls", "wall_materials")),
        *map(_radio_field, ("wall_loss_db", "shadowing_db", "fading_db", "air_time_ns", "queue_ns", "access_ns")),
    ]
)
"""See `cosim.recording.mcap_writer.FRAME`. Null: ``received_ns`` and ``delay_ns`` of frames lost or under way at the end of the
run, ``copy_ns`` without a second copy, unknown items of a link budget."""
PATHS_SCHEMA = pa.schema(map(_radio_field, PATHS))
"""Further columns of the radio table of a run whose channel knows the paths of the wave."""
NOT_LOST = ("received", UNDER_WAY)  # outcomes
DERIVED = ("yaw",)  # columns made from others, which do not enter the digest
NULLABLE = ("received_ns", "delay_ns", "copy_ns", "sinr_db", "origin_number", *PATHS)  # columns with missing values
FACTS = b"vcmvsp.run"
_STATE_TYPES: dict[str, type[np.number]] = {"time_ns": np.int64, "vehicle": np.int32}
ROW_GROUP = 1 << 20  # rows of a file that are packed together
PART_ROWS = 1 << 17  # rows of a table that are read together, in little memory
_PHYSICAL = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE", "BYTE_ARRAY")


class Placement(msgspec.Struct, frozen=True):
    """The slot that ``vehicle`` keeps from ``time_ns`` on."""

    time_ns: int
    vehicle: str
    follows: Follows


class RunFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a run that its tables do not contain."""

    scenario: str
    seed: int
    end_ns: int
    vehicles: tuple[str, ...]
    follows: tuple[Placement, ...] = ()
    stations: tuple[str, ...] | msgspec.UnsetType = msgspec.UNSET  # vehicles that are stations; unset: none is


@dataclass(frozen=True)
class Recording:
    """A run read from its directory."""

    states: pa.Table
    radio: pa.Table
    facts: RunFacts
    metrics: dict[str, Any]

    @property
    def follows(self) -> tuple[Placement, ...]:
        """Slots of all followers, each with the time from which it holds."""
        return self.facts.follows


class RunTable:
    """A table of a run, built block by block from what is kept of it (`StateRows`, `Frames`), a single block only once.

    Args:
        rows: number of rows.
        build: builds the given columns of the rows from the first to before the last.
    """

    def __init__(self, rows: int, build: Callable[[Collection[str] | None, tuple[int, int]], pa.Table]) -> None:
        self.num_rows, self._build, self._whole = rows, build, None if rows > PART_ROWS else build(None, (0, rows))
        self.schema = (build(None, (0, 0)) if self._whole is None else self._whole).schema

    def in_memory(self) -> pa.Table:
        """The table in memory."""
        if self._whole is None:
            self._whole = self._build(None, (0, self.num_rows))
        return self._whole

    def blocks(self, columns: Collection[str] | None = None) -> Iterator[pa.Table]:
        """The given columns, or all, in tables of `PART_ROWS` rows, at least one; each has all names of a column of names."""
        if self._whole is not None:
            yield self._whole if columns is None else self._whole.select([*columns])
            return
        for first in range(0, self.num_rows, PART_ROWS):
            yield self._build(columns, (first, min(first + PART_ROWS, self.num_rows)))


class TableFile:
    """A table in a Parquet file, read block by block. Raises `OSError`, `ValueError`: as `read_table`."""

    def __init__(self, path: Path) -> None:
        file, fields = _opened(path)
        with file:
            self.num_rows, self.schema, self._path = file.metadata.num_rows, pa.schema(fields), path

    def blocks(self, columns: Collection[str] | None = None) -> Iterator[pa.Table]:
        """The given columns, or all, in tables of `PART_ROWS` rows; at least one table."""
        file, fields = _opened(self._path, columns)
        with file:
            if not self.num_rows:
                yield pa.Table.from_batches([], pa.schema(fields))  # empty_table() imports pandas if it is installed
            for batch in file.iter_batches(PART_ROWS, columns=[field.name for field in fields]):
                yield _as_written(pa.Table.from_batches([batch]), fields, self._path.name)


Table = pa.Table | RunTable | TableFile


def blocks_of(table: Table, columns: Collection[str]) -> Iterator[pa.Table]:
    """The columns of a table in parts, as far as they exist."""
    names = [name for name in table.schema.names if name in columns]
    return iter((table.select(names),)) if isinstance(table, pa.Table) else table.blocks(names)


def selected(table: Table, columns: Collection[str]) -> pa.Table:
    """Columns of a table in memory, as far as they exist."""
    return pa.concat_tables(blocks_of(table, columns))


class StateRows(PackedRows[tuple[int, States]]):
    """True states of the vehicles at recorded instants."""

    def append(self, time_ns: int, states: States) -> None:
        """Add the states of an instant."""
        self._waiting.append((time_ns, states))
        self._held += len(states.names)
        if self._held >= CHUNK_ROWS:
            self._pack()

    def columns(self, rows: tuple[int, int], names: Collection[str] = STATES_SCHEMA.names) -> dict[str, Any]:
        """The Arrow columns of these rows."""
        parts, cut = self._spool.around(*rows)
        columns: dict[str, Any] = {}
        for name in names:
            if name == "yaw":
                values = yaws_of(np.stack([self._spool.read(each, parts, np.float64)[cut] for each in ATTITUDE], axis=-1))
            else:
                values = self._spool.read(name, parts, _STATE_TYPES.get(name, np.float64))[cut]
            columns[name] = self._vehicles.column(values) if name == "vehicle" else column(values)
        return columns

    def _packed(self, waiting: Sequence[tuple[int, States]]) -> dict[str, Array]:
        times, instants = zip(*waiting, strict=True)
        names = [states.names for states in instants]
        packed = {"time_ns": np.repeat(np.array(times, np.int64), list(map(len, names)))}
        packed["vehicle"] = self._vehicles.codes_of_groups(names)
        blocks: list[Array] = []
        for name, width in (("position", 3), ("attitude", 4), ("velocity", 3), ("angular_velocity", 3)):
            blocks.extend(joined([getattr(states, name) for states in instants], (0, width)).T)
        return packed | dict(zip(STATE_VALUES, blocks, strict=True))


class NoteRows(PackedRows[tuple[int, str, Mapping[str, float | str]]]):
    """Values that agents note."""

    def __init__(self, vehicles: Sequence[str], folder: Path | None = None) -> None:
        super().__init__(vehicles, folder)
        self._names, self._texts = Names(()), Names(("",))

    def append(self, time_ns: int, vehicle: str, values: Mapping[str, float | str]) -> None:
        """Add the notes of an agent at a time."""
        self._waiting.append((time_ns, vehicle, values))
        if len(self._waiting) >= CHUNK_ROWS:
            self._pack()

    def table(self, facts: RunFacts) -> pa.Table:
        """All notes so far (`NOTES_SCHEMA`)."""
        self._pack()
        parts = range(len(self._spool))
        time_ns, value = self._spool.read("time_ns", parts, np.int64), self._spool.read("value", parts, np.float64)
        vehicle, name, text = (self._spool.read(each, parts, np.int32) for each in ("vehicle", "name", "text"))
        columns = [
            column(time_ns),
            self._vehicles.column(vehicle),
            self._names.column(name),
            column(value, ~np.isnan(value)),
            self._texts.column(text),
        ]
        return with_facts(columns, NOTES_SCHEMA, facts)

    def _packed(self, waiting: Sequence[tuple[int, str, Mapping[str, float | str]]]) -> dict[str, Array]:
        time_ns, vehicles, notes = zip(*waiting, strict=True)
        counts = list(map(len, notes))
        values = [value for each in notes for value in each.values()]
        numbers, texts = np.full(len(values), np.nan), [""] * len(values)
        for place, value in enumerate(values):
            if isinstance(value, str):
                texts[place] = value
            else:
                numbers[place] = value
        return {
            "time_ns": np.repeat(np.array(time_ns, np.int64), counts),
            "vehicle": np.repeat(self._vehicles.codes(vehicles), counts),
            "name": self._names.codes_of_groups(map(tuple, notes)),
            "value": numbers,
            "text": self._texts.codes(texts),
        }


def states_table(
    states: StateRows | Sequence[tuple[int, States]],
    facts: RunFacts,
    columns: Collection[str] | None = None,
    rows: tuple[int, int] | None = None,
) -> pa.Table:
    """Build the table of true states at these instants: all columns and rows, or the given ones."""
    if not isinstance(states, StateRows):
        instants, states = states, StateRows(facts.vehicles)
        for instant in instants:
            states.append(*instant)
    fields = [field for field in STATES_SCHEMA if columns is None or field.name in columns]
    arrays = states.columns(rows or (0, states.rows), [field.name for field in fields])
    return with_facts(list(arrays.values()), pa.schema(fields), facts)


def radio_table(
    frames: Frames | Sequence[FrameReport],
    facts: RunFacts,
    columns: Collection[str] | None = None,
    rows: tuple[int, int] | None = None,
) -> pa.Table:
    """Build the table of all frames at all intended receivers: all columns and rows, or the given ones."""
    if not isinstance(frames, Frames):
        reports, frames = frames, Frames(facts.vehicles)
        frames.extend(reports)
    available = [*RADIO_SCHEMA, *(PATHS_SCHEMA if frames.has_paths else ())]
    fields = [field for field in available if columns is None or field.name in columns]
    arrays = frames.columns(facts.end_ns, [field.name for field in fields], rows)
    return with_facts(list(arrays.values()), pa.schema(fields), facts)


def write_table(table: Table, path: Path | BinaryIO) -> None:
    """Write Parquet, deterministically (fixed row groups, zstd)."""
    texts: Any = [field.name for field in table.schema if pa.types.is_dictionary(field.type)]
    floats: Any = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    encodings = {"use_dictionary": texts, "use_byte_stream_split": floats}
    blocks = iter((table,)) if isinstance(table, pa.Table) else table.blocks()
    with pq.ParquetWriter(path, table.schema, compression="zstd", **encodings) as writer:
        while group := list(islice(blocks, max(1, ROW_GROUP // PART_ROWS))):
            writer.write_table(pa.concat_tables(group), row_group_size=ROW_GROUP)
            group.clear()


def read_table(path: Path, columns: Collection[str] | None = None) -> pa.Table:
    """Read Parquet, the given columns as far as they exist; `pyarrow.parquet.read_table` would import pandas if installed.

    Raises:
        OSError, ValueError: the file is unreadable or exceeds `limits`.
    """
    file, fields = _opened(path, columns)
    with file:
        return _as_written(file.read([field.name for field in fields]), fields, path.name)


def _opened(path: Path, columns: Collection[str] | None = None) -> "tuple[pq.ParquetFile, list[pa.Field[Any]]]":
    with pq.ParquetFile(path) as file:
        fields, texts = list(file.schema_arrow), _checked(file.metadata, path.name)
    selection = [field for field in fields if columns is None or field.name in columns]
    dictionaries = pq.ParquetFile(path, read_dictionary=texts)  # so a text of all rows takes the space of one
    return dictionaries, selection


def _as_written(table: pa.Table, fields: "Sequence[pa.Field[Any]]", name: str) -> pa.Table:
    """The columns with the types stored in the file."""
    for place, field in enumerate(fields):
        if field.type != table.schema.field(place).type:
            limits.within(_text_bytes(table.column(place)), limits.TABLE_TEXT_BYTES, f"bytes of {field.name} in {name}")
            table = table.set_column(place, field, table.column(place).cast(field.type))
    table.validate(full=True)  # texts are UTF-8, codes have a text
    return table


def _checked(about: pq.FileMetaData, name: str) -> list[str]:
    """Text columns of a Parquet file, after a check that it is flat and within limits."""
    limits.within(about.num_columns, limits.COLUMNS, f"columns in {name}")
    limits.within(about.num_rows, limits.ROWS, f"rows in {name}")
    columns = [about.schema.column(number) for number in range(about.num_columns)]
    if strange := [each.path for each in columns if each.max_repetition_level or each.physical_type not in _PHYSICAL]:
        raise ValueError(f"its column {strange[0]} contains neither numbers nor texts")
    texts = [number for number, each in enumerate(columns) if each.physical_type == "BYTE_ARRAY"]
    packed = 0
    for group in map(about.row_group, range(about.num_row_groups) if texts else ()):
        packed += sum(group.column(number).total_uncompressed_size for number in texts)
    limits.within(packed, limits.TABLE_TEXT_BYTES, f"bytes of texts in {name}")
    return [columns[number].path for number in texts]


def _text_bytes(texts: "pa.ChunkedArray[Any]") -> int:
    total = 0
    chunk: Any
    for chunk in texts.chunks:  # of dictionary-encoded texts
        sizes = np.array([len(text.encode()) for text in chunk.dictionary.to_pylist()], np.int64)
        total += int(sizes[chunk.indices.drop_null().to_numpy()].sum())
    return total


def load(run_dir: str | Path, radio: Collection[str] | None = None) -> Recording:
    """Read a run directory: ``states.parquet``, ``radio.parquet`` and, if it exists, ``metrics.json``."""
    folder = Path(run_dir)
    recording, metrics = load_tables(folder, radio), folder / "metrics.json"
    return replace(recording, metrics=read_json(limits.read_bytes(metrics), dict[str, Any])) if metrics.is_file() else recording


def load_tables(folder: Path, radio: Collection[str] | None = None) -> Recording:
    """Read both tables of a run directory, without its metrics; ``radio``: the columns of that table to read, if not all."""
    for name in ("states.parquet", "radio.parquet"):
        if not (folder / name).is_file():
            raise UsageError(f"{folder}: no {name} here; name the folder of a run (runs/<name>-<seed> or its --out)")
    states = read_table(folder / "states.parquet")
    facts = (states.schema.metadata or {}).get(FACTS)
    if facts is None:
        raise UsageError(f"{folder / 'states.parquet'}: not written by vcmvsp (its schema metadata lacks {FACTS.decode()})")
    frames = read_table(folder / "radio.parquet", radio)
    return Recording(states=states, radio=frames, facts=read_json(facts, RunFacts), metrics={})


def with_facts(columns: list[Any], schema: pa.Schema, facts: RunFacts) -> pa.Table:
    """The table of these columns, with the facts of its run in its metadata."""
    return pa.Table.from_arrays(columns, schema=schema.with_metadata({FACTS: msgspec.json.encode(facts)}))
