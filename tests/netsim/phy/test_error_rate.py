"""Error rates compared with ns-3.44 (its classes, called directly and in whole simulations) and with closed forms."""

import math

import numpy as np
import pytest

from tests.support.netsim.channels import array
from vcmvsp.netsim.phy.constant_rate import ThermalNoise
from vcmvsp.netsim.phy.dsss import DsssErrors, biorthogonal_error
from vcmvsp.netsim.phy.error_rate import ErrorRate, look_up, look_up_one, steps
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors
from vcmvsp.netsim.phy.ofdm import HT_MODES, MODES, OfdmErrors

pytestmark = pytest.mark.slow

DSSS = [DsssErrors(rate) for rate in (1e6, 2e6, 5.5e6, 11e6)]
OFDM = [OfdmErrors(rate, model=model) for rate in MODES for model in ("table", "yans", "nist")]
HT = [OfdmErrors(rate, model=model) for rate in HT_MODES for model in ("table", "yans")]
MODELS: list[ErrorRate] = [*DSSS, *OFDM, *HT, *(OfdmErrors(rate, long=True) for rate in MODES), OqpskErrors()]

Points = tuple[tuple[float, float], ...]
NS3_SUCCESS: dict[ErrorRate, Points] = {  # of 1088 bits (100 bytes of payload), at SINRs in dB: (SINR, success), ...
    DsssErrors(): ((-6.0, 0.114408641), (-5.2, 0.492387011), (-4.1, 0.90090911)),
    DsssErrors(2e6): ((-1.8, 0.098592624), (-0.8, 0.503983425), (0.4, 0.897292683)),
    DsssErrors(5.5e6): ((1.0, 0.097880127), (1.9, 0.489886115), (3.0, 0.892215516)),
    DsssErrors(11e6): ((4.0, 0.09515186), (4.9, 0.484629977), (6.1, 0.908406873)),
    OfdmErrors(6e6, model="yans"): ((-1.9, 0.115129482), (-1.2, 0.506310104), (-0.2, 0.909650688)),
    OfdmErrors(9e6, model="yans"): ((0.2, 0.08680217), (1.0, 0.495758392), (2.0, 0.898603442)),
    OfdmErrors(12e6, model="yans"): ((0.9, 0.084900767), (1.7, 0.488377795), (2.7, 0.896574009)),
    OfdmErrors(18e6, model="yans"): ((4.2, 0.090566992), (4.9, 0.525660184), (5.7, 0.895911398)),
    OfdmErrors(24e6, model="yans"): ((6.8, 0.110641195), (7.7, 0.479551247), (9.0, 0.907638945)),
    OfdmErrors(36e6, model="yans"): ((10.7, 0.10444984), (11.4, 0.500808867), (12.3, 0.892740365)),
    OfdmErrors(48e6, model="yans"): ((14.1, 0.090226744), (15.2, 0.510007033), (16.5, 0.904655567)),
    OfdmErrors(54e6, model="yans"): ((16.4, 0.097598723), (17.2, 0.502460811), (18.2, 0.897385047)),
    OfdmErrors(6e6, model="nist"): ((2.4, 0.113828396), (2.7, 0.472891842), (3.3, 0.908955549)),
    OfdmErrors(9e6, model="nist"): ((5.2, 0.091529106), (5.6, 0.550607148), (6.1, 0.891785734)),
    OfdmErrors(12e6, model="nist"): ((5.4, 0.104814328), (5.7, 0.460088165), (6.3, 0.90585467)),
    OfdmErrors(18e6, model="nist"): ((8.2, 0.083672905), (8.6, 0.5390978), (9.1, 0.888308191)),
    OfdmErrors(24e6, model="nist"): ((11.7, 0.067550663), (12.1, 0.466304622), (12.7, 0.886183479)),
    OfdmErrors(36e6, model="nist"): ((14.9, 0.130410509), (15.2, 0.462882849), (15.8, 0.887507278)),
    OfdmErrors(48e6, model="nist"): ((19.6, 0.134635282), (20.0, 0.544208586), (20.6, 0.904733163)),
    OfdmErrors(54e6, model="nist"): ((20.8, 0.122778052), (21.2, 0.535521127), (21.8, 0.897401443)),
    OqpskErrors(): ((-1.5, 0.060843949), (-0.7, 0.481240135), (0.2, 0.894607301)),
}


@pytest.mark.parametrize("errors", NS3_SUCCESS, ids=str)
def test_success_is_that_of_ns_3(errors: ErrorRate) -> None:
    sinr_db, expected = np.array(NS3_SUCCESS[errors]).T
    tolerance = 1e-6 if errors == OqpskErrors() else 1e-5
    assert errors.success(sinr_db, 1088) == pytest.approx(expected, abs=tolerance)
    assert np.exp(-1088 * errors.hazard(10.0 ** (sinr_db / 10.0))) == pytest.approx(expected, abs=1e-8)


def test_thermal_noise_is_that_of_ns_3() -> None:
    assert ThermalNoise().dbm == pytest.approx(-93.97, abs=0.01)  # ns-3.44 for 802.11
    assert ThermalNoise(1.0, 0.0).dbm == pytest.approx(-173.975, abs=0.001)  # the textbook -174 dBm/Hz
    assert ThermalNoise.ieee802154(-92.0).dbm == pytest.approx(-92.4, abs=0.01)


