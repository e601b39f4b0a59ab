"""Vehicles that comb an area with made-up looks, and a radio that loses messages: what it takes to compare exchanges."""

import math
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from vcmvsp.agents.reconnaissance import Comb, Grid, MapExchange, Rectangle, Sensor, decisions, exchange
from vcmvsp.agents.reconnaissance.exchange import Kind
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array

S = 1_000_000_000  # ns
AREA = Rectangle(0.0, 0.0, 100.0, 100.0)
GRID = Grid(AREA, 2.0)
SENSOR = Sensor(0.9, 0.1)
RADIUS, SPEED = 8.0, 4.0  # m, m/s
MARGIN = 10.0  # m: targets keep this from the border, where a cell is seen for less time


def over_the_air(body: dict[str, Any]) -> Any:
    """The body as another vehicle gets it."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(body))


def size(body: dict[str, Any]) -> int:
    """Bytes of payload."""
    return len(msgspec.msgpack.encode(body))


class Looks:
    """What a sensor says of cells: right with p at targets, wrong with q elsewhere."""

    def __init__(
        self, targets: list[int], sensor: Sensor, rng: np.random.Generator, cells: int = GRID.rows * GRID.columns
    ) -> None:
        self.chances = np.full(cells, sensor.q)
        self.chances[targets] = sensor.p
        self.rng = rng

    def at(self, cells: Array) -> Array:
        hits: Array = self.rng.random(len(cells)) < self.chances[cells]
        return hits


def moved(position: tuple[float, float], comb: Comb, names: list[str], way_m: float) -> tuple[float, float]:
    """Where a vehicle gets that follows its lanes exactly, round corners, too."""
    while way_m > 1e-9:
        goal = comb.goal(position, names)
        step = min(way_m, math.dist(position, goal))
        part = step / max(math.dist(position, goal), 1e-12)
        position = (position[0] + part * (goal[0] - position[0]), position[1] + part * (goal[1] - position[1]))
        way_m -= step
    return position


@dataclass
class Search:
    """A team that looks once a second until all of it holds both targets."""

    count: int
    kind: Kind | str  # or "central": one map that gets all looks
    loss: float = 0.0
    seed: int = 0
    most: int = 1000  # messages a second
    max_bytes: int = 1400
    scaled: bool = False
    relay: bool = True
    names: list[str] = field(init=False)
    minds: dict[str, MapExchange] = field(init=False)
    sent_bytes: int = 0

    def __post_init__(self) -> None:
        self.names = [f"uav{i}" for i in range(1, self.count + 1)]
        rng = stream(self.seed, "targets")
        spots = rng.uniform(MARGIN, 100.0 - MARGIN, (2, 2))
        self.targets = [cell for x, y in spots if (cell := GRID.at(x, y)) is not None]
        self.looks = Looks(self.targets, SENSOR, stream(self.seed, "looks"))  # the same for all kinds
        self.air = stream(self.seed, "air")
        kind: Any = "ledger" if self.kind == "central" else self.kind
        more: dict[str, Any] = {"max_bytes": self.max_bytes, "scaled": self.scaled, "relay": self.relay}
        self.minds = {name: exchange(kind, GRID, SENSOR, name, self.names, **more) for name in self.names}
        if self.kind == "central":
            self.minds = dict.fromkeys(self.names, self.minds["uav1"])
        self.combs = {name: Comb(name, AREA, RADIUS, reached=1e-6) for name in self.names}
        self.places = {
            name: self.combs[name].goal((AREA.right * i / self.count, 0.0), self.names) for i, name in enumerate(self.names)
        }

    def second(self, now_s: int) -> None:
        """Move, look, tell all."""
        for name in self.names:
            self.places[name] = moved(self.places[name], self.combs[name], self.names, SPEED)
            cells = GRID.within(*self.places[name], RADIUS)
            self.minds[name].look(cells, self.looks.at(cells), now_s * S)
        if self.kind == "central":
            return
        for name in self.names:
            for body in self.minds[name].messages(now_s * S, self.most):
                self.sent_bytes += size(body)
                heard = over_the_air(body)
                for other in self.names:
                    if other != name and self.air.random() >= self.loss:
                        assert self.minds[other].take(name, heard, now_s * S)

    def done(self) -> bool:
        """Whether all hold both targets."""
        minds = {id(mind): mind for mind in self.minds.values()}
        return all((decisions(mind.log_odds).ravel()[self.targets] == 1).all() for mind in minds.values())

    def false_cells(self) -> float:
        """How many cells are wrongly held to be targets, a member."""
        return float(np.mean([(decisions(mind.log_odds) == 1).sum() - len(set(self.targets)) for mind in self.minds.values()]))

    def run(self, limit_s: int = 600) -> float:
        """Seconds until it is done; inf: not within the limit."""
        for now_s in range(1, limit_s + 1):
            self.second(now_s)
            if self.done():
                return float(now_s)
        return math.inf
