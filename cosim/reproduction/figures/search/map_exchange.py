"""Map exchange between searching vehicles and its dependence on message loss; figure 45: the shared map over time.

Two targets in 100 x 100 m, two or four bodiless vehicles at 4 m/s. Each looks once a second at the cells of 2 m within 8 m
(right with p = 0.9 at a target, wrong with q = 0.1 elsewhere) and sends messages of up to 1400 bytes once a second, which each
receiver loses independently. A search ends when every vehicle's map is sure of both targets. Members never time out.

All exchanges get the same searches, since lanes and detection errors are equal. Durations vary: medians of eight, as in the
independent simulation, spread by 30 %, of twenty-four by half as much. The ledger must agree with that simulation. Exchanges
that lose or dilute evidence must be slower than the ledger, and no slower than in that simulation.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from vcmvsp.cosim.assembly.parts.recognition import Sensor, decisions
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event, vehicle_of
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import IDEAL
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.reproduction.runner import Runner
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array, Note, ProbabilityMap, States

EDGE_M, CELL_M, REACH_M, SPEED = 100.0, 2.0, 8.0, 4.0
MARGIN_M = 10.0  # minimum distance of targets from the border, where cells are seen for less time
P, Q, OVERLAP = 0.9, 0.1, 0.2
SURE = 252.5  # of 255: P > 0.99
HEIGHT_M, NEVER_S = 20.0, 1e6
PERIOD_S = 0.2  # period of the agents
COUNTS = (2, 4)
LIMITS_S = {2: 600.0, 4: 500.0}
LOSSES = (0.0, 0.3, 0.6, 0.9)
SEEDS = 24
ALONE = 8  # seeds without an exchange: all of these searches reach the limit
KINDS = ("ledger", "delta", "consensus")
# An independent simulation: medians of eight searches, s; where many exceed the limit, their share.
REFERENCE: Mapping[int, Mapping[str, tuple[float, ...]]] = {
    2: {
        "ledger": (95.0, 100.0, 102.0, 116.0),
        "delta": (95.0, 220.0, 348.0, math.nan),
        "consensus": (208.0, 220.0, 192.0, 233.0),
    },
    4: {
        "ledger": (49.5, 50.0, 52.0, 61.5),
        "delta": (49.5, 88.0, 205.0, math.nan),
        "consensus": (154.0, 170.0, 185.0, 191.0),
    },
}
NOT_OVER: Mapping[int, Mapping[tuple[str, float], float]] = {2: {("delta", 0.9): 1.0}, 4: {("delta", 0.9): 0.75}}
SHARE = 0.15
FALSE_CELLS = 0.6  # per map; 0.4 to 0.8 of 2500 when both targets are found: the price of speed
SEQUENTIAL = {0.9: (3, 0.00137, 3.740), 0.8: (4, 0.00389, 6.615)}  # p: net hits, wrong decisions, looks at a cell
SHOWN_SEED, SHOWN_LOSS, SHOWN_S = 4, 0.3, (20.0, 50.0, 80.0, 160.0)


def search(count: int, exchange: str, loss: float, seed: int, limit_s: float) -> dict[str, Any]:
    """The scenario of a search."""
    width = EDGE_M / count
    lanes = math.ceil(width / (2.0 * REACH_M * (1.0 - OVERLAP)))
    targets = [{"name": f"target{i}", "place": place} for i, place in enumerate(places(seed), start=1)]
    starts = [(width * (i + 0.5 / lanes), 0.5 * REACH_M, HEIGHT_M) for i in range(count)]
    return {
        "name": "search",
        "duration_s": limit_s,
        "seed": seed,
        "physics": {"kind": "kinematic", "rate_hz": 5.0},
        "world": {
            "kind": "empty",
            "bounds": (0.0, 0.0, EDGE_M, EDGE_M),
            "targets": targets,
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
        "vehicle": [{"name": f"uav{i}", "position": start, "agent": {}} for i, start in enumerate(starts, start=1)],
    }


def places(seed: int) -> list[tuple[float, float]]:
    """Positions of the two targets, m."""
    x, y = stream(seed, "targets").uniform(MARGIN_M, EDGE_M - MARGIN_M, (2, 2)).tolist()
    return [(x[0], x[1]), (y[0], y[1])]


@dataclass
class SearchRun:
    """Data of a search."""

    done_s: float = math.inf  # time at which all maps are sure of both targets; inf: not within the limit
    false_cells: float = math.nan  # per map, at that time: cells wrongly decided as targets
    bytes_sent: float = 0.0  # of maps, all vehicles, up to that time
    seconds: float = 0.0  # up to that time, or the limit
    maps: list[dict[str, ProbabilityMap]] = field(default_factory=list)  # by vehicle, at the requested seconds
    tracks: dict[str, Array] = field(default_factory=dict)  # by vehicle, (n, 3): s, x and y, m


Searches = Mapping[tuple[int, str, float], list[SearchRun]]  # by number of vehicles, exchange and loss


class Watcher:
    """Observer that collects the data of a search."""

    def __init__(self, count: int, targets: list[tuple[float, float]], keep_s: tuple[float, ...]) -> None:
        self._count = count
        self._targets = [(int(y / CELL_M), int(x / CELL_M)) for x, y in targets]
        self._keep_s, self._maps, self._bytes = keep_s, dict[str, ProbabilityMap](), dict[str, float]()
        self._tracks: dict[str, list[tuple[float, float, float]]] = {}
        self.searched = SearchRun()

    def on(self, event: Event) -> None:
        """Record an event."""
        value, vehicle = event.value, vehicle_of(event.key)
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
        """The collected data."""
        search = self.searched
        search.seconds = min(search.done_s, limit_s)
        search.bytes_sent = sum(self._bytes.values())
        if math.isfinite(search.done_s):
            sure = [int((each.probability > SURE).sum()) for each in self._maps.values()]
            search.false_cells = float(np.mean(sure)) - len({*self._targets})
        search.tracks = {name: np.array(track) for name, track in self._tracks.items()}
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
    """Run a search and return its data; with ``keep_s``, also maps and tracks (it then runs to the limit)."""
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


def search_exchange(runner: Runner, seeds: int = SEEDS, losses: Sequence[float] = LOSSES) -> Figure:
    """Time until all vehicles know both targets, by exchange and loss."""
    cases = [(count, kind, loss) for count in COUNTS for kind in KINDS for loss in losses]
    tries = dict.fromkeys(cases, seeds) | {(count, "none", 0.0): min(seeds, ALONE) for count in COUNTS}
    jobs = [partial(searched, *case, seed, LIMITS_S[case[0]]) for case, most in tries.items() for seed in range(most)]
    answers = iter(runner(jobs))
    searches: Searches = {case: list(islice(answers, most)) for case, most in tries.items()}
    rows = list(sequential_rows())
    for count in COUNTS:
        rows += _rows(count, searches, losses)
    panels = [draw(count, searches, losses) for draw in (_times, _bytes) for count in COUNTS]
    return Figure("Search for two targets: until all know both (medians; infinite ones not drawn)", panels, rows)


def _rows(count: int, searches: Searches, losses: Sequence[float]) -> Iterator[Row]:
    reference, best = REFERENCE[count], _median(searches[count, "ledger", losses[0]])
    for kind in KINDS:
        for loss in losses:
            runs, must = searches[count, kind, loss], reference[kind][LOSSES.index(loss)]
            case = f"N = {count}, {kind}, loss {loss:g}"
            if (kind, loss) in NOT_OVER[count]:
                yield absolute(f"{case}: share not over", NOT_OVER[count][kind, loss], _unfinished(runs), 0.25)
            elif kind == "ledger":
                yield relative(f"{case}: median, s", must, _median(runs), SHARE)
                ratio = must / reference["ledger"][0]
                if loss > 0.0:
                    yield relative(f"{case}: median over that without loss", ratio, _median(runs) / best, SHARE)
            else:
                yield at_most(f"{case}: median, s", (1.0 + SHARE) * must, _median(runs))
                quicker = _median(searches[count, "ledger", loss]) - _median(runs)
                yield at_most(f"{case}: the ledger's median is greater by, s", 0.0, quicker)
    if losses[0] == 0.0:
        yield absolute(f"N = {count}, delta over ledger, no loss", 1.0, _median(searches[count, "delta", 0.0]) / best, 0.0)
    yield absolute(f"N = {count}, none: share not over", 1.0, _unfinished(searches[count, "none", 0.0]), 0.2)
    over = [each.false_cells for loss in losses for each in searches[count, "ledger", loss] if math.isfinite(each.done_s)]
    false = float(np.mean(over)) if over else math.nan
    yield absolute(f"N = {count}, ledger: false cells of a map", FALSE_CELLS, false, 0.3)


def sequential_rows() -> Iterator[Row]:
    """Exact test of a single cell: evidence of the platform's own map as a random walk between decisions."""
    for p, (net, wrong, looks) in SEQUENTIAL.items():
        found_net, found_wrong, found_looks = sequential(p)
        yield absolute(f"one cell, p = {p:g}: net hits to decide", net, found_net, 0.0)
        yield absolute(f"one cell, p = {p:g}: wrong decisions", wrong, found_wrong, 5e-6)
        yield absolute(f"one cell, p = {p:g}: looks", looks, found_looks, 5e-4)


