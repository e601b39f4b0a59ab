"""Obstacle avoidance from the newest range scan, without a map. Formations and missions do not belong here.

`view`: content of a scan; `method`: question and answer of a method; `potential_field`, `gap`, `vfh`, `dynamic_window`: the
methods; `steering`: a method around commands, and speed limits near obstacles; `avoid`: around any agent.
"""

from vcmvsp.agents.avoidance.dynamic_window import DynamicWindow
from vcmvsp.agents.avoidance.gap import Gap
from vcmvsp.agents.avoidance.method import Decision, Method, Own, Task
from vcmvsp.agents.avoidance.potential_field import PotentialField
from vcmvsp.agents.avoidance.vfh import Vfh
from vcmvsp.agents.avoidance.view import View, view_of

Avoidance = PotentialField | Gap | Vfh | DynamicWindow | Own

__all__ = ["Avoidance", "Decision", "DynamicWindow", "Gap", "Method", "Own", "PotentialField", "Task", "Vfh", "View", "view_of"]
