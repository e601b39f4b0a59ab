"""Which of its algorithms a vehicle obeys, and why.

`table`: the states of a mission and what leads from one to the next; `runner`: the algorithms themselves, all of which go on
while one of them commands; `guard`: limits of the speed near obstacles, whoever commands.
"""

from vcmvsp.agents.mission.runner import Around, Runner, Standby
from vcmvsp.agents.mission.speed_limit import Guard
from vcmvsp.agents.reconnaissance.state_table import Facts, State, step

__all__ = ["Around", "Facts", "Guard", "Runner", "Standby", "State", "step"]
