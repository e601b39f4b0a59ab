"""IEEE 802.15.4 without beacons: unslotted CSMA/CA, acknowledgements, retries."""

from dataclasses import dataclass
from typing import Annotated

import msgspec

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels, Seconds
from vcmvsp.netsim.interfaces.layers import Keys, Phy
from vcmvsp.netsim.interfaces.medium import Medium
from vcmvsp.netsim.mac.csma154.events import Csma154Medium
from vcmvsp.netsim.mac.csma154.receivers import Csma154Air
from vcmvsp.netsim.mac.csma154.sender import Csma154Rules
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors

Exponent = Annotated[int, msgspec.Meta(ge=0, le=16)]
Few = Annotated[int, msgspec.Meta(ge=0, le=28)]
Many = Annotated[int, msgspec.Meta(ge=1)]


@dataclass(frozen=True)
class Csma154:
    """Unslotted CSMA/CA of IEEE 802.15.4 at 2.4 GHz, as ns-3.44 ``LrWpanMac`` and ``LrWpanPhy``.

    The sensitivity is no threshold of reception: it sets the noise (`netsim.phy.noise.ThermalNoise.ieee802154`). Messages that
    need several frames contend once, and are received or lost as one.

    Args:
        min_be: exponent of the first backoff (macMinBE).
        max_be: of the longest (macMaxBE).
        max_backoffs: a frame that finds the air busy this often and once more is given up (macMaxCSMABackoffs).
        acknowledge: unicast frames are acknowledged, and repeated where no acknowledgement comes.
        max_retries: how often (macMaxFrameRetries).
        queue_frames: that may wait at a sender, with the one that is being sent; None: no limit.
        lifetime_s: a frame that has waited longer when its turn comes is not sent; None: no limit.
        cca_above_sensitivity_db: level of all frames together, above the phy's sensitivity, at which the air is busy; it is so
            too to a radio that is receiving a frame.
        preamble_snr_db: least ratio to noise and interference at which a frame is noticed.
        forget_interference: a disturbance that is over before another frame begins or this one ends has no effect, as in
            ns-3.44; false: it counts.
    """

    min_be: Exponent = 3
    max_be: Exponent = 5
    max_backoffs: Few = 4
    acknowledge: bool = True
    max_retries: Few = 3
    queue_frames: Many | None = None
    lifetime_s: Seconds | None = None
    cca_above_sensitivity_db: Decibels = 10.0
    preamble_snr_db: Decibels = -5.0
    forget_interference: bool = True

    def __post_init__(self) -> None:
        if self.min_be > self.max_be:
            raise ScenarioError(f"min_be = {self.min_be} is more than max_be = {self.max_be}", key="min_be")

    @property
    def needs_snr_db(self) -> float:
        """What a frame needs to be noticed, whatever the phy's sensitivity."""
        return self.preamble_snr_db

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The air for ``count`` radios.

        Args:
            phy: `netsim.phy.ieee802154.Ieee802154`.
            count: n.
            keys: random keys of the radios, (n,): a backoff is a pure function of its radio's key and of its number.
            noise_mw: at every receiver.
        """
        errors = getattr(phy, "errors", None)
        if not isinstance(errors, OqpskErrors):
            raise ScenarioError(
                f"mac csma154 is that of IEEE 802.15.4: it needs phy ieee802154, not {type(phy).__name__}", key="kind"
            )
        air = Csma154Air(
            count,
            noise_mw,
            errors,
            preamble_snr_db=self.preamble_snr_db,
            busy_dbm=phy.sensitivity_dbm + self.cca_above_sensitivity_db,
            forgetful=self.forget_interference,
        )
        rules = Csma154Rules(
            min_be=self.min_be,
            max_be=self.max_be,
            max_backoffs=self.max_backoffs,
            acknowledge=self.acknowledge,
            max_retries=self.max_retries,
            queue_frames=self.queue_frames,
            lifetime_ns=None if self.lifetime_s is None else seconds_to_ns(self.lifetime_s),
        )
        return Csma154Medium(rules, air, phy, errors, keys)
