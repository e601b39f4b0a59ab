"""Noise: what a receiver hears when nobody sends."""

import math
from dataclasses import dataclass
from typing import Self

from vcmvsp.cosim.types import Positive
from vcmvsp.netsim.interfaces.layers import Floats

BOLTZMANN = 1.380649e-23  # J/K (SI)
TEMPERATURE_K = 290.0  # of the standard definition of noise figure


@dataclass(frozen=True)
class ThermalNoise:
    """``N = k 290 K B F``: bandwidth B, noise figure F.

    The defaults are those of ns-3.44 for IEEE 802.11, -93.965 dBm: 7 dB (``WifiPhy::RxNoiseFigure``) over 20 MHz, also for
    DSSS, whose error formulas count on it.
    """

    bandwidth_hz: Positive = 20e6
    noise_figure_db: float = 7.0

    @classmethod
    def ieee802154(cls, sensitivity_dbm: float = -85.0) -> Self:
        """The noise of an 802.15.4 receiver with this sensitivity.

        As in ns-3.44 (``LrWpanPhy::SetRxSensitivity``): over 5 MHz, with a figure that is 0 dB at a sensitivity of -106.58
        dBm. It is 0.406 dB below the sensitivity.
        """
        return cls(5e6, sensitivity_dbm + 106.58)

    @property
    def dbm(self) -> float:
        """Its power."""
        watts = BOLTZMANN * TEMPERATURE_K * self.bandwidth_hz
        return 10.0 * math.log10(watts) + 30.0 + self.noise_figure_db

    def snr_db(self, rssi_dbm: Floats) -> Floats:
        """Signal above noise, the shape of ``rssi_dbm``."""
        return rssi_dbm - self.dbm
