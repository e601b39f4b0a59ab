"""Several algorithms on one vehicle: which of them commands, and why. The algorithms themselves do not belong here.

`mission`: the agent; `runner`: its algorithms, all of which go on while one commands; `speed_limit`: limits near obstacles.
"""

from vcmvsp.agents.mission.runner import AlgorithmRunner, Avoidance, Guard, Standby
from vcmvsp.agents.reconnaissance.state_table import MissionFacts, MissionState, step

__all__ = ["AlgorithmRunner", "Avoidance", "Guard", "MissionFacts", "MissionState", "Standby", "step"]
