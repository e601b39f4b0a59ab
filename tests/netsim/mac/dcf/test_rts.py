"""RTS and CTS of IEEE 802.11: exchange, silence of other radios, hidden terminals. Times: 802.11g at 54 Mbit/s."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import (
    MS,
    STRONG,
    UNTIL,
    US,
    all_equal,
    frame,
    open_air,
    run,
    saturated_receptions,
    whole_slots,
)
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.mac.dcf.medium import DcfMedium
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

pytestmark = pytest.mark.slow

PHY = Ofdm(54e6)
SLOT, SIFS, DIFS = 20 * US, 10 * US, 50 * US
RTS, CTS, ACK = 34 * US, 34 * US, 34 * US  # 20 and 14 bytes at 24 Mbit/s: 20 us, 2 symbols, signal extension 6 us
DATA = PHY.air_time_ns(1000)
LATER = 10 * MS
ALWAYS = Dcf(rts_threshold_bytes=0)


def by_link(count: int, *links: tuple[int, int]) -> Floats:
    """Levels (n, n): strong on these links, in both directions, and none on the others."""
    levels = np.zeros((count, count))
    for a, b in links:
        levels[a, b] = levels[b, a] = STRONG
    return levels


def air(levels: Floats, mac: Dcf = ALWAYS) -> DcfMedium:
    medium = open_air(len(levels), PHY, mac)
    medium.levels[:] = levels
    return medium


@pytest.mark.parametrize(("threshold", "to"), [(None, 1), (1035, 1), (1036, 1), (1037, 1), (0, -1)])
def test_a_unicast_frame_above_the_threshold_is_sent_behind_rts_and_cts(threshold: int | None, to: int) -> None:
    """The PSDU has 1036 bytes: payload 1000, LLC and SNAP 8, MAC header 24, FCS 4."""
    medium = open_air(2, PHY, Dcf(rts_threshold_bytes=threshold))
    (decided,) = run(medium, [frame(0, LATER, 0, all_equal(2), to=to, size=1000)], UNTIL)
    behind = RTS + SIFS + CTS + SIFS if threshold == 1035 else 0
    assert decided.start_ns == LATER + DIFS + behind
    assert decided.end_ns == decided.start_ns + DATA
    assert (decided.attempts, decided.fate[1]) == (1, Fate.RECEIVED)


@pytest.mark.parametrize(("near", "known_after"), [(0, RTS), (1, RTS + SIFS + CTS)])
def test_a_radio_that_hears_one_of_both_is_silent_until_the_end_of_the_acknowledgement(near: int, known_after: int) -> None:
    """Radio 2 hears the sender alone, or the destination alone; its frame follows the reservation."""
    levels = by_link(3, (0, 1), (near, 2))
    exchange = RTS + SIFS + CTS + SIFS + DATA + SIFS + ACK
    other = frame(1, LATER + DIFS + known_after + 2 * US, 2, levels[2])
    frames = [frame(0, LATER, 0, levels[0], to=1, size=1000), other]
    decided = {each.number: each for each in run(air(levels), frames, UNTIL)}
    assert decided[0].fate[1] == Fate.RECEIVED
    whole_slots(decided[1].start_ns - LATER - DIFS - exchange - DIFS, largest=15)


def test_a_reservation_by_rts_ends_early_if_no_frame_follows() -> None:
    """IEEE 802.11-2016, 10.3.2.4: after 2 SIFS, CTS, preamble and header, and 2 slots; the destination is out of range."""
    levels = by_link(3, (0, 2))
    rts_end = LATER + DIFS + RTS
    frames = [frame(0, LATER, 0, levels[0], to=1, size=1000), frame(1, rts_end + 2 * US, 2, levels[2])]
    other = next(each for each in run(air(levels, Dcf(rts_threshold_bytes=0, attempts=1)), frames, UNTIL) if each.number)
    whole_slots(other.start_ns - rts_end - (2 * SIFS + CTS + 20 * US + 2 * SLOT) - DIFS, largest=15)


def test_a_destination_with_a_reservation_does_not_answer() -> None:
    """Radio 2 hears the exchange of 0 and 1, which radio 3 cannot hear; it answers the first RTS of 3 after that exchange."""
    levels = by_link(4, (0, 1), (1, 2), (2, 3))
    begin = LATER + DIFS + RTS + SIFS + CTS
    end = begin + SIFS + DATA + SIFS + ACK
    frames = [frame(0, LATER, 0, levels[0], to=1, size=1000), frame(1, begin - DIFS + 5 * US, 3, levels[3], to=2, size=1000)]
    decided = {each.number: each for each in run(air(levels), frames, UNTIL)}
    assert decided[0].fate[1] == Fate.RECEIVED
    assert decided[1].fate[2] == Fate.RECEIVED
    assert decided[1].attempts > 1
    assert decided[1].start_ns - 2 * SIFS - RTS - CTS >= end - RTS  # the RTS ends after the reservation


def test_unanswered_rts_count_as_attempts() -> None:
    levels = np.zeros((2, 2))
    (decided,) = run(air(levels), [frame(0, LATER, 0, levels[0], to=1, size=1000)], UNTIL)
    assert (decided.attempts, decided.fate[1]) == (7, Fate.UNDETECTED)
    assert decided.end_ns == decided.start_ns + RTS + SIFS + SLOT + 20 * US  # the timeout of the CTS


def square(count: int) -> Floats:
    """Levels (n, n) of the positions of ``bench.ns3.cases.Case``, by free space: all in range."""
    place = np.random.default_rng(count).uniform(0.0, 200.0, (count, 3)).round(3)[:, :2]
    distance = np.linalg.norm(place[:, None] - place, axis=-1)
    levels = 10.0 ** ((16.0206 - 40.052) / 10.0 - 2.0 * np.log10(np.maximum(distance, 1.0)))
    np.fill_diagonal(levels, 0.0)
    return levels


@pytest.mark.parametrize(
    ("phy", "size", "without_bps", "with_bps"), [(Dsss(1e6), 1000, 0.3595e6, 0.8042e6), (Ofdm(6e6), 2000, 2.202e6, 5.069e6)]
)
def test_rts_more_than_doubles_delivery_of_hidden_terminals_as_in_ns_3(
    phy: Dsss | Ofdm, size: int, without_bps: float, with_bps: float
) -> None:
    """Radios 1 and 2 are hidden from each other; ns-3.44, 10 runs of 5 s (``bench.ns3.compare --core sink``): 1.3 and 0.2 %."""
    levels = by_link(3, (0, 1), (0, 2))
    for threshold, expected_bps, tolerance in ((None, without_bps, 0.06), (500, with_bps, 0.02)):
        received = saturated_receptions(
            levels, phy, Dcf(queue_frames=10**6, rts_threshold_bytes=threshold), (-1, 0, 0), size, 10
        )
        assert 8.0 * size * received / 10 == pytest.approx(expected_bps, rel=tolerance)


@pytest.mark.parametrize(
    ("phy", "count", "expected_bps"),
    [
        (Dsss(11e6), 2, 4.3872e6),
        (Dsss(11e6), 10, 4.6288e6),
        (Ofdm(54e6), 2, 17.0e6),
        (Ofdm(54e6), 10, 18.6864e6),
        (Ofdm(65e6), 2, 16.8816e6),
        (Ofdm(65e6), 10, 18.7936e6),
    ],
)
def test_saturated_radios_with_rts_receive_as_much_as_in_ns_3(phy: Dsss | Ofdm, count: int, expected_bps: float) -> None:
    """Frames of 1000 bytes to the next radio, all in range; ns-3.44, 5 runs of 1 s (``bench.ns3.compare --core rts500``)."""
    mac, to = Dcf(queue_frames=10**6, rts_threshold_bytes=500), [(i + 1) % count for i in range(count)]
    received = saturated_receptions(square(count), phy, mac, to, 1000, 1)
    assert 8000.0 * received == pytest.approx(expected_bps, rel=0.02)
