"""Contention through the channel: messages in, reports out, for every medium access."""

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp

from tests.support.cosim.receptions import receptions_in
from tests.support.netsim.channels import at_rest, make_channel, plain_channel, play
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.interfaces.layers import Draw, Fading, Floats, Frame, Phy, Radio
from vcmvsp.netsim.interfaces.medium import Mac, Offered
from vcmvsp.netsim.mac.csma154.medium import Csma154
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import Ieee802154
from vcmvsp.netsim.phy.ofdm import Ofdm
from vcmvsp.netsim.propagation.fading import Nakagami, Rayleigh, Rician

pytestmark = pytest.mark.slow

MS = 1_000_000
NAMES = tuple(f"car{i}" for i in range(6))
PLACES: Floats = np.array([(0.0, 0, 0), (20, 0, 0), (40, 10, 0), (60, 0, 0), (90, 5, 0), (120, 0, 0)])
MACS = [("wifi-b-1", "dcf"), ("wifi-g-6", "dcf"), ("zigbee", "csma154")]
CHANCE: dict[str, Any] = {"loss": {"probability": 0.1}, "fading": {"kind": "nakagami", "m": 1.5}}

Offer = tuple[int, int, int]
"""When (us), who, to whom (itself: all)."""
OFFERS = st.lists(st.tuples(st.integers(0, 40_000), st.integers(0, 5), st.integers(0, 5)), max_size=30).map(sorted)


def contended(preset: str, mac: str, **changes: Any) -> Channel:
    return make_channel(preset, mac={"kind": mac}, **{**CHANCE, **changes})


def reports(
    channel: Channel, offers: list[Offer], cuts: Sequence[int] = (), names: tuple[str, ...] = NAMES
) -> list[FrameReport]:
    """All reports, with the channel advanced at the offers and at other times."""
    places = np.concatenate([PLACES, np.full((len(names) - len(NAMES), 3), 1e9)])
    sends: list[Any] = [(at_us * 1000, NAMES[sender], None if to == sender else NAMES[to]) for at_us, sender, to in offers]
    sends += [(cut * 1000, None, None) for cut in cuts]
    return play(channel, names, places, sorted(sends, key=lambda each: each[0]), size_bytes=80)


JAMMER = {"sources": [{"power_dbm": -10.0, "position": [60.0, 20.0, 0.0]}]}
STEADY: dict[str, Any] = {"jammer": JAMMER, "fading": {"kind": "none"}}


@pytest.mark.parametrize(("preset", "mac"), MACS)
@settings(max_examples=8)
@given(offers=OFFERS, cuts=st.lists(st.integers(0, 200_000), max_size=10), changes=st.sampled_from([{}, STEADY]))
@example(offers=[(0, 0, 0), (0, 0, 0), (0, 3, 4)], cuts=[6848], changes={})  # a received frame on the air again at the cut
def test_every_frame_is_reported_once_however_the_channel_is_advanced(
    preset: str, mac: str, offers: list[Offer], cuts: list[int], changes: dict[str, Any]
) -> None:
    """With levels that change at every attempt, and with constant levels."""
    whole = reports(contended(preset, mac, **changes), offers)
    assert sorted(report.frame for report in whole) == list(range(len(offers)))
    assert encode(reports(contended(preset, mac, **changes), offers, cuts)) == encode(whole)


@pytest.mark.parametrize(("preset", "mac"), MACS)
def test_a_radio_out_of_reach_changes_nothing(preset: str, mac: str) -> None:
    rng = np.random.default_rng(4)
    offers = sorted((int(t), int(s), int(s)) for t, s in zip(rng.integers(0, 200_000, 80), rng.integers(0, 6, 80), strict=True))
    few = reports(contended(preset, mac), offers)
    many = reports(contended(preset, mac), offers, names=(*NAMES, "far"))
    for a, b in zip(few, many, strict=True):
        assert (a.frame, a.received_ns.tolist(), a.outcome) == (b.frame, b.received_ns[:-1].tolist(), b.outcome[:-1])
        assert np.array_equal(a.rssi_dbm, b.rssi_dbm[:-1])


def test_a_radio_of_its_own_sensitivity_hears_more() -> None:
    radios = {"car2": Radio(sensitivity_dbm=-100.0, antenna_height_m=0.0)}
    channel = plain_channel(phy=Dsss(preamble_snr_db=-100.0), mac=Dcf(), radios=radios)
    places = np.array([(0.0, 0, 0), (100, 0, 0), (0, 100, 0)])  # -84 dBm
    channel.send(100 * MS, Message(sender="car0", body={}, size_bytes=100), NAMES[:3], places)
    assert channel.advance(10**10)[0].outcome == ("below sensitivity", "received")


def two_to_car1(channel: Channel) -> list[FrameReport]:
    found = play(channel, NAMES[:2], PLACES[:2], [(100 * MS, "car0", "car1")] * 2, size_bytes=80)
    assert [each.outcome for each in found] == [("received",)] * 2
    return found


