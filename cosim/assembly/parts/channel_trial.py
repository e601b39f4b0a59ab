"""A trial of the channel alone: radios that stand still and broadcast, their places, and a file of what was received."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation.broadcast_trial import Broadcasts, run
from vcmvsp.netsim.evaluation.files import RowFile, read_positions

__all__ = ["Broadcasts", "Channel", "RowFile", "read_positions", "run"]
