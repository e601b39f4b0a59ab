import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.netsim.interfaces.layers import PathLoss, Paths
from vcmvsp.netsim.presets import preset
from vcmvsp.netsim.propagation.path_loss import LogDistance, NoPathLoss
from vcmvsp.netsim.propagation.two_ray import Friis

coordinate = st.floats(-2000.0, 2000.0)
point = st.tuples(coordinate, coordinate, coordinate)


def loss_db(layer: PathLoss, *distances: float) -> Any:
    return layer.loss_db(Paths.between(np.zeros(3), np.array([(d, 0.0, 0.0) for d in distances])))


def test_distance_is_three_dimensional() -> None:
    paths = Paths.between(np.array([1.0, 1.0, 1.0]), np.array([[3.0, 4.0, 7.0], [1.0, 1.0, -4.0]]))
    assert paths.distance_m.tolist() == [7.0, 5.0]  # 2, 3, 6 and 0, 0, 5


def test_free_space_loss_of_a_metre() -> None:
    # the same law in MHz and km, as ITU-R P.525 has it (there rounded to 32.4 dB)
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


def test_exponent_2_is_free_space() -> None:
    distances = [1.0, 3.0, 47.0, 2000.0]
    free_space = loss_db(Friis(2.4e9), *distances)
    layer = LogDistance(exponent=2.0, reference_distance_m=1.0, reference_loss_db=float(free_space[0]))
    assert loss_db(layer, *distances) == pytest.approx(free_space, abs=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 2.0, 2.7, 4.0])
def test_each_decade_costs_ten_times_the_exponent(exponent: float) -> None:
    steps = np.diff(loss_db(LogDistance(exponent=exponent, reference_distance_m=2.0), 2.0, 20.0, 200.0, 2000.0))
    assert steps == pytest.approx([10 * exponent] * 3, abs=1e-9)


def test_the_convention_of_the_wireless_simulation_server() -> None:
    """S = Pd0 - 10 N log10(d / d0), as received level; nearer than d0 it stays Pd0."""
    layer = LogDistance(exponent=2.5, reference_distance_m=2.0, reference_loss_db=49.67)
    level = 0.0 - loss_db(layer, 0.0, 1.0, 2.0, 8.0)
    assert level == pytest.approx([-49.67, -49.67, -49.67, -49.67 - 25 * math.log10(4)], abs=1e-12)


def test_without_path_loss_distance_does_not_matter() -> None:
    assert loss_db(NoPathLoss(), 0.0, 1.0, 1e6).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("layer", [NoPathLoss(), LogDistance(exponent=3.3)])
@given(points=st.lists(point, min_size=2, max_size=12))
def test_reciprocal_finite_repeatable_and_each_receiver_for_itself(layer: PathLoss, points: list[tuple[float, ...]]) -> None:
    here, there = np.array(points[0]), np.array(points[1:])
    losses = layer.loss_db(Paths.between(here, there))
    assert losses.shape == (len(there),)
    assert np.isfinite(losses).all()
    assert losses.tolist() == layer.loss_db(Paths.between(here, there)).tolist()
    for receiver, loss in zip(there, losses.tolist(), strict=True):
        assert layer.loss_db(Paths.between(here, receiver[None])).item() == loss
        assert layer.loss_db(Paths.between(receiver, here[None])).item() == loss
