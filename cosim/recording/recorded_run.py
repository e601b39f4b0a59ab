"""A run's recording read back for exports: ``run.mcap``, which is all that a killed run leaves."""

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording import foxglove
from vcmvsp.cosim.recording.mcap_reader import Recorded, about, contents
from vcmvsp.cosim.types import (
    Array,
    FrameReport,
    Imu,
    Incident,
    Measured,
    Note,
    Odometry,
    RealStatus,
    VehicleState,
    Velocity,
    Waypoint,
)
from vcmvsp.cosim.util.documents import json_reader, read_json

FILE = "run.mcap"
TOLD_EVERY = 500  # messages


class Noted(msgspec.Struct, tag="note"):
    """A note; null is a number that JSON cannot say."""

    values: dict[str, Any]


class _Measured(msgspec.Struct, tag="measured"):
    """Numbers by name, likewise."""

    time_ns: int
    values: dict[str, float | None]


Command = Velocity | Waypoint
_READ_AS: dict[str, Any] = {
    **{f"vcmvsp.{kind.__name__}": kind for kind in (VehicleState, Odometry, Imu, RealStatus, Incident)},
    **{f"vcmvsp.{kind.__name__}": Command for kind in (Velocity, Waypoint)},  # one topic may have both
    f"vcmvsp.{Measured.__name__}": _Measured,
    f"vcmvsp.{Note.__name__}": Noted,
    "vcmvsp.Frame": FrameReport,
    **{
        f"foxglove.{kind.__name__}": kind
        for kind in (
            *(foxglove.CameraCalibration, foxglove.FrameTransforms, foxglove.LaserScan, foxglove.Log, foxglove.PoseInFrame),
            *(foxglove.RawImage, foxglove.SceneUpdate, foxglove.CompressedImage, foxglove.Grid),
        )
    },
}


class Source:
    """The recording in a run's folder; each pass reads the file anew.

    Args:
        run_dir: the folder that a run has left, or is writing.
        tell: takes a line for the user: that the recording is damaged, and how far it goes. It is told so once.

    Attributes:
        folder: the run's.
        tell: as it was given.
        progress: called during each pass with the part of the file that has been read, 0 to 1.
        scenario: its name.
        seed: of the run, as text.
        vehicles: in the order of the run.

    Raises:
        UsageError: there is no recording in the folder, or nothing in it can be read.
    """

    def __init__(self, run_dir: Path, tell: Callable[[str], None]) -> None:
        self.folder, self.tell = run_dir, tell
        self._path, self._told = run_dir / FILE, False
        self.progress: Callable[[float], None] = lambda _: None
        try:
            with self._path.open("rb") as stream:
                said = about(stream)
        except OSError as error:
            problem = "there is no such folder" if not run_dir.is_dir() else f"no {FILE} here"
            why = problem if isinstance(error, FileNotFoundError | NotADirectoryError) else f"{FILE}: {error.strerror}"
            raise UsageError(f"{run_dir}: {why}; name the folder that a run left (runs/NAME-SEED, or its --out)") from error
        if "vehicles" not in said:
            raise UsageError(f"{self._path}: is no recording of a run, or is damaged from its beginning on")
        self.scenario, self.seed = said["scenario"], said["seed"]
        self.vehicles = tuple(said["vehicles"].split())

    def __iter__(self) -> Iterator[Recorded]:
        """Every message, in order of time; of a damaged recording those before the damage."""
        return self.only(lambda *_: True)

    def only(self, wanted: Callable[[str, str], bool]) -> Iterator[Recorded]:
        """Messages of some topics, and one without a topic behind others: see `contents`."""
        last_ns = 0
        try:
            with self._path.open("rb") as stream:
                size = max(1, os.fstat(stream.fileno()).st_size)
                for number, each in enumerate(contents(stream, wanted)):
                    last_ns = each.time_ns
                    if number % TOLD_EVERY == 0:
                        self.progress(stream.tell() / size)
                    yield each
        except ValueError as error:
            if not self._told:
                self._told = True
                self.tell(f"{self._path} is damaged ({error}): what is exported ends at {last_ns / SECOND_NS:.3f} s")
        except OSError as error:
            raise UsageError(f"{self._path}: {error.strerror}") from error


def is_known(schema: str) -> bool:
    """Whether `Values` looks into messages of this schema."""
    return schema in _READ_AS


class Values:
    """Messages as values; None: of a kind that no export looks into.

    Args:
        also: further schemas that are looked into, and the type of each.
    """

    def __init__(self, also: Mapping[str, Any] = {}) -> None:
        self._read_as = {**_READ_AS, **also}
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    def of(self, message: Recorded) -> Any:
        """The value that a message was made of, or the `cosim.recording.foxglove` message that it is.

        Raises:
            UsageError: it is not what its schema says.
        """
        kind = self._read_as.get(message.schema)
        if kind is None:
            return None
        decode = self._decoders.get(message.schema)
        if decode is None:
            decode = self._decoders[message.schema] = json_reader(kind, _array)
        with contextlib.suppress(ValueError):
            return decode(message.data)
        try:
            return msgspec.convert(_with_nan(read_json(message.data)), kind, dec_hook=_array)
        except ValueError as error:
            raise UsageError(f"{FILE}: a message of {message.topic} is no {message.schema}: {error}") from error


def _with_nan(said: object) -> object:
    """JSON with NaN in place of null: of a vehicle that was sent to infinity, say."""
    if isinstance(said, dict):
        return {name: _with_nan(each) for name, each in said.items()}
    if isinstance(said, list):
        return [_with_nan(each) for each in said]
    return math.nan if said is None else said


def _array(_: type, numbers: Sequence[float | None]) -> Array:
    """Numbers; those that JSON cannot say are null there, and NaN here."""
    whole = {int}.issuperset(map(type, numbers))
    return np.array(numbers, np.int64 if whole else np.float64)
