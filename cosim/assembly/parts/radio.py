"""Types of the radio channel, and measurements of a channel without a run: coverage, broadcast trials, model curves."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation import broadcast_trial, coverage, model_curves
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
    "broadcast_trial",
    "coverage",
    "model_curves",
]
