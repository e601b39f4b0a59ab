from itertools import permutations
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel, only_report, plain_channel, send
from vcmvsp.cosim.types import Array, FrameReport, Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.interfaces.layers import Floats, Paths
from vcmvsp.netsim.phy.dsss import Dsss

pytestmark = pytest.mark.slow


def broadcast(channel: Channel, sender: str, places: dict[str, tuple[float, float, float]], sent_ns: int = 0) -> FrameReport:
    message = Message(sender=sender, body={}, size_bytes=100)
    return only_report(channel.send(sent_ns, message, tuple(places), np.array(list(places.values()))))


@pytest.mark.parametrize(
    ("preset", "within_m", "beyond_m"), [("wss", 43_055.0, 43_056.0), ("wifi-b-1", 85.56, 85.57), ("zigbee", 31.4, 31.5)]
)
def test_the_range_of_a_preset_follows_its_law(preset: str, within_m: float, beyond_m: float) -> None:
    """802.11b: in ns-3.44 a node with this path loss receives at the first distance and not at the second."""
    assert send(make_channel(preset), within_m, beyond_m).outcome == ("received", "below sensitivity")


def test_a_level_equal_to_the_sensitivity_is_received() -> None:
    channel = make_channel("wss", path_loss={"exponent": 2.0}, phy={"sensitivity_dbm": -49.67 - 40.0})
    report = send(channel, 200.0, np.nextafter(200.0, 201.0) + 1e-9)  # 2 m x 10^(40 / 20)
    assert report.rssi_dbm[0] == -49.67 - 40.0
    assert report.outcome == ("received", "below sensitivity")


def test_an_ideal_channel_delivers_everything_at_once_but_not_in_no_time() -> None:
    report = send(make_channel("ideal"), 0.0, 1.0, 1e6, sent_ns=7, size_bytes=100)
    assert report.outcome == ("received",) * 3
    assert report.received_ns.tolist() == [7 + 1_800] * 3


def test_the_report_contains_the_frame_and_its_outcomes() -> None:
    places = {"a": (0.0, 0.0, 0.0), "b": (3.0, 4.0, 0.0), "c": (0.0, 0.0, 300.0)}
    report = broadcast(make_channel("wifi-b-1"), "b", places, sent_ns=12)
    assert (report.frame, report.sender, report.sent_ns, report.size_bytes) == (0, "b", 12, 100)
    assert report.receivers == ("a", "c")
    assert report.distance_m == pytest.approx([5.0, np.sqrt(9 + 16 + 300**2)])
    assert report.received_ns.tolist() == [12 + 1_280_000, -1]
    assert report.outcome == ("received", "below sensitivity")
    arrays: list[Array] = [report.distance_m, report.rssi_dbm, report.received_ns]
    assert [array.dtype for array in arrays] == [np.float64, np.float64, np.int64]
    assert not any(array.flags.writeable for array in arrays)


def test_frames_are_numbered_as_they_enter_and_senders_do_not_wait_for_each_other() -> None:
    places, channel = {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)}, make_channel("wifi-b-1")
    reports = [broadcast(channel, sender, places) for sender in "abab"]
    assert [report.frame for report in reports] == [0, 1, 2, 3]
    assert [report.received_ns.item() for report in reports] == [1_280_000, 1_280_000, 2_560_000, 2_560_000]


def test_queue_obeys_lindley() -> None:
    """Waiting time of frame k is W[k+1] = max(0, W[k] + air time - gap)."""
    rng = np.random.default_rng(5)
    channel, phy = make_channel("wifi-b-1"), Dsss()
    now, wait = 0, 0
    for gap, size in zip(rng.integers(0, 3_000_000, 300).tolist(), rng.integers(0, 200, 300).tolist(), strict=True):
        air = phy.air_time_ns(size)
        assert send(channel, 5.0, sent_ns=now, size_bytes=size).received_ns.item() == now + wait + air
        now, wait = now + gap, max(0, wait + air - gap)


def test_unicast_concerns_the_addressed_vehicle_alone_and_draws_as_a_broadcast() -> None:
    to_all, to_one = (make_channel(loss={"probability": 0.5}, delay={"seconds": 0.1, "jitter_s": 0.05}) for _ in range(2))
    for k in range(200):
        all_rows = send(to_all, 1.0, 2.0, 3.0, sent_ns=k * 10**9)
        one_row = send(to_one, 1.0, 2.0, 3.0, sent_ns=k * 10**9, to="car2")
        assert (one_row.receivers, one_row.distance_m.tolist()) == (("car2",), [2.0])
        assert one_row.received_ns.item() == all_rows.received_ns[1]


