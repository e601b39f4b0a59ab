"""Broadcasts of one instant: a batch fares as the same frames in turn."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation.broadcast_trial import TrialTraffic, Waypoints, run

pytestmark = pytest.mark.slow

NAMES = tuple(f"car{number}" for number in range(7))
TABLES: dict[str, dict[str, Any]] = {
    "ideal": {},
    "lossy": {"loss": {"probability": 0.3}, "delay": {"seconds": 0.01, "jitter_s": 0.004}},
    "late": {"delay": {"seconds": 1e-4, "jitter_s": 1e-3}},
}
INSTANT = st.tuples(
    st.integers(0, 3_000_000),  # ns since the previous one: some frames still wait for their radio, some begin together
    st.integers(0, 2),  # positions, m
    st.lists(st.integers(0, 6), min_size=2, max_size=7, unique=True),  # senders in this order
    st.lists(st.sampled_from((20, 20, 300, 1500)), min_size=7, max_size=7),
)


@given(
    preset=st.sampled_from(("ideal", "wifi-b-1", "wifi-g-54", "wss")),
    table=st.sampled_from(sorted(TABLES)),
    far_m=st.floats(1.0, 600.0),
    instants=st.lists(INSTANT, min_size=1, max_size=4),
)
def test_broadcasts_of_one_instant_fare_as_one_after_the_other(
    preset: str, table: str, far_m: float, instants: list[tuple[int, int, list[int], list[int]]]
) -> None:
    together, apart = make_channel(preset, **TABLES[table]), make_channel(preset, **TABLES[table])
    places = [far_m * np.random.default_rng(each).random((7, 3)) for each in range(3)]
    now_ns = 0
    for wait_ns, where, senders, sizes in instants:
        now_ns += wait_ns
        messages = [Message(sender=NAMES[each], body={}, size_bytes=sizes[each]) for each in senders]
        got = together.send_all(now_ns, messages, NAMES, places[where])
        assert got is not None
        assert list(map(encode, got)) == list(map(encode, _one_by_one(apart, now_ns, messages, places[where])))
    alone = Message(sender=NAMES[0], body={}, size_bytes=20)  # the next frames continue from this state
    after = [channel.send(now_ns, alone, NAMES, places[0]) for channel in (together, apart)]
    assert encode(after[0]) == encode(after[1])


def _one_by_one(channel: Channel, now_ns: int, messages: list[Message], places: Any) -> list[FrameReport]:
    return [report for message in messages for report in channel.send(now_ns, message, NAMES, places)]


@pytest.mark.parametrize(
    "tables",
    [
        {"mac": {"kind": "dcf"}},  # frames share the air
        {"fading": {"kind": "rayleigh"}},  # each frame has its own level
        {"shadowing": {"sigma_db": 4.0}},  # loss depends on more than distance
    ],
)
def test_frames_that_must_be_sent_singly_are_refused_without_effect(tables: dict[str, Any]) -> None:
    messages = [Message(sender=name, body={}, size_bytes=20) for name in ("car0", "car2")]
    places = np.arange(21.0).reshape(7, 3)
    channel, other = make_channel("wifi-b-1", **tables), make_channel("wifi-b-1", **tables)
    assert channel.send_all(0, messages, NAMES, places) is None
    assert channel.send_all(0, messages[:1] * 2, NAMES, places) is None  # twice the same name
    ways = [_one_by_one(each, 0, messages, places) + each.advance(10**8) for each in (channel, other)]
    assert encode(ways[0]) == encode(ways[1])


def plan(count: int, side_m: float, rate_hz: float = 20.0) -> TrialTraffic:
    position = np.random.default_rng(count).uniform(0.0, side_m, (count, 3))
    return TrialTraffic(waypoints=Waypoints.fixed(position), rate_hz=rate_hz, size_bytes=100, duration_s=1.0, seed=3)


@pytest.mark.parametrize(
    ("preset", "count", "side_m", "changes"),
    [
        ("wifi-b-1", 30, 100.0, {}),
        ("wifi-g-54", 20, 150.0, {"shadowing": {"sigma_db": 6.0}}),
        ("wifi-a-6", 2, 10.0, {}),
        ("wifi-b-11", 12, 400.0, {"path_loss": {"exponent": 2.5}}),
    ],
)
def test_the_same_counts_and_delays(preset: str, count: int, side_m: float, changes: dict[str, Any]) -> None:
    channel = make_channel(preset, mac={"kind": "dcf"}, **changes)
    sent = plan(count, side_m)
    assert channel.bulk(sent.names, sent.waypoints.at(0)) is not None
    at_once = run(channel, sent)
    one_by_one = run(channel, sent, sink=lambda _: None)
    del at_once["cpu_s"], one_by_one["cpu_s"]
    assert at_once == one_by_one
    assert at_once["receptions"] > 0


@pytest.mark.parametrize(
    "changes",
    [
        {"fading": {"kind": "rayleigh"}},
        {"loss": {"probability": 0.1}},
        {"delay": {"seconds": 0.1}},
        {"script": {"changes": [{"from_s": 0.0, "loss": 1.0}]}},
        {"jammer": {"sources": [{"power_dbm": 10.0, "position": [0.0, 0.0, 0.0]}]}},
        {"delivery": {"duplicate": 0.1}},
        {"mac": {"kind": "ideal"}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_not_where_a_layer_has_a_say_in_each_frame(changes: dict[str, Any]) -> None:
    sent = plan(5, 50.0)
    channel = make_channel("wifi-b-1", vehicles=sent.names, **{"mac": {"kind": "dcf"}, **changes})
    assert channel.bulk(sent.names, sent.waypoints.at(0)) is None
