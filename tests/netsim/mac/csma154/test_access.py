"""CSMA/CA of IEEE 802.15.4: when a lone radio sends, its queue, its parameters."""

import itertools

import numpy as np
import pytest

from tests.support.netsim.csma154_runs import MS, NOISE_DBM, PHY, US, World, backoffs, keys, levels
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.mac.csma154.medium import Csma154
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors


def test_lone_sender_waits_for_backoff_assessment_and_turnaround() -> None:
    world, count = World(levels(2)), 4000
    for index in range(count):
        world.offer(index * 10 * MS, 0)
    decided = world.finish()
    waits = np.array([decided[index].start_ns - index * 10 * MS for index in range(count)])
    units, rest = np.divmod(waits - (128 + 192) * US, 320 * US)
    assert not rest.any()
    expected = [int(8 * uniform) for uniform in backoffs(count, 0)]
    assert units.tolist() == expected  # each a function of key and number alone
    seen = np.bincount(units, minlength=8)
    assert len(seen) == 8
    assert ((seen - count / 8) ** 2 / (count / 8)).sum() < 24.3  # chi-square, 7 degrees of freedom, 0.1 %
    for each in decided.values():
        assert each.end_ns == each.start_ns + PHY.air_time_ns(50)
        assert each.attempts == 1


@pytest.mark.parametrize(("size", "ifs_us"), [(7, 192), (8, 640), (100, 640)])
def test_frames_of_one_sender_keep_interframe_spaces(size: int, ifs_us: int) -> None:
    """After a PSDU of up to 18 bytes 12 symbols, else 40 (IEEE 802.15.4-2006, 7.4.2); ns-3.44 was seen to keep the same."""
    world = World(levels(2))
    for _ in range(50):
        world.offer(0, 0, size=size)
    decided = world.finish()
    uniforms = backoffs(50, 0)
    for before, after in itertools.pairwise(range(50)):
        wait_ns = decided[after].start_ns - decided[before].end_ns
        assert wait_ns == (ifs_us + int(8 * uniforms[after]) * 320 + 128 + 192) * US


@pytest.mark.parametrize("snr_db", [-3.0, -1.0, 0.0, 0.5, 1.0])
def test_success_is_that_of_the_error_rate(snr_db: float) -> None:
    hazard = float(-np.log(OqpskErrors().success(np.array([snr_db]), 8 * (50 + 17)))[0])
    world = World(levels(2, NOISE_DBM + snr_db))
    more, less = (world.offer(0, 0, patience=hazard * factor) for factor in (1.0 + 1e-9, 1.0 - 1e-9))
    decided = world.finish()
    assert decided[more].fate[1] == Fate.RECEIVED
    assert decided[less].fate[1] == Fate.ERROR
    assert decided[more].least_sinr[1] == pytest.approx(10.0 ** (snr_db / 10.0))


def test_below_the_preamble_threshold_nothing_is_noticed() -> None:
    for snr_db, fate in ((-5.01, Fate.UNDETECTED), (-4.99, Fate.RECEIVED)):
        world = World(levels(2, NOISE_DBM + snr_db))
        number = world.offer(0, 0, patience=np.inf)
        assert world.finish()[number].fate[1] == fate


def test_a_full_queue_refuses_and_priorities_overtake() -> None:
    world = World(levels(2), queue_frames=3)
    numbers = [world.offer(0, 0, priority=priority) for priority in (0, 0, 5, 9)]
    decided = world.finish()
    assert decided[numbers[3]].fate.tolist() == [Fate.QUEUE_FULL] * 2
    assert decided[numbers[3]].end_ns == 0
    order = sorted(numbers[:3], key=lambda number: decided[number].start_ns)
    assert order == [numbers[0], numbers[2], numbers[1]]


def test_frames_that_waited_too_long_are_not_sent() -> None:
    world = World(levels(2), lifetime_s=0.02)
    numbers = [world.offer(0, 0, size=100) for _ in range(20)]
    decided = world.finish()
    sent = [number for number in numbers if decided[number].attempts]
    assert 1 < len(sent) < 10
    assert sent == numbers[: len(sent)]
    for number in numbers[len(sent) :]:
        assert decided[number].fate.tolist() == [Fate.EXPIRED] * 2
        assert decided[number].end_ns > 20 * MS


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ScenarioError, match="min_be = 6 is more than max_be = 5"):
        Csma154(min_be=6)
    with pytest.raises(ScenarioError, match="needs phy ieee802154, not Dsss"):
        Csma154().open(Dsss(), 2, keys(2), 1e-9)
