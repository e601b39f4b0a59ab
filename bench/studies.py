"""Studies: speed of a run, overhead of the study, and gain by a second core.

Run with ``python -m bench.studies``. The workload is that of a formation under loss: three points without bodies, 10 Hz.
"""

import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from bench.cores import gain_of_integers
from bench.measure import Row, cpu, in_turn, measured, missing, peak_mib, table
from bench.workloads import star
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.studies.engine import study
from vcmvsp.cosim.studies.plan import Plan
from vcmvsp.cosim.studies.rows import Row as Values
from vcmvsp.cosim.studies.rows import decode, encode, flat
from vcmvsp.cosim.studies.store import Store
from vcmvsp.cosim.studies.worker import Job, Work, run_one, version

ROUNDS = 5
DURATION_S = 120.0
RUNS = 100
JOBS = 2
IDEAL = {"preset": "ideal", "loss": {"probability": 0.2}, "delay": {"seconds": 0.05, "jitter_s": 0.02}}
VARY = {"radio.loss.probability": [0.1, 0.3]}


def formation(duration_s: float = DURATION_S) -> dict[str, Any]:
    """The scenario."""
    return star(3, physics="kinematic", duration_s=duration_s)


def succeeded(work: Work, seed: int) -> None:
    """One run; a failed one takes no time, and must not be timed."""
    if (error := decode(run_one(work, Job(seed, {}))).error) is not None:
        raise RuntimeError(error)


def wall_s(scenario: dict[str, Any], runs: int, jobs: int) -> float:
    """Wall-clock seconds of a study, from the first check to the table."""
    begin = time.monotonic()
    found = study(scenario, vary=VARY, seeds=runs // 2, jobs=jobs)
    seconds = time.monotonic() - begin
    if found.num_rows != runs or found["error"].null_count != runs:
        raise RuntimeError(f"runs failed: {found['error'].to_pylist()}")
    return seconds


def speed() -> Row:
    """A run of a study, on the channel of the built-in studies: tables and metrics, no files."""
    return _speed("an ideal channel with loss and delay", formation() | {"radio": IDEAL})


def speed_contended() -> Row:
    """The same with contention."""
    return _speed("802.11b", formation())


def _speed(radio: str, scenario: dict[str, Any]) -> Row:
    work = Work(tomli_w.dumps(scenario), ".", version())
    ours, other, ratio = in_turn(
        lambda: cpu(lambda: succeeded(work, 1)), lambda: cpu(lambda: api.run(scenario, seed=1)), ROUNDS
    )
    name = f"study: a run of 3 kinematic robots, 10 Hz, 120 s, {radio}; beside vcmvsp.run with its MCAP file in memory"
    times = DURATION_S / ours
    return Row(name, f"{times:.0f}x real time", f"{DURATION_S / other:.0f}x", ratio, "goal: >= 200x a core", times >= 200.0)


def overhead() -> Row:
    """Runs that take no time, so that the study's own cost is left: a longer one less a shorter one, without the start."""
    scenario, runs = formation(0.1), 200
    work = Work(tomli_w.dumps(scenario), ".", version())

    def ours() -> float:
        return (wall_s(scenario, 2 * runs, 1) - wall_s(scenario, runs, 1)) / runs

    def other() -> float:
        begin = time.monotonic()
        for number in range(runs):
            succeeded(work, number)
        return (time.monotonic() - begin) / runs

    our_s, other_s, _ = in_turn(ours, other, 3)
    added = 1000.0 * (our_s - other_s)
    name = "study: a run of 0.1 s in one worker; beside the same run in a loop, in this process (ratio: ms that the study adds)"
    return Row(name, f"{1000 * our_s:.1f} ms", f"{1000 * other_s:.1f} ms", added, "goal: <= 50 ms a run", added <= 50.0)


def efficiency() -> Row:
    """Two workers beside one, start and end included, and beside what the second core adds to a loop over integers."""
    name = (
        f"study: {RUNS} runs of 120 s with {JOBS} jobs; beside one with one (ratio: gain, beside that of a loop over integers)"
    )
    try:
        possible = gain_of_integers()
    except ValueError as error:
        return missing(name, ">= 0.85", error)
    one, two = wall_s(formation(), RUNS, 1), wall_s(formation(), RUNS, JOBS)
    share = one / two / possible
    return Row(name, f"{two:.0f} s", f"{one:.0f} s", share, ">= 0.85", share >= 0.85)


def memory() -> Row:
    """Collect and write the rows of a large study, in a process of its own."""
    peak_mib, columns, megabytes = map(float, _fresh("bench.studies", "fill").split())
    name = f"study: peak memory, 10 000 rows of 50 vehicles ({columns:.0f} numbers each); beside their JSON"
    return Row(name, f"{peak_mib:.0f} MiB", f"{megabytes:.0f} MB", peak_mib / megabytes, "< 500 MiB", peak_mib < 500.0)


def _fresh(module: str, function: str) -> str:
    command = [sys.executable, "-c", f"from {module} import {function}; {function}()"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def fill() -> None:
    """Print the peak memory in MiB, numbers in a row, and MB of all rows; every row has other numbers."""
    values = flat(api.run(star(50, physics="kinematic", duration_s=0.2) | {"radio": IDEAL}, mcap=False).metrics)
    plan, written = Plan(scenario="", scenario_toml="", vary={"a": list(range(500))}, seeds=list(range(20))), 0
    draw = random.Random(0)
    texts: dict[str, Any] = {name: value for name, value in values.items() if isinstance(value, str)}
    with tempfile.TemporaryDirectory() as folder, Store(Path(folder), plan, resume=False, force=False) as store:
        for run in plan.runs:
            drawn: dict[str, Any] = {name: draw.random() for name in values}
            row = encode(Values(drawn | texts))
            written += len(row)
            store.add(run.key, row)
        store.finish()
    print(peak_mib(), len(values), written / 1e6)


ALL: Sequence[Callable[[], Row]] = (speed, speed_contended, overhead, efficiency, memory)


def rows() -> list[Row]:
    """All rows."""
    return measured(ALL)


if __name__ == "__main__":
    print(table(rows()))
