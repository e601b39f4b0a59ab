"""Every frame is counted once at each intended receiver: received, lost by a cause, or on the air when the run ended."""

from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.studies import two
from vcmvsp.cosim.analysis.links import Log, links_of, overview
from vcmvsp.cosim.report.run_page import radio_sentences
from vcmvsp.cosim.terminal import progress

pytestmark = pytest.mark.processes

DURATION_S = 1.0
LOSSY = {"kind": "bernoulli", "probability": 0.2}


class Sends(vcmvsp.Agent):
    """Sends a number of bytes at each tick."""

    period_s = 0.1

    def __init__(self, size_bytes: int = 100, to: str | None = None) -> None:
        self.size_bytes, self.to = size_bytes, to

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> None:
        radio.send(size_bytes=self.size_bytes, to=self.to)


class OwnDelay:
    """Delay of a third of a second at the first receiver, more at the others."""

    def delay_ns(self, frame: Any, draw: Any) -> Any:
        return 330_000_000 * (1 + np.arange(len(frame.receivers)))


def content(radio: dict[str, Any], **tables: Any) -> dict[str, Any]:
    """Two cars that send at 10 Hz each."""
    return {**two(duration_s=DURATION_S, radio=radio), **tables}


RADIOS: dict[str, dict[str, Any]] = {
    "no delay": {"preset": "ideal", "loss": LOSSY},
    "a delay": {"preset": "ideal", "loss": LOSSY, "delay": {"seconds": 0.35}},
    "a delay longer than the run": {"preset": "ideal", "loss": LOSSY, "delay": {"seconds": 100.0}},
    "jitter": {"preset": "ideal", "loss": LOSSY, "delay": {"kind": "uniform", "from_s": 0.0, "to_s": 2.0}},
    "a delay of one's own": {"preset": "ideal", "loss": LOSSY, "delay": {"kind": f"{__name__}:OwnDelay"}},
    "copies": {"preset": "ideal", "delivery": {"kind": "delivery", "duplicate": 0.9}, "delay": {"seconds": 0.35}},
    "contention": {"preset": "wifi-b-1", "loss": LOSSY, "delay": {"seconds": 0.35}},
    "802.15.4": {"preset": "zigbee", "loss": LOSSY, "delay": {"seconds": 100.0}},
}


def check(result: vcmvsp.Result) -> dict[str, Any]:
    """Conservation law, in numbers and rows; all ways of counting agree."""
    radio, table = result.metrics["radio"], result.radio
    outcomes, end_ns = table["outcome"].to_pylist(), round(1e9 * result.metrics["duration_s"])
    assert table.num_rows == radio["receptions"] + radio["under_way"] + sum(radio["losses"].values())
    assert {*radio["losses"], "received", "under way"} >= set(outcomes)
    assert (outcomes.count("received"), outcomes.count("under way")) == (radio["receptions"], radio["under_way"])
    for outcome, received_ns, delay_ns, copy_ns in zip(
        outcomes, *(table[name].to_pylist() for name in ("received_ns", "delay_ns", "copy_ns")), strict=True
    ):
        assert (received_ns is not None) == (delay_ns is not None) == (outcome == "received")
        assert max(received_ns or 0, copy_ns or 0) <= end_ns
    words = progress.summary(result)
    assert (f"{radio['under_way']} under way" in words) == (0 < radio["under_way"] < table.num_rows)
    assert int(links_of(table, ("car1", "car2")).under_way.sum()) == radio["under_way"]
    return dict(radio)


@pytest.mark.parametrize("to", [None, "car2"])
@pytest.mark.parametrize("name", RADIOS)
def test_sent_is_received_lost_and_under_way(name: str, to: str | None) -> None:
    agents = {"car1": Sends(to=to), "car2": Sends()}
    radio = check(vcmvsp.run(content(RADIOS[name]), agents=agents, mcap=False))
    assert radio["frames"] == 20
    assert (radio["under_way"] > 0) == (name != "no delay")


@pytest.mark.parametrize("preset", ["zigbee", "wifi-b-1", "wifi-g-6", "ideal"])
@pytest.mark.parametrize("to", [None, "car2"])
def test_a_message_of_many_frames_is_counted_as_any_other(preset: str, to: str | None) -> None:
    agents = {"car1": Sends(size_bytes=80_000, to=to), "car2": Sends(size_bytes=0)}
    radio = check(vcmvsp.run(content({"preset": preset}), agents=agents, mcap=False))
    assert radio["frames"] == 20
    assert radio["under_way"] > 0 or preset == "ideal"


@pytest.mark.parametrize("kind", ["flooding", "distance_vector"])
@pytest.mark.parametrize("delay_s", [0.0, 0.35, 100.0])
def test_so_are_the_frames_of_routing(kind: str, delay_s: float) -> None:
    radio = {"preset": "wifi-b-1", "loss": LOSSY, "delay": {"seconds": delay_s}}
    check(vcmvsp.run(content(radio, routing={"kind": kind}), agents={"car1": Sends(), "car2": Sends(to="car1")}, mcap=False))


def test_frames_of_agents_in_processes_are_counted_once_too(tmp_path: Any) -> None:
    scenario = content({"preset": "ideal", "loss": LOSSY, "delay": {"seconds": 0.35}})
    folder = tmp_path / "run"
    radio = check(vcmvsp.run(scenario, agents="process", out=folder))
    rows = overview(Log(folder))
    assert sum(row["under_way"] for row in rows) == radio["under_way"] > 0
    assert sum(row["received"] for row in rows) == radio["receptions"]
    assert "under way" in pq.read_table(folder / "radio.parquet")["outcome"].to_pylist()
    assert f", {radio['under_way']} were still under way" in next(iter(radio_sentences(radio)))
