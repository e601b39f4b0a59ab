"""Formations over a radio: leaders, followers, consensus, and what a follower makes of an old message.

Start reading in `leader_follower`; ``agents/README.md`` says what the law does and does not do.
"""

from agents.formation.aerial_follower import AerialFollower
from agents.formation.aerial_route import AerialRoute
from agents.formation.consensus import Consensus
from agents.formation.formation import Formation
from agents.formation.geometry import axle_velocity, hand_point, hand_velocity
from agents.formation.leader import Leader
from agents.formation.leader_follower import LeaderFollower
from agents.formation.listening import heartbeat_for
from agents.formation.prediction import DeadReckoning, Estimator, Hold
from agents.formation.report import LeaderState, Report
from agents.formation.route import Route
from agents.formation.sending import Sending
from agents.formation.teleop import Teleop
from agents.formation.trajectory import Trajectory

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
