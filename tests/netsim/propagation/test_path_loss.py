"""Path loss: closed forms, ns-3 (free space, two-ray ground), and the laws of every path loss."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import along_x
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import PathLoss, Paths
from vcmvsp.netsim.presets import preset
from vcmvsp.netsim.propagation.path_loss import Friis, LogDistance, NoPathLoss, TwoRayGround
from vcmvsp.netsim.propagation.walls import ItuWalls


def loss_db(layer: PathLoss, *distances: float) -> Any:
    return layer.loss_db(along_x(*distances))


def test_distance_is_three_dimensional() -> None:
    paths = Paths.between(np.array([1.0, 1.0, 1.0]), np.array([[3.0, 4.0, 7.0], [1.0, 1.0, -4.0]]))
    assert paths.distance_m.tolist() == [7.0, 5.0]  # 2, 3, 6 and 0, 0, 5


def test_free_space_loss_of_a_metre() -> None:
    # the same law in MHz and km, from ITU-R P.525 (there rounded to 32.4 dB)
    (metre,) = loss_db(Friis(2.4e9), 1.0)
    assert metre == pytest.approx(32.4478 + 20 * math.log10(2400) - 60, abs=1e-3)
    assert LogDistance().reference_loss_db == pytest.approx(metre, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "frequency_hz"), [("wifi-b-1", 2.4e9), ("wifi-g-54", 2.4e9), ("wifi-a-6", 5.15e9), ("zigbee", 2.4e9)]
)
def test_presets_begin_behind_a_metre_of_free_space(name: str, frequency_hz: float) -> None:
    layers = preset(name)
    assert layers["walls"]["frequency_hz"] == frequency_hz
    assert layers["path_loss"]["reference_loss_db"] == pytest.approx(loss_db(Friis(frequency_hz), 1.0)[0], abs=1e-3)


@pytest.mark.parametrize("exponent", [1.0, 2.0, 2.7, 4.0])
def test_each_decade_costs_ten_times_the_exponent(exponent: float) -> None:
    steps = np.diff(loss_db(LogDistance(exponent=exponent, reference_distance_m=2.0), 2.0, 20.0, 200.0, 2000.0))
    assert steps == pytest.approx([10 * exponent] * 3, abs=1e-9)


def test_the_convention_of_the_wireless_simulation_server() -> None:
    """S = Pd0 - 10 N log10(d / d0), as received level; nearer than d0 it is Pd0."""
    layer = LogDistance(exponent=2.5, reference_distance_m=2.0, reference_loss_db=49.67)
    level = 0.0 - loss_db(layer, 0.0, 1.0, 2.0, 8.0)
    assert level == pytest.approx([-49.67, -49.67, -49.67, -49.67 - 25 * math.log10(4)], abs=1e-12)


def test_without_path_loss_distance_does_not_matter() -> None:
    assert loss_db(NoPathLoss(), 0.0, 1.0, 1e6).tolist() == [0.0, 0.0, 0.0]


# ns-3.44, -CalcRxPower(0 dBm) along x: TwoRayGroundPropagationLossModel by Frequency and both heights. The first column is the
# distance.
CASES = (2.4e9, 1.5, 1.5), (2.4e9, 0.3, 0.5), (2.4e9, 10.0, 1.0), (5.15e9, 1.5, 1.5), (5.15e9, 0.3, 0.5), (5.15e9, 10.0, 1.0)
NS3_TWO_RAY = """
       1.0   40.0520080561   40.2223414491   59.1901465800   46.6839278027   46.8542611957   65.8220663265
       2.5   48.0108082296   48.0385145106   59.4596624124   54.6427279761   54.6704342572   66.0915821590
      10.0   60.0520080561   60.0537448867   62.6287938048   66.6839278027   66.6856646333   69.2607135514
      47.0   73.4939652148   83.3622464167   73.6503628795   80.1258849614   83.3622464167   80.2822826261
     100.0   80.0520080561   96.4782095624   80.0870442035   86.6839278027   96.4782095624   86.7189639501
     239.9   88.1575595565  111.6793907745   87.6587210769   94.2845327621  111.6793907745   94.2906408235
     500.0  100.9151498112  124.4369763821   94.0328150291  100.9151498112  124.4369763821  100.6647347756
    1234.5  116.6159934085  140.1378188176  103.6601054130  116.6159934085  140.1378188176  108.5139805092
    2000.0  124.9975494643  148.5193747323  112.0413757140  124.9975494643  148.5193747323  112.7046156597
"""


@pytest.mark.parametrize("kind", [Friis, TwoRayGround, ItuWalls])
def test_a_frequency_in_gigahertz_is_refused(kind: type) -> None:
    arguments = {"sightline": None} if kind is ItuWalls else {}
    with pytest.raises(ScenarioError, match=r"frequency_hz: must be a number >= 1e\+06 and <= 1e\+12, not 2\.4"):
        binding.call(kind, {"frequency_hz": 2.4}, arguments=arguments)


@pytest.mark.parametrize("case", CASES)
def test_two_ray_ground_is_that_of_ns3(case: tuple[float, float, float]) -> None:
    frequency_hz, here, there = case
    distances, *losses = np.array(NS3_TWO_RAY.split(), np.float64).reshape(-1, 1 + len(CASES)).T
    standing = TwoRayGround(frequency_hz).loss_db(along_x(*distances, tx_z=here, rx_z=there))
    assert standing == pytest.approx(losses[CASES.index(case)], abs=1e-9)
    if here == there:
        alone = TwoRayGround(frequency_hz, antenna_height_m=here).loss_db(distances)
        assert alone == pytest.approx(standing, abs=1e-9)


def test_free_space_is_no_amplifier() -> None:
    assert loss_db(Friis(), 0.0, 1e-4, 1e-3).tolist() == [0.0, 0.0, 0.0]
    assert (TwoRayGround().loss_db(along_x(0.0, 1e-4, 1e-3, tx_z=-3.0)) >= 0.0).all()
