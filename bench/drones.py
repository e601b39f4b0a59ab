"""Quadrotors beside those of PyFlyt and gym-pybullet-drones, which fly them in PyBullet too, in one run.

``python -m bench.drones``. All step at 240 Hz, and are given new velocities and yaw rates ten times a second or more often;
our flight controllers and PyFlyt's run at 120 Hz or more, those of gym-pybullet-drones at 48 Hz, as in its examples. CPU time
of each process. gym-pybullet-drones itself is not on PyPI; swarm-drone-gym there is a fork of it, under the same names.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bench.asked import SilentError, installed, program
from bench.measure import Row, in_turn, missing, table
from bench.vehicles import Fleet, federate_cpu_s

ROUNDS = 3
MOST = {10: 0.25, 50: 0.1, 100: 0.1}  # of a peer's time, by how many fly
RATE_HZ = 240.0
WORK = 25.0  # quadrotors times seconds, of a peer's stretch
PYTHON = Path(".drones/bin/python")  # with the peers, which need an older NumPy than we do: see the Makefile


class Peer(NamedTuple):
    """A program of `bench.peers`."""

    module: str
    name: str


PEERS = (
    Peer("pyflyt_fleet", "PyFlyt 0.29 at its own 240 Hz"),
    Peer("gym_drones", "swarm-drone-gym 2.0.0.3 at 240 Hz, a fork of gym-pybullet-drones, which is not on PyPI"),
)


def rows() -> Iterator[Row]:
    """All of them; each is measured when it is asked for."""
    for count in MOST:
        for peer in PEERS:
            yield _row(count, peer)


def _row(count: int, peer: Peer) -> Row:
    print(f"measuring: drones, {count} beside {peer.module} ...", file=sys.stderr, flush=True)
    span_s = max(0.5, WORK / count)
    fleet = Fleet(0, count, rate_hz=RATE_HZ)
    name, demand = f"{count} quadrotors, {RATE_HZ:g} Hz; beside it {peer.name}", f"<= {MOST[count]:g}"
    try:
        with program(peer.module, installed(PYTHON), agents=count, span_s=span_s) as its:
            ours, other, ratio = in_turn(lambda: federate_cpu_s(fleet), lambda: its() / span_s, ROUNDS)
    except SilentError as error:
        return missing(name, demand, error)
    return Row(name, f"{1.0 / ours:.1f}x real time", f"{1.0 / other:.2f}x", ratio, demand, ratio <= MOST[count])


if __name__ == "__main__":
    print(table(list(rows())))
