"""Free space and two-ray ground against ns-3 and against each other."""

import math

import numpy as np
import pytest

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.testing import check_channel
from vcmvsp.netsim.interfaces.layers import Paths
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.two_ray import Friis, TwoRayGround
from vcmvsp.netsim.propagation.walls import ItuWalls

DISTANCES = (1.0, 2.5, 10.0, 47.0, 100.0, 239.9, 500.0, 1234.5, 2000.0)

# ns-3.44, -CalcRxPower(0 dBm) at DISTANCES along x: FriisPropagationLossModel by Frequency ...
NS3_FRIIS = {
    2.4e9: (
        40.0520080561,
        48.0108082296,
        60.0520080561,
        73.4939652148,
        80.0520080561,
        87.6526130155,
        94.0314081428,
        101.8818299415,
        106.0726079694,
    ),
    5.15e9: (
        46.6839278027,
        54.6427279761,
        66.6839278027,
        80.1258849614,
        86.6839278027,
        94.2845327621,
        100.6633278894,
        108.5137496881,
        112.7045277160,
    ),
}
# ... and TwoRayGroundPropagationLossModel (HeightAboveZ 0) by Frequency and the heights of both ends
NS3_TWO_RAY = {
    (2.4e9, 1.5, 1.5): (
        40.0520080561,
        48.0108082296,
        60.0520080561,
        73.4939652148,
        80.0520080561,
        88.1575595565,
        100.9151498112,
        116.6159934085,
        124.9975494643,
    ),
    (2.4e9, 0.3, 0.5): (
        40.2223414491,
        48.0385145106,
        60.0537448867,
        83.3622464167,
        96.4782095624,
        111.6793907745,
        124.4369763821,
        140.1378188176,
        148.5193747323,
    ),
    (2.4e9, 10.0, 1.0): (
        59.1901465800,
        59.4596624124,
        62.6287938048,
        73.6503628795,
        80.0870442035,
        87.6587210769,
        94.0328150291,
        103.6601054130,
        112.0413757140,
    ),
    (5.15e9, 1.5, 1.5): (
        46.6839278027,
        54.6427279761,
        66.6839278027,
        80.1258849614,
        86.6839278027,
        94.2845327621,
        100.9151498112,
        116.6159934085,
        124.9975494643,
    ),
    (5.15e9, 0.3, 0.5): (
        46.8542611957,
        54.6704342572,
        66.6856646333,
        83.3622464167,
        96.4782095624,
        111.6793907745,
        124.4369763821,
        140.1378188176,
        148.5193747323,
    ),
    (5.15e9, 10.0, 1.0): (
        65.8220663265,
        66.0915821590,
        69.2607135514,
        80.2822826261,
        86.7189639501,
        94.2906408235,
        100.6647347756,
        108.5139805092,
        112.7046156597,
    ),
}


def line(*distances: float, tx_z: float = 0.0, rx_z: float = 0.0) -> Paths:
    return Paths.between(np.array([0.0, 0.0, tx_z]), np.array([(d, 0.0, rx_z) for d in distances]))


@pytest.mark.parametrize("frequency_hz", NS3_FRIIS)
def test_friis_is_that_of_ns3(frequency_hz: float) -> None:
    loss = Friis(frequency_hz).loss_db(line(*DISTANCES))
    assert loss == pytest.approx(NS3_FRIIS[frequency_hz], abs=1e-9)
    assert loss[0] == pytest.approx(20.0 * math.log10(4.0 * math.pi * frequency_hz / SPEED_OF_LIGHT), abs=1e-12)


@pytest.mark.parametrize("kind", [Friis, TwoRayGround, ItuWalls])
def test_a_frequency_in_gigahertz_is_refused(kind: type) -> None:
    given = {"sightline": None} if kind is ItuWalls else {}
    with pytest.raises(ScenarioError, match=r"frequency_hz: must be a number >= 1e\+06 and <= 1e\+12, not 2\.4"):
        binding.call(kind, {"frequency_hz": 2.4}, given=given)


@pytest.mark.parametrize("case", NS3_TWO_RAY)
def test_two_ray_ground_is_that_of_ns3(case: tuple[float, float, float]) -> None:
    frequency_hz, here, there = case
    standing = TwoRayGround(frequency_hz).loss_db(line(*DISTANCES, tx_z=here, rx_z=there))
    assert standing == pytest.approx(NS3_TWO_RAY[case], abs=1e-9)
    if here == there:
        alone = TwoRayGround(frequency_hz, antenna_height_m=here).loss_db(DISTANCES)
        assert alone == pytest.approx(standing, abs=1e-9)


def test_both_laws_meet_at_the_crossover_and_the_far_one_falls_with_the_fourth_power() -> None:
    layer, crossover = TwoRayGround(2.4e9, 1.5), 4 * math.pi * 1.5 * 1.5 * 2.4e9 / SPEED_OF_LIGHT
    before, after = layer.loss_db([crossover * (1 - 1e-9), crossover * (1 + 1e-9)])
    assert before == pytest.approx(after, abs=1e-6)
    assert np.diff(layer.loss_db([crossover * 2, crossover * 20])) == pytest.approx(40.0, abs=1e-9)
    assert np.diff(layer.loss_db([crossover / 20, crossover / 2])) == pytest.approx(20.0, abs=1e-9)


def test_free_space_is_no_amplifier() -> None:
    assert Friis().loss_db(line(0.0, 1e-4, 1e-3)).tolist() == [0.0, 0.0, 0.0]
    assert (TwoRayGround().loss_db(line(0.0, 1e-4, 1e-3, tx_z=-3.0)) >= 0.0).all()


@pytest.mark.parametrize("layer", [Friis(5.15e9), TwoRayGround(), TwoRayGround(5.15e9, 0.0)])
def test_the_laws_of_every_path_loss(layer: Friis | TwoRayGround) -> None:
    check_channel(layer)
