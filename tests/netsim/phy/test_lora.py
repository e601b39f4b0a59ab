"""LoRa: time on the air by Semtech's formula, and sensitivities."""

from fractions import Fraction
from itertools import product
from math import ceil

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel, send
from vcmvsp.netsim.phy.lora import LEAST_SNR_DB, Lora

PUBLISHED = [
    # payload, SF, implicit, CR, bandwidth, preamble, optimised: seconds. Values in the tests of the ns-3 module lorawan 0.3.
    (10, 7, False, 1, 125e3, 8, False, 0.041216),
    (10, 8, False, 1, 125e3, 8, False, 0.072192),
    (10, 8, True, 1, 125e3, 8, False, 0.072192),
    (10, 8, True, 2, 125e3, 8, False, 0.078336),
    (10, 8, True, 2, 125e3, 10, False, 0.082432),
    (10, 8, True, 2, 125e3, 10, True, 0.082432),
    (10, 10, True, 2, 125e3, 10, True, 0.280576),
    (10, 10, True, 2, 250e3, 10, True, 0.140288),
    (10, 10, True, 2, 500e3, 10, True, 0.070144),
    (10, 10, False, 2, 500e3, 10, True, 0.082432),
    (10, 10, False, 2, 500e3, 8, True, 0.078336),
    (10, 12, False, 2, 500e3, 8, True, 0.264192),
    (50, 12, False, 2, 500e3, 8, True, 0.657408),
    (50, 12, False, 2, 125e3, 8, True, 2.629632),
    (50, 12, False, 1, 125e3, 8, True, 2.301952),
    # LoRaWAN: 10 bytes and 13 of headers at 125 kHz, by calculators of The Things Network.
    (23, 7, False, 1, 125e3, 8, None, 0.061696),
    (23, 8, False, 1, 125e3, 8, None, 0.113152),
    (23, 9, False, 1, 125e3, 8, None, 0.205824),
    (23, 10, False, 1, 125e3, 8, None, 0.370688),
    (23, 11, False, 1, 125e3, 8, None, 0.823296),
    (23, 12, False, 1, 125e3, 8, None, 1.482752),
]


@pytest.mark.parametrize("setting", PUBLISHED)
def test_the_time_on_the_air_is_the_published_one(setting: tuple[int, int, bool, int, float, int, bool | None, float]) -> None:
    size, factor, implicit, rate, bandwidth_hz, preamble, slow, seconds = setting
    phy = Lora(
        spreading_factor=factor,
        explicit_header=not implicit,
        coding_rate=rate,
        bandwidth_hz=bandwidth_hz,
        preamble_symbols=preamble,
        low_data_rate=slow,
    )
    assert phy.air_time_ns(size) == round(seconds * 1e9)


@pytest.mark.parametrize(("factor", "rate"), list(product(range(7, 13), range(1, 5))))
@pytest.mark.parametrize("bandwidth_hz", [41700.0, 125e3, 500e3])
def test_the_time_on_the_air_is_semtechs_formula(factor: int, rate: int, bandwidth_hz: float) -> None:
    """AN1200.13, equations 1 to 4, in fractions; the optimisation is on for symbols of 16 ms and more."""
    symbol_s = Fraction(2**factor) / Fraction(bandwidth_hz)
    slow = symbol_s >= Fraction(16, 1000)
    for size, crc in product((0, 1, 17, 255), (False, True)):
        bits = Fraction(8 * size - 4 * factor + 28 + 16 * crc, 4 * (factor - 2 * slow))
        symbols = 8 + max(ceil(bits) * (rate + 4), 0)
        total_s = (Fraction(49, 4) + symbols) * symbol_s
        phy = Lora(spreading_factor=factor, coding_rate=rate, bandwidth_hz=bandwidth_hz, crc=crc)
        assert phy.air_time_ns(size) == ceil(total_s * 10**9)


def test_a_long_message_takes_several_frames() -> None:
    phy = Lora()
    assert phy.air_time_ns(256) == phy.air_time_ns(255) + phy.air_time_ns(1)


@pytest.mark.parametrize(("factor", "dbm"), [(7, -123.0), (8, -126.0), (9, -129.0), (10, -132.0), (11, -133.0), (12, -136.0)])
def test_sensitivities_equal_the_data_sheet(factor: int, dbm: float) -> None:
    """SX1276/77/78/79 data sheet, table 10: 125 kHz, lower band; it rounds to 1 dB, and the SNR steps by 2.5 dB."""
    assert Lora(spreading_factor=factor).sensitivity_dbm == pytest.approx(dbm, abs=2.0)


@pytest.mark.parametrize("factor", LEAST_SNR_DB)
def test_a_frame_is_received_down_to_the_ratio_of_its_spreading_factor(factor: int) -> None:
    """Exponent 3 behind 31.218 dB at 1 m: the range is where the level equals the sensitivity."""
    phy = Lora(spreading_factor=factor)
    range_m = 10.0 ** ((phy.tx_power_dbm - phy.sensitivity_dbm - 31.218) / 30.0)
    report = send(make_channel(f"lora-sf{factor}"), range_m * 0.999, range_m * 1.001)
    assert report.outcome == ("received", "below sensitivity")
    assert report.snr_db is not None
    assert report.snr_db == pytest.approx(np.full(2, LEAST_SNR_DB[factor]), abs=0.02)
