"""Aerial vehicles and a radio without the platform: a minimal loop around their algorithms."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from tests.support.agents.agent_loop import T, Uav, info, reception_of
from vcmvsp.agents.formation.aerial import report_keys
from vcmvsp.cosim.agent import Agent, Body, Observation, Radio
from vcmvsp.cosim.types import Reception, Vec3, Velocity

BODY = Body(width_m=0.5, radius_m=0.25, flies=True)


class Drifter(Agent):
    """Moves as commanded and reports any content."""

    def __init__(self, velocity: Vec3, yaw_rate: float = 0.0) -> None:
        self.velocity, self.yaw_rate = velocity, yaw_rate

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        (x, y, _), (vx, vy, _) = obs.state.position, self.velocity
        v = vx * math.cos(obs.state.yaw) + vy * math.sin(obs.state.yaw)
        planar = {"t_ns": obs.time_ns, "x": x, "y": y, "th": obs.state.yaw, "v": v, "w": self.yaw_rate}
        radio.send({**report_keys(obs, self.velocity), **planar})
        return Velocity(linear=self.velocity, yaw_rate=self.yaw_rate)


@dataclass
class Flight:
    """Record of every tick before its command."""

    position: dict[str, list[Vec3]]
    yaw: dict[str, list[float]]
    commands: dict[str, list[Velocity]]
    notes: dict[str, list[dict[str, Any]]]
    messages: dict[str, list[dict[str, Any]]] = field(default_factory=dict)


def fly(
    agents: dict[str, Agent],
    starts: Sequence[Uav],
    ticks: int,
    *,
    lost: Callable[[int, str], bool] = lambda tick, sender: False,
) -> Flight:
    """Close the loop; every vehicle receives a transmission at the next tick, unless it is lost."""
    names = tuple(agents)
    radios = {name: Radio(name, names) for name in names}
    uavs = dict(zip(names, starts, strict=True))
    for name, agent in agents.items():
        agent.start(info(name, names, body=BODY, sensors=("scan",)))
    flight = Flight(*({name: [] for name in names} for _ in range(5)))  # type: ignore[arg-type]
    air: list[Reception] = []
    for tick in range(ticks):
        sent: list[Reception] = []
        for name, agent in agents.items():
            received = [each for each in air if each.message.sender != name]
            command = agent.act(uavs[name].see(round(tick * T * 1e9), received), radios[name])
            assert isinstance(command, Velocity)
            flight.position[name].append(uavs[name].position)
            flight.yaw[name].append(uavs[name].yaw)
            flight.commands[name].append(command)
            flight.notes[name].append(agent.drain_notes())
            for message in radios[name].drain():
                assert isinstance(message.body, dict)
                flight.messages[name].append(message.body)
                if not lost(tick, name):
                    sent.append(reception_of(message))
        for name, commands in flight.commands.items():
            uavs[name].move(commands[-1])
        air = sent
    return flight
