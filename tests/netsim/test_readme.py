"""README of the radio: its block works as printed, and every outcome is listed."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.support.docs.readme_pages import PAGES, block
from tests.support.netsim.channels import send
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.testing import check_channel
from vcmvsp.netsim.channel.channel import Channel, Outages
from vcmvsp.netsim.channel.link_budget import ReceiverModel
from vcmvsp.netsim.channel.reception import Outcomes
from vcmvsp.netsim.impairments.delay import NoDelay
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.impairments.loss import Bernoulli, GilbertElliott
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.phy.dsss import Dsss


def test_the_layers_of_ones_own() -> None:
    models: dict[str, Any] = {"__name__": "my_models"}
    exec(compile(block("docs/howto/radio-layer.md", "class Rain"), "README.md", "exec", dont_inherit=True), models)
    rain, tunnel = models["Rain"](db_per_km=4.0), models["Tunnel"](reach_m=500.0)
    check_channel(rain)
    check_channel(tunnel)
    channel = Channel(path_loss=rain, phy=Dsss(), loss=tunnel, delay=NoDelay())
    report = send(channel, 1.0, 1000.0)
    assert report.rssi_dbm == pytest.approx([16.0206 - 40.052 - 0.004, 16.0206 - 40.052 - 60.0 - 4.0], abs=1e-3)
    outcomes = [send(channel, 100.0, 600.0, sent_ns=k * 10**9).outcome for k in range(2000)]
    assert sum(near == "tunnel" for near, _ in outcomes) == pytest.approx(200, abs=4.5 * 13.4)  # sqrt(2000 x 0.1 x 0.9)
    assert all(far == "tunnel" for _, far in outcomes)


def test_every_outcome_is_explained(tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text("time_s,sender,receiver,loss\n0,a,b,1\n")
    trace = Trace(str(tmp_path / "links.csv"))
    known = {UNDER_WAY, Outages.cause}
    for loss in (Bernoulli(0.5), GilbertElliott()):
        for script, fades in ((Script(), True), (Script(), False), (None, False)):
            outcomes = Outcomes(ReceiverModel(Dsss(), 4.0), loss, NoDelay(), script, trace, Delivery(), fades=fades)
            known |= set(outcomes._words.tolist())
    section = PAGES["docs/explanation/radio.md"].partition("## What becomes of a frame")[2].partition("\n## ")[0]
    rows = [line.split(" | ")[0] for line in section.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`([^`]+)`", row)} == known - {""}
