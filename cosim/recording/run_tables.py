"""The tables of a run: those that it has left; of one that goes on or was cut before it wrote them, what its recording has."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.recorded_run import FILE, Source, Values
from vcmvsp.cosim.tables.schema import Placement, Recording, RunFacts, load, load_tables, radio_table, states_table
from vcmvsp.cosim.types import Follows, FrameReport, States, VehicleState
from vcmvsp.cosim.util.documents import read_json


def tables_of(folder: Path, tell: Callable[[str], None] = lambda _: None, *, numbers: bool = False) -> Recording:
    """Both tables.

    Args:
        folder: that a run has left, or is writing into.
        tell: takes a line for the user: that only the recording is there, and how far it goes.
        numbers: those of ``metrics.json``, too, if it is there.

    Raises:
        UsageError: there is neither.
        OSError, ValueError: a table is damaged.
    """
    absent = [name for name in ("states.parquet", "radio.parquet") if not (folder / name).is_file()]
    if not absent or not (folder / FILE).is_file():
        return load(folder) if numbers else load_tables(folder)
    found = _recorded(Source(folder, lambda _: None))
    reached = f"{FILE} has, up to {found.facts.end_ns / SECOND_NS:.3f} s, without frames of programs and without routes"
    tell(f"{folder}: no {absent[0]} here, as the run goes on or was cut: what is shown is what {reached}")
    return found


def _recorded(source: Source) -> Recording:
    """What stands in a recording."""
    values, end_ns = Values(), 0
    instants: dict[int, dict[str, VehicleState]] = {}
    reports: list[FrameReport] = []
    follows: list[Placement] = []
    for said in source:
        end_ns = max(end_ns, said.time_ns)
        vehicle, _, what = said.topic.partition("/")
        if said.topic == "radio/frame":
            reports.append(values.of(said))
        elif what == "state" and vehicle in source.vehicles:
            instants.setdefault(said.time_ns, {})[vehicle] = values.of(said)
        elif what == "follows":
            follows.append(Placement(said.time_ns, vehicle, read_json(said.data, Follows)))
    if not instants:
        raise UsageError(f"{source.folder}: the run was cut, or looked at, before its {FILE} had anything to show")
    facts = RunFacts(
        scenario=source.scenario, seed=int(source.seed), end_ns=end_ns, vehicles=source.vehicles, follows=tuple(follows)
    )
    rows = [(time_ns, _states(states)) for time_ns, states in instants.items()]
    return Recording(states=states_table(rows, facts), radio=radio_table(reports, facts), facts=facts, metrics={})


def _states(states: dict[str, VehicleState]) -> States:
    """The states of one instant, in columns."""
    fields = ("position", "velocity", "attitude", "angular_velocity")
    columns = {name: np.array([getattr(state, name) for state in states.values()]) for name in fields}
    return States(names=tuple(states), **columns)
