"""Access and reception of a few radios, computed by hand. Times: 802.11b at 1 Mbit/s, unless stated otherwise."""

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel
from tests.support.netsim.dcf_runs import MS, STRONG, UNTIL, US, all_equal, frame, open_air, run, whole_slots
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate, Offered
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

AIR = 1280 * US
SLOT, DIFS = 20 * US, 50 * US
LATER = 10 * MS  # behind the first backoff, which counts from time 0


@pytest.mark.parametrize(
    ("phy", "delay_us"), [(Dsss(1e6), 1330), (Dsss(11e6), 341), (Ofdm(6e6), 264), (Ofdm(6e6, "5GHz"), 242)], ids=str
)
def test_a_lone_frame_takes_difs_and_its_air_time(phy: Dsss | Ofdm, delay_us: int) -> None:
    """The delays of ns-3.44; 802.11a: 34 + 208 us."""
    (decided,) = run(open_air(2, phy), [frame(0, LATER, 0, all_equal(2))], 1000 * MS)
    assert decided.end_ns - LATER == delay_us * US
    assert decided.end_ns - decided.start_ns == phy.air_time_ns(100)
    assert decided.fate.tolist() == [Fate.TRANSMITTING, Fate.RECEIVED]
    assert decided.least_sinr[1] == pytest.approx(STRONG / 10 ** (phy.noise_dbm / 10))
    assert decided.attempts == 1


