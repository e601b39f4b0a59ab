"""CSMA/CA of IEEE 802.15.4: acknowledgements and retries."""

import numpy as np
import pytest

from tests.support.netsim.csma154_runs import MS, NOISE_DBM, PHY, SILENT, US, World, assessments, at, backoffs, levels
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors


def test_an_acknowledged_frame() -> None:
    """192 us turnaround and 352 us on the air behind the frame; the next one a space later."""
    world = World(levels(2))
    first, second = (world.offer(0, 0, to=1) for _ in range(2))
    decided, air_ns, uniforms = world.finish(), PHY.air_time_ns(50), backoffs(2, 0)
    one, two = decided[first], decided[second]
    assert (one.attempts, one.fate[1]) == (1, Fate.RECEIVED)
    assert one.end_ns == one.start_ns + air_ns
    assert two.start_ns == one.end_ns + (192 + 352 + 640 + int(8 * uniforms[1]) * 320 + 128 + 192) * US


def test_without_an_answer_a_frame_is_sent_four_times() -> None:
    """Each time after 54 symbols in vain, and with new contention."""
    world = World(levels(2, SILENT))
    number = world.offer(0, 0, to=1)
    decided, air_ns = world.finish()[number], PHY.air_time_ns(50)
    time_ns = 0
    for uniform in backoffs(4, 0):
        start_ns = time_ns + (int(8 * uniform) * 320 + 128 + 192) * US
        time_ns = start_ns + air_ns + 864 * US
    assert (decided.start_ns, decided.end_ns, decided.attempts) == (start_ns, time_ns, 4)
    assert decided.fate[1] == Fate.UNDETECTED


def test_unacknowledged_unicast_is_sent_once() -> None:
    world = World(levels(2, SILENT), acknowledge=False)
    number = world.offer(0, 0, to=1)
    assert world.finish()[number].attempts == 1


def test_retries_at_the_edge_of_range_follow_the_error_rate() -> None:
    """Frame and acknowledgement succeed with p and q: attempts are geometric, cut at four."""
    snr_db, count = -0.8, 4000
    world = World(levels(2, NOISE_DBM + snr_db))
    for index in range(count):
        world.offer(index * 100 * MS, 0, to=1, size=100)
    decided = world.finish()
    p, q = OqpskErrors().success(np.full(2, snr_db), np.array([8.0 * 117, 88.0])).tolist()
    assert 0.3 < p < 0.7
    seen = np.bincount([world.sent[number] for number in decided], minlength=5)[1:] / count
    fail = 1.0 - p * q
    expected = np.array([p * q, fail * p * q, fail**2 * p * q, fail**3])
    assert np.abs(seen - expected).max() < 4.0 * 0.5 / np.sqrt(count)
    received = np.mean([each.fate[1] == Fate.RECEIVED for each in decided.values()])
    assert abs(received - (1.0 - (1.0 - p) ** 4)) < 4.0 * 0.5 / np.sqrt(count)
    for each in decided.values():  # received is what was received first, whether its sender knows it or not
        patient = np.flatnonzero(world.patience(each.number)[: world.sent[each.number], 1] > -np.log(p))
        assert (each.fate[1] == Fate.RECEIVED) == (patient.size > 0)
        if patient.size:
            assert patient[0] == each.attempts - 1
            assert each.end_ns == each.start_ns + PHY.air_time_ns(100)
    # and the acknowledgement has nothing to do with the backoff
    waits = np.array([each.start_ns - each.number * 100 * MS for each in decided.values() if each.attempts == 1])
    assert abs(np.mean(waits == (128 + 192) * US) - 1.0 / 8.0) < 4.0 * np.sqrt(7.0 / 64.0 / len(waits))


def test_one_who_answers_begins_its_own_contention_anew() -> None:
    """It forgets the backoff during which the frame came; both frames arrive."""
    world = World(levels(2))
    starts = [assessments(row, 0)[0] + 192 * US for row in (0, 1)]
    answer = world.offer(0, 0, to=1, size=100)
    other = world.offer(starts[0] + 1 * MS, 1, to=0, size=100)  # while the frame is coming in
    decided = world.finish()
    assert decided[answer].fate[1] == decided[other].fate[0] == Fate.RECEIVED
    assert decided[other].start_ns >= decided[answer].end_ns + (192 + 128 + 192) * US


@pytest.mark.parametrize("retries", [0, 1])
def test_a_frame_that_comes_instead_of_the_acknowledgement_ends_the_wait(retries: int) -> None:
    """1 does not hear 0, but is heard: 0 answers it, and then sends again, or has given up."""
    dbm = levels(2)
    dbm[0, 1] = SILENT
    world = World(dbm, max_retries=retries)
    end_ns = 100 * MS + PHY.air_time_ns(50)
    waits = world.offer(at(100 * MS, 0), 0, to=1)
    comes = world.offer(at(end_ns + 200 * US, 1), 1, to=0, size=1)
    came_ns = end_ns + 200 * US + PHY.air_time_ns(1)
    decided = world.finish()
    assert decided[comes].end_ns == came_ns
    waited = decided[waits]
    assert waited.attempts == retries + 1
    if retries:
        ready_ns = came_ns + (192 + 352 + 192) * US
        assert waited.start_ns == ready_ns + (int(8 * backoffs(2, 0)[1]) * 320 + 128 + 192) * US
    else:
        assert waited.end_ns == came_ns
