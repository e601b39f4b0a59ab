"""Formations over a radio: leaders, followers, consensus, and the prediction of old reports.

Start reading in `followers.leader_follower`; ``agents/README.md`` says what the law does and does not do. Methods of obstacle
avoidance do not belong here.
"""

from vcmvsp.agents.formation.aerial.follower import AerialFollower
from vcmvsp.agents.formation.aerial.route import AerialRoute
from vcmvsp.agents.formation.followers.consensus import Consensus
from vcmvsp.agents.formation.followers.laws import axle_velocity, hand_point, hand_velocity
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.leader import Leader
from vcmvsp.agents.formation.leaders.route import Route
from vcmvsp.agents.formation.leaders.teleop import Teleop
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.prediction import DeadReckoning, Estimator, Hold
from vcmvsp.agents.formation.reports.report import LeaderState, Report, heartbeat_for
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation

__all__ = [
    "AerialFollower",
    "AerialRoute",
    "Consensus",
    "DeadReckoning",
    "Estimator",
    "Formation",
    "Hold",
    "Leader",
    "LeaderFollower",
    "LeaderState",
    "Report",
    "Route",
    "Sending",
    "Teleop",
    "Trajectory",
    "axle_velocity",
    "hand_point",
    "hand_velocity",
    "heartbeat_for",
]
