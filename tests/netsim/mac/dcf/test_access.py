"""When a few radios send, worked out by hand. Times are those of 802.11b at 1 Mbit/s (100 bytes: 1280 us), unless said."""

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel
from tests.support.netsim.dcf_runs import MS, STRONG, UNTIL, US, all_equal, frame, open_air, run
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import Ieee802154
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


def test_every_radio_counts_a_first_backoff_down_from_time_0() -> None:
    starts = set()
    for seed in range(40):
        (decided,) = run(open_air(2, seed=seed), [frame(0, 0, 0, all_equal(2))], 1000 * MS)
        slots, rest = divmod(decided.start_ns - DIFS, SLOT)
        assert rest == 0
        assert 0 <= slots <= 31
        starts.add(slots)
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


def test_a_frame_that_finds_the_air_busy_draws_a_backoff_and_one_that_only_waits_for_difs_does_not() -> None:
    busy_from = LATER + DIFS
    early = frame(1, LATER + 30 * US, 1, all_equal(3))  # the first begins 20 us later, and is noticed 4 us later
    decided = run(open_air(3), [frame(0, LATER, 0, all_equal(3)), early], 1000 * MS)
    assert decided[1].start_ns == busy_from + AIR + DIFS  # no backoff
    delays = set()
    for seed in range(20):
        late = frame(1, busy_from + 100 * US, 1, all_equal(3))
        decided = run(open_air(3, seed=seed), [frame(0, LATER, 0, all_equal(3)), late], 1000 * MS)
        slots, rest = divmod(decided[1].start_ns - busy_from - AIR - DIFS, SLOT)
        assert (rest, 0 <= slots <= 31) == (0, True)
        delays.add(slots)
    assert len(delays) > 8


def test_carrier_sense_is_4_us_late() -> None:
    for lag_us, collides in ((0, True), (3, True), (4, True), (5, False)):
        second = frame(1, LATER + lag_us * US, 1, all_equal(3))
        decided = run(open_air(3), [frame(0, LATER, 0, all_equal(3)), second], 1000 * MS)
        fates = [each.fate[2] for each in decided]
        assert fates == ([Fate.COLLISION] * 2 if collides else [Fate.RECEIVED] * 2)
        assert (decided[0].fate[1] == Fate.TRANSMITTING) == collides


def test_the_sum_of_weak_frames_makes_the_air_busy() -> None:
    """Two of -84 dBm are -81: neither is detected, yet the fourth radio waits for the end of the first."""
    weak = np.array([0.0, 0.0, 10**-8.4, 10**-8.4])
    frames = [frame(0, LATER, 0, weak), frame(1, LATER + 200 * US, 1, weak), frame(2, LATER + 400 * US, 3, all_equal(4, 0.0))]
    first, second, third = run(open_air(4), frames, 1000 * MS)
    assert first.fate[3] == second.fate[3] == Fate.UNDETECTED
    slots, rest = divmod(third.start_ns - first.end_ns - DIFS, SLOT)
    assert (rest, 0 <= slots <= 31) == (0, True)
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
    for patience, ifs_us, fate in (
        (0.05, eifs_us, Fate.ERROR),
        (np.inf, eifs_us - (60 if slot_us == 9 else 314), Fate.RECEIVED),
    ):
        heard = frame(0, LATER, 0, level, patience=patience)
        first, second = run(open_air(2, phy), [heard, frame(1, LATER + 60 * US, 1, level)], 1000 * MS)
        assert first.fate[1] == fate
        slots, rest = divmod(second.start_ns - first.end_ns - ifs_us * US, slot_us * US)
        assert (rest, 0 <= slots <= 31) == (0, True)
    noise_only = [frame(0, LATER, 0, level, patience=1e-300), frame(1, LATER + 4 * MS, 1, level)]
    assert run(open_air(2, phy), noise_only, 1000 * MS)[1].start_ns == LATER + 4 * MS + (34 if slot_us == 9 else 50) * US


