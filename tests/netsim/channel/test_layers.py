"""All layers together, through the channel, for every medium access."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel, play
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.phy.ofdm import OfdmErrors

pytestmark = pytest.mark.slow

MS = 1_000_000
NAMES = tuple(f"car{i}" for i in range(5))
PLACES: Floats = np.array([(0.0, 0, 0), (15, 0, 0), (40, 10, 0), (70, 0, 0), (150, 5, 0)])
MACS = [("wifi-b-1", "ideal"), ("wifi-b-1", "dcf"), ("zigbee", "csma154")]


def channel(preset: str, mac: str, **changes: Any) -> Channel:
    return make_channel(preset, mac={"kind": mac}, vehicles=NAMES, **changes)


def reports(air: Channel, *, unicast: bool = False, frames: int = 60) -> list[FrameReport]:
    """Five radios that send at random."""
    rng = np.random.default_rng(6)
    times = np.sort(rng.integers(0, 300 * MS, frames)).tolist()
    senders, hops = rng.integers(0, 5, frames).tolist(), rng.integers(1, 5, frames).tolist()
    to = [NAMES[(sender + hop) % 5] if unicast else None for sender, hop in zip(senders, hops, strict=True)]
    sends = zip(times, [NAMES[sender] for sender in senders], to, strict=True)
    return sorted(play(air, NAMES, PLACES, sends, size_bytes=90), key=lambda report: report.frame)


def fates(found: list[FrameReport]) -> list[Any]:
    return [(report.outcome, report.received_ns.tolist(), report.rssi_dbm.tolist()) for report in found]


@pytest.mark.parametrize(("preset", "mac"), MACS)
@pytest.mark.parametrize("unicast", [False, True])
def test_layers_that_touch_nothing_change_nothing(preset: str, mac: str, unicast: bool) -> None:
    """An idle jammer, changes long after the end, and levels recomputed at each attempt."""
    without = fates(reports(channel(preset, mac), unicast=unicast))
    jammer = {"sources": [{"power_dbm": 60.0, "position": [0.0, 0.0, 0.0], "from_s": 1000.0}]}
    script = {"changes": [{"from_s": 1000.0, "loss": 1.0, "attenuation_db": 99.0, "delay_s": 9.0}]}
    for changes in ({"jammer": jammer}, {"script": script}, {"delivery": {"duplicate": 0.0}}):
        assert fates(reports(channel(preset, mac, **changes), unicast=unicast)) == without


@pytest.mark.parametrize(("preset", "mac"), MACS)
def test_a_jammer_destroys_weaker_frames(preset: str, mac: str) -> None:
    """A jammer beside car1 drowns what arrives there from elsewhere; distant receivers still receive their neighbours."""
    sources = [{"power_dbm": 10.0, "position": [15.0, 1.0, 0.0]}]
    before, after = reports(channel(preset, mac)), reports(channel(preset, mac, jammer={"sources": sources}))
    changed = [(a, b) for x, y in zip(before, after, strict=True) for a, b in zip(x.outcome, y.outcome, strict=True) if a != b]
    assert changed
    assert all(pair == ("received", "jammed") for pair in changed)
    for report in after:
        at = dict(zip(report.receivers, report.outcome, strict=True))
        assert at.get("car1") != "received"
        assert report.sinr_db is not None
        assert report.snr_db is not None
        audible = np.isfinite(report.sinr_db)
        assert (report.sinr_db[audible] < report.snr_db[audible]).all()


def test_a_weak_jammer_adds_to_the_noise() -> None:
    """Success over one link equals the error rate at the ratio of signal to noise plus jammer."""
    jammer = {"sources": [{"power_dbm": -5.0, "position": [0.0, 50.0, 0.0]}]}
    air = make_channel("wifi-g-54", jammer=jammer, phy={"tx_power_dbm": 0.0, "sensitivity_dbm": -100.0})
    places, count = np.array([(0.0, 0.0, 0.0), (15.0, 0.0, 0.0)]), 4000
    found = play(air, ("a", "b"), places, [(k * MS, "a", None) for k in range(count)])
    assert found[0].sinr_db is not None
    expected = OfdmErrors(54e6).frame_success(found[0].sinr_db, 100)[0]
    assert 0.1 < expected < 0.9
    received = np.mean([report.outcome == ("received",) for report in found])
    assert abs(received - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / count)
    assert {word for report in found for word in report.outcome} >= {"received", "jammed"}


@pytest.mark.parametrize(("preset", "mac"), MACS)
def test_a_trace_takes_the_place_of_the_models(preset: str, mac: str, tmp_path: Path) -> None:
    """A link with recorded levels, one that loses everything, one that delays."""
    rows = ["0,car0,car4,-60,0,0.0", "0,car0,car1,-60,1,0.0", "0,car0,car2,-60,0,0.5"]
    (tmp_path / "links.csv").write_text("\n".join(["time_s,sender,receiver,rssi_dbm,loss,delay_s", *rows]))
    air = channel(preset, mac, trace={"file": str(tmp_path / "links.csv")}, loss={"probability": 1.0})
    (report,) = play(air, NAMES, PLACES, [(100 * MS, "car0", None)], size_bytes=50)
    assert report.outcome == ("traced loss", "received", "random loss" if mac != "csma154" else report.outcome[2], "received")
    assert report.rssi_dbm[[0, 1, 3]].tolist() == [-60.0] * 3
    assert report.received_ns[1] == 600 * MS
    assert report.received_ns[3] < 200 * MS


def test_copies_and_a_limited_rate() -> None:
    air = channel("ideal", "ideal", delivery={"rate_bps": 8000.0, "queue_s": 0.15, "duplicate": 1.0, "duplicate_delay_s": 0.01})
    found = play(air, NAMES, PLACES, [(k, "car0", None) for k in range(4)])  # 0.1 s each
    assert [report.outcome[0] for report in found] == ["received", "received", "rate limit", "rate limit"]
    for k, report in enumerate(found[:2]):
        assert report.copy_ns is not None
        assert report.received_ns[0] == pytest.approx((k + 1) * 100 * MS, abs=10_000)
        assert report.copy_ns[0] == report.received_ns[0] + 10 * MS


@pytest.mark.parametrize(("preset", "mac"), MACS[1:])
@pytest.mark.parametrize("changes", [{"queue_frames": 3}, {"lifetime_s": 0.02}])
def test_a_delay_is_queue_and_access_and_air(preset: str, mac: str, changes: dict[str, Any]) -> None:
    air = make_channel(preset, mac={"kind": mac, **changes}, vehicles=NAMES)
    arrived = [(each, at_ns) for each in reports(air, frames=300) if (at_ns := max(each.received_ns.tolist())) >= 0]
    assert len(arrived) > 20
    for report, at_ns in arrived:
        assert at_ns - report.sent_ns == report.queue_ns + report.access_ns + report.air_time_ns
        assert min(report.queue_ns, report.access_ns) >= 0


@pytest.mark.parametrize(("preset", "mac"), MACS[1:])
@settings(max_examples=40)
@example(offers=[(0, 1, 1000, 0), (0, 1, 1000, 1)])  # one gives up before the end of the other, for which it waits
@given(
    offers=st.lists(
        st.tuples(st.integers(0, 9_000), st.integers(0, 2_000), st.sampled_from([1, 100, 1000]), st.integers(0, 4)),
        min_size=1,
        max_size=12,
    ).map(sorted)
)
def test_no_frame_is_decided_before_the_predicted_time(preset: str, mac: str, offers: list[tuple[int, int, int, int]]) -> None:
    """Frames of all sizes among partly hidden radios, with different delays on their way to the radio."""
    air = channel(preset, mac, path_loss={"exponent": 4.0})
    sent, predicted_ns = 0, None
    found: list[FrameReport] = []
    while sent < len(offers) or predicted_ns is not None:
        at_ns = offers[sent][0] * 1000 if sent < len(offers) else None
        if at_ns is not None and (predicted_ns is None or at_ns <= predicted_ns):
            early = air.advance(at_ns - 1)
            assert not early
            found += air.advance(at_ns)
            _, wait_us, size, sender = offers[sent]
            message = Message(sender=NAMES[sender], body={}, size_bytes=size)
            found += air.send(at_ns, message, NAMES, PLACES, handover_ns=wait_us * 1000)
            found += air.advance(at_ns)
            sent += 1
        else:
            assert predicted_ns is not None
            assert not air.advance(predicted_ns - 1)
            found += air.advance(predicted_ns)
        predicted_ns = air.next_ns()
    assert sorted(report.frame for report in found) == list(range(len(offers)))


@pytest.mark.parametrize("path_loss", ["log_distance", "friis", "none"])
@pytest.mark.parametrize(("preset", "mac"), MACS)
def test_frames_sent_together_get_the_budgets_of_frames_sent_alone(
    preset: str, mac: str, path_loss: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Budgets of frames sent at one instant are computed together: equal to the last bit."""

    def encoded_reports() -> list[bytes]:
        air = channel(preset, mac, path_loss={"kind": path_loss}, loss={"probability": 0.2})
        found: list[FrameReport] = []
        for k in range(6):
            places = PLACES * (1.0 + 0.3 * k)
            for name in NAMES[: 4 + k % 2]:
                message = Message(sender=name, body={}, size_bytes=60 + 40 * (k % 2))
                found += air.send(100 * k * MS, message, NAMES, places, handover_ns=len(found) * MS)
            found += air.advance(100 * (k + 1) * MS - 1)
        return [encode(report) for report in found]

    together = encoded_reports()
    monkeypatch.setattr("vcmvsp.netsim.channel.link_budget.AT_ONCE", 0)
    assert encoded_reports() == together
    assert len(together) == 27
