"""One core at three speeds: vectors, loops, and loops that are compiled do the same to the last bit."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, PHYS, UNTIL, bytes_of, mixed, open_air, periodic, run, square
from vcmvsp.netsim.mac.dcf import access, capture
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.mac.dcf.state import DcfState

pytestmark = pytest.mark.slow

LOOPS = {name: loop for each in (capture, access) for name, loop in vars(each).items() if name.endswith("_loop")}
MACS = [Dcf(), Dcf(capture_margin_db=5.0), Dcf(queue_frames=4, lifetime_s=0.02), Dcf(preamble_time_us=30.0)]


@pytest.mark.parametrize("seed", range(12))
def test_loops_leave_the_same_bits_everywhere_as_vectors(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    frames, phy, mac = mixed(seed, frames=150), PHYS[seed % 4], MACS[seed // 4]
    vectors, loops = open_air(6, phy, mac, seed=seed), open_air(6, phy, mac, seed=seed)
    assert len(LOOPS) == 10
    for until in (10 * MS, 30 * MS, UNTIL):
        now = [each for each in frames if each.time_ns <= until]
        frames = frames[len(now) :]
        by_vectors = run(vectors, now, until)
        with monkeypatch.context() as patch:
            for name, loop in LOOPS.items():
                for module in (capture, access):
                    if hasattr(module, name.removesuffix("_loop")):
                        patch.setattr(module, name.removesuffix("_loop"), loop)
            by_loops = run(loops, now, until)
        assert bytes_of(by_loops) == bytes_of(by_vectors)
        assert bits(loops._state) == bits(vectors._state)


def bits(state: DcfState) -> dict[str, bytes]:
    passed_on = {"busy", "order"}  # to the caller, not to the next event
    return {name: value.tobytes() for name, value in state._asdict().items() if name not in passed_on}


@pytest.mark.parametrize("seed", range(16))
def test_compiled_is_the_same_to_the_last_bit(seed: int) -> None:
    frames, phy, mac = mixed(seed, frames=300), PHYS[seed % 4], MACS[seed // 4]
    by_numpy, machine = open_air(6, phy, mac, seed=seed), open_air(6, phy, mac, seed=seed, compiled=True)
    assert bytes_of(run(machine, frames, UNTIL)) == bytes_of(run(by_numpy, frames, UNTIL))
    assert bits(machine._state) == bits(by_numpy._state)


def test_compiled_many_at_once_that_are_hidden_from_each_other() -> None:
    levels = square(40, 300.0, 3.0, 1)
    frames = periodic(levels, 20.0, 1000 * MS)
    by_numpy = run(open_air(40), frames, UNTIL)
    time_ns, sender, number = (np.array([getattr(each, it) for each in frames]) for it in ("time_ns", "sender", "number"))
    machine = open_air(40, compiled=True)
    machine.offer_many(time_ns, sender, 100, levels, np.array([each.patience for each in frames]), number)
    assert bytes_of(machine.advance(UNTIL)) == bytes_of(by_numpy)