def sequential(p: float) -> tuple[int, float, float]:
    """Net hits until a cell with a target is decided, share of wrong decisions, mean looks, for q = 1 - p and a prior of 0.5.

    A random walk, one step up with p and down with 1 - p, until a decision, solved by its fundamental matrix.
    """
    evidence = Sensor(p, 1.0 - p).evidence(np.array([1]), np.array([0]))[0]
    net = next(hits for hits in range(1, 100) if decisions(np.array([hits * evidence]))[0] == 1)
    states = 2 * net - 1  # -net + 1 to net - 1
    steps = np.diag(np.full(states - 1, p), 1) + np.diag(np.full(states - 1, 1.0 - p), -1)
    visits = np.linalg.inv(np.eye(states) - steps)[net - 1]  # start in the middle
    return net, float(visits[0] * (1.0 - p)), float(visits.sum())


def _median(runs: Sequence[SearchRun]) -> float:
    return float(np.median([each.done_s for each in runs]))


def _unfinished(runs: Sequence[SearchRun]) -> float:
    return float(np.mean([math.isinf(each.done_s) for each in runs]))


def _rate(runs: Sequence[SearchRun], count: int) -> float:
    """Sent by each of ``count`` vehicles, kB/s."""
    return float(np.mean([each.bytes_sent / each.seconds / count / 1000.0 for each in runs]))


