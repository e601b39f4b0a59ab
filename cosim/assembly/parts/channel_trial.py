"""The channel alone: curves of its models, coverage maps, and a trial with radios that send by a rule."""

from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation import coverage
from vcmvsp.netsim.evaluation.broadcast_trial import Kind, TrialTraffic, Waypoints, run
from vcmvsp.netsim.evaluation.files import RowFile, read_positions
from vcmvsp.netsim.evaluation.model_curves import error_rate, grid, mean_levels, packet_errors
from vcmvsp.netsim.evaluation.ray_paths import ray_paths
