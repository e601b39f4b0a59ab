"""Reads the recording of a run for exports: ``run.mcap``, the only file that a killed run leaves."""

import contextlib
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim import types
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording import foxglove
from vcmvsp.cosim.recording.mcap_reader import Recorded, about, contents
from vcmvsp.cosim.tables import radio_frames, schema
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import json_reader, read_json
from vcmvsp.cosim.util.text import Tell

FILE = "run.mcap"
TOLD_EVERY = 500  # messages
_INT64 = range(-(2**63), 2**63)
_NUMBERS_OF = attrgetter(*radio_frames.PER_FRAME)
_COLUMNS_OF = attrgetter(*radio_frames.PER_ROW, *radio_frames.BUDGET, *radio_frames.PATHS, "outcome", "wall_materials")


class Noted(msgspec.Struct, tag="note"):
    """A note of an agent; null stands for a number that JSON cannot express."""

    values: dict[str, Any]


class _Measured(msgspec.Struct, tag="measured"):
    time_ns: int
    values: dict[str, float | None]


Command = types.Velocity | types.Waypoint
_FOXGLOVE = ("CameraCalibration", "CompressedImage", "FrameTransforms", "Grid", "LaserScan", "Log", "PoseInFrame", "RawImage")
_READ_AS: dict[str, Any] = {
    **{f"vcmvsp.{kind.__name__}": kind for kind in (types.VehicleState, types.Odometry, types.Imu, types.RealStatus)},
    **dict.fromkeys(("vcmvsp.Velocity", "vcmvsp.Waypoint"), Command),  # one topic may carry both
    "vcmvsp.Incident": types.Incident,
    "vcmvsp.Measured": _Measured,
    "vcmvsp.Note": Noted,
    "vcmvsp.Frame": types.FrameReport,
}
_READ_AS |= {f"foxglove.{name}": getattr(foxglove, name) for name in (*_FOXGLOVE, "SceneUpdate")}


class Source:
    """The recording in a run's folder; each pass reads the file anew.

    Args:
        run_dir: folder of a finished or current run.
        tell: receives one line for the user if the recording is damaged: how far it is readable.

    Raises:
        UsageError: the folder contains no readable recording.
    """

    def __init__(self, run_dir: Path, tell: Callable[[str], None]) -> None:
        self.folder, self.tell = run_dir, tell
        self._path, self._has_warned = run_dir / FILE, False
        self.progress: Callable[[float], None] = lambda _: None  # receives the share of the file read by a pass, 0 to 1
        try:
            with self._path.open("rb") as stream:
                facts = about(stream)
        except OSError as error:
            problem = "there is no such folder" if not run_dir.is_dir() else f"no {FILE} here"
            why = problem if isinstance(error, FileNotFoundError | NotADirectoryError) else f"{FILE}: {error.strerror}"
            raise UsageError(f"{run_dir}: {why}; name the folder of a run (runs/NAME-SEED, or its --out)") from error
        try:
            self.scenario, self.seed = facts["scenario"], int(facts["seed"])
        except (KeyError, ValueError):
            raise UsageError(f"{self._path}: not a recording of a run, or damaged from the beginning") from None
        self.vehicles = vehicles_of(facts, self._path)

    def __iter__(self) -> Iterator[Recorded]:
        """All messages in order of time; of a damaged recording, those before the damage."""
        return self.only(lambda *_: True)

    def facts(self, end_ns: int) -> schema.RunFacts:
        """Facts of the run up to a time, without slots of followers."""
        return schema.RunFacts(scenario=self.scenario, seed=self.seed, end_ns=end_ns, vehicles=self.vehicles)

    def only(self, selects: Callable[[str, str], bool]) -> Iterator[Recorded]:
        """Messages of wanted topics, and placeholders without a topic for the others: see `contents`."""
        last_ns = 0
        try:
            with self._path.open("rb") as stream:
                size = max(1, os.fstat(stream.fileno()).st_size)
                for number, each in enumerate(contents(stream, selects)):
                    last_ns = each.time_ns
                    if number % TOLD_EVERY == 0:
                        self.progress(stream.tell() / size)
                    yield each
        except ValueError as error:
            if not self._has_warned:
                self._has_warned = True
                self.tell(f"{self._path} is damaged ({error}): the export ends at {last_ns / SECOND_NS:.3f} s")
        except OSError as error:
            raise UsageError(f"{self._path}: {error.strerror}") from error


def vehicles_of(about: Mapping[str, str], path: Path) -> tuple[str, ...]:
    """The vehicles of a run, from the metadata of its recording. Raises `UsageError` (more than `limits.VEHICLES`)."""
    names = tuple(about.get("vehicles", "").split())
    try:
        limits.within(len(names), limits.VEHICLES, "vehicles")
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
    return names


def is_known(schema: str) -> bool:
    """Whether `Values` decodes messages of this schema."""
    return schema in _READ_AS


class Values:
    """Decodes messages to values; None for types that no export uses.

    Args:
        also: further schemas to decode, each with its type.
    """

    def __init__(self, also: Mapping[str, Any] = {}) -> None:
        self._read_as = {**_READ_AS, **also}
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    def of(self, message: Recorded) -> Any:
        """The value that a message was made from, or the message itself if it is a `cosim.recording.foxglove` type.

        Raises:
            UsageError: the message does not match its schema.
        """
        kind = self._read_as.get(message.schema)
        if kind is None:
            return None
        decode = self._decoders.get(message.schema)
        if decode is None:
            decode = self._decoders[message.schema] = json_reader(kind, _array)
        try:
            return _checked(decode(message.data))
        except ValueError as error:
            with contextlib.suppress(ValueError):
                return _checked(msgspec.convert(_with_nan(read_json(message.data)), kind, dec_hook=_array))
            raise UsageError(f"{FILE}: a message of {message.topic} does not match {message.schema}: {error}") from error


