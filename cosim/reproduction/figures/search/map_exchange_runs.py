"""Searches for two targets in 100 x 100 m, with a simulated detector of cells and a radio that loses messages.

Each runs on the whole platform until every map is sure of both targets: vehicles without a body at 4 m/s, looks once a second
at the cells of 2 m within 8 m, right with p = 0.9 at a target and wrong with q = 0.1 elsewhere, messages of up to 1400 bytes
once a second, which each receiver loses independently. Members count as living after any silence.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.reproduction.figures.scenarios import IDEAL
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array, Note, ProbabilityMap, States

EDGE_M, CELL_M, REACH_M, SPEED = 100.0, 2.0, 8.0, 4.0
MARGIN_M = 10.0  # targets keep this from the border, where cells are seen for less time
P, Q, OVERLAP = 0.9, 0.1, 0.2
SURE = 252.5  # of 255: P > 0.99
HEIGHT_M, NEVER_S = 20.0, 1e6
PERIOD_S = 0.2  # of the agents


def search(count: int, exchange: str, loss: float, seed: int, limit_s: float) -> dict[str, Any]:
    """The scenario."""
    width = EDGE_M / count
    lanes = math.ceil(width / (2.0 * REACH_M * (1.0 - OVERLAP)))
    return {
        "name": "search",
        "duration_s": limit_s,
        "seed": seed,
        "physics": {"kind": "kinematic", "rate_hz": 5.0},
        "world": {
            "kind": "empty",
            "bounds": (0.0, 0.0, EDGE_M, EDGE_M),
            "targets": [{"name": f"target{i}", "place": place} for i, place in enumerate(places(seed), start=1)],
        },
        "radio": {**IDEAL, "loss": {"kind": "bernoulli", "probability": loss}},
        "record": {"period_s": 1.0},
        "vehicles": {
            "kind": "point",
            "sensors": {
                "cells": {"kind": "target_sensor", "rate_hz": 1.0, "reach_m": REACH_M, "cell_m": CELL_M, "p": P, "q": Q}
            },
        },
        "agents": {
            "kind": "search",
            "period_s": PERIOD_S,
            "area": (0.0, 0.0, EDGE_M, EDGE_M),
            "cell_m": CELL_M,
            "sensor": "cells",
            "swath_m": REACH_M,
            "overlap": OVERLAP,
            "speed": SPEED,
            "acceleration": 100.0,
            "arrive_m": SPEED * PERIOD_S,
            "exchange": exchange,
            "p": P,
            "q": Q,
            "most": 12,
            "alive_s": NEVER_S,
        },
        "vehicle": [
            {"name": f"uav{i + 1}", "position": (width * (i + 0.5 / lanes), 0.5 * REACH_M, HEIGHT_M), "agent": {}}
            for i in range(count)
        ],
    }


def places(seed: int) -> list[tuple[float, float]]:
    """Where the two targets are, m."""
    x, y = stream(seed, "targets").uniform(MARGIN_M, EDGE_M - MARGIN_M, (2, 2)).tolist()
    return [(x[0], x[1]), (y[0], y[1])]


@dataclass
class SearchRun:
    """Data of a search."""

    done_s: float = math.inf  # when all maps were sure of both targets; inf: not within the limit
    false_cells: float = math.nan  # then, a map: cells that are held to be targets, and are none
    bytes_sent: float = 0.0  # of maps, by all, until then
    seconds: float = 0.0  # until then, or the limit
    maps: list[dict[str, ProbabilityMap]] = field(default_factory=list)  # by vehicle, at the requested seconds
    tracks: dict[str, Array] = field(default_factory=dict)  # by vehicle, (n, 3): s, x and y, m


class Watcher:
    """Looks at what is published."""

    def __init__(self, count: int, targets: list[tuple[float, float]], keep_s: tuple[float, ...]) -> None:
        self._count = count
        self._targets = [(int(y / CELL_M), int(x / CELL_M)) for x, y in targets]
        self._keep_s, self._maps, self._bytes = keep_s, dict[str, ProbabilityMap](), dict[str, float]()
        self._tracks: dict[str, list[tuple[float, float, float]]] = {}
        self.searched = SearchRun()

    def on(self, event: Event) -> None:
        """Take an event."""
        value, vehicle = event.value, event.key.partition("/")[0]
        time_s = event.time_ns / 1e9
        if isinstance(value, States):
            self._keep(time_s, value)
        elif isinstance(value, Note) and "map_bytes" in value.values:
            self._bytes[vehicle] = float(value.values["map_bytes"])
        elif isinstance(value, ProbabilityMap):
            self._maps[vehicle] = value
            if len(self._maps) == self._count and all(self._holds(each) for each in self._maps.values()):
                self.searched.done_s = min(self.searched.done_s, time_s)

    def end(self, limit_s: float) -> SearchRun:
        """The data."""
        search = self.searched
        search.seconds = min(search.done_s, limit_s)
        search.bytes_sent = sum(self._bytes.values())
        if math.isfinite(search.done_s):
            sure = [int((each.probability > SURE).sum()) for each in self._maps.values()]
            search.false_cells = float(np.mean(sure)) - len({*self._targets})
        search.tracks = {name: np.array(track) for name, track in self._tracks.items()} if self._keep_s else {}
        return search

    def _holds(self, belief: ProbabilityMap) -> bool:
        return all(belief.probability[cell] > SURE for cell in self._targets)

    def _keep(self, time_s: float, states: States) -> None:
        if not self._keep_s:
            return
        for name, (x, y, _) in zip(states.names, states.position.tolist(), strict=True):
            self._tracks.setdefault(name, []).append((time_s, x, y))
        if len(self.searched.maps) < len(self._keep_s) and time_s > self._keep_s[len(self.searched.maps)]:
            self.searched.maps.append(dict(self._maps))


def searched(count: int, exchange: str, loss: float, seed: int, limit_s: float, *, keep_s: tuple[float, ...] = ()) -> SearchRun:
    """The result of a search; with maps and tracks if there are seconds for maps (then it runs to the limit)."""
    parsed, source = scenarios.load(search(count, exchange, loss, seed, limit_s))
    watcher = Watcher(count, places(seed), keep_s)
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        assembled.start(kernel)

        def on_instant(now_ns: int) -> None:
            kernel.stop |= not keep_s and watcher.searched.done_s <= now_ns / 1e9

        try:
            kernel.run(watcher.on, on_instant=on_instant)
        except KeyboardInterrupt:
            if not kernel.stop:
                raise
        finally:
            kernel.close()
    return watcher.end(limit_s)
