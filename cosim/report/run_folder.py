"""Reads the files of a run's folder, as far as they exist and are readable."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pyarrow.parquet as pq

from vcmvsp.cosim.analysis.links import NUMBERS, Links, links_of
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.foxglove import LEVELS
from vcmvsp.cosim.recording.mcap_reader import about, messages, of_topic
from vcmvsp.cosim.tables.schema import Recording, TableFile, load_tables
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json, read_toml

T = TypeVar("T")

FILES = {
    "scenario.toml": "what was run, how to repeat it, and what theory expects",
    "states.parquet": "where the vehicles went",
    "radio.parquet": "what became of frames",
    "metrics.json": "the numbers",
    "run.mcap": "what befell agents and robots, and what was seen in a mission",
    "about.json": "whether the run came to its end, and the machine that it ran on",
}
"""Files of a run, and the content that is missing without each."""
_LEVELS = {number: name for name, number in LEVELS.items()}


class _Line(msgspec.Struct):
    level: int
    message: str


@dataclass(frozen=True)
class RunContent:
    """The content of a run's folder."""

    folder: Path
    scenario_toml: str = ""
    scenario: dict[str, Any] = field(default_factory=dict)
    recording: Recording | None = None  # without frames
    radio: TableFile | None = None
    links: Links | None = None
    metrics: dict[str, Any] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    log: Sequence[tuple[float, str, str]] = ()  # s, level, text: log of the recording
    missing: Sequence[tuple[str, str]] = ()  # file, and why it is not shown
    head: Mapping[str, str] = field(default_factory=dict)  # metadata of the recording: scenario, seed, vehicles
    recorded_s: float | None = None  # length of the recording, if the run left no tables


def content_of(folder: Path) -> RunContent:
    """Read the folder of a run; an empty one is a UsageError."""
    if not any((folder / name).is_file() for name in FILES):
        raise UsageError(f"{folder}: no results of a run or study here; name its folder (runs/<name>-<seed> or its --out)")
    missing = {name: "is not there" for name in FILES if not (folder / name).is_file()}

    def read(name: str, reader: Callable[[Path], T], otherwise: T) -> T:
        if name in missing:
            return otherwise
        try:
            return reader(folder / name)
        except (ValueError, OSError) as error:
            missing[name] = f"cannot be read: {' '.join(str(error).split())}".replace(f"{folder}/", "")
            return otherwise

    text = read("scenario.toml", limits.read_text, "")
    recording = None
    schemas = [read(name, pq.read_schema, None) for name in ("states.parquet", "radio.parquet")]
    if None not in schemas:
        recording = read("states.parquet", lambda path: load_tables(path.parent, ()), None)
    radio = None if recording is None else read("radio.parquet", TableFile, None)
    links = None if recording is None or radio is None else read("radio.parquet", lambda _: _links(recording, radio), None)
    return RunContent(
        folder,
        text,
        read("scenario.toml", lambda _: read_toml(text), {}),
        recording,
        radio,
        links,
        read("metrics.json", lambda path: _json(path, "vcmvsp.metrics/1"), {}),
        read("about.json", lambda path: _json(path, "vcmvsp.about/1"), {}),
        read("run.mcap", _log, ()),
        list(missing.items()),
        read("run.mcap", _head, {}),
        None if recording is not None or "run.mcap" in missing else _recorded_s(folder / "run.mcap"),
    )


def _json(path: Path, schema: str) -> dict[str, Any]:
    content: dict[str, Any] = read_json(limits.read_bytes(path), dict[str, Any])
    if content.get("schema") != schema:
        raise ValueError(f"its schema is not {schema}: it was written by another version")
    return content


def _links(recording: Recording, radio: TableFile) -> Links:
    if absent := [name for name in NUMBERS if name not in radio.schema.names]:
        raise ValueError(f"it has no {absent[0]}: it was written by another version")
    return links_of(radio, recording.facts.vehicles)


def _log(path: Path) -> list[tuple[float, str, str]]:
    with path.open("rb") as stream:
        lines = [(time_ns, read_json(data, _Line)) for time_ns, data in of_topic(stream, "log")]
    return [(time_ns / SECOND_NS, _LEVELS.get(line.level, "info"), line.message) for time_ns, line in lines]


def _head(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        return about(stream)


def _recorded_s(path: Path) -> float:
    """Time of the last message before the damage."""
    last = 0
    with path.open("rb") as stream, contextlib.suppress(ValueError):  # the readable part ends there
        for _, time_ns, _ in messages(stream):
            last = max(last, time_ns)
    return last / SECOND_NS
