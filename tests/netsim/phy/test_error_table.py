import numpy as np
import pytest

from vcmvsp.netsim.phy.dsss import DsssErrors
from vcmvsp.netsim.phy.error_rate import ErrorRate, look_up, look_up_one, steps
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors
from vcmvsp.netsim.phy.ofdm import MODES, OfdmErrors

MODELS: list[ErrorRate] = [
    *(DsssErrors(rate) for rate in (1e6, 2e6, 5.5e6, 11e6)),
    *(OfdmErrors(rate, long=long) for rate in MODES for long in (False, True)),
    *(OfdmErrors(rate, "5GHz", "yans") for rate in (6e6, 54e6)),
    *(OfdmErrors(rate, "2.4GHz", "nist") for rate in (6e6, 54e6)),
    OqpskErrors(),
]


@pytest.mark.parametrize("errors", MODELS, ids=str)
def test_success_is_that_of_the_formula_within_1e_5(errors: ErrorRate) -> None:
    sinr = 0.5 * (steps()[:-1] + steps()[1:])  # halfway interpolation is worst
    exact, looked_up = errors.hazard(sinr), errors.bit_hazard(sinr)
    for bits in (4, 24, 136, 1088, 18_720):
        np.testing.assert_allclose(np.exp(-bits * looked_up), np.exp(-bits * exact), rtol=0, atol=1e-5)


@pytest.mark.parametrize("errors", MODELS, ids=str)
def test_tables_never_rise(errors: ErrorRate) -> None:
    assert np.all(np.isfinite(errors.table))
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