@pytest.mark.parametrize(("patience", "start_us"), [(np.inf, 200), (0.05, 364)])
def test_who_was_told_of_eifs_is_not_woken_up_when_it_ends_early(patience: float, start_us: int) -> None:
    """Behind a frame from 0, one from 1 is received from 100 to 150 us, while 2 waits since 60 us: until DIFS behind it.

    If the first was lost, 2 waits for EIFS, and does not notice that it is over: as ns-3.44 does.
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


def test_the_queue_has_an_end() -> None:
    medium = open_air(2, mac=Dcf(queue_frames=3))
    decided = run(medium, [frame(k, LATER + k, 0, all_equal(2)) for k in range(6)], LATER + 5)
    assert [(each.number, each.end_ns, each.start_ns) for each in decided] == [
        (3, LATER + 3, -1),
        (4, LATER + 4, -1),
        (5, LATER + 5, -1),
    ]
    assert all((each.fate == Fate.QUEUE_FULL).all() for each in decided)
    assert [each.number for each in medium.advance(UNTIL)] == [0, 1, 2]


def test_what_waits_too_long_is_never_sent() -> None:
    medium = open_air(2, mac=Dcf(lifetime_s=0.01))
    decided = run(medium, [frame(k, LATER, 0, all_equal(2)) for k in range(20)], 1000 * MS)
    sent = [each for each in decided if each.start_ns >= 0]
    given_up = [each for each in decided if each.start_ns < 0]
    assert len(sent) + len(given_up) == 20
    assert all(each.start_ns <= LATER + 10 * MS for each in sent)
    assert all(each.end_ns > LATER + 10 * MS and (each.fate == Fate.EXPIRED).all() for each in given_up)
    assert 4 <= len(sent) <= 8  # 10 ms; 1.33 ms and a backoff of 0.31 ms in the mean


def test_a_higher_priority_goes_first_and_equal_ones_in_their_order() -> None:
    priorities = [0, 0, 2, 1, 2, 0]
    frames = [frame(k, LATER + k, 0, all_equal(2), priority=p) for k, p in enumerate(priorities)]
    decided = run(open_air(2), frames, 1000 * MS)
    assert [each.number for each in decided] == [2, 4, 3, 0, 1, 5]  # none had begun


def test_levels_are_asked_for_when_a_frame_begins() -> None:
    asked = []

    def renew(attempt: int, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
        asked.append((attempt, start_ns))
        return all_equal(2), np.full(2, np.inf)

    offered = frame(7, LATER, 0, all_equal(2))
    lazy = type(offered)(7, LATER, 0, -1, 100, 0, None, None, renew)
    (decided,) = run(open_air(2), [lazy], 1000 * MS)
    assert asked == [(0, LATER + DIFS)]
    assert decided.fate[1] == Fate.RECEIVED


def test_only_the_phys_of_802_11_have_a_dcf() -> None:
    with pytest.raises(ScenarioError, match=r"dcf is IEEE 802.11: it goes with the phys dsss and ofdm, not with Ieee802154"):
        Dcf().open(Ieee802154(), 2, np.zeros(2, np.uint64), 1e-9)


@pytest.mark.parametrize(
    ("key", "value"),
    [("sifs_us", 1e30), ("slot_us", 1e-9), ("preamble_time_us", 1e30), ("lifetime_s", 1e300), ("capture_margin_db", 1e308)],
)
def test_numbers_that_no_radio_has_are_refused(key: str, value: float) -> None:
    with pytest.raises(ScenarioError, match=rf"radio.mac.{key}: must be a number >= "):
        make_channel("wifi-b-1", mac={"kind": "dcf", key: value})


def test_a_window_below_the_standards_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"cw_max = 3 is less than the standard's cw_min, 31"):
        make_channel("wifi-b-1", mac={"kind": "dcf", "cw_max": 3})
