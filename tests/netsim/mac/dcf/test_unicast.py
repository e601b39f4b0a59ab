"""Acknowledgements and retries of a few radios, by hand. Times are those of 802.11b at 1 Mbit/s, unless said."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, STRONG, US, all_equal, frame, open_air, run
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate, Offered
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

AIR = 1280 * US
SLOT, DIFS = 20 * US, 50 * US
LATER = 10 * MS  # behind the first backoff, which counts from time 0
ACK = 304 * US  # 14 bytes at 1 Mbit/s
SIFS = 10 * US
TIMEOUT = (10 + 20 + 192) * US  # SIFS, slot, preamble and header


def test_a_unicast_frame_is_acknowledged() -> None:
    (decided,) = run(open_air(3), [frame(0, LATER, 0, all_equal(3), to=2)], 1000 * MS)
    assert decided.start_ns == LATER + DIFS
    assert decided.end_ns == LATER + DIFS + AIR
    assert decided.fate[2] == Fate.RECEIVED
    assert decided.attempts == 1


@pytest.mark.parametrize(
    ("phy", "ack_us"),
    [(Dsss(11e6), 203), (Ofdm(6e6), 50), (Ofdm(9e6), 50), (Ofdm(54e6), 34), (Ofdm(54e6, "5GHz"), 28)],
    ids=str,
)
def test_acknowledgements_go_at_the_highest_mandatory_rate_below_that_of_the_data(phy: Dsss | Ofdm, ack_us: int) -> None:
    """Air times of ns-3.44: the next frame goes whole slots behind SIFS, acknowledgement and DIFS."""
    first, second = run(open_air(2, phy), [frame(k, LATER, 0, all_equal(2), to=1) for k in (0, 1)], 1000 * MS)
    sifs_us, slot_us = (16, 9) if isinstance(phy, Ofdm) and phy.band == "5GHz" else (10, 20)
    rest_ns = second.start_ns - first.end_ns - (2 * sifs_us + ack_us + 2 * slot_us) * US
    assert rest_ns >= 0
    assert rest_ns % (slot_us * US) == 0


def noted(level: Floats, patience: Floats) -> tuple[Offered, list[int]]:
    """A frame from 0 to 1, and when its attempts begin."""
    starts: list[int] = []

    def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
        starts.append(start_ns)
        return level, patience

    return Offered(0, LATER, 0, 1, 100, 0, None, None, renew), starts


def test_a_unicast_frame_is_tried_7_times_with_growing_windows() -> None:
    unheard = np.zeros(2)
    windows = np.zeros(6, int)
    for seed in range(60):
        offered, starts = noted(unheard, unheard)
        (decided,) = run(open_air(2, seed=seed), [offered], 10_000 * MS)
        assert (decided.attempts, len(starts), decided.fate[1]) == (7, 7, Fate.UNDETECTED)
        assert decided.end_ns == starts[-1] + AIR + TIMEOUT
        slots, rest = np.divmod(np.diff(starts) - AIR - TIMEOUT - DIFS, SLOT)
        assert not rest.any()
        windows = np.maximum(windows, slots)
    limits = np.array([63, 127, 255, 511, 1023, 1023])
    assert (windows <= limits).all()
    assert (windows > 0.85 * limits).all()


def test_the_window_falls_back_at_every_8th_failure_whatever_frame_it_belongs_to() -> None:
    """As measured of ns-3.44: largest backoffs 63, 127, 255, 511, 1022, 1022, 1014, 31, 63, ... over frames of 7 attempts."""
    starts: list[int] = []

    def renew(attempt: int, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
        starts.append(start_ns)
        return np.zeros(2), np.zeros(2)

    offered = frame(0, LATER, 0, np.zeros(2), to=1)
    medium = open_air(2, mac=Dcf(lifetime_s=1e6))
    run(medium, [type(offered)(k, LATER, 0, 1, 100, 0, None, None, renew) for k in range(300)], 100_000 * MS)
    slots, rest = np.divmod(np.diff(starts) - AIR - TIMEOUT - DIFS, SLOT)
    assert len(starts) == 7 * 300
    assert not rest.any()
    largest = np.array([slots[k::8].max() for k in range(8)])
    limits = np.array([63, 127, 255, 511, 1023, 1023, 1023, 31])
    assert (largest <= limits).all()
    assert (largest > 0.95 * limits).all()


@pytest.mark.parametrize("size", [1, 1000])
@pytest.mark.parametrize("lag_us", [2, 29, 31])
def test_who_hears_another_frame_instead_of_an_acknowledgement_gives_up_at_its_end(size: int, lag_us: int) -> None:
    """If its payload begins within the timeout, 50 us at 54 Mbit/s; whether it ends before that or behind it (ns-3.44)."""
    phy = Ofdm(54e6)
    medium = open_air(3, phy, Dcf(attempts=1))
    end = LATER + DIFS + phy.air_time_ns(100)
    frames = [frame(0, LATER, 0, np.zeros(3), to=1), frame(1, end + lag_us * US - DIFS, 2, all_equal(3), size=size)]
    unicast, other = sorted(run(medium, frames, 1000 * MS), key=lambda each: each.number)
    assert other.start_ns == end + lag_us * US
    assert unicast.end_ns == (other.end_ns + 400 if lag_us <= 30 else end + 50 * US)


def test_a_frame_whose_acknowledgement_is_lost_was_received_all_the_same() -> None:
    """The receiver hears the sender, the sender does not hear the receiver: never at that level."""
    medium = open_air(2, mac=Dcf(attempts=3, preamble_time_us=4.0))
    medium.sensitivity_mw[0] = 10 * STRONG
    offered, starts = noted(all_equal(2), np.full(2, 99.0))
    (decided,) = run(medium, [offered], 1000 * MS)
    assert (decided.attempts, decided.fate[1]) == (1, Fate.RECEIVED)
    assert decided.end_ns == LATER + DIFS + AIR
    assert len(starts) == 3


@pytest.mark.parametrize(("gain_db", "attempts"), [(-24.0, 3), (-21.0, 1)])
def test_an_acknowledgement_loses_on_its_way_what_the_data_lost(gain_db: float, attempts: int) -> None:
    """Data arrive at -60 dBm; who answers with so much less power is heard from -82 dBm on."""
    medium = open_air(2, mac=Dcf(attempts=3))
    medium.power_mw[:] = 40.0, 40.0 * 10.0 ** (gain_db / 10.0)
    offered, starts = noted(all_equal(2), np.full(2, 99.0))
    (decided,) = run(medium, [offered], 1000 * MS)
    assert decided.fate[1] == Fate.RECEIVED
    assert len(starts) == attempts


def test_others_keep_silent_for_an_acknowledgement_that_they_cannot_hear() -> None:
    """Radio 2 hears radio 0 but not radio 1: it knows from the frame how long the answer takes."""
    to_all, deaf_to_1 = all_equal(3), np.array([STRONG, 0, 0])
    medium = open_air(3)
    medium.levels[1] = deaf_to_1
    frames = [frame(0, LATER, 0, to_all, to=1), frame(1, LATER + DIFS + AIR + 100 * US, 2, to_all)]
    unicast, after = run(medium, frames, 1000 * MS)
    slots, rest = divmod(after.start_ns - unicast.end_ns - SIFS - ACK - DIFS, SLOT)
    assert (rest, 0 <= slots <= 31) == (0, True)
    heard = run(open_air(3), [frame(0, LATER, 0, to_all), frames[1]], 1000 * MS)[1]
    assert heard.start_ns == frames[1].time_ns + DIFS  # nothing to wait for behind a broadcast


def test_a_queue_of_unicast_frames_counts_the_one_that_is_being_sent() -> None:
    medium = open_air(2, mac=Dcf(queue_frames=2))
    now = LATER + DIFS + 100 * US
    frames = [frame(0, LATER, 0, all_equal(2), to=1), *(frame(k, now + k, 0, all_equal(2), to=1) for k in (1, 2))]
    decided = run(medium, frames, 1000 * MS)
    assert [(each.number, each.fate[1]) for each in decided] == [(2, Fate.QUEUE_FULL), (0, Fate.RECEIVED), (1, Fate.RECEIVED)]
