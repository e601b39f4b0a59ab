"""Scenarios of a few cars on flat ground, as TOML: the first leads, and agents may run in processes."""

from typing import Any

LEADER, FOLLOWER = 'kind = "trajectory"', 'kind = "leader_follower", leader = "car1"'
WAITS = """
import pathlib, time
from vcmvsp.agents.formation.leaders.trajectory import Trajectory

class Waits(Trajectory):
    '''At ``until`` seconds, waits for a file beside this one.'''
    def __init__(self, until: float) -> None:
        super().__init__()
        self.until = until
    def act(self, obs, radio):
        while obs.time_s >= self.until and not pathlib.Path(__file__).with_name("go").exists():
            time.sleep(0.02)
        return super().act(obs, radio)
"""
"""``waits.py``: an agent that waits for an event of a test."""

HERE, ELSEWHERE = ', runs = "inprocess"', ', runs = "zenoh"'


def team(name: str, *agents: str, duration_s: float, loss: float | None = None, **of_agents: Any) -> str:
    """A scenario with a car for each of these agents, the inside of a TOML table.

    Args:
        name: of the scenario.
        agents: of car1, car2, ...
        duration_s: of the run.
        loss: probability of each frame over the radio.
        of_agents: keys of ``[agents]``; a word is a string.
    """
    words = {key: f'"{value}"' if isinstance(value, str) else value for key, value in of_agents.items()}
    lines = [f'name = "{name}"', f"duration_s = {duration_s}", "[physics]", 'kind = "kinematic"', "[radio]", 'preset = "ideal"']
    lines += [] if loss is None else [f"loss = {{ probability = {loss} }}"]
    lines += ["[agents]", *(f"{key} = {value}" for key, value in words.items()), "[vehicles]", 'kind = "kinematic"']
    for number, agent in enumerate(agents, 1):
        lines += ["[[vehicle]]", f'name = "car{number}"', f"agent = {{ {agent} }}"]
        lines += [f"pose = [-1.0, {0.5 * (number - 2)}, 0.0]"] if number > 1 else []
    return "\n".join([*lines, ""])
