"""Coefficients: limits of Fresnel's formulas, energy of a slab, transition function."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from vcmvsp.netsim.propagation.rays.coefficients import MATERIALS, fresnel_transition, half_space, permittivity, slab
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS, slab_loss_db

COSINES = np.cos(np.radians(np.arange(0.0, 90.0, 5.0)))
ENDLESS = np.full(len(COSINES), math.inf)


def test_medium_dry_ground_at_1_ghz() -> None:
    """ITU-R P.2040-3, table 3: at 1 GHz the permittivity is a, and the conductivity c."""
    assert permittivity("medium_dry_ground", 1e9) == pytest.approx(15.0 - 17.98j * 0.035)


@pytest.mark.parametrize("material", MATERIALS)
def test_reflection_at_normal_and_grazing_incidence(material: str) -> None:
    eta = np.full(2, permittivity(material, 2.4e9))
    found = half_space(np.array([1.0, 1e-9]), eta)
    index = eta[0] ** 0.5
    assert found.perpendicular[0] == pytest.approx((1.0 - index) / (1.0 + index))
    assert found.parallel[0] == pytest.approx(-found.perpendicular[0])
    assert found.perpendicular[1] == pytest.approx(-1.0, abs=1e-6)
    assert found.parallel[1] == pytest.approx(-1.0, abs=1e-3)


def test_brewster_angle_of_a_lossless_medium() -> None:
    found = half_space(np.array([math.cos(math.atan(2.0))]), np.array([4.0 + 0j]))
    assert abs(found.parallel[0]) < 1e-12


@pytest.mark.parametrize("thickness", [0.01, 0.3, 1.7])
def test_a_lossless_slab_keeps_the_power(thickness: float) -> None:
    size, eta = np.full(len(COSINES), thickness), np.full(len(COSINES), 5.0 + 0j)
    for echoes in ("phases", "averaged"):
        reflected, through = slab(COSINES, eta, size, echoes)
        for there, back in zip(through, reflected, strict=True):
            assert np.abs(there) ** 2 + np.abs(back) ** 2 == pytest.approx(np.ones(len(COSINES)), abs=1e-12)


def test_no_slab_and_an_endless_one() -> None:
    eta = np.full(len(COSINES), permittivity("concrete", 2.4e9))
    reflected, through = slab(COSINES, eta, np.zeros(len(COSINES)), "phases")
    assert np.abs(reflected.parallel).max() < 1e-12
    assert through.perpendicular == pytest.approx(np.ones(len(COSINES)))
    reflected, through = slab(COSINES, eta, ENDLESS, "phases")
    assert reflected.parallel == pytest.approx(half_space(COSINES, eta).parallel)
    assert not through.parallel.any()


@pytest.mark.parametrize("material", [name for name in ITU_MATERIALS if name != "metal"])
def test_averaged_echoes_lose_as_much_as_walls_do(material: str) -> None:
    thickness = np.array([0.1 * 2.4e9 / 299_792_458.0])
    _, through = slab(np.ones(1), np.array([permittivity(material, 2.4e9)]), thickness, "averaged")
    assert -20.0 * math.log10(abs(through.parallel[0])) == pytest.approx(slab_loss_db(material, 0.1, 2.4e9), abs=1e-9)


@pytest.mark.parametrize("x", [1e-3, 0.1, 1.0, 7.0])
def test_transition_function_is_its_integral(x: float) -> None:
    """Kouyoumjian and Pathak 1974, equation 29; on the path t = sqrt(x) + u exp(-j pi / 4), where it does not oscillate."""
    root, turn = math.sqrt(x), np.exp(-0.25j * math.pi)

    def on_path(u: float) -> complex:
        return complex(np.exp(-1j * (root + u * turn) ** 2) * turn)

    parts = [quad(lambda u, part=part: getattr(on_path(u), part), 0.0, 12.0)[0] for part in ("real", "imag")]
    assert fresnel_transition(np.array([root]))[0] == pytest.approx(2j * root * np.exp(1j * x) * complex(*parts), rel=1e-8)


def test_transition_function_far_from_the_boundary_is_one() -> None:
    assert fresnel_transition(np.array([100.0]))[0] == pytest.approx(1.0, abs=1e-4)
