"""Types of the radio channel."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.interfaces.layers import Frame, PathLoss, Paths, Phy, Radio, SenderLinks

__all__ = ["Channel", "Frame", "PathLoss", "Paths", "Phy", "Radio", "RadioFederate", "SenderLinks"]
