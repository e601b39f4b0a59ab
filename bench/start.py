"""Cost of a run that simulates next to nothing, and of ``--help``: ``python -m bench.start``.

CPU seconds and wall-clock seconds of whole processes, from the command line to its end.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from bench.measure import Row, in_turn, measured, medians, table

ROUNDS = 3
SCENARIO, DURATION_S = "formation-circle", 0.1
IMPORTS = "import pybullet, numpy, simpy"


class Cost(NamedTuple):
    """Cost of a finished process, s."""

    cpu_s: float
    wall_s: float


def process(arguments: Sequence[str]) -> Cost:
    """Python with these arguments; imports are compiled once, regardless of PYTHONDONTWRITEBYTECODE."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    compiled = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=compiled)
    wall_s, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return Cost(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall_s)


def help_cpu() -> Row:
    """``vcmvsp --help``."""
    ours, other, ratio = in_turn(
        lambda: process(["-m", "vcmvsp.cosim.cli.app", "--help"]).cpu_s, lambda: process(["-c", "pass"]).cpu_s, 9
    )
    name = "vcmvsp --help; beside python -c pass"
    return Row(name, f"{ours:.2f} CPU s", f"{other:.2f}", ratio, "goal: <= 0.3 CPU s", ours <= 0.3)


def run() -> list[Row]:
    """A run from the command line."""
    print("measuring: start, run ...", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "-m",
            "vcmvsp.cosim.cli.app",
            "run",
            SCENARIO,
            "--set",
            f"duration_s={DURATION_S}",
            "--set",
            "metrics.from_s=0.0",
        ]
        words += ["--quiet", "--force", "--out", str(Path(folder) / "run")]
        pairs = [(process(words), process(["-c", IMPORTS])) for _ in range(ROUNDS + 1)][1:]  # the first run compiles
    name = f"vcmvsp run of {DURATION_S:g} s of {SCENARIO}, with its files and figures; beside python -c '{IMPORTS}'"
    found = []
    for clock, place in (("CPU", 0), ("wall", 1)):
        ours, other, ratio = medians([(our_times[place], other_times[place]) for our_times, other_times in pairs])
        found.append(Row(name, f"{ours:.2f} {clock} s", f"{other:.2f}", ratio, "none", True))
    return found


def rows() -> list[Row]:
    """All rows."""
    return [*measured((help_cpu,)), *run()]


if __name__ == "__main__":
    print(table(rows()))