def test_frames_have_as_many_bits_as_ns_3_counts() -> None:
    """Rate x time: ns-3.44 counts the bits that fill the last symbol, and 802.11g's 6 us of silence."""
    assert OfdmErrors(54e6).payload(100)[1] == 54 * (6 * 4 + 6) == 1620
    assert OfdmErrors(54e6, band="5GHz").payload(100)[1] == 54 * 6 * 4
    assert OfdmErrors(6e6).payload(100)[1] == 6 * (47 * 4 + 6)
    assert DsssErrors(1e6).payload(100)[1] == 8 * 136
    assert DsssErrors(11e6).payload(100)[1] == 11 * 99  # 98.9 us
    assert DsssErrors(5.5e6).payload(1)[1] == 297  # 54 us; 296 bits take 53.8
    assert OqpskErrors().payload(20)[1] == 8 * (6 + 11 + 20)
    assert OqpskErrors().payload(117)[1] == 8 * (117 + 2 * 17)  # two frames


def test_dbpsk_keeps_its_closed_form_far_out_in_the_tails() -> None:
    """DBPSK has a closed form: pb = exp(-22 x) / 2, at 1e-12 as at 1e-200, and where a frame has 1e-300 left.

    Between two steps, 2^-11 of an octave, a straight line is above an exponential by (22 x / 2^11)^2 / 8 of it.
    """
    errors = DsssErrors()
    for bit_error in (1e-12, 1e-16, 1e-60, 1e-200):
        sinr = -math.log(2.0 * bit_error) / 22.0
        assert errors.bit_hazard(array(sinr))[0] == pytest.approx(bit_error, rel=(22.0 * sinr / 2**11) ** 2 / 8.0, abs=0.0)
    sinr_db = array(10.0 * math.log10(-math.log(2e-12 / 1000.0) / 22.0))
    assert 1.0 - errors.success(sinr_db, 1000)[0] == pytest.approx(1e-12, rel=5e-4, abs=0.0)  # doubles near 1 are 1.1e-16 apart
    bit_error = -math.expm1(math.log(1e-300) / 18432)
    sinr_db = array(10.0 * math.log10(-math.log(2.0 * bit_error) / 22.0))
    assert errors.success(sinr_db, 18432)[0] == pytest.approx(1e-300, rel=0.01, abs=0.0)


def test_tables_are_shared_and_cannot_be_written() -> None:
    assert np.shares_memory(OfdmErrors(6e6).table, OfdmErrors(6e6).table)
    assert not OfdmErrors(6e6).table.flags.writeable


def test_biorthogonal_signals() -> None:
    """Without energy one of 16 is guessed; with much, the 14 neighbours at sqrt(2 E) dominate: 14 Q(sqrt e) (union bound)."""
    assert biorthogonal_error(array(0.0))[0] == pytest.approx(15.0 / 16.0, abs=1e-10)
    for e, distance in ((20.0, 0.05), (40.0, 2e-3), (400.0, 1e-9)):
        union = 14.0 * 0.5 * math.erfc(math.sqrt(e / 2.0))
        error = float(biorthogonal_error(array(e))[0])
        assert union * (1.0 - distance) <= error <= union * (1.0 + 1e-9)


def test_without_a_signal_bits_are_guessed() -> None:
    """DBPSK and O-QPSK then decide by chance: pb = 1/2; the shortest code word of 4 bits is guessed with 1/16."""
    nothing = array(0.0)
    for errors in (DsssErrors(1e6), OqpskErrors()):
        assert errors.hazard(nothing)[0] == pytest.approx(math.log(2.0), rel=1e-9)
    assert -np.expm1(-4.0 * DsssErrors(5.5e6).hazard(nothing)[0]) == pytest.approx(15.0 / 16.0, rel=1e-9)


@pytest.mark.parametrize("errors", MODELS, ids=str)
def test_success_is_that_of_the_formula_within_1e_5(errors: ErrorRate) -> None:
    sinr = 0.5 * (steps()[:-1] + steps()[1:])  # halfway between steps, where interpolation is worst
    exact, looked_up = errors.hazard(sinr), errors.bit_hazard(sinr)
    for bits in (4, 24, 136, 1088, 18_720):
        np.testing.assert_allclose(np.exp(-bits * looked_up), np.exp(-bits * exact), rtol=0, atol=1e-5)


@pytest.mark.parametrize("errors", MODELS, ids=str)
def test_success_grows_with_sinr_and_falls_with_bits(errors: ErrorRate) -> None:
    """Hazards of a bit are positive and never rise from step to step; between steps they are straight lines."""
    assert np.all(np.isfinite(errors.table))
    assert np.all(errors.table > 0.0)
    assert np.all(np.diff(errors.table) <= 1e-12 * errors.table[1:])


@pytest.mark.parametrize("errors", [DsssErrors(1e6), OfdmErrors(54e6)], ids=str)
def test_the_steps_themselves_are_exact_and_outside_them_the_ends_go_on(errors: ErrorRate) -> None:
    sinr = 2.0 ** np.arange(-16.0, 16.0)
    np.testing.assert_array_equal(errors.bit_hazard(sinr), errors.hazard(sinr))
    assert errors.bit_hazard(np.array([0.0]))[0] == pytest.approx(errors.table[0], rel=1e-2)
    assert errors.bit_hazard(np.array([1e9]))[0] == pytest.approx(errors.table[-1], abs=1e-12)


def test_one_by_one_is_the_same_to_the_last_bit() -> None:
    table, sinr = OfdmErrors(54e6).table, 2.0 ** np.random.default_rng(2).uniform(-20.0, 20.0, 2000)
    assert [look_up_one(table, each) for each in sinr.tolist()] == look_up(table, sinr).tolist()
