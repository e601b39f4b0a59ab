"""Many frames at once give what single frames give."""

from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel
from vcmvsp.netsim.evaluation.broadcast_trial import Broadcasts, run


def plan(count: int, side_m: float, rate_hz: float = 20.0) -> Broadcasts:
    position = np.random.default_rng(count).uniform(0.0, side_m, (count, 3))
    return Broadcasts(position=position, rate_hz=rate_hz, size_bytes=100, duration_s=1.0, seed=3)


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
    assert channel.bulk(sent.names, sent.position) is not None
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
    assert (
        make_channel("wifi-b-1", vehicles=sent.names, **{"mac": {"kind": "dcf"}, **changes}).bulk(sent.names, sent.position)
        is None
    )
