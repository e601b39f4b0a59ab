"""The layers that the README shows work as they stand there."""

import re
from pathlib import Path
from typing import Any

import pytest

import netsim
from netsim.channel import Channel
from netsim.delay import NoDelay
from netsim.phy import Dsss
from netsim.presets import PRESETS
from tests.netsim.helpers import KINDS, make_channel, send

README = (Path(netsim.__path__[0]) / "README.md").read_text(encoding="utf-8")


def test_the_layers_of_ones_own() -> None:
    models: dict[str, Any] = {"__name__": "my_models"}
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(block, "README.md", "exec", dont_inherit=True), models)
    channel = Channel(
        path_loss=models["Rain"](db_per_km=4.0), phy=Dsss(), loss=models["Tunnel"](reach_m=500.0), delay=NoDelay()
    )
    report = send(channel, 1.0, 1000.0)
    assert report.rssi_dbm == pytest.approx([16.0206 - 40.052 - 0.004, 16.0206 - 40.052 - 60.0 - 4.0], abs=1e-3)
    outcomes = [send(channel, 100.0, 600.0, sent_ns=k * 10**9).outcome for k in range(2000)]
    assert sum(near == "tunnel" for near, _ in outcomes) == pytest.approx(200, abs=4.5 * 13.4)  # sqrt(2000 x 0.1 x 0.9)
    assert all(far == "tunnel" for _, far in outcomes)


def test_presets_and_kinds_are_all_described() -> None:
    for name in (*PRESETS, *(kind for kinds in KINDS.values() for kind in kinds)):
        assert f"| `{name}` |" in README


@pytest.mark.parametrize(("name", "range_m"), [("wss", 43_056.0), ("wifi-b-1", 85.6), ("zigbee", 31.5)])
def test_ranges_of_the_presets(name: str, range_m: float) -> None:
    assert send(make_channel(name), range_m * 0.998, range_m * 1.002).outcome == ("received", "below sensitivity")
