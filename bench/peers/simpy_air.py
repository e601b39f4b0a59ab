"""A network in the style of UAV simulators on SimPy, such as UavNetSim: a process for each node, and one for each reception.

Written for this comparison, since UavNetSim is not on PyPI, and leaner than it: no queue of a MAC, no acknowledgements, no
routes, no log, and nodes that wait for events instead of polling every few microseconds. At each receiver a packet waits until
its end; then its level over noise and interference decides. ``--agents``, ``--span_s``, ``--loss``.
"""

import math
import random
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

import simpy

from bench.peers.pace import MESSAGE, Options, stretches

RATE_HZ = 10
BIT_RATE = 1e6
POWER_W, NOISE_W, THRESHOLD_DB = 0.1, 1e-12, 6.0
OVERHEAD_BYTES = 64
Waits = Generator[simpy.Event, Any, None]


@dataclass
class Packet:
    """On the air from begin to end, s."""

    sender: "Node"
    text: str
    begin: float
    end: float


class Node:
    """A node at rest with an inbox."""

    def __init__(self, env: simpy.Environment, number: int, air: "Air") -> None:
        self.place = (3.0 * (number % 10), 3.0 * (number // 10), 0.0)
        self.inbox = simpy.Store(env)
        self.received = 0
        self._env, self._air = env, air
        self._begin = number / RATE_HZ / 100.0  # in turn, so that few overlap
        env.process(self._send())
        env.process(self._receive())

    def _send(self) -> Waits:
        yield self._env.timeout(self._begin)
        while True:
            self._air.broadcast(self)
            yield self._env.timeout(1.0 / RATE_HZ)

    def _receive(self) -> Waits:
        while True:
            yield self.inbox.get()
            self.received += 1


class Air:
    """Packets on the air, and their outcome at each receiver."""

    def __init__(self, env: simpy.Environment, loss: float) -> None:
        self.nodes: list[Node] = []
        self._env, self._loss, self._packets, self._draw = env, loss, list[Packet](), random.Random(1)

    def broadcast(self, sender: Node) -> None:
        """Put a packet on the air, and wait for its end at each receiver."""
        now = self._env.now
        packet = Packet(sender, MESSAGE, now, now + 8.0 * (len(MESSAGE) + OVERHEAD_BYTES) / BIT_RATE)
        self._packets = [each for each in self._packets if each.end > now]
        self._packets.append(packet)
        for node in self.nodes:
            if node is not sender:
                self._env.process(self._deliver(packet, node))

    def _deliver(self, packet: Packet, receiver: Node) -> Waits:
        yield self._env.timeout(packet.end - self._env.now)
        others = (each for each in self._packets if each is not packet and each.begin < packet.end)
        disturbance = NOISE_W + sum(level(each.sender, receiver) for each in others)
        if 10.0 * math.log10(level(packet.sender, receiver) / disturbance) < THRESHOLD_DB:
            return
        if self._draw.random() >= self._loss:
            yield receiver.inbox.put(packet)


def level(sender: Node, receiver: Node) -> float:
    """Received power, W."""
    distance_m = max(1.0, math.dist(sender.place, receiver.place)) if sender is not receiver else 1.0
    return float(POWER_W * 10.0 ** (-(40.0 + 30.0 * math.log10(distance_m)) / 10.0))


def work(settings: Options) -> Callable[[], None]:
    """Each call is a run of its own."""

    def run() -> None:
        assert any(node.received for node in talked(settings.agents, settings.span_s, settings.loss))

    return run


def talked(count: int, span_s: float, loss: float) -> list[Node]:
    """The nodes after a run."""
    env = simpy.Environment()
    air = Air(env, loss)
    air.nodes += [Node(env, number, air) for number in range(count)]
    env.run(until=span_s)
    return air.nodes


if __name__ == "__main__":
    stretches(work)
