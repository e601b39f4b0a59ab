import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Phy
from vcmvsp.netsim.phy.ofdm import RATES_BPS, Ofdm

PAYLOADS = (1, 7, 100, 333, 1500, 2000)
NS3_AIR_TIME_US = {  # ns-3.44 WifiPhy::CalculateTxDuration, 802.11a, for these payloads
    6e6: (76, 84, 208, 516, 2072, 2740),
    9e6: (56, 64, 144, 352, 1388, 1836),
    12e6: (48, 52, 116, 268, 1048, 1380),
    18e6: (40, 44, 84, 188, 704, 928),
    24e6: (36, 36, 68, 144, 536, 700),
    36e6: (32, 32, 52, 104, 364, 476),
    48e6: (28, 28, 44, 84, 280, 360),
    54e6: (28, 28, 44, 76, 248, 324),
}


@pytest.mark.parametrize("rate_bps", NS3_AIR_TIME_US)
def test_air_time_is_that_of_ns_3(rate_bps: float) -> None:
    """802.11g takes 6 us longer, there too: the signal extension."""
    expected = [1000 * us for us in NS3_AIR_TIME_US[rate_bps]]
    assert [Ofdm(rate_bps, "5GHz").air_time_ns(payload) for payload in PAYLOADS] == expected
    assert [Ofdm(rate_bps, "2.4GHz").air_time_ns(payload) for payload in PAYLOADS] == [ns + 6000 for ns in expected]


@pytest.mark.parametrize("rate_bps", RATES_BPS)
@given(size=st.integers(0, 3000), more=st.integers(0, 3000))
def test_air_time_grows_by_whole_symbols_that_hold_the_frame(rate_bps: float, size: int, more: int) -> None:
    phy: Phy = Ofdm(rate_bps, "5GHz")
    air_ns = phy.air_time_ns(size)
    symbols, rest = divmod(air_ns - 20_000, 4_000)
    bits = 16 + 8 * (size + 36) + 6
    assert rest == 0
    assert (symbols - 1) * 4e-6 * rate_bps < bits <= symbols * 4e-6 * rate_bps
    assert air_ns <= phy.air_time_ns(size + more)


def test_rates_that_ofdm_does_not_have_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"rate_bps = 1\.1e\+07.*6e6.*54e6"):
        Ofdm(rate_bps=11e6)
