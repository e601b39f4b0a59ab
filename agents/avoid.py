"""Avoidance around anybody's agent: the task says where to go, and need not know that something stands in the way."""

from typing import Any

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.method import Point
from vcmvsp.agents.avoidance_filter import GetAround
from vcmvsp.agents.factory import build_nested
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Velocity, Waypoint


class Avoid(Agent):
    """Does what another agent says, but around what stands in the way (`agents.avoidance_filter`).

    Where the task leaves its last command in force, that one is looked at again.

    Noted besides what the task notes: ``mode`` and ``level``, when they change.

    Args:
        task: the agent that says where to go: its ``kind`` and its parameters.
        avoidance: how this vehicle gets around what stands in the way.
        goal: where the task is about to get, x and y, m, world; default: where its commands lead.
    """

    def __init__(self, task: dict[str, Any], avoidance: Avoidance, *, goal: Point | None = None) -> None:
        self.task, self._around = build_nested(task, "task"), GetAround(avoidance, goal)
        self.period = self.task.period
        wanted, looked_at = self.task.sensors, self._around.sensors or ()
        self.sensors = None if wanted is None else tuple(dict.fromkeys((*wanted, *looked_at)))
        self._last: Velocity | Waypoint | None = None

    def start(self, info: VehicleInfo) -> None:
        """Both begin."""
        self._around.start(info)
        self._last = None
        self.task.start(info)
        self.follows = self.task.follows

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """What the task says, as far as nothing is in the way."""
        self._last = self.task.act(obs, radio) or self._last
        self.follows = self.task.follows
        command = self._around.around(obs, radio, self._last)
        self.note(**{**self.task.drain_notes(), **self._around.drain_notes()})
        for shown in self.task.drain_shown().values():
            self.show(shown)
        return command

    def close(self) -> None:
        """Both end."""
        self.task.close()
