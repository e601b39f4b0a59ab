"""Metrics of a reconnaissance mission: finds, tracking and area seen, from notes of agents and true positions of targets.

Agents note their commander (``commander``), task (``task``), target (``target``), confirmed finds and their positions
(``found``, ``found_x``, ``found_y``), and bytes of maps sent (``map_bytes``). A target or position without a name is ``""``,
any target. A vehicle whose agent has failed (``status``) or is lost has none of the first three.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, pairwise
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.types import Array, Mosaic, ProbabilityMap, Sightings

NEAR_M = 3.0  # within this distance in the plane a vehicle is at the target
TRACKED_NS = 10 * SECOND_NS  # a tracking vehicle stays near its target at least this long
KEPT = ("commander", "task", "target")  # every change of these counts
MARKS = ("commander", "task", "found")  # a vehicle that notes one of these is on a mission
COUNTED = frozenset({*KEPT, *MARKS, "map_bytes"})


class Target(Protocol):
    """A search target on the ground."""

    @property
    def name(self) -> str:
        """Name used by the search."""

    @property
    def size_m(self) -> float:
        """Edge length or diameter."""

    def place(self, time_s: float) -> tuple[float, float]:
        """Position of its centre, m, world."""

    def yaw(self, time_s: float) -> float:
        """Heading, rad."""


class Found(NamedTuple):
    """A find that a vehicle confirmed."""

    time_ns: int
    vehicle: str
    name: str  # "": unknown
    place: tuple[float, float]  # m


class Mission:
    """Collects mission data during a run."""

    def __init__(self) -> None:
        self._histories: dict[tuple[str, str], list[tuple[int, str]]] = {}
        self._at_loss: dict[tuple[str, str], str] = {}  # values at the loss of an agent
        self._map_bytes: dict[str, list[float]] = {}  # per agent; a replacement agent begins at 0
        self._maps: dict[str, ProbabilityMap] = {}
        self._marked = False
        self.found: list[Found] = []

    def __bool__(self) -> bool:
        return self._marked

    def take(self, vehicle: str, time_ns: int, values: Mapping[str, Any]) -> None:
        """Record the notes of an agent at a time."""
        if COUNTED.isdisjoint(values) and values.get("status") != "failed":
            return  # most notes
        self._marked = self._marked or any(mark in values for mark in MARKS)
        for name in KEPT:
            if name in values:
                history = self._histories.setdefault((vehicle, name), [])
                if not history or history[-1][1] != str(values[name]):
                    history.append((time_ns, str(values[name])))
        if values.get("status") == "failed":
            self.leave(vehicle, time_ns)
        if "map_bytes" in values:
            sent = _number(values["map_bytes"])
            counts = self._map_bytes.setdefault(vehicle, [sent])
            counts[-1:] = [counts[-1], sent] if sent < counts[-1] else [sent]
        if "found" in values:
            place = _number(values.get("found_x")), _number(values.get("found_y"))
            self.found.append(Found(time_ns, vehicle, str(values["found"]), place))

    def leave(self, vehicle: str, time_ns: int) -> None:
        """Record that a vehicle has lost its agent."""
        for name in KEPT:
            history = self._histories.get((vehicle, name))
            if history and history[-1][1]:
                self._at_loss[vehicle, name] = history[-1][1]
                history.append((time_ns, ""))

    def restore(self, vehicle: str, time_ns: int) -> None:
        """Record that an agent is back; its last notes apply until it notes others."""
        for name in KEPT:
            before = self._at_loss.pop((vehicle, name), "")
            if before and not (history := self._histories[vehicle, name])[-1][1]:
                history.append((time_ns, before))

    def see(self, vehicle: str, value: ProbabilityMap | Sightings | Mosaic) -> None:
        """Record a map (the newest counts), sightings or a mosaic; each marks its vehicle as on a mission."""
        self._marked = True
        if isinstance(value, ProbabilityMap):
            self._maps[vehicle] = value

    def of(self, vehicle: str, name: str) -> Sequence[tuple[int, str]]:
        """Times (ns) and values that a vehicle noted as commander, task or target; consecutive values differ; ``""``: none."""
        return self._histories.get((vehicle, name), ())

    def lost(self, vehicle: str) -> list[tuple[int, str]]:
        """Times (ns) at which a vehicle gave up tracking, and the targets."""
        tasks = self.of(vehicle, "task")
        ends = [end for (_, task), (end, following) in pairwise(tasks) if task == "track" and following]
        targets = [(-1, ""), *self.of(vehicle, "target")]
        return [(end, targets[bisect_left(targets, end, key=itemgetter(0)) - 1][1]) for end in ends]

    def metrics(self, moved: Motion, targets: Sequence[Target]) -> dict[str, Any] | None:
        """The ``mission`` part (`cosim.metrics`); None without targets and without a vehicle on a mission."""
        if not (self._marked or targets):
            return None
        first_s: dict[str, float | None] = {target.name: None for target in targets}
        false_finds = 0
        for find in self.found:
            target = target_at(targets, find)
            if target is None:
                false_finds += 1
            elif first_s[target.name] is None:
                first_s[target.name] = find.time_ns / SECOND_NS
        switches = 0
        for history in [each for (_, name), each in self._histories.items() if name == "commander"]:
            commanders = [name for _, name in history if name]  # ignores gaps without a commander
            switches += sum(before != after for before, after in pairwise(commanders))
        tracked = [target for target in targets if self._tracked(moved, target)]
        return {
            "targets_found": len(first_s) - list(first_s.values()).count(None),
            "targets_tracked": len(tracked),
            "found_s": first_s,
            "false_finds": false_finds,
            "area_seen_ratio": searched_ratio(self._maps.values()),
            "map_bytes_sent": int(sum(filter(math.isfinite, chain.from_iterable(self._map_bytes.values())))),
            "switches": switches,
        }

    def _tracked(self, moved: Motion, target: Target) -> bool:
        places = np.array([target.place(time_s) for time_s in (moved.time_ns / SECOND_NS).tolist()]).reshape(-1, 2)
        for column, vehicle in enumerate(moved.names):
            x, y, _ = moved.position[:, :, column]
            if self.of(vehicle, "task"):
                follows = self._was(moved, vehicle, "task", ("track",)) & self._was(moved, vehicle, "target", ("", target.name))
            else:  # a single task
                follows = self._was(moved, vehicle, "target", (target.name,))
            if _longest_ns(moved.time_ns, follows & (np.hypot(x - places[:, 0], y - places[:, 1]) <= NEAR_M)) >= TRACKED_NS:
                return True
        return False

    def _was(self, moved: Motion, vehicle: str, name: str, values: Sequence[str]) -> Array:
        history = [(-1, ""), *self.of(vehicle, name)]
        newest = np.searchsorted([time_ns for time_ns, _ in history], moved.time_ns, side="right") - 1
        return np.array([value in values for _, value in history])[newest]


def target_at(targets: Sequence[Target], find: Found) -> Target | None:
    """The nearest target to a find that was within `NEAR_M` and matches its name; None without one."""
    time_s = find.time_ns / SECOND_NS
    away = [(math.dist(target.place(time_s), find.place), target) for target in targets if find.name in ("", target.name)]
    near = [pair for pair in away if pair[0] <= NEAR_M]
    return min(near, key=lambda pair: pair[0])[1] if near else None


def searched_ratio(maps: Iterable[ProbabilityMap]) -> float | None:
    """Share of the area of the maps that at least one vehicle has seen; None without maps.

    For different grids, all cell centres count, weighted with the area of the cell over the number of maps around it.
    """
    grids: dict[tuple[float, ...], Array] = {}
    for each in maps:
        grid = each.left, each.bottom, each.cell_m, *each.seen.shape
        grids[grid] = each.seen | grids[grid] if grid in grids else each.seen
    area = seen_area = 0.0
    for left, bottom, cell_m, rows, columns in grids:
        x, y = left + cell_m * (np.arange(columns) + 0.5), bottom + cell_m * (np.arange(rows) + 0.5)
        covered, seen = np.zeros((len(y), len(x))), np.zeros((len(y), len(x)), np.bool_)
        for other, seen_there in grids.items():
            inside, is_seen = _looked_up(other, seen_there, x, y)
            covered += inside
            seen |= is_seen
        area += float((cell_m**2 / covered).sum())
        seen_area += float((cell_m**2 / covered)[seen].sum())
    return seen_area / area if area else None


def _looked_up(grid: tuple[float, ...], seen: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Which of the points (len(y), len(x)) a grid contains, and which of them have been seen."""
    left, bottom, cell_m, *_ = grid
    (rows, columns), (i, j) = seen.shape, (np.floor((each - edge) / cell_m) for each, edge in ((y, bottom), (x, left)))
    up, along = (i >= 0) & (i < rows), (j >= 0) & (j < columns)
    inside, is_seen = up[:, None] & along, np.zeros((len(y), len(x)), np.bool_)
    is_seen[inside] = seen[np.ix_(i[up].astype(int), j[along].astype(int))].ravel()
    return inside, is_seen


def _number(noted: object) -> float:
    """A noted value as a number; notes may be of any type."""
    return float(noted) if isinstance(noted, int | float) else math.nan


def _longest_ns(time_ns: Array, holds: Array) -> int:
    changes = np.diff(np.concatenate(([False], holds, [False])).astype(np.int8))
    first, last = np.flatnonzero(changes == 1), np.flatnonzero(changes == -1) - 1
    return int((time_ns[last] - time_ns[first]).max(initial=-1))
