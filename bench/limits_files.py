"""How large the files of a run are, for each vehicle and for each frame at each of its receivers."""

import tempfile
from pathlib import Path
from typing import NamedTuple

from bench.crowds import RADIOS, team
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.tables.schema import read_table

VEHICLES, DURATION_S = 50, 10.0
SILENT_HZ, TALKING_HZ = 1e-6, 10.0


class Sizes(NamedTuple):
    """Bytes: of vehicles that are silent, per vehicle and simulated second; and what each frame adds at each receiver."""

    mcap_state: float
    mcap_reception: float
    states_state: float
    radio_reception: float


class Left(NamedTuple):
    """What a run left: bytes, and rows of ``radio.parquet``."""

    mcap: int
    states: int
    radio: int
    receptions: int


def sizes() -> Sizes:
    """Of kinematic vehicles that all hear each other by 802.11g, once silent and once not."""
    silent, talking = left(SILENT_HZ), left(TALKING_HZ)
    lived = VEHICLES * DURATION_S
    return Sizes(
        mcap_state=silent.mcap / lived,
        mcap_reception=(talking.mcap - silent.mcap) / talking.receptions,
        states_state=silent.states / lived,
        radio_reception=(talking.radio - silent.radio) / talking.receptions,
    )


def left(hz: float) -> Left:
    """What a run of them leaves when each broadcasts so often."""
    scenario = team({"kinematic": VEHICLES}, hz, RADIOS["802.11g with contention"], DURATION_S)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        api.run(scenario, agents="inprocess", out=out)
        mcap, states, radio = ((out / name).stat().st_size for name in ("run.mcap", "states.parquet", "radio.parquet"))
        return Left(mcap, states, radio, read_table(out / "radio.parquet").num_rows)
