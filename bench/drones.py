"""Quadrotors beside PyFlyt and gym-pybullet-drones, which also use PyBullet, and beside crazyflow, in one run.

``python -m bench.drones``. All step at 240 Hz, crazyflow at 250 Hz, and receive new velocities and yaw rates ten times a
second or more often; our flight controllers, PyFlyt's and crazyflow's run at 120 Hz or more, those of gym-pybullet-drones at
48 Hz, as in its examples. CPU time of each process, without compilation. gym-pybullet-drones itself is not on PyPI;
swarm-drone-gym there is a fork of it, under the same names.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bench.asked import SilentError, installed, program
from bench.measure import Row, in_turn, missing, table
from bench.vehicles import Fleet, federate_cpu_s

ROUNDS = 3
IN_BULLET = {10: 0.25, 50: 0.1, 100: 0.1}  # largest share of a peer's time, by number of quadrotors
IN_JAX = dict.fromkeys((10, 100, 1000), 0.5)
RATE_HZ = 240.0
WORK = 25.0  # quadrotors times seconds, of a peer's stretch
LEAST_S = 2.0  # of a stretch
OLD = Path(".drones/bin/python")  # with peers that need an older NumPy than ours: see the Makefile
JAX = Path(".crazyflow/bin/python")


class Peer(NamedTuple):
    """A program of `bench.peers`."""

    module: str
    name: str
    python: Path
    most: dict[int, float]


PEERS = (
    Peer("pyflyt_fleet", "PyFlyt 0.29 at its own 240 Hz", OLD, IN_BULLET),
    Peer(
        "gym_drones", "swarm-drone-gym 2.0.0.3 at 240 Hz, a fork of gym-pybullet-drones, which is not on PyPI", OLD, IN_BULLET
    ),
    Peer("crazyflow_fleet", "crazyflow 0.4 at 250 Hz, on one core, one thread", JAX, IN_JAX),
)


def rows() -> Iterator[Row]:
    """All rows; each is measured when it is requested."""
    for peer in PEERS:
        for count in peer.most:
            yield _row(count, peer)


def _row(count: int, peer: Peer) -> Row:
    print(f"measuring: drones, {count} beside {peer.module} ...", file=sys.stderr, flush=True)
    span_s, most = max(LEAST_S, WORK / count), peer.most[count]
    fleet = Fleet(0, count, rate_hz=RATE_HZ)
    name, demand = f"{count} quadrotors, {RATE_HZ:g} Hz; beside {peer.name}", f"<= {most:g}"
    try:
        with program(peer.module, installed(peer.python), agents=count, span_s=span_s) as peer_stretch:
            ours, other, ratio = in_turn(lambda: federate_cpu_s(fleet), lambda: peer_stretch() / span_s, ROUNDS)
    except SilentError as error:
        return missing(name, demand, error)
    return Row(name, f"{1.0 / ours:.1f}x real time", f"{1.0 / other:.2f}x", ratio, demand, ratio <= most)


if __name__ == "__main__":
    print(table(list(rows())))
