"""A follower that is sent to another place on its way: what the step responses are measured with."""

from collections.abc import Mapping
from typing import Any

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.registry import find
from vcmvsp.cosim.types import NonNegative, Velocity, Waypoint


class StepFollower(Agent):
    """Two followers in one: the first decides until ``at_s``, the second from then on.

    Args:
        leader: of both.
        at_s: when the step is, s.
        before: parameters of the `leader_follower` before the step.
        after: those of the one after it.
    """

    def __init__(self, leader: str, at_s: NonNegative, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        follower = find("agent", "leader_follower")
        self._before: Agent = binding.call(follower, {"leader": leader, **before}, key="before")
        self._after: Agent = binding.call(follower, {"leader": leader, **after}, key="after")
        self._at_s = at_s
        self.follows = self._before.follows

    def start(self, info: VehicleInfo) -> None:
        """Start both."""
        self._before.start(info)
        self._after.start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """Run both, since both need the messages; return the command of one."""
        commands = self._before.act(obs, radio), self._after.act(obs, radio)
        stepped = obs.time_s >= self._at_s
        self.follows = (self._after if stepped else self._before).follows
        return commands[stepped]
