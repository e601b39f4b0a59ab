"""Size of a run's files, and its memory, per vehicle and per frame and receiver."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from bench.crowds import RADIOS, team
from bench.measure import peak_mib
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.tables.schema import load, read_table

VEHICLES, DURATION_S = 50, 10.0
SILENT_HZ, TALKING_HZ = 1e-6, 10.0
SHORT_S, LONG_S = 50.0, 100.0  # of a run whose memory is measured: more receptions than a row group of its file
OFTEN_S, RARELY_S = 0.01, 1e3  # between recorded states


class Sizes(NamedTuple):
    """Bytes: of silent vehicles, per vehicle and simulated second; and the increase by each frame at each receiver."""

    mcap_state: float
    mcap_reception: float
    states_state: float
    radio_reception: float


class Left(NamedTuple):
    """Result of a run: bytes, and rows of ``radio.parquet``."""

    mcap: int
    states: int
    radio: int
    receptions: int


def sizes() -> Sizes:
    """Sizes of runs of kinematic vehicles that all hear each other by 802.11g, one silent, one not."""
    silent, talking = left(SILENT_HZ), left(TALKING_HZ)
    lived = VEHICLES * DURATION_S
    return Sizes(
        mcap_state=silent.mcap / lived,
        mcap_reception=(talking.mcap - silent.mcap) / talking.receptions,
        states_state=silent.states / lived,
        radio_reception=(talking.radio - silent.radio) / talking.receptions,
    )


def left(hz: float) -> Left:
    """Result of a run in which each broadcasts at this rate."""
    scenario = team({"kinematic": VEHICLES}, hz, RADIOS["802.11g with contention"], DURATION_S)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        api.run(scenario, agents="inprocess", out=out)
        mcap, states, radio = ((out / name).stat().st_size for name in ("run.mcap", "states.parquet", "radio.parquet"))
        return Left(mcap, states, radio, read_table(out / "radio.parquet").num_rows)


class Resident(NamedTuple):
    """Peak resident memory of a run, bytes, its figures and its report included, per row of each table."""

    state: float
    reception: float


def resident() -> Resident:
    """From the increase in longer runs: one that records often and is silent, and one that sends and records rarely."""
    per_row = []
    for column, hz, period_s in ((0, SILENT_HZ, OFTEN_S), (1, TALKING_HZ, RARELY_S)):
        short, long = (_fresh(hz, period_s, duration_s) for duration_s in (SHORT_S, LONG_S))
        per_row.append((long[2] - short[2]) / (long[column] - short[column]))
    return Resident(*per_row)


def _fresh(hz: float, period_s: float, duration_s: float) -> tuple[float, ...]:
    """`taken`, in a process of its own."""
    command = [sys.executable, "-m", "bench.limits_files", *map(str, (hz, period_s, duration_s))]
    return tuple(map(float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()))


def taken(hz: float, period_s: float, duration_s: float) -> tuple[int, int, float]:
    """Rows of states, rows of receptions, and the peak memory of this process, bytes, at the end of the run."""
    scenario = team({"kinematic": VEHICLES}, hz, RADIOS["802.11g with contention"], duration_s)
    with tempfile.TemporaryDirectory() as folder:
        api.run(scenario | {"record": {"period_s": period_s}}, agents="inprocess", out=Path(folder) / "run")
        peak_bytes = peak_mib() * 2**20
        left_tables = load(Path(folder) / "run")
    return left_tables.states.num_rows, left_tables.radio.num_rows, peak_bytes


if __name__ == "__main__":
    print(*taken(*map(float, sys.argv[1:])))
