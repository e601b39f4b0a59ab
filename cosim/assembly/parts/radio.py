"""Types of the radio channel."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.interfaces.layers import Frame, Links, PathLoss, Paths, Phy
from vcmvsp.netsim.interfaces.radio import Radio

__all__ = [
    "Channel",
    "Frame",
    "Links",
    "PathLoss",
    "Paths",
    "Phy",
    "Radio",
    "RadioFederate",
]
