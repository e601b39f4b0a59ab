"""Agents in other processes, beside bare Zenoh, HELICS and mosaik, in one run: ``python -m bench.federation``.

A world sends each agent its pose (200 bytes on our wire) and, in some rows, its scan (512 beams); each agent answers with a
command (90 bytes); neither does anything else, and nothing is recorded. Wall-clock time of an agent's step: a stretch of steps
of ours and one of its peer in turn, medians of the pairs. Both are separate programs (`bench.peers`); the packages of HELICS
and mosaik are in ``.peers`` (see the Makefile). HELICS is measured as in its examples, to which the demand refers, and in the
fastest way that was found.
"""

import itertools
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from bench.asked import SilentError, installed, program
from bench.cores import gain_of_integers
from bench.measure import Row, in_turn, missing, table
from bench.peers import ours

ROUNDS = 7
PAIRS = 10  # of agents that compute
HERE = Path(sys.executable)
PYTHON = Path(".peers/bin/python")


class Peer(NamedTuple):
    """A program of `bench.peers`, and its mode of operation."""

    module: str
    name: str
    way: str = ""


QUERY = Peer("bare", "a bare Zenoh query and its reply", "query")
PUBLISH = Peer("bare", "bare Zenoh, a publication each way", "publish")
PLAIN = Peer("helics_star", "HELICS 3.6.1 (zmq) as in its examples, a blocking federate per agent", "plain")
EACH = Peer("helics_star", "HELICS 3.6.1 (zmq) at its quickest with a federate per agent", "each")
ALL = Peer("helics_star", "HELICS 3.6.1 (zmq) at its quickest, one federate for all agents", "all")
MOSAIK = Peer("mosaik_star", "mosaik 3.6.0")
NONE = math.inf


class Star(NamedTuple):
    """Workload of a row, its peers, and the largest allowed share of their time."""

    agents: int
    processes: int
    beside: dict[Peer, float]
    scans: bool = False
    latency_s: float = 0.0

    @property
    def name(self) -> str:
        """For the table."""
        placement = f"{self.agents} agents"
        if self.processes == self.agents:
            placement = f"{self.agents} hosts x 1 agent"
        elif self.processes:
            placement = f"{self.processes} host x {self.agents} agents"
        else:
            placement += " in-process"
        if self.scans:
            placement += ", scans"
        if self.latency_s:
            placement += ", commands a step later"
        return placement


STARS = (
    Star(8, 8, {QUERY: 1.5, PUBLISH: NONE, PLAIN: 1 / 3, EACH: NONE, MOSAIK: 1 / 2.5}),
    Star(8, 8, {QUERY: 1.5, PUBLISH: NONE, PLAIN: 1 / 3, EACH: NONE, MOSAIK: 1 / 2.5}, scans=True),
    Star(8, 8, {EACH: NONE}, latency_s=0.1),
    Star(32, 1, {QUERY: 2.0, PUBLISH: NONE, PLAIN: 1 / 10, EACH: NONE, ALL: NONE, MOSAIK: 1 / 2}),
    Star(32, 1, {QUERY: 2.0, PUBLISH: NONE, PLAIN: 1 / 10, EACH: NONE, ALL: NONE, MOSAIK: 1 / 20}, scans=True),
    Star(32, 1, {EACH: NONE, ALL: NONE}, latency_s=0.1),
    Star(32, 0, {MOSAIK: 1.0}),
    Star(32, 0, {MOSAIK: 1.0}, scans=True),
)


def beside(star: Star) -> Iterator[Row]:
    """A row for each peer."""
    query_size, reply_size = ours.sizes(star.scans)
    same: dict[str, Any] = {"agents": star.agents, "processes": star.processes}
    same |= {"scans": star.scans, "latency_s": star.latency_s}
    with program("ours", HERE, **same) as our_stretch:
        for peer, share in star.beside.items():
            print(f"measuring: federation, {star.name}, beside {peer.name} ...", file=sys.stderr, flush=True)
            name = f"agents elsewhere: {star.name}; beside {peer.name}"
            demand = "none" if share == NONE else f"<= {share:.2g}x"
            try:
                python = HERE if peer.module == "bare" else installed(PYTHON)
                with program(peer.module, python, **same, way=peer.way, asked=query_size, answered=reply_size) as peer_stretch:
                    one, other, ratio = in_turn(our_stretch, peer_stretch, ROUNDS)
            except SilentError as error:
                yield missing(name, demand, error)
            else:
                yield Row(name, f"{1e6 * one:.1f} us a step", f"{1e6 * other:.1f} us", ratio, demand, ratio <= share)


def compute_row() -> Row:
    """Two agents that take 20 ms of CPU time each."""
    return _computing("2 agents that compute 20 ms, in two processes", 1.2, 2)


def overlap_row() -> Row:
    """Agents and world at the same time, on two cores: an agent's command takes effect a step later."""
    name = "a world that computes 40 ms, 2 agents that compute 20 ms, in one other process, commands a step later"
    return _computing(name, 1.1, 1, latency_s=0.1, world_s=0.04)


def _computing(name: str, demanded: float, processes: int, **options: Any) -> Row:
    """The least of each, since CPU time taken by other programs is no part of the comparison.

    ``demanded``: time beside that of an ideal division of the work, by what the second core adds to a loop over integers.
    """
    print(f"measuring: federation, {name} ...", file=sys.stderr, flush=True)
    row_name = f"agents elsewhere: {name}; beside all in one process (least of {PAIRS}; ratio: to an ideal division)"
    try:
        possible = gain_of_integers()
    except ValueError as error:
        return missing(row_name, f"<= {demanded}x", error)
    same: dict[str, Any] = {"agents": 2, "busy_s": 0.02, "stretch_s": 1.0, **options}
    with program("ours", HERE, **same, processes=processes) as apart, program("ours", HERE, **same) as together:
        pairs = [(apart(), together()) for _ in range(PAIRS)]
    apart_s, together_s = (min(each) for each in zip(*pairs, strict=True))
    ratio = apart_s / together_s * possible
    return Row(
        row_name, f"{2e3 * apart_s:.1f} ms a step", f"{2e3 * together_s:.1f} ms", ratio, f"<= {demanded}x", ratio <= demanded
    )


def rows() -> list[Row]:
    """All rows."""
    return [*itertools.chain.from_iterable(map(beside, STARS)), compute_row(), overlap_row()]


if __name__ == "__main__":
    print(table(rows()))