@pytest.mark.parametrize("at_us", [10_000, 10_010, 10_011, 10_029])
def test_a_lone_frame_of_802_11n_takes_the_rest_of_a_slot_and_its_air_time(at_us: int) -> None:
    """EDCA as in ns-3.44: slots begin AIFS, 70 us, after the last busy time, which is here the start of the run."""
    (decided,) = run(open_air(2, Ofdm(65e6)), [frame(0, at_us * US, 0, all_equal(2))], 1000 * MS)
    assert decided.start_ns == (70 + 20 * -(-(at_us - 70) // 20)) * US
    assert decided.end_ns - decided.start_ns == 62 * US


def test_a_backoff_of_802_11n_counts_the_slot_in_which_the_air_becomes_busy() -> None:
    """EDCA decrements at the end of AIFS, too: a radio that lost with b slots against a keeps b - a - 1, not b - a."""
    left = set()
    for seed in range(20):
        alone = [run(open_air(3, Ofdm(65e6), seed=seed), [frame(0, 0, i, all_equal(3))], 1000 * MS)[0] for i in range(2)]
        both = run(open_air(3, Ofdm(65e6), seed=seed), [frame(i, 0, i, all_equal(3)) for i in range(2)], 1000 * MS)
        first, last = sorted(each.start_ns for each in alone)
        if first < last:
            assert both[0].start_ns == first
            assert both[1].start_ns == both[0].end_ns + 70 * US + (last - first - SLOT)
            left.add(last - first)
    assert len(left) > 5


def test_every_radio_counts_a_first_backoff_down_from_time_0() -> None:
    starts = set()
    for seed in range(40):
        (decided,) = run(open_air(2, seed=seed), [frame(0, 0, 0, all_equal(2))], 1000 * MS)
        starts.add(whole_slots(decided.start_ns - DIFS))
    assert len(starts) > 15


def test_frames_of_a_radio_are_a_backoff_apart() -> None:
    decided = run(open_air(2), [frame(k, LATER, 0, all_equal(2)) for k in range(2000)], 10_000 * MS)
    sent = [each for each in decided if each.start_ns >= 0]
    gaps = np.diff([each.start_ns for each in sent]) - AIR - DIFS
    slots, rest = np.divmod(gaps, SLOT)
    assert not rest.any()
    counts = np.bincount(slots, minlength=32)
    assert len(counts) == 32  # 0..31
    assert abs(slots.mean() - 15.5) < 4 * 9.23 / len(slots) ** 0.5  # sd of a uniform of 32 values


def test_a_busy_medium_draws_a_backoff_and_a_wait_for_difs_does_not() -> None:
    busy_from = LATER + DIFS
    early = frame(1, LATER + 30 * US, 1, all_equal(3))  # the first begins 20 us later, and is detected 4 us later
    decided = run(open_air(3), [frame(0, LATER, 0, all_equal(3)), early], 1000 * MS)
    assert decided[1].start_ns == busy_from + AIR + DIFS  # no backoff
    delays = set()
    for seed in range(20):
        late = frame(1, busy_from + 100 * US, 1, all_equal(3))
        decided = run(open_air(3, seed=seed), [frame(0, LATER, 0, all_equal(3)), late], 1000 * MS)
        delays.add(whole_slots(decided[1].start_ns - busy_from - AIR - DIFS))
    assert len(delays) > 8


def test_carrier_sense_is_4_us_late() -> None:
    for lag_us, collides in ((0, True), (3, True), (4, True), (5, False)):
        second = frame(1, LATER + lag_us * US, 1, all_equal(3))
        decided = run(open_air(3), [frame(0, LATER, 0, all_equal(3)), second], 1000 * MS)
        fates = [each.fate[2] for each in decided]
        assert fates == ([Fate.COLLISION] * 2 if collides else [Fate.RECEIVED] * 2)
        assert (decided[0].fate[1] == Fate.TRANSMITTING) == collides


def test_the_sum_of_weak_frames_makes_the_air_busy() -> None:
    """Two of -84 dBm are -81 dBm: neither is detected, yet the fourth radio waits for the end of the first."""
    weak = np.array([0.0, 0.0, 10**-8.4, 10**-8.4])
    frames = [frame(0, LATER, 0, weak), frame(1, LATER + 200 * US, 1, weak), frame(2, LATER + 400 * US, 3, all_equal(4, 0.0))]
    first, second, third = run(open_air(4), frames, 1000 * MS)
    assert first.fate[3] == second.fate[3] == Fate.UNDETECTED
    whole_slots(third.start_ns - first.end_ns - DIFS)
    _, third = run(open_air(4), [frames[0], frames[2]], 1000 * MS)
    assert third.start_ns == LATER + 400 * US + DIFS


@pytest.mark.parametrize(
    ("phy", "snr_db", "eifs_us", "slot_us"),
    [(Ofdm(54e6, "5GHz"), 12.0, 94, 9), (Ofdm(54e6), 12.0, 364, 20), (Dsss(11e6, sensitivity_dbm=-100.0), 4.2, 364, 20)],
    ids=str,
)
def test_behind_a_payload_that_failed_a_receiver_waits_eifs(
    phy: Dsss | Ofdm, snr_db: float, eifs_us: int, slot_us: int
) -> None:
    """EIFS: SIFS, an acknowledgement at the lowest rate, DIFS (ns-3.44: 94 and 364 us)."""
    level = all_equal(2, 10 ** ((phy.noise_dbm + snr_db) / 10))
    difs_us = 34 if slot_us == 9 else 50
    for patience, ifs_us, fate in ((0.05, eifs_us, Fate.ERROR), (np.inf, difs_us, Fate.RECEIVED)):
        offered = frame(0, LATER, 0, level, patience=patience)
        first, second = run(open_air(2, phy), [offered, frame(1, LATER + 60 * US, 1, level)], 1000 * MS)
        assert first.fate[1] == fate
        whole_slots(second.start_ns - first.end_ns - ifs_us * US, slot_us * US)
    noise_only = [frame(0, LATER, 0, level, patience=1e-300), frame(1, LATER + 4 * MS, 1, level)]
    assert run(open_air(2, phy), noise_only, 1000 * MS)[1].start_ns == LATER + 4 * MS + difs_us * US


@pytest.mark.parametrize(("patience", "start_us"), [(np.inf, 200), (0.05, 364)])
def test_a_radio_waits_for_all_of_eifs_even_if_it_ends_early(patience: float, start_us: int) -> None:
    """Behind a frame from 0, one from 1 is received from 100 to 150 us, while 2 waits from 60 us on: until DIFS behind it.

    If the first was lost, 2 waits for the whole EIFS and misses the early end: as in ns-3.44.
    """
    phy = Ofdm(54e6)
    level = all_equal(3, 10 ** ((phy.noise_dbm + 13.0) / 10))
    end = LATER + 100 * US
    first = frame(0, LATER, 0, level, patience=np.array([np.inf, np.inf, patience]))
    others = [frame(1, end + 50 * US, 1, level), frame(2, end + 60 * US, 2, level)]
    decided = run(open_air(3, phy), [first, *others], 1000 * MS)
    assert [each.number for each in decided] == [0, 1, 2]
    assert decided[0].end_ns == end
    assert decided[1].fate[2] == Fate.RECEIVED
    assert decided[2].start_ns == end + start_us * US


def test_a_full_queue_refuses_frames() -> None:
    medium = open_air(2, mac=Dcf(queue_frames=3))
    decided = run(medium, [frame(k, LATER + k, 0, all_equal(2)) for k in range(6)], LATER + 5)
    assert [(each.number, each.end_ns, each.start_ns) for each in decided] == [(k, LATER + k, -1) for k in (3, 4, 5)]
    assert all((each.fate == Fate.QUEUE_FULL).all() for each in decided)
    assert [each.number for each in medium.advance(UNTIL)] == [0, 1, 2]


def test_frames_that_waited_too_long_are_not_sent() -> None:
    medium = open_air(2, mac=Dcf(lifetime_s=0.01))
    decided = run(medium, [frame(k, LATER, 0, all_equal(2)) for k in range(20)], 1000 * MS)
    sent = [each for each in decided if each.start_ns >= 0]
    given_up = [each for each in decided if each.start_ns < 0]
    assert len(sent) + len(given_up) == 20
    assert all(each.start_ns <= LATER + 10 * MS for each in sent)
    assert all(each.end_ns > LATER + 10 * MS and (each.fate == Fate.EXPIRED).all() for each in given_up)
    assert 4 <= len(sent) <= 8  # 10 ms; 1.33 ms and a backoff of 0.31 ms on average


def test_a_higher_priority_goes_first_and_equal_ones_in_their_order() -> None:
    priorities = [0, 0, 2, 1, 2, 0]
    frames = [frame(k, LATER + k, 0, all_equal(2), priority=p) for k, p in enumerate(priorities)]
    decided = run(open_air(2), frames, 1000 * MS)
    assert [each.number for each in decided] == [2, 4, 3, 0, 1, 5]  # none had begun


@pytest.mark.parametrize(
    ("preset", "key", "value", "message"),
    [
        ("wifi-b-1", "sifs_us", 1e30, r"radio.mac.sifs_us: must be a number >= "),
        ("wifi-b-1", "slot_us", 1e-9, r"radio.mac.slot_us: must be a number >= "),
        ("wifi-b-1", "preamble_time_us", 1e30, r"radio.mac.preamble_time_us: must be a number >= "),
        ("wifi-b-1", "lifetime_s", 1e300, r"radio.mac.lifetime_s: must be a number >= "),
        ("wifi-b-1", "capture_margin_db", 1e308, r"radio.mac.capture_margin_db: must be a number >= "),
        ("wifi-b-1", "cw_max", 3, r"radio.mac.cw_max: must not be less than cw_min = 31 of the standard, not 3"),
        ("wifi-b-1", "rate_control", "ideal", r"radio.mac.rate_control: ideal chooses among the rates of 802.11a, g, n and ax"),
        ("zigbee", "cw_max", 63, r"radio.mac.kind: dcf .* IEEE 802.11 and needs phy dsss or ofdm, not Ieee802154"),
    ],
)
def test_numbers_and_phys_that_no_radio_has_are_refused(preset: str, key: str, value: float, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        make_channel(preset, mac={"kind": "dcf", key: value})


def test_senders_that_do_not_hear_each_other_collide_at_the_receiver_between_them() -> None:
    left, right = np.array([0, STRONG, 0]), np.array([0, 10 * STRONG, 0])
    frames = [frame(0, LATER, 0, left, patience=1.0), frame(1, LATER + 500 * US, 2, right, patience=1.0)]
    first, second = run(open_air(3), frames, 1000 * MS)
    assert second.start_ns == LATER + 500 * US + DIFS  # it has received nothing
    assert first.fate.tolist() == [Fate.TRANSMITTING, Fate.COLLISION, Fate.UNDETECTED]
    assert second.fate[1] == Fate.COLLISION  # stronger, but too late
    assert first.least_sinr[1] == pytest.approx(0.1, rel=1e-3)
    frames[1] = frame(1, LATER + 1300 * US, 2, right)  # in turn
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
    """At 54 Mbit/s one curve is for less than 400 bytes and one for more; the header uses that of 6 Mbit/s."""
    phy, sinr = Ofdm(54e6), 10**1.6
    level = all_equal(2, sinr * 10 ** (phy.noise_dbm / 10))
    frames: list[Offered] = []
    header, header_bits = phy.errors.header
    for size in (100, 1000, 100, 1000):
        curve, bits = phy.errors.payload(size)
        hazard = float((bits * curve.hazard(np.array([sinr])) + header_bits * header.hazard(np.array([sinr])))[0])
        for factor in (0.999, 1.001):
            frames.append(frame(len(frames), LATER + len(frames), 0, level, size=size, patience=factor * hazard))
    assert phy.errors.payload(100)[0] != phy.errors.payload(1000)[0]
    assert [each.fate[1] for each in run(open_air(2, phy), frames, 1000 * MS)] == [Fate.ERROR, Fate.RECEIVED] * 4


ACK = 304 * US  # 14 bytes at 1 Mbit/s
SIFS = 10 * US
TIMEOUT = (10 + 20 + 192) * US  # SIFS, slot, preamble and header


@pytest.mark.parametrize(
    ("phy", "ack_us"),
    [(Dsss(11e6), 203), (Ofdm(6e6), 50), (Ofdm(9e6), 50), (Ofdm(54e6), 34), (Ofdm(54e6, "5GHz"), 28)],
    ids=str,
)
def test_acknowledgements_go_at_the_highest_mandatory_rate_below_that_of_the_data(phy: Dsss | Ofdm, ack_us: int) -> None:
    """Air times of ns-3.44: the next frame begins whole slots behind SIFS, acknowledgement and DIFS."""
    first, second = run(open_air(2, phy), [frame(k, LATER, 0, all_equal(2), to=1) for k in (0, 1)], 1000 * MS)
    sifs_us, slot_us = (16, 9) if isinstance(phy, Ofdm) and phy.band == "5GHz" else (10, 20)
    rest_ns = second.start_ns - first.end_ns - (2 * sifs_us + ack_us + 2 * slot_us) * US
    assert rest_ns >= 0
    assert rest_ns % (slot_us * US) == 0


def noted(level: Floats, patience: Floats, number: int = 0) -> tuple[Offered, list[int]]:
    """A frame from 0 to 1, and the times of its attempts."""
    starts: list[int] = []

    def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
        starts.append(start_ns)
        return level, patience

    return Offered(number, LATER, 0, 1, 100, 0, None, None, renew), starts


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
    """Measured in ns-3.44: largest backoffs 63, 127, 255, 511, 1022, 1022, 1014, 31, 63, ... over frames of 7 attempts."""
    offered, attempts = zip(*(noted(np.zeros(2), np.zeros(2), number) for number in range(300)), strict=True)
    run(open_air(2, mac=Dcf(lifetime_s=1e6)), offered, 100_000 * MS)
    starts = np.concatenate(attempts)
    slots, rest = np.divmod(np.diff(starts) - AIR - TIMEOUT - DIFS, SLOT)
    assert len(starts) == 7 * 300
    assert not rest.any()
    largest = np.array([slots[k::8].max() for k in range(8)])
    limits = np.array([63, 127, 255, 511, 1023, 1023, 1023, 31])
    assert (largest <= limits).all()
    assert (largest > 0.95 * limits).all()


@pytest.mark.parametrize("size", [1, 1000])
@pytest.mark.parametrize("lag_us", [2, 29, 31])
def test_a_frame_instead_of_an_acknowledgement_ends_the_wait_at_its_end(size: int, lag_us: int) -> None:
    """Its payload begins within the timeout, 50 us at 54 Mbit/s, and ends before or after it (ns-3.44)."""
    phy = Ofdm(54e6)
    medium = open_air(3, phy, Dcf(attempts=1))
    end = LATER + DIFS + phy.air_time_ns(100)
    frames = [frame(0, LATER, 0, np.zeros(3), to=1), frame(1, end + lag_us * US - DIFS, 2, all_equal(3), size=size)]
    unicast, other = sorted(run(medium, frames, 1000 * MS), key=lambda each: each.number)
    assert other.start_ns == end + lag_us * US
    assert unicast.end_ns == (other.end_ns + 400 if lag_us <= 30 else end + 50 * US)


def test_a_frame_with_a_lost_acknowledgement_counts_as_received() -> None:
    """One-way link: the receiver hears the sender, the sender never hears the receiver."""
    medium = open_air(2, mac=Dcf(attempts=3, preamble_time_us=4.0))
    medium.sensitivity_mw[0] = 10 * STRONG
    offered, starts = noted(all_equal(2), np.full(2, 99.0))
    (decided,) = run(medium, [offered], 1000 * MS)
    assert (decided.attempts, decided.fate[1]) == (1, Fate.RECEIVED)
    assert decided.end_ns == LATER + DIFS + AIR
    assert len(starts) == 3


@pytest.mark.parametrize(("gain_db", "attempts"), [(-24.0, 3), (-21.0, 1)])
def test_an_acknowledgement_has_the_path_loss_of_the_data(gain_db: float, attempts: int) -> None:
    """Data arrive at -60 dBm; a receiver that transmits with so much less power is heard from -82 dBm on."""
    medium = open_air(2, mac=Dcf(attempts=3))
    medium.power_mw[:] = 40.0, 40.0 * 10.0 ** (gain_db / 10.0)
    offered, starts = noted(all_equal(2), np.full(2, 99.0))
    (decided,) = run(medium, [offered], 1000 * MS)
    assert decided.fate[1] == Fate.RECEIVED
    assert len(starts) == attempts


def test_others_keep_silent_for_an_acknowledgement_that_they_cannot_hear() -> None:
    """Radio 2 hears radio 0 but not radio 1: the frame's duration field covers the acknowledgement."""
    to_all, deaf_to_1 = all_equal(3), np.array([STRONG, 0, 0])
    medium = open_air(3)
    medium.levels[1] = deaf_to_1
    frames = [frame(0, LATER, 0, to_all, to=1), frame(1, LATER + DIFS + AIR + 100 * US, 2, to_all)]
    unicast, after = run(medium, frames, 1000 * MS)
    whole_slots(after.start_ns - unicast.end_ns - SIFS - ACK - DIFS)
    after_broadcast = run(open_air(3), [frame(0, LATER, 0, to_all), frames[1]], 1000 * MS)[1]
    assert after_broadcast.start_ns == frames[1].time_ns + DIFS  # no acknowledgement to wait for after a broadcast


def test_a_queue_counts_the_unicast_frame_in_transmission() -> None:
    medium = open_air(2, mac=Dcf(queue_frames=2))
    now = LATER + DIFS + 100 * US
    frames = [frame(0, LATER, 0, all_equal(2), to=1), *(frame(k, now + k, 0, all_equal(2), to=1) for k in (1, 2))]
    decided = run(medium, frames, 1000 * MS)
    assert [(each.number, each.fate[1]) for each in decided] == [(2, Fate.QUEUE_FULL), (0, Fate.RECEIVED), (1, Fate.RECEIVED)]
