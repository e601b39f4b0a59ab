"""Interpreted and compiled core give results equal to the last bit."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, PHYS, UNTIL, bytes_of, mixed_traffic, open_air, periodic, run, square_levels
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.mac.dcf.state import DcfState
from vcmvsp.netsim.phy.ofdm import Ofdm

pytestmark = pytest.mark.slow

MACS = [Dcf(), Dcf(capture_margin_db=5.0), Dcf(queue_frames=4, lifetime_s=0.02), Dcf(preamble_time_us=30.0)]


def bits(state: DcfState) -> dict[str, bytes]:
    passed_on = {"busy", "order"}  # to the caller, not to the next event
    return {name: value.tobytes() for name, value in state._asdict().items() if name not in passed_on}


@pytest.mark.parametrize("seed", range(16))
def test_compiled_is_the_same_to_the_last_bit(seed: int) -> None:
    frames, phy, mac = mixed_traffic(seed, frames=300), PHYS[seed % 4], MACS[seed // 4]
    interpreted, machine = open_air(6, phy, mac, seed=seed), open_air(6, phy, mac, seed=seed, compiled=True)
    assert bytes_of(run(machine, frames, UNTIL)) == bytes_of(run(interpreted, frames, UNTIL))
    assert bits(machine._state) == bits(interpreted._state)


@pytest.mark.parametrize("seed", range(2))
def test_compiled_802_11n_is_the_same_to_the_last_bit(seed: int) -> None:
    frames, phy = mixed_traffic(seed, frames=300), Ofdm(65e6)
    interpreted, machine = open_air(6, phy, seed=seed), open_air(6, phy, seed=seed, compiled=True)
    assert bytes_of(run(machine, frames, UNTIL)) == bytes_of(run(interpreted, frames, UNTIL))


def test_compiled_many_at_once_that_are_hidden_from_each_other() -> None:
    levels = square_levels(40, 300.0, 3.0, 1)
    frames = periodic(levels, 20.0, 1000 * MS)
    interpreted = run(open_air(40), frames, UNTIL)
    time_ns, sender, number = (np.array([getattr(each, it) for each in frames]) for it in ("time_ns", "sender", "number"))
    machine = open_air(40, compiled=True)
    machine.offer_many(time_ns, sender, 100, levels, np.array([each.patience for each in frames]), number)
    assert bytes_of(machine.advance(UNTIL)) == bytes_of(interpreted)