def _checked(value: Any) -> Any:
    """The value. Raises `ValueError` (a frame with columns of different lengths, or with numbers beyond 64 bits)."""
    if isinstance(value, types.FrameReport):
        lengths = {len(each) for each in _COLUMNS_OF(value) if each is not None and each is not msgspec.UNSET}
        if lengths != {len(value.receivers)}:
            raise ValueError("its columns differ in length")
        if not all(each in _INT64 for each in _NUMBERS_OF(value)):
            raise ValueError("it has numbers of more than 64 bits")
    return value


def _with_nan(value: object) -> object:
    if isinstance(value, dict):
        return {name: _with_nan(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_with_nan(each) for each in value]
    return math.nan if value is None else value


def _array(_: type, numbers: Sequence[float | None]) -> types.Array:
    whole = {int}.issuperset(map(type, numbers))
    try:
        array = np.array(numbers, np.int64 if whole else np.float64)
    except OverflowError as error:
        raise ValueError("it has numbers of more than 64 bits") from error
    if array.ndim != 1:
        raise ValueError("it has lists of lists")
    return array


def tables_of(
    folder: Path,
    tell: Tell = lambda _: None,
    *,
    numbers: bool = False,
    radio: Collection[str] | None = None,
    before_ns: int | None = None,
) -> schema.Recording:
    """Both tables of a run, the radio table with the given columns or all; ``numbers``: with ``metrics.json`` if it exists.

    Args:
        tell: receives a line for the user if only the recording exists: how far it goes.
        before_ns: only earlier messages of the recording count, if only that exists; None: all.

    Raises:
        UsageError: the folder contains neither tables nor a recording.
        OSError, ValueError: a table is damaged.
    """
    if not (absent := _absent(folder)):
        return schema.load(folder, radio) if numbers else schema.load_tables(folder, radio)
    states, frames, facts = _recorded(folder, absent, tell, with_frames=radio is None or bool(radio), before_ns=before_ns)
    return schema.Recording(states=states, radio=schema.radio_table(frames, facts, radio), facts=facts, metrics={})


def radio_columns(
    folder: Path, tell: Tell = lambda _: None
) -> tuple[schema.RunFacts, Sequence[str], Callable[[str], pa.Table]]:
    """Facts of a run, column names of its radio table, and a function that reads one column; errors as of `tables_of`."""
    if absent := _absent(folder):
        _, frames, facts = _recorded(folder, absent, tell)
        names = schema.radio_table(frames, facts, rows=(0, 0)).schema.names
        return facts, names, lambda name: schema.radio_table(frames, facts, (name,))
    path = folder / "radio.parquet"
    names = pq.read_schema(path).names if path.is_file() else []
    return schema.load_tables(folder, ()).facts, names, lambda name: schema.read_table(path, (name,))


def _absent(folder: Path) -> str:
    absent = [name for name in ("states.parquet", "radio.parquet") if not (folder / name).is_file()]
    return absent[0] if absent and (folder / FILE).is_file() else ""


def _recorded(
    folder: Path, absent: str, tell: Tell, *, with_frames: bool = True, before_ns: int | None = None
) -> tuple[pa.Table, radio_frames.Frames, schema.RunFacts]:
    source = Source(folder, lambda _: None)
    values, end_ns = Values(), 0
    instants: dict[int, dict[str, types.VehicleState]] = {}
    frames = radio_frames.Frames(source.vehicles)
    follows: list[schema.Placement] = []

    def is_wanted(topic: str, _: str) -> bool:
        return topic.partition("/")[2] in ("state", "follows") or (topic == "radio/frame" and with_frames)

    for record in source.only(is_wanted):
        if before_ns is not None and record.time_ns >= before_ns:
            break
        end_ns = max(end_ns, record.time_ns)
        vehicle, _, subtopic = record.topic.partition("/")
        if record.topic == "radio/frame":
            frames.extend((values.of(record),))
        elif subtopic == "state" and vehicle in source.vehicles:
            instants.setdefault(record.time_ns, {})[vehicle] = values.of(record)
        elif subtopic == "follows":
            follows.append(schema.Placement(record.time_ns, vehicle, read_json(record.data, types.Follows)))
    if not instants:
        raise UsageError(f"{source.folder}: {FILE} is still empty: the run was killed early, or has just started")
    facts = msgspec.structs.replace(source.facts(end_ns), follows=tuple(follows))
    reached = f"up to {end_ns / SECOND_NS:.3f} s, without frames of programs and routes"
    tell(f"{folder}: no {absent} here (the run continues or was killed): data come from {FILE}, {reached}")
    return schema.states_table([(time_ns, states_of(states)) for time_ns, states in instants.items()], facts), frames, facts


def states_of(states: Mapping[str, types.VehicleState]) -> types.States:
    """The true states of one instant as columns."""
    columns = {}
    for name in ("position", "velocity", "attitude", "angular_velocity"):
        columns[name] = types.frozen([getattr(state, name) for state in states.values()], np.float64)
    return types.States(names=tuple(states), **columns)
