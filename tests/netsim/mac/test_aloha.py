"""Pure Aloha: throughput, capture, and the duty cycle."""

from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel, play
from vcmvsp.cosim.types import FrameReport
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation import broadcast_trial

SIZE = 20
NO_CAPTURE = {"kind": "lora", "capture_db": 300.0}


def aloha(count: int, phy: dict[str, Any], **mac: Any) -> Channel:
    names, rules = [f"v{i}" for i in range(count)], {"kind": "aloha", "duty_cycle": 1.0, "queue_frames": 1000, **mac}
    return make_channel("lora-sf7", vehicles=names, phy={"kind": "lora", **phy}, mac=rules)


@pytest.mark.parametrize("load", [0.1, 0.5, 1.0])
def test_throughput_without_capture_is_that_of_theory(load: float) -> None:
    """``S = G exp(-2 G)`` of infinitely many senders; of n with a load of g each, the n - 1 others neither send, with 1 - g,
    nor begin during the frame, with ``exp(-g)``.
    """
    count, frames = 10, 10_000
    channel = aloha(count, NO_CAPTURE)
    air_s = channel.phy.air_time_ns(SIZE) / 1e9
    rate_hz = load / air_s / count
    plan = broadcast_trial.TrialTraffic(
        waypoints=broadcast_trial.Waypoints.fixed(np.zeros((count, 3)) + np.arange(count)[:, None]),
        size_bytes=SIZE,
        rate_hz=rate_hz,
        duration_s=frames / (rate_hz * count),
        kind="poisson",
    )
    counts = broadcast_trial.run(channel, plan)
    own = load / count
    expected = ((1.0 - own) * np.exp(-own)) ** (count - 1)
    assert counts["delivery_ratio"] == pytest.approx(expected, abs=4.0 * np.sqrt(expected * (1.0 - expected) / frames))


def two(channel: Channel, distance_m: float, apart_ns: int) -> list[FrameReport]:
    """Two frames to a radio between them: one from 10 m, the other from ``distance_m``, ``apart_ns`` later."""
    position = np.array([[-10.0, 0.0, 0.0], [distance_m, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return play(channel, ("v0", "v1", "v2"), position, [(0, "v0", None), (apart_ns, "v1", None)], SIZE)


@pytest.mark.parametrize(
    ("ratio_db", "outcomes"),
    [(7.0, ("received", "collision")), (5.9, ("collision", "collision")), (-7.0, ("collision", "received"))],
)
def test_the_stronger_frame_is_received_if_it_is_6_db_above_the_other(ratio_db: float, outcomes: tuple[str, str]) -> None:
    reports = two(aloha(3, {}), 10.0 * 10.0 ** (ratio_db / 30.0), 1_000_000)
    assert tuple(each.outcome[each.receivers.index("v2")] for each in reports) == outcomes


def test_interference_is_the_sum_of_simultaneous_frames() -> None:
    """Each of two is 8 dB weaker: 5 dB together, 8 dB in turn."""
    far_m = 10.0 * 10.0 ** (8.0 / 30.0)
    names, position = ("v0", "v1", "v2", "v3"), np.array([[-10.0, 0, 0], [far_m, 0, 0], [0, far_m, 0], [0.0, 0, 0]])
    air_ns = aloha(4, {}).phy.air_time_ns(SIZE)
    for begins_ns, outcome in (((-air_ns // 2, air_ns // 2), "received"), ((1000, 2000), "collision")):
        sends = sorted((air_ns + begin_ns, sender) for begin_ns, sender in zip((0, *begins_ns), names, strict=False))
        reports = play(aloha(4, {}), names, position, [(*each, None) for each in sends], SIZE)
        (own,) = [each for each in reports if each.sender == "v0"]
        assert own.outcome[own.receivers.index("v3")] == outcome


def test_a_radio_that_sends_receives_nothing() -> None:
    reports = two(aloha(3, {}), 10.0, 1_000_000)
    assert reports[0].outcome[reports[0].receivers.index("v1")] == "receiver transmitting"


NEAR = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])


def test_the_duty_cycle_keeps_a_radio_silent() -> None:
    channel, sizes = aloha(2, {}, duty_cycle=0.1), [20, 100, 5, 5]
    reports = play(channel, ("v0", "v1"), NEAR, [(0, "v0", None, size) for size in sizes])
    starts = [each.sent_ns + each.queue_ns + each.access_ns for each in reports]
    assert np.diff(starts).tolist() == [10 * channel.phy.air_time_ns(size) for size in sizes[:-1]]


def test_the_modem_of_the_preset_holds_one_packet() -> None:
    channel = make_channel("lora-sf7", vehicles=["v0", "v1"], mac={"kind": "aloha"})
    times_ns = (0, 1, 10**9, 2 * 10**9)  # on the air, during it, silent, silent with one that waits
    reports = play(channel, ("v0", "v1"), NEAR, [(time_ns, "v0", None) for time_ns in times_ns], SIZE)
    outcomes = [each.outcome[0] for each in sorted(reports, key=lambda each: each.frame)]
    assert outcomes == ["received", "queue full", "received", "queue full"]