def outcomes(channel: Channel, order: tuple[str, ...], frames: int = 40) -> dict[tuple[str, str], list[int]]:
    """Reception times of every link when the vehicles of ``order`` send in turn every second."""
    places = {name: (float(ord(name)), 0.0, 0.0) for name in order}
    found: dict[tuple[str, str], list[int]] = {}
    for k in range(frames):
        for sender in order:
            report = broadcast(channel, sender, places, sent_ns=k * 10**9)
            for receiver, received_ns in zip(report.receivers, report.received_ns.tolist(), strict=True):
                found.setdefault((sender, receiver), []).append(received_ns)
    return found


CHANCE: dict[str, Any] = {"loss": {"probability": 0.4}, "delay": {"seconds": 0.1, "jitter_s": 0.03}}
SPREAD: dict[str, Any] = {"shadowing": {"sigma_db": 20.0}, "fading": {"kind": "rayleigh"}}


@pytest.mark.parametrize("layers", [CHANCE, CHANCE | SPREAD], ids=["chance", "spread"])
def test_a_link_is_independent_of_other_vehicles_and_their_order(layers: dict[str, Any]) -> None:
    alone = outcomes(make_channel("wifi-b-1", **layers), ("a", "b", "c"))
    assert len({tuple(times) for times in alone.values()}) == 6  # six links with different outcomes
    for order in [*permutations("abc"), tuple("zabyxc"), tuple("abcdefghijklmnopqrstuvw")]:
        others_too = outcomes(make_channel("wifi-b-1", **layers), order)
        assert {link: others_too[link] for link in alone} == alone


def test_seeds_repeat_and_differ() -> None:
    once = outcomes(make_channel(seed=1, **CHANCE), ("a", "b"))
    assert outcomes(make_channel(seed=1, **CHANCE), ("a", "b")) == once
    assert outcomes(make_channel(seed=2, **CHANCE), ("a", "b")) != once
    channel = make_channel(seed=2, **CHANCE)
    outcomes(channel, ("a", "b"))
    channel.start(seed=1)
    assert outcomes(channel, ("a", "b")) == once


def test_a_lone_vehicle_sends_to_no_receiver() -> None:
    report = send(make_channel("wifi-b-1", **CHANCE))
    assert (report.receivers, report.outcome, report.received_ns.tolist()) == ((), (), [])


def test_a_sender_and_receiver_without_position_are_refused() -> None:
    with pytest.raises(ValueError, match="sender ghost has no position; vehicles with a position: a, b"):
        broadcast(make_channel(), "ghost", {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)})
    with pytest.raises(ValueError, match="unknown receiver 'car7'; receivers: car1"):
        send(make_channel(), 1.0, to="car7")


class Nothing:
    """A user-written path loss that returns no number."""

    def loss_db(self, paths: Paths) -> Floats:
        return np.full(paths.distance_m.shape, np.nan)


class Timeless(Dsss):
    def air_time_ns(self, size_bytes: int) -> int:
        return 0


def test_a_level_that_is_no_number_is_not_received() -> None:
    assert send(plain_channel(path_loss=Nothing()), 5.0).outcome == ("below sensitivity",)


def test_air_time_must_not_be_zero() -> None:
    with pytest.raises(ValueError, match=r"Timeless\.air_time_ns\(100\) is 0"):
        send(plain_channel(phy=Timeless()), 5.0)


def test_too_weak_comes_before_lost_by_chance() -> None:
    report = send(make_channel("wifi-b-1", loss={"probability": 1.0}), 10.0, 1000.0)
    assert report.outcome == ("random loss", "below sensitivity")
    assert report.received_ns.tolist() == [-1, -1]


def test_vehicles_that_come_and_go_change_nothing_for_the_others() -> None:
    few, many = {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)}, {"c": (9.0, 0.0, 0.0), "a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)}
    steady, changing = make_channel(**CHANCE), make_channel(**CHANCE)
    for k in range(200):
        expected = broadcast(steady, "a", few, k * 10**9).received_ns[-1]
        assert broadcast(changing, "a", few if k % 3 else many, k * 10**9).received_ns[-1] == expected
