"""What a few radios receive, by hand. Times are those of 802.11b at 1 Mbit/s (100 bytes: 1280 us), unless said."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, STRONG, US, all_equal, frame, open_air, run
from vcmvsp.netsim.interfaces.medium import Fate, Offered
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

AIR = 1280 * US
SLOT, DIFS = 20 * US, 50 * US
LATER = 10 * MS  # behind the first backoff, which counts from time 0


def test_senders_that_do_not_hear_each_other_collide_at_the_receiver_between_them() -> None:
    left, right = np.array([0, STRONG, 0]), np.array([0, 10 * STRONG, 0])
    frames = [frame(0, LATER, 0, left, patience=1.0), frame(1, LATER + 500 * US, 2, right, patience=1.0)]
    first, second = run(open_air(3), frames, 1000 * MS)
    assert second.start_ns == LATER + 500 * US + DIFS  # it has heard nothing
    assert first.fate.tolist() == [Fate.TRANSMITTING, Fate.COLLISION, Fate.UNDETECTED]
    assert second.fate[1] == Fate.COLLISION  # stronger, but too late
    assert first.least_sinr[1] == pytest.approx(0.1, rel=1e-3)
    frames[1] = frame(1, LATER + 1300 * US, 2, right)  # one behind the other
    assert [each.fate[1] for each in run(open_air(3), frames, 1000 * MS)] == [Fate.RECEIVED] * 2


def test_interference_counts_only_while_it_lasts() -> None:
    """At -6 dB a bit at 1 Mbit/s fails with exp(-22/4)/2; before the other begins hardly ever."""
    weak = STRONG / 4.0
    left, right = np.array([0, weak, 0]), np.array([0, STRONG, 0])
    frames = [frame(0, LATER, 0, left, patience=3.0), frame(1, LATER + 500 * US, 2, right)]
    first, second = run(open_air(3), frames, 1000 * MS)
    bits = 1280 - 550  # behind the start of the second
    assert 0.5 * np.exp(-22.0 * 0.25) * bits < 3.0
    assert first.fate[1] == Fate.RECEIVED
    frames[0] = frame(0, LATER, 0, left, patience=0.9 * 0.5 * np.exp(-22.0 * 0.25) * bits)
    first, second = run(open_air(3), frames, 1000 * MS)
    assert first.fate[1] == Fate.COLLISION
    assert second.fate[1] == Fate.COLLISION  # the receiver was busy with the first


def test_causes() -> None:
    noise = 10 ** (Dsss().noise_dbm / 10)
    too_weak, at_6_db = 10**-8.21, 4.0 * noise
    deaf_to_it = run(open_air(2), [frame(0, LATER, 0, np.array([0, too_weak]))], 1000 * MS)
    assert deaf_to_it[0].fate[1] == Fate.UNDETECTED
    phy = Dsss(11e6, sensitivity_dbm=-100.0)
    hazard = float(phy.errors.hazard(np.array([4.0]))[0]) * 1088
    for patience, fate in ((0.5 * hazard, Fate.ERROR), (2.0 * hazard, Fate.RECEIVED)):
        (decided,) = run(open_air(2, phy), [frame(0, LATER, 0, np.array([0, at_6_db]), patience=patience)], 1000 * MS)
        assert decided.fate[1] == fate


def test_of_frames_that_begin_together_the_stronger_is_received() -> None:
    loud, soft = np.array([0, STRONG, STRONG]), np.array([STRONG, 0, STRONG / 10])
    for first, second in ((soft, loud), (loud, soft)):
        sender = 0 if first is loud else 1
        frames = [frame(0, LATER, sender, first), frame(1, LATER + 3 * US, 1 - sender, second)]
        decided = {each.number: each.fate[2] for each in run(open_air(3), frames, 1000 * MS)}
        assert decided[0 if first is loud else 1] == Fate.RECEIVED
        assert decided[1 if first is loud else 0] == Fate.COLLISION


@pytest.mark.parametrize(("margin_db", "fate"), [(None, Fate.COLLISION), (5.0, Fate.RECEIVED), (15.0, Fate.COLLISION)])
def test_a_stronger_frame_takes_the_receiver_over_where_capture_is_on(margin_db: float | None, fate: Fate) -> None:
    soft, loud = np.array([0, STRONG / 10, 0]), np.array([0, STRONG, 0])
    frames = [frame(0, LATER, 0, soft, patience=1.0), frame(1, LATER + 10 * US, 2, loud, patience=1.0)]
    first, second = run(open_air(3, mac=Dcf(capture_margin_db=margin_db)), frames, 1000 * MS)
    assert second.fate[1] == fate
    assert first.fate[1] == Fate.COLLISION
    frames[1] = frame(1, LATER + 30 * US, 2, loud)  # out of its window: 4 + 16 us
    assert run(open_air(3, mac=Dcf(capture_margin_db=margin_db)), frames, 1000 * MS)[1].fate[1] == Fate.COLLISION


def test_frames_of_two_sizes_go_by_the_curves_of_their_sizes() -> None:
    """At 54 Mbit/s there is one for less than 400 bytes and one for more; the header has that of 6 Mbit/s."""
    phy, sinr = Ofdm(54e6), 10**1.6
    level = all_equal(2, sinr * 10 ** (phy.noise_dbm / 10))
    frames: list[Offered] = []
    expected: list[Fate] = []
    for size in (100, 1000, 100, 1000):
        curve, bits = phy.errors.payload(size)
        header, header_bits = phy.errors.header
        hazard = float((bits * curve.hazard(np.array([sinr])) + header_bits * header.hazard(np.array([sinr])))[0])
        for factor, fate in ((0.999, Fate.ERROR), (1.001, Fate.RECEIVED)):
            number = len(frames)
            frames.append(frame(number, LATER + number, 0, level, size=size, patience=factor * hazard))
            expected.append(fate)
    assert phy.errors.payload(100)[0] != phy.errors.payload(1000)[0]
    assert [each.fate[1] for each in run(open_air(2, phy), frames, 1000 * MS)] == expected
