"""Leader-follower formation over a radio: leaders, followers, and what a follower makes of an old message.

Start reading in `leader_follower`; ``agents/README.md`` says what the law does and does not do.
"""

from agents.formation.geometry import axle_velocity, hand_point, hand_velocity
from agents.formation.leader_follower import LeaderFollower
from agents.formation.prediction import DeadReckoning, Estimator, Hold
from agents.formation.report import LeaderState, Report
from agents.formation.trajectory import Trajectory

__all__ = [
    "DeadReckoning",
    "Estimator",
    "Hold",
    "LeaderFollower",
    "LeaderState",
    "Report",
    "Trajectory",
    "axle_velocity",
    "hand_point",
    "hand_velocity",
]
