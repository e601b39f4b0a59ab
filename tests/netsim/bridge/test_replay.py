"""Whole runs with programs: a replay equals the run, and its files agree with each other."""

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.netsim.gateway_context import free_ports
from vcmvsp.cosim.recording.external_inputs import read_inputs
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.cosim.types import Datagrams

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SAME = ("radio.parquet", "states.parquet", "metrics.json")
DURATION_S, PERIOD_S = 1.5, 0.004
MOST_SAID = round(2.0 * DURATION_S / PERIOD_S)
SETTINGS: dict[str, Any] = {"duration_s": DURATION_S, "seed": 3, "physics.kind": "kinematic"}
CHANNELS: dict[str, dict[str, Any]] = {
    "uncontended": {"radio": {"loss": {"probability": 0.2}, "delay": {"seconds": 0.01, "jitter_s": 0.01}}},
    "dcf": {"radio": {"preset": "wifi-g-54", "mac": {"kind": "dcf"}}},
    "agents": {"bridge.agents": True, "radio": {"delay": {"seconds": 0.01}}},
    "flooding": {"bridge.agents": True, "routing.kind": "flooding", "radio": {"loss": {"probability": 0.2}}},
}


@contextlib.contextmanager
def programs(first_port: int) -> Iterator[None]:
    """The first vehicle's program broadcasts, the second's sends to the third, repeatedly.

    They end after twice the run's duration: a run that lags behind must not receive ever more datagrams.
    """
    stop = threading.Event()

    def say() -> None:
        rounds = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
            while rounds < MOST_SAID and not stop.wait(PERIOD_S):
                with contextlib.suppress(ConnectionError):  # the run has not started, or has ended
                    program.sendto(b"to all", ("127.0.0.1", first_port))
                    program.sendto(b"to one", ("127.0.0.1", first_port + 100 + 3))
                    rounds += 1

    thread = threading.Thread(target=say)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_replay_with_programs_is_equal_to_the_byte_and_its_files_agree(channel: str, tmp_path: Path) -> None:
    first_port, folder = free_ports(300), tmp_path / "run"
    with programs(first_port):
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
    assert missing - 2 * int((entered_ns > 1_400_000_000).sum()) <= about["lost"] <= missing  # some are on the air at the end
    assert about["lost"] > 0 or "loss" not in CHANNELS[channel]["radio"]
