"""Interpreted and compiled core give results equal to the last bit."""

from itertools import product

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, PHYS, UNTIL, bytes_of, mixed_traffic, open_air, periodic, run, square_levels
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.mac.dcf.state import DcfState
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

pytestmark = pytest.mark.slow

MACS = [Dcf(), Dcf(capture_margin_db=5.0), Dcf(queue_frames=4, lifetime_s=0.02), Dcf(preamble_time_us=30.0)]
RATED = [Dcf(rate_control="ideal"), Dcf(rate_control="ideal", rts_threshold_bytes=500)]
CASES: list[tuple[Dsss | Ofdm, Dcf]] = [
    *product(PHYS, MACS),
    *product([Ofdm(54e6)], [Dcf(rts_threshold_bytes=0), Dcf(rts_threshold_bytes=500)]),
    *product([Ofdm(), Ofdm(65e6)], RATED),
    *((Ofdm(65e6), Dcf()), (Ofdm(86e6), RATED[1]), (Ofdm(6e6, "5GHz"), RATED[1])),
]


def bits(state: DcfState) -> dict[str, bytes]:
    passed_on = {"busy", "order"}  # to the caller, not to the next event
    return {name: value.tobytes() for name, value in state._asdict().items() if name not in passed_on}


@pytest.mark.parametrize("seed", range(len(CASES)))
def test_compiled_is_the_same_to_the_last_bit(seed: int) -> None:
    frames, (phy, mac) = mixed_traffic(seed, frames=200), CASES[seed]
    interpreted, machine = open_air(6, phy, mac, seed=seed), open_air(6, phy, mac, seed=seed, compiled=True)
    decided = run(interpreted, frames, UNTIL)
    assert sorted(each.number for each in decided) == list(range(200))
    assert bytes_of(run(machine, frames, UNTIL)) == bytes_of(decided)
    assert bits(machine._state) == bits(interpreted._state)


def test_compiled_many_at_once_that_are_hidden_from_each_other() -> None:
    levels = square_levels(40, 300.0, 3.0, 1)
    frames = periodic(levels, 20.0, 1000 * MS)
    interpreted = run(open_air(40), frames, UNTIL)
    time_ns, sender, number = (np.array([getattr(each, it) for each in frames]) for it in ("time_ns", "sender", "number"))
    machine = open_air(40, compiled=True)
    machine.offer_many(time_ns, sender, 100, levels, np.array([each.patience for each in frames]), number)
    assert bytes_of(machine.advance(UNTIL)) == bytes_of(interpreted)
