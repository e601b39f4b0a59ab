"""Types of the radio channel."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.federate import RadioFederate
from vcmvsp.netsim.interfaces.layers import Frame, PathLoss, Paths, Phy, Radio, SenderLinks
