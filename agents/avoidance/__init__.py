"""Getting around what stands in the way, by what a range scanner says now and without a map.

`view`: what a scan says; `method`: what a method is asked and answers; `potential_field`, `gap`, `vfh`, `dynamic_window`: the
methods; `levels`: limits of the speed near obstacles; `steering`: all of it around the commands of any agent.
"""

from vcmvsp.agents.avoidance.dynamic_window import DynamicWindow
from vcmvsp.agents.avoidance.gap import Gap
from vcmvsp.agents.avoidance.method import Decision, Method, Task
from vcmvsp.agents.avoidance.potential_field import PotentialField
from vcmvsp.agents.avoidance.user_method import Own
from vcmvsp.agents.avoidance.vfh import Vfh
from vcmvsp.agents.avoidance.view import View, view_of

Avoidance = PotentialField | Gap | Vfh | DynamicWindow | Own

__all__ = ["Avoidance", "Decision", "DynamicWindow", "Gap", "Method", "Own", "PotentialField", "Task", "Vfh", "View", "view_of"]