@pytest.mark.parametrize(("phy", "mac"), [(Dsss(), Dcf()), (Ofdm(), Dcf()), (Ieee802154(), Csma154())], ids=str)
@pytest.mark.parametrize("power_dbm", [None, -60.0])
def test_a_weak_acknowledgement_is_lost(phy: Phy, mac: Mac, power_dbm: float | None) -> None:
    """The acknowledgement is too weak: the sender retries, at least four times in all, before the next frame."""
    radios = {"car1": Radio(tx_power_dbm=power_dbm, antenna_height_m=0.0)}
    first, second = two_to_car1(plain_channel(phy=phy, mac=mac, radios=radios))
    started_ns = [int(each.received_ns[0]) - each.air_time_ns for each in (first, second)]
    assert (started_ns[1] - started_ns[0] > 4 * first.air_time_ns) == (power_dbm is not None)


class Fade:
    """Attenuates by 100 dB whatever begins within an interval, ns; nothing unless set."""

    during_ns = range(0)

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        return np.full(len(frame.paths.distance_m), -100.0 if frame.start_ns in self.during_ns else 0.0)


@pytest.mark.parametrize(("phy", "mac", "pause_us"), [(Dsss(), Dcf(), 20), (Ofdm(), Dcf(), 20), (Ieee802154(), Csma154(), 200)])
def test_an_acknowledgement_fades_at_its_own_time(phy: Phy, mac: Mac, pause_us: int) -> None:
    """The data have arrived; the channel fades just behind them, and they are repeated before the next frame."""
    fading, pauses = Fade(), []
    for fades in (False, True):
        first, second = two_to_car1(plain_channel(phy=phy, mac=mac, fading=fading))
        end_ns = int(first.received_ns[0])
        fading.during_ns = range(end_ns, end_ns + pause_us * 1000)
        pauses.append(int(second.received_ns[0]) - second.air_time_ns - end_ns)
        assert (pauses[-1] > first.air_time_ns) == fades


def offered(sends: int, **layers: Any) -> list[Offered]:
    """The frames of car0 to car2, 1 ms apart, as a medium without any traffic gets them."""
    medium = Mock(spec=["offer", "advance", "next_ns"])
    medium.advance.return_value = []
    channel = plain_channel(mac=SimpleNamespace(open=lambda *_: medium), **layers)
    play(channel, NAMES[:3], PLACES[:3], [(k * MS, "car0", "car2") for k in range(sends)], size_bytes=80)
    return [call.args[0] for call in medium.offer.call_args_list]


def gains(fading: Fading) -> tuple[Floats, Floats]:
    """Gains of 2000 frames and of their acknowledgements 1 ms later, relative to the mean."""
    data, answers = [], []
    for k, frame in enumerate(offered(2000, fading=fading)):
        assert frame.answer is not None
        data.append(frame.renew(0, k * MS)[0][2])
        answers.append(data[-1] * frame.answer((k + 1) * MS))
    return np.array(data) / np.mean(data), np.array(answers) / np.mean(data)


@pytest.mark.parametrize("fading", [Rayleigh(), Nakagami(1.5), Rician(2.0)], ids=str)
def test_without_doppler_an_acknowledgement_fades_independently(fading: Fading) -> None:
    data, answers = gains(fading)
    assert abs(np.corrcoef(data, answers)[0, 1]) < 4.5 / math.sqrt(len(data))
    for gain in (data, answers):
        assert abs(gain.mean() - 1.0) < 4.5 * math.sqrt((gain.var() + data.var()) / len(data))
    assert ks_2samp(data, answers).pvalue > 1e-5


@pytest.mark.parametrize("kind", [Rayleigh, Nakagami, Rician])
def test_with_doppler_it_meets_the_channel_as_it_is_then(kind: Any) -> None:
    """A millisecond later, as the next frame does."""
    data, answers = gains(kind(doppler_hz=50.0))
    assert answers[:-1] == pytest.approx(data[1:])


def test_where_nothing_fades_an_acknowledgement_is_as_strong_as_the_frame() -> None:
    assert [each.answer for each in offered(1)] == [None]


def test_frames_cut_off_by_the_end_are_reported_as_under_way() -> None:
    channel = contended("wifi-b-1", "dcf")
    for _ in range(3):
        channel.send(100 * MS, Message(sender="car0", body={}, size_bytes=100), NAMES, PLACES)
    first = channel.advance(102 * MS)
    rest = channel.finish()
    assert [report.frame for report in (*first, *rest)] == [0, 1, 2]
    assert {word for report in rest for word in report.outcome} == {UNDER_WAY}
    assert channel.next_ns() is None


def test_the_federate_is_stepped_twice_a_frame_and_hears_at_its_end() -> None:
    """Once to send and once at its end; delivery may need one step more."""
    radio = RadioFederate(make_channel("wifi-b-1", mac={"kind": "dcf"}))
    radio.start(RunInfo(scenario="test", seed=1, duration_ns=10**12, vehicles=NAMES))
    steps = 0
    for k in range(50):
        now = k * 100 * MS
        sends = [Event(f"{name}/send", now, Message(sender=name, body={"k": k}, size_bytes=60)) for name in NAMES]
        step = radio.step(now, [Event("world/states", now, at_rest(NAMES, PLACES)), *sends])
        reports, due = [], step.next_ns
        while due is not None:
            step, steps = radio.step(due, []), steps + 1
            for _, reception in receptions_in(step.events):
                assert (reception.sent_ns, reception.received_ns) == (now, due)
            reports += [event.value for event in step.events if isinstance(event.value, FrameReport)]
            due = step.next_ns
        assert len(reports) == 6
    assert steps <= 50 * 6 * 2
