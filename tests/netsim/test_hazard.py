import numpy as np
import pytest

from netsim.error_rate import DsssErrors, ErrorRate, OqpskErrors
from netsim.error_rate_ofdm import MODES, OfdmErrors
from netsim.hazard import FIRST, FRACTION_BITS, LAST, hazard_table, look_up

MODELS: list[ErrorRate] = [
    *(DsssErrors(rate) for rate in (1e6, 2e6, 5.5e6, 11e6)),
    *(OfdmErrors(rate, "2.4GHz", "table") for rate in MODES),
    *(OfdmErrors(rate, "5GHz", "yans") for rate in (6e6, 54e6)),
    *(OfdmErrors(rate, "2.4GHz", "nist") for rate in (6e6, 54e6)),
    OqpskErrors(),
]


@pytest.mark.parametrize("errors", MODELS, ids=str)
def test_success_is_that_of_the_formula_within_1e_5(errors: ErrorRate) -> None:
    halfway = ((FIRST + np.arange(LAST + 1)) << FRACTION_BITS) + (1 << (FRACTION_BITS - 1))  # where interpolation is worst
    sinr = halfway.view(np.float64)
    exact, looked_up = errors.hazard(sinr), look_up(hazard_table(errors), sinr)
    for bits in (24, 136, 1088, 18_720):
        np.testing.assert_allclose(np.exp(-bits * looked_up), np.exp(-bits * exact), rtol=0, atol=1e-5)


@pytest.mark.parametrize("errors", [DsssErrors(1e6), OfdmErrors(54e6)], ids=str)
def test_the_steps_themselves_are_exact_and_outside_them_the_ends_go_on(errors: ErrorRate) -> None:
    table = hazard_table(errors)
    sinr = 2.0 ** np.arange(-16.0, 16.0)
    np.testing.assert_array_equal(look_up(table, sinr), errors.hazard(sinr))
    assert look_up(table, np.array([0.0]))[0] == pytest.approx(table[0], rel=1e-2)
    assert look_up(table, np.array([1e9]))[0] == pytest.approx(table[-1], abs=1e-12)
