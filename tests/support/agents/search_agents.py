"""Searching vehicles without the platform: points in the air, invented looks, and a lossy radio."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.support.agents import agent_loop
from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import T, Uav, reception_of
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle
from vcmvsp.agents.reconnaissance.search import Search
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Looks, Message, Reception, Vec3, Velocity

S = 1_000_000_000
SIDE = 40.0  # m
GRID = Grid(Rectangle(0.0, 0.0, SIDE, SIDE), 2.0)
REACH = 6.0  # m
TARGETS = ((9.0, 31.0), (27.0, 13.0))


def info(name: str, names: tuple[str, ...], sensors: tuple[str, ...] | None = ("looks",)) -> VehicleInfo:
    return agent_loop.info(name, names, body=BODY, sensors=sensors)


def searcher(**params: Any) -> Search:
    return Search((0.0, 0.0, SIDE, SIDE), **{"sensor": "looks", "swath_m": REACH, **params})


def looks(x: float, y: float, time_ns: int, rng: np.random.Generator | None = None) -> Looks:
    """Looks at the cells around a place; correct with 0.9, or, without a generator, always."""
    cells = GRID.within(x, y, REACH)
    truth = np.isin(cells, [cell for target in TARGETS if (cell := GRID.at(*target)) is not None])
    hits = truth if rng is None else np.where(rng.random(len(cells)) < 0.9, truth, ~truth)
    rows, columns = np.divmod(cells, GRID.columns)
    return Looks(time_ns=time_ns, cell_m=2.0, cells=np.column_stack([columns, rows]).astype(np.int32), hits=hits)


def observation(position: Vec3, time_ns: int, *received: Reception, yaw: float = 0.0, **readings: Any) -> Observation:
    return Uav(position, yaw).see(time_ns, received, **readings)


@dataclass
class Team:
    """Searchers that move exactly as commanded and look once a second; messages arrive at the next tick."""

    agents: dict[str, Search]
    starts: dict[str, Vec3] = field(default_factory=dict)
    lost: Callable[[int, str, str], bool] = lambda tick, sender, hearer: False
    errs: bool = True

    def __post_init__(self) -> None:
        names = tuple(self.agents)
        self.tick, self.commands = -1, dict.fromkeys(names, Velocity())
        self.places = {name: self.starts.get(name, (1.0 + SIDE * i / len(names), 1.0, 20.0)) for i, name in enumerate(names)}
        self.radios = {name: Radio(name, names) for name in names}
        self.rngs = {name: np.random.default_rng(i) for i, name in enumerate(names)}
        self.air: list[Message] = []
        self.notes: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        self.sent: dict[str, list[Message]] = {name: [] for name in names}
        self.readings: dict[str, Any] = {}
        for name, agent in self.agents.items():
            agent.start(info(name, names))

    def step(self, *, standing_by: tuple[str, ...] = (), dead: tuple[str, ...] = ()) -> None:
        """Advance by a tick."""
        self.tick += 1
        now_ns, air = round(self.tick * T * S), self.air
        self.air = []
        for name, agent in self.agents.items():
            if name in dead:
                continue
            x, y, z = self.places[name]
            if self.tick % 10 == 0:
                self.readings[name] = looks(x, y, now_ns, self.rngs[name] if self.errs else None)
            received = [each for each in air if each.sender != name and not self.lost(self.tick, each.sender, name)]
            obs = observation((x, y, z), now_ns, *map(reception_of, received), looks=self.readings[name])
            if name in standing_by:
                agent.stand_by(obs, self.radios[name])
                self.commands[name] = Velocity()
            else:
                self.commands[name] = agent.act(obs, self.radios[name])
            self.notes[name].append(agent.drain_notes())
            messages = self.radios[name].drain()
            self.sent[name] += messages
            self.air += messages
        for name, command in self.commands.items():
            if name not in dead:
                x, y, z = (p + T * v for p, v in zip(self.places[name], command.linear, strict=True))
                self.places[name] = x, y, z

    def run(self, seconds: float, **how: Any) -> None:
        for _ in range(math.ceil(seconds / T)):
            self.step(**how)


def of_map(messages: list[Message]) -> list[Message]:
    """Content of the map without the roster."""
    return [each for each in messages if isinstance(each.body, dict) and "do" not in each.body]