def _times(count: int, searches: Searches, losses: Sequence[float]) -> Panel:
    curves = []
    for color, kind in enumerate(KINDS, 1):
        at = [LOSSES.index(loss) for loss in losses]
        x, must = np.array(losses), np.array(REFERENCE[count][kind])[at]
        medians = np.array([_median(searches[count, kind, loss]) for loss in losses])
        curves += [
            Curve(x[np.isfinite(medians)], medians[np.isfinite(medians)], kind, color, "both"),
            Curve(x[np.isfinite(must)], must[np.isfinite(must)], "independent" if color == 1 else "", color, "hollow"),
        ]
        done_s = [(loss, each.done_s) for loss in losses for each in searches[count, kind, loss]]
        single_x, single_y = np.array(done_s)[np.isfinite(done_s).all(axis=1)].T
        curves.append(Curve(single_x + 0.008 * (color - 2), single_y, "", color, "dots"))
    return Panel(f"{count} vehicles", "probability of loss", "until all know both [s]", curves, log_y=True)


def _bytes(count: int, searches: Searches, losses: Sequence[float]) -> Panel:
    curves = []
    for color, kind in enumerate(KINDS, 1):
        rates = [_rate(searches[count, kind, loss], count) for loss in losses]
        curves.append(Curve(np.array(losses), np.array(rates), kind, color, "both"))
    title = f"{count} vehicles: messages"
    return Panel(title, "probability of loss", "sent by a vehicle [kB/s]", curves)


def fig_45(runner: Runner) -> Figure:
    """Figure 45: the maps of two vehicles at four instants, with three messages in ten lost."""
    limit_s = SHOWN_S[-1] + 2.0
    (search,) = runner([partial(searched, 2, "ledger", SHOWN_LOSS, SHOWN_SEED, limit_s, keep_s=SHOWN_S)])
    targets = places(SHOWN_SEED)
    cells = {(int(y / CELL_M), int(x / CELL_M)) for x, y in targets}
    rows, panels = [], []
    for name in search.tracks:
        last = search.maps[-1][name].probability
        sure = sum(last[cell] > SURE for cell in cells)
        decided = float(((last > SURE) | (last < 255.0 - SURE)).mean())
        rows += [
            absolute(f"{name}: targets that its map is sure of", 2.0, sure, 0.0),
            at_most(f"{name}: false cells", 2.0, float((last > SURE).sum() - sure)),
            absolute(f"{name}: share of the cells that are decided", 1.0, decided, 0.2),
        ]
        panels += [_map(name, at_s, each[name], search, targets) for at_s, each in zip(SHOWN_S, search.maps, strict=True)]
    apart = [np.abs(_plain(each["uav1"]) - _plain(each["uav2"])).mean() for each in search.maps]
    rows.append(at_most("the two maps differ by, mean of all cells and instants", 0.05, float(np.mean(apart))))
    rows.append(at_most("all know both after, s", SHOWN_S[-1], search.done_s))
    return Figure("Fig. 45: probability of a target, ledger, three messages in ten lost", panels, rows, columns=len(SHOWN_S))


def _plain(belief: ProbabilityMap) -> Array:
    return np.asarray(belief.probability / 255.0)


def _map(name: str, at_s: float, belief: ProbabilityMap, search: SearchRun, targets: Sequence[tuple[float, float]]) -> Panel:
    middles = CELL_M * (np.arange(belief.probability.shape[0]) + 0.5)
    x, y = np.array(targets).T
    has_legend = at_s == SHOWN_S[0]  # more legends would hide too much
    curves = [Curve(x, y, "target" if has_legend else "", 2, "hollow")]
    for color, (vehicle, track) in zip((4, 3), search.tracks.items(), strict=True):
        so_far = track[track[:, 0] <= at_s]
        curves.append(Curve(so_far[:, 1], so_far[:, 2], vehicle if has_legend else "", color))
    ends = (0.0, EDGE_M)
    heat = Heat(middles, middles, _plain(belief), "P(target) [1]", "map")
    return Panel(f"{name} after {at_s:g} s", "x east [m]", "y north [m]", curves, heat=heat, x_limits=ends, y_limits=ends)
