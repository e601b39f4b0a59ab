"""The tables of a run: those that it has left; of one that goes on or was cut before it wrote them, what its recording has."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.recorded_run import FILE, Source, Values
from vcmvsp.cosim.tables.radio_frames import Frames
from vcmvsp.cosim.tables.schema import (
    RADIO_SCHEMA,
    Placement,
    Recording,
    RunFacts,
    load,
    load_tables,
    radio_table,
    read_table,
    states_table,
)
from vcmvsp.cosim.types import Follows, States, VehicleState
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.text import Tell


def tables_of(
    folder: Path, tell: Tell = lambda _: None, *, numbers: bool = False, radio: Collection[str] | None = None
) -> Recording:
    """Both tables.

    Args:
        folder: that a run has left, or is writing into.
        tell: takes a line for the user: that only the recording is there, and how far it goes.
        numbers: those of ``metrics.json``, too, if it is there.
        radio: the columns of the radio's table that are needed; default: all.

    Raises:
        UsageError: there is neither.
        OSError, ValueError: a table is damaged.
    """
    if not (absent := _absent(folder)):
        return load(folder, radio) if numbers else load_tables(folder, radio)
    states, frames, facts = _recorded(folder, absent, tell, with_frames=radio is None or bool(radio))
    known = radio if radio is None else [name for name in RADIO_SCHEMA.names if name in radio]
    return Recording(states=states, radio=radio_table(frames, facts, known), facts=facts, metrics={})


def radio_columns(folder: Path, tell: Tell = lambda _: None) -> tuple[RunFacts, Sequence[str], Callable[[str], pa.Table]]:
    """Facts of a run, names of the columns of its radio's table, and what gives one of them; errors as of `tables_of`."""
    if absent := _absent(folder):
        _, frames, facts = _recorded(folder, absent, tell)
        return facts, RADIO_SCHEMA.names, lambda name: radio_table(frames, facts, (name,))
    path = folder / "radio.parquet"
    names = pq.read_schema(path).names if path.is_file() else ()
    return load_tables(folder, ()).facts, names, lambda name: read_table(path, (name,))


def _absent(folder: Path) -> str:
    """The table that has to be made of the recording, as it is not there."""
    absent = [name for name in ("states.parquet", "radio.parquet") if not (folder / name).is_file()]
    return absent[0] if absent and (folder / FILE).is_file() else ""


def _recorded(folder: Path, absent: str, tell: Tell, *, with_frames: bool = True) -> tuple[pa.Table, Frames, RunFacts]:
    source = Source(folder, lambda _: None)
    values, end_ns = Values(), 0
    instants: dict[int, dict[str, VehicleState]] = {}
    frames = Frames(source.vehicles)
    follows: list[Placement] = []

    def is_wanted(topic: str, _: str) -> bool:
        return topic.partition("/")[2] in ("state", "follows") or (topic == "radio/frame" and with_frames)

    for said in source.only(is_wanted):
        end_ns = max(end_ns, said.time_ns)
        vehicle, _, what = said.topic.partition("/")
        if said.topic == "radio/frame":
            frames.extend((values.of(said),))
        elif what == "state" and vehicle in source.vehicles:
            instants.setdefault(said.time_ns, {})[vehicle] = values.of(said)
        elif what == "follows":
            follows.append(Placement(said.time_ns, vehicle, read_json(said.data, Follows)))
    if not instants:
        raise UsageError(f"{source.folder}: the run was cut, or looked at, before its {FILE} had anything to show")
    facts = RunFacts(
        scenario=source.scenario, seed=int(source.seed), end_ns=end_ns, vehicles=source.vehicles, follows=tuple(follows)
    )
    reached = f"{FILE} has, up to {end_ns / SECOND_NS:.3f} s, without frames of programs and without routes"
    tell(f"{folder}: no {absent} here, as the run goes on or was cut: what is shown is what {reached}")
    return states_table([(time_ns, _states(states)) for time_ns, states in instants.items()], facts), frames, facts


def _states(states: dict[str, VehicleState]) -> States:
    fields = ("position", "velocity", "attitude", "angular_velocity")
    columns = {name: np.array([getattr(state, name) for state in states.values()]) for name in fields}
    return States(names=tuple(states), **columns)
