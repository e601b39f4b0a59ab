"""Gain of each way past a limit, beside the same run without it."""

import importlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from bench.asked import program
from bench.crowds import RADIOS, team
from bench.federation import HERE
from bench.measure import cpu, in_turn
from bench.ns3.cases import Case
from bench.radio import _ours_s
from bench.studies import JOBS, VARY, formation
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.studies.engine import study

ROUNDS = 3
RUN_S = 4.0
STUDY_RUNS, STUDY_RUN_S = 24, 60.0
SCANNERS = 20


class Way(NamedTuple):
    """A line: with the way, without it, and the median of the ratios."""

    label: str
    ours: str
    other: str
    ratio: float


def ways(tell: Callable[[str], None]) -> Iterator[Way]:
    """All ways; each is named, then measured."""
    for way in (bodies, states_less_often, without_mcap, on_demand, compiled, processes, jobs, workers):
        tell(way.__name__.replace("_", " "))
        yield way()


def bodies() -> Way:
    """Bodies only for vehicles that a sensor observes."""
    ideal = RADIOS["ideal radio"]
    few = team({"p2dx": 10, "kinematic": 90}, 1.0, ideal, RUN_S)
    return _runs("10 p2dx and 90 kinematic; beside 100 p2dx", few, team({"p2dx": 100}, 1.0, ideal, RUN_S))


def states_less_often() -> Way:
    """States once a second."""
    scenario = team({"kinematic": 100}, 1.0, RADIOS["ideal radio"], RUN_S)
    return _runs("100 kinematic, `record.period_s = 1.0`; beside 0.1", scenario | {"record": {"period_s": 1.0}}, scenario)


def without_mcap() -> Way:
    """Tables and metrics alone."""
    scenario = team({"kinematic": 50}, 10.0, RADIOS["ideal radio"], RUN_S)
    ours, other, ratio = in_turn(lambda: _run_s(scenario, mcap=False), lambda: _run_s(scenario), ROUNDS)
    return Way("50 kinematic, 10 Hz, `mcap=False` as in a study; beside one with `run.mcap`", _s(ours), _s(other), ratio)


def on_demand() -> Way:
    """Scans that no agent reads."""
    scenario = team({"p2dx": SCANNERS}, 1.0, RADIOS["ideal radio"], RUN_S)
    for vehicle in scenario["vehicle"]:
        vehicle["sensors"] = {"scan": {"kind": "lms"}}
    recorded = scenario | {"record": {"sensors": ["scan"]}}
    return _runs(f"{SCANNERS} p2dx with scanners without a reader; beside `record.sensors`", scenario, recorded)


def compiled() -> Way:
    """The contention core in machine code."""
    case = Case("g-6", 100, 10.0)
    ours, other, ratio = in_turn(lambda: _ours_s(case, compiled=True), lambda: _ours_s(case, compiled=False), 1)
    return Way("channel alone, 802.11g, 100 radios, 5 s, compiled; beside `VCMVSP_COMPILED=0`", _s(ours), _s(other), ratio)


def processes() -> Way:
    """Agents that compute, in processes of their own."""
    same: dict[str, Any] = {"agents": 2, "busy_s": 0.02, "stretch_s": 0.5}
    with program("ours", HERE, **same, processes=2) as apart, program("ours", HERE, **same) as together:
        ours, other, ratio = in_turn(apart, together, ROUNDS)
    label = "2 agents that compute 20 ms each, in 2 host processes, a step; beside agents in the run's process"
    return Way(label, f"{2e3 * ours:.1f} wall ms", f"{2e3 * other:.1f}", ratio)


def jobs() -> Way:
    """Runs in parallel."""
    ours, other = _study_s(STUDY_RUNS, jobs=JOBS), _study_s(STUDY_RUNS, jobs=1)
    return Way(f"study, {STUDY_RUNS} runs, {JOBS} at once; beside 1", f"{ours:.1f} wall s", f"{other:.1f}", ours / other)


def workers() -> Way:
    """Studies on a Dask cluster."""
    ours, other = _cluster_s(JOBS), _cluster_s(1)
    label = f"the same on a Dask cluster of this machine with {JOBS} workers; beside 1"
    return Way(label, f"{ours:.1f} wall s", f"{other:.1f}", ours / other)


def _cluster_s(count: int) -> float:
    """A study on a number of Dask workers, each of which has made a run."""
    distributed: Any = importlib.import_module("distributed")
    with distributed.LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster:
        _study_s(4 * count, cluster=cluster)
        return _study_s(STUDY_RUNS, cluster=cluster)


def _study_s(runs: int, **where: Any) -> float:
    """Wall-clock seconds of a study, from the first check to the table."""
    begin = time.monotonic()
    found = study(formation(STUDY_RUN_S), vary=VARY, seeds=runs // 2, **where)
    seconds = time.monotonic() - begin
    if found["error"].null_count != runs:
        raise RuntimeError(f"runs failed: {found['error'].to_pylist()}")
    return seconds


def _runs(label: str, ours: Mapping[str, Any], other: Mapping[str, Any]) -> Way:
    our_s, other_s, ratio = in_turn(lambda: _run_s(ours), lambda: _run_s(other), ROUNDS)
    return Way(f"{label}, {RUN_S:g} s", _s(our_s), _s(other_s), ratio)


def _run_s(scenario: Mapping[str, Any], *, mcap: bool = True) -> float:
    """CPU seconds of ``vcmvsp.run``, start and metrics included; files stay in memory."""
    return cpu(lambda: api.run(scenario, agents="inprocess", mcap=mcap))


def _s(seconds: float) -> str:
    return f"{seconds:.2f} CPU s"
