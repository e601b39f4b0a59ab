from fractions import Fraction
from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Phy
from vcmvsp.netsim.phy.constant_rate import ConstantRate
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import Ieee802154
from vcmvsp.netsim.phy.ofdm import Ofdm

PHYS: list[Phy] = [ConstantRate(), ConstantRate(rate_bps=54e6, overhead_s=20e-6), Dsss(), Dsss(rate_bps=5.5e6), Ieee802154()]


@pytest.mark.parametrize("mbps", ["1", "2", "5.5", "11"])
@pytest.mark.parametrize("payload", [1, 100, 1500])
def test_802_11b_air_time(mbps: str, payload: int) -> None:
    payload_us = Fraction(8 * (payload + 36)) / Fraction(mbps)
    assert Dsss(rate_bps=float(mbps) * 1e6).air_time_ns(payload) == (192 + ceil(payload_us)) * 1000


@pytest.mark.parametrize(("payload", "microseconds"), [(1, 576), (7, 768), (20, 1184), (100, 3744), (114, 4192), (116, 4256)])
def test_802_15_4_air_time(payload: int, microseconds: int) -> None:
    """(6 + PSDU) x 32 us, as ns-3.44 takes; it stops at 114 bytes, the standard at 116 (PSDU 127 bytes, 4.256 ms)."""
    assert Ieee802154().air_time_ns(payload) == microseconds * 1000


def test_802_15_4_splits_what_does_not_fit() -> None:
    phy = Ieee802154()
    assert phy.air_time_ns(117) == phy.air_time_ns(116) + 640_000 + phy.air_time_ns(1)
    assert phy.air_time_ns(1500) == 12 * (phy.air_time_ns(116) + 640_000) + phy.air_time_ns(1500 - 12 * 116)


@pytest.mark.parametrize(
    ("phy", "sifs_us"), [(Dsss(1e6), 10), (Dsss(11e6), 10), (Ofdm(6e6), 10), (Ofdm(54e6), 10), (Ofdm(6e6, "5GHz"), 16)]
)
def test_802_11_splits_what_does_not_fit_into_an_msdu(phy: Dsss | Ofdm, sifs_us: int) -> None:
    """An MSDU has 2304 bytes, of which LLC and SNAP take 8."""
    full_ns = phy.air_time_ns(2296) + sifs_us * 1000
    assert phy.air_time_ns(2297) == full_ns + phy.air_time_ns(1)
    assert phy.air_time_ns(14_622) == 6 * full_ns + phy.air_time_ns(14_622 - 6 * 2296)
    bits = [phy.errors.payload(size)[1] for size in (2296, 14_622 - 6 * 2296, 14_622)]
    assert bits[2] == 6 * bits[0] + bits[1]


def test_constant_rate_air_time() -> None:
    assert ConstantRate(rate_bps=250e3, overhead_s=1e-3).air_time_ns(100) == 1_000_000 + 3_200_000
    assert ConstantRate(rate_bps=3e9, overhead_s=0.0).air_time_ns(1) == 3  # 2.67 ns
    assert ConstantRate(rate_bps=1e9, overhead_s=0.0).air_time_ns(0) == 1  # never nothing


@pytest.mark.parametrize("phy", PHYS)
@given(size=st.integers(0, 100_000), more=st.integers(0, 5000))
def test_air_time_is_positive_and_grows_with_the_payload(phy: Phy, size: int, more: int) -> None:
    assert 1 <= phy.air_time_ns(size) <= phy.air_time_ns(size + more)


def test_rates_that_802_11b_does_not_have_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"rate_bps.*3e\+06.*5\.5e6"):
        Dsss(rate_bps=3e6)
