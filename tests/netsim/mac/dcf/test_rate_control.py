"""Rate control of 802.11: rate of a frame by the SNR of the previous one, and delivery as in ns-3."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, UNTIL, all_equal, frame, open_air, run, saturated_receptions
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.ofdm import HE_MODES, HT_MODES, MODES, Ofdm

pytestmark = pytest.mark.slow

IDEAL = Dcf(rate_control="ideal")
LATER = 10 * MS


def level(snr_db: float) -> Floats:
    return all_equal(2, 10.0 ** ((Ofdm().noise_dbm + snr_db) / 10.0))


@pytest.mark.parametrize("rate_bps", [*list(MODES)[1:], *list(HT_MODES)[1:], *list(HE_MODES)[1:]])
def test_a_frame_has_the_highest_rate_that_the_snr_of_the_one_before_allows(rate_bps: float) -> None:
    phy = Ofdm(rate_bps, sensitivity_dbm=-100.0, preamble_snr_db=-10.0)
    rates = phy.rates_bps
    for margin_db, expected_bps in ((0.01, rate_bps), (-0.01, rates[rates.index(rate_bps) - 1])):
        frames = [frame(k, LATER + k * MS, 0, level(phy.least_snr_db + margin_db), to=1) for k in range(2)]
        times = [each.end_ns - each.start_ns for each in run(open_air(2, phy, IDEAL), frames, UNTIL)]
        assert times == [Ofdm(each).air_time_ns(100) for each in (rates[0], expected_bps)]


def test_broadcasts_have_the_rate_of_the_phy() -> None:
    frames = [frame(k, LATER + k * MS, 0, level(40.0), to=to) for k, to in enumerate((1, -1, 1))]
    times = [each.end_ns - each.start_ns for each in run(open_air(2, Ofdm(12e6), IDEAL), frames, UNTIL)]
    assert times == [Ofdm(rate).air_time_ns(100) for rate in (6e6, 12e6, 54e6)]


def test_after_a_frame_that_was_given_up_the_rate_is_the_lowest() -> None:
    unheard = np.zeros(2)
    frames = [frame(k, LATER + k * 100 * MS, 0, unheard if k == 2 else level(40.0), to=1) for k in range(5)]
    decided = run(open_air(2, Ofdm(), IDEAL), frames, UNTIL)
    assert [each.fate[1] == Fate.RECEIVED for each in decided] == [True, True, False, True, True]
    times = [each.end_ns - each.start_ns for each in decided]
    assert [times[k] for k in (0, 1, 3, 4)] == [Ofdm(rate).air_time_ns(100) for rate in (6e6, 54e6, 6e6, 54e6)]


def test_rts_also_reports_the_snr() -> None:
    """The first frame has 6 Mbit/s, chosen before its RTS; its retry, without an acknowledgement, the rate for the SNR of the
    RTS.
    """
    mac = Dcf(rate_control="ideal", rts_threshold_bytes=0)
    frames = [frame(0, LATER, 0, level(40.0), to=1, patience=np.array([0.0, 0.0]))]
    (decided,) = run(open_air(2, Ofdm(), mac), frames, UNTIL)
    assert decided.attempts == 7
    assert decided.end_ns - decided.start_ns < Ofdm(6e6).air_time_ns(100)


NS3_BPS = {  # by distance, m
    Ofdm(6e6, "5GHz"): {10: 24.902e6, 20: 24.901e6, 30: 23.432e6, 40: 20.117e6},
    Ofdm(6.5e6): {10: 18.266e6, 30: 18.261e6, 50: 17.006e6, 70: 15.310e6},
    Ofdm(8.6e6): {10: 20.947e6, 50: 18.506e6, 70: 16.746e6},
}


@pytest.mark.parametrize("phy", NS3_BPS)
def test_a_saturated_link_carries_as_much_as_in_ns_3(phy: Ofdm) -> None:
    """Frames of 1000 bytes, exponent 3; ns-3.44 ``IdealWifiManager``, 5 runs of 1 s (``bench.ns3.compare --core ideal``)."""
    loss_db = 46.684 if phy.band == "5GHz" else 40.052  # at 1 m
    for distance_m, expected_bps in NS3_BPS[phy].items():
        power = 10.0 ** ((16.0206 - loss_db - 30.0 * np.log10(distance_m)) / 10.0)
        received = saturated_receptions(np.array([[0.0, power], [power, 0.0]]), phy, IDEAL, (-1, 0), 1000, 1)
        assert 8000.0 * received == pytest.approx(expected_bps, rel=0.02)
