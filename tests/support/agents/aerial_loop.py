"""Vehicles in the air and a radio without the platform: as little as it takes to close the loop around their algorithms."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.support.agents.agent_loop import received
from vcmvsp.agents.formation.aerial import told
from vcmvsp.cosim.agent import Agent, Body, Observation, Radio, VehicleInfo
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.types import Reception, Scan, Vec3, VehicleState, Velocity

T = 0.1
BODY = Body(width_m=0.5, radius_m=0.25, flies=True)


@dataclass
class Uav:
    """A point that moves exactly as it is told."""

    position: Vec3
    yaw: float = 0.0
    velocity: Vec3 = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0

    def see(self, time_ns: int, heard: Sequence[Reception] = (), **readings: Any) -> Observation:
        state = VehicleState(
            position=self.position,
            velocity=self.velocity,
            attitude=quaternion_from_yaw(self.yaw),
            angular_velocity=(0.0, 0.0, self.yaw_rate),
        )
        received = ReceivedMessages.of(heard, time_ns)
        return Observation(vehicle="me", time_ns=time_ns, state=state, readings=readings, heard=received)

    def move(self, command: Velocity) -> None:
        self.velocity, self.yaw_rate = command.linear, command.yaw_rate
        x, y, z = (p + T * v for p, v in zip(self.position, self.velocity, strict=True))
        self.position, self.yaw = (x, y, z), self.yaw + T * self.yaw_rate


class Drifter(Agent):
    """Moves as told, and reports what it likes."""

    def __init__(self, velocity: Vec3, yaw_rate: float = 0.0) -> None:
        self.velocity, self.yaw_rate = velocity, yaw_rate

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        (x, y, _), (vx, vy, _) = obs.state.position, self.velocity
        v = vx * math.cos(obs.state.yaw) + vy * math.sin(obs.state.yaw)
        radio.send(
            {**told(obs, self.velocity), "t_ns": obs.time_ns, "x": x, "y": y, "th": obs.state.yaw, "v": v, "w": self.yaw_rate}
        )
        return Velocity(linear=self.velocity, yaw_rate=self.yaw_rate)


@dataclass
class Flight:
    """What happened, at every tick before its command."""

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
    """Close the loop; what is sent at a tick is heard by all at the next one, unless it is lost."""
    names = tuple(agents)
    radios = {name: Radio(name, names) for name in names}
    uavs = dict(zip(names, starts, strict=True))
    for name, agent in agents.items():
        agent.start(VehicleInfo(name=name, vehicles=names, period_s=T, latency_s=0.0, seed=1, body=BODY, sensors=("scan",)))
    seen = Flight(*({name: [] for name in names} for _ in range(5)))  # type: ignore[arg-type]
    air: list[Reception] = []
    for tick in range(ticks):
        sent: list[Reception] = []
        for name, agent in agents.items():
            heard = [each for each in air if each.message.sender != name]
            command = agent.act(uavs[name].see(round(tick * T * 1e9), heard), radios[name])
            assert isinstance(command, Velocity)
            seen.position[name].append(uavs[name].position)
            seen.yaw[name].append(uavs[name].yaw)
            seen.commands[name].append(command)
            seen.notes[name].append(agent.drain_notes())
            for message in radios[name].drain():
                assert isinstance(message.body, dict)
                seen.messages[name].append(message.body)
                if not lost(tick, name):
                    sent.append(received(message))
        for name, commands in seen.commands.items():
            uavs[name].move(commands[-1])
        air = sent
    return seen


def ring(ranges: Sequence[float], time_ns: int = 0) -> Scan:
    """A scan all the way round."""
    count = len(ranges)
    return Scan(
        time_ns=time_ns,
        angle_min=0.0,
        angle_step=math.tau / count,
        range_max=6.0,
        ranges=np.array(ranges, float),
    )
