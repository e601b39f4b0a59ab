"""Whole runs with programs: a replay equals the run, and its files agree with each other."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.netsim.bridge_runs import sent_repeatedly
from tests.support.netsim.gateway_context import free_ports
from vcmvsp.cosim.recording.external_inputs import read_inputs
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.cosim.types import Datagrams

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SAME = ("radio.parquet", "states.parquet", "metrics.json")
ROUNDS = 500  # for twice the run's duration: a run that lags behind must not receive ever more datagrams
SETTINGS: dict[str, Any] = {"duration_s": 1.0, "seed": 3, "physics.kind": "kinematic"}
CHANNELS: dict[str, dict[str, Any]] = {
    "uncontended": {"radio": {"loss": {"probability": 0.2}, "delay": {"seconds": 0.01, "jitter_s": 0.01}}},
    "dcf": {"radio": {"preset": "wifi-g-54", "mac": {"kind": "dcf"}}},
    "agents": {"bridge.agents": True, "radio": {"delay": {"seconds": 0.01}}},
    "flooding": {"bridge.agents": True, "routing.kind": "flooding", "radio": {"loss": {"probability": 0.2}}},
}


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_replay_with_programs_is_equal_to_the_byte_and_its_files_agree(channel: str, tmp_path: Path) -> None:
    first_port, folder = free_ports(300), tmp_path / "run"
    with sent_repeatedly({first_port: b"to all", first_port + 100 + 3: b"to one"}, ROUNDS):
        run = vcmvsp.run(
            "formation-circle", set={**SETTINGS, **CHANNELS[channel], "bridge.udp.first_port": first_port}, out=folder
        )
    again = replay(folder, out=tmp_path / "again")
    for name in SAME:
        assert (folder / name).read_bytes() == (again.folder / name).read_bytes(), name  # type: ignore[operator]

    about = json.loads((folder / "about.json").read_text())["bridge"]
    radio = {(row["frame"], row["receiver"]): row for row in pq.read_table(folder / "radio.parquet").to_pylist()}
    deliveries = pq.read_table(folder / "bridge.parquet").to_pylist()
    assert about == run.about["bridge"]
    assert about["delivered"] == sum(row["late_s"] is not None for row in deliveries) > 0
    for row in deliveries:
        carried = radio[row["frame"], row["receiver"]]
        late = row["wanted_ns"] > run.about["simulated_s"] * 1e9  # than the end of the run
        assert carried["received_ns"] == (None if late else row["wanted_ns"])
        assert carried["outcome"] == ("under way" if late else "received")
        assert carried["sender"] == row["sender"] or channel == "flooding"
    batches = [(now_ns, value) for _, now_ns, value in read_inputs(folder / "hardware.mcap") if isinstance(value, Datagrams)]
    to = np.concatenate([each.to for _, each in batches])
    entered_ns = np.concatenate([np.maximum(each.sent_ns, now_ns) for now_ns, each in batches])  # later than sent, if delayed
    assert about["datagrams"] == len(to)
    arrived = {(row["number"], row["receiver"]) for row in deliveries}
    missing = int(np.where(to < 0, 2, 1).sum()) - len(arrived)
    assert missing - 2 * int((entered_ns > 900_000_000).sum()) <= about["lost"] <= missing  # some are on the air at the end
    assert about["lost"] > 0 or "loss" not in CHANNELS[channel]["radio"]
