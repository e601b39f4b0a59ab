"""Contract of built-in layers: finite, repeatable, independent between receivers, reciprocal."""

from typing import Any

import pytest

from vcmvsp.cosim.testing import check_channel
from vcmvsp.netsim.impairments.delay import EmpiricalDelay, FixedDelay, GammaDelay, NormalDelay, UniformDelay
from vcmvsp.netsim.impairments.loss import Bernoulli, Bursts, GilbertElliott
from vcmvsp.netsim.phy.constant_rate import ConstantRate
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ieee802154 import Ieee802154
from vcmvsp.netsim.phy.ofdm import Ofdm
from vcmvsp.netsim.propagation.fading import Nakagami, Rayleigh, Rician
from vcmvsp.netsim.propagation.path_loss import Friis, LogDistance, NoPathLoss, TwoRayGround
from vcmvsp.netsim.propagation.shadowing import Shadowing
from vcmvsp.netsim.propagation.walls import FixedWalls, ItuWalls
from vcmvsp.physics.raycast.line_of_sight import Sightline
from vcmvsp.physics.world.solids import Box

WALLS = Sightline(
    [
        Box(center=(x, y, 1.0), size=(20.0, 0.2, 300.0), yaw_rad=x * 0.01, material="brick")
        for x in range(-250, 300, 50)
        for y in range(-250, 300, 50)
    ]
)
MEASURED = ((0.0, 0.002), (0.5, 0.004), (0.99, 0.03), (1.0, 0.2))
LAYERS = [
    *(NoPathLoss(), LogDistance(exponent=3.3), Friis(5.15e9), TwoRayGround(), TwoRayGround(5.15e9, 0.0)),
    *(ItuWalls(WALLS), FixedWalls(WALLS), FixedWalls(Sightline([])), Shadowing(sigma_db=4.0)),
    *(Rayleigh(), Nakagami(1.5), Rician(4.0), Rayleigh(8.0), Nakagami(1.5, 8.0), Rician(4.0, 8.0)),
    *(Bernoulli(0.5), GilbertElliott(), Bursts(0.2, 0.5)),
    *(FixedDelay(0.1, 0.02), UniformDelay(0.0, 0.1), NormalDelay(0.01, 0.01), GammaDelay(0.01, 0.01), EmpiricalDelay(MEASURED)),
    *(ConstantRate(), ConstantRate(rate_bps=54e6, overhead_s=20e-6), Dsss(), Dsss(rate_bps=5.5e6), Ieee802154()),
    *(Ofdm(rate_bps, band) for rate_bps in (6e6, 54e6) for band in ("2.4GHz", "5GHz")),
]


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_a_layer_keeps_the_contract(layer: Any) -> None:
    check_channel(layer)
