"""What a vehicle's own radio has that others need not have."""

from dataclasses import dataclass

from vcmvsp.cosim.types import Decibels, NonNegative


@dataclass(frozen=True)
class Radio:
    """A vehicle's antenna and, where they differ from the phy's, its power and sensitivity.

    The level at a receiver is the sender's power plus both antenna gains, less what is lost between. Antennas radiate alike in
    all directions.
    """

    tx_power_dbm: Decibels | None = None  # transmitted power; None: the phy's
    sensitivity_dbm: Decibels | None = None  # weakest level at which it notices a frame; None: the phy's
    antenna_gain_dbi: Decibels = 0.0  # of what it sends, and of what it hears
    antenna_height_m: NonNegative = 0.5  # above the vehicle's position
    body_loss_db: NonNegative = 0.0  # of links between others that pass through this vehicle
    body_radius_m: NonNegative = 0.3  # of its body, an upright cylinder that begins at its position
    body_height_m: NonNegative = 0.6  # of that cylinder


AT_POSITION = Radio(antenna_height_m=0.0)
"""A radio whose antenna is where its vehicle is."""
