"""Coefficients: limits of Fresnel's formulas, energy of a slab, transition function."""

import cmath
import math

import numpy as np
import pytest
from scipy.special import wofz

from vcmvsp.netsim.propagation.rays.coefficients import (
    FAR,
    MATERIALS,
    faddeeva_numbers,
    fresnel_transition,
    half_space,
    permittivity,
    slab,
)
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS, slab_loss_db

COSINES = [math.cos(math.radians(angle)) for angle in range(0, 90, 5)]
NUMBERS = np.array(faddeeva_numbers())


def test_medium_dry_ground_at_1_ghz() -> None:
    """ITU-R P.2040-3, table 3: at 1 GHz the permittivity is a, and the conductivity c."""
    assert permittivity("medium_dry_ground", 1e9) == pytest.approx(15.0 - 17.98j * 0.035)


@pytest.mark.parametrize("material", MATERIALS)
def test_reflection_at_normal_and_grazing_incidence(material: str) -> None:
    eta = permittivity(material, 2.4e9)
    perpendicular, parallel, index = half_space(1.0, eta)
    assert index == pytest.approx(cmath.sqrt(eta))
    assert perpendicular == pytest.approx((1.0 - index) / (1.0 + index))
    assert parallel == pytest.approx(-perpendicular)
    perpendicular, parallel, _ = half_space(1e-9, eta)
    assert perpendicular == pytest.approx(-1.0, abs=1e-6)
    assert parallel == pytest.approx(-1.0, abs=1e-3)


def test_brewster_angle_of_a_lossless_medium() -> None:
    assert abs(half_space(math.cos(math.atan(2.0)), 4.0 + 0j)[1]) < 1e-12


@pytest.mark.parametrize("thickness", [0.01, 0.3, 1.7])
@pytest.mark.parametrize("averaged", [0, 1])
def test_a_lossless_slab_keeps_the_power(thickness: float, averaged: int) -> None:
    for cosine in COSINES:
        found = slab(cosine, 5.0 + 0j, thickness, averaged)
        for back, through in zip(found[:2], found[2:], strict=True):
            assert abs(back) ** 2 + abs(through) ** 2 == pytest.approx(1.0, abs=1e-12)


def test_no_slab_and_an_endless_one() -> None:
    eta = permittivity("concrete", 2.4e9)
    for cosine in COSINES:
        assert slab(cosine, eta, 0.0, 0) == pytest.approx((0.0, 0.0, 1.0, 1.0), abs=1e-12)
        assert slab(cosine, eta, math.inf, 0) == (*half_space(cosine, eta)[:2], 0.0, 0.0)


@pytest.mark.parametrize("material", [name for name in ITU_MATERIALS if name != "metal"])
def test_averaged_echoes_lose_as_much_as_walls_do(material: str) -> None:
    parallel = slab(1.0, permittivity(material, 2.4e9), 0.1 * 2.4e9 / 299_792_458.0, 1)[3]
    assert -20.0 * math.log10(abs(parallel)) == pytest.approx(slab_loss_db(material, 0.1, 2.4e9), abs=1e-9)


@pytest.mark.parametrize("root", [1e-9, 1e-3, 0.03, 0.3, 1.0, 2.6, 4.5, FAR, FAR + 1e-9, 8.0, 100.0])
def test_transition_function_is_that_of_the_faddeeva_function(root: float) -> None:
    """Kouyoumjian and Pathak 1974, equation 29, by SciPy's (S. G. Johnson's) Faddeeva function."""
    expected = math.sqrt(math.pi) * cmath.exp(0.25j * math.pi) * root * wofz(cmath.exp(0.75j * math.pi) * root)
    assert fresnel_transition(root, NUMBERS) == pytest.approx(expected, rel=1e-9)


def test_transition_function_far_from_the_boundary_is_one() -> None:
    assert fresnel_transition(100.0, NUMBERS) == pytest.approx(1.0, abs=1e-4)
