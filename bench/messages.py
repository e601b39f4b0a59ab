"""Vehicles that only communicate, beside gradysim and a SimPy program, in one run: ``python -m bench.messages``.

Vehicles are at rest, broadcast twenty bytes ten times a second over a channel that loses a fifth, and count their receptions.
gradysim keeps no record of a run, so ours keeps none in the rows beside it; one row adds tables and metrics. UavNetSim is not
on PyPI: a SimPy program of the same design stands in for it (`bench.peers.simpy_air`). CPU seconds of each process.
"""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.asked import SilentError, installed, program
from bench.measure import Row, cpu, in_turn, missing, table
from bench.peers.pace import MESSAGE
from bench.workloads import Recording, run_cpu_s
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Message, Velocity
from vcmvsp.netsim.federate import RadioFederate

ROUNDS = 3
COUNTS = (10, 50, 100)
LEAST = {10: "goal: >= 2", 50: ">= 5", 100: ">= 8"}  # times less than gradysim
LOSS = 0.2
TENTH_NS = 100_000_000
WORK = 300_000  # receptions that each round is about
PEERS = Path(".peers/bin/python")
STILL = Velocity(linear=(0.0, 0.0, 0.0), yaw_rate=0.0)
IDEAL: dict[str, Any] = {"preset": "ideal"}
LEVELS: dict[str, Any] = {"preset": "wifi-b-1", "mac": {"kind": "ideal"}}  # every sender has the air for itself


class Counter(Agent):
    """Stays in place, broadcasts, and counts receptions."""

    def __init__(self) -> None:
        self.received = 0

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Ten times a second."""
        self.received += len(obs.heard)
        radio.send(MESSAGE.encode())
        return STILL


def talk(count: int, radio: dict[str, Any], duration_s: float) -> dict[str, Any]:
    """The scenario."""
    places = [(3.0 * (n % 10), 3.0 * (n // 10), 0.0) for n in range(count)]
    return {
        "name": "talk",
        "duration_s": duration_s,
        "physics": {"kind": "kinematic"},
        "radio": {**radio, "loss": {"probability": LOSS}},
        "vehicles": {"kind": "kinematic"},
        "agents": {"kind": "bench.messages:Counter", "period_s": 0.1},
        "vehicle": [{"name": f"car{n}", "pose": place, "agent": {}} for n, place in enumerate(places)],
    }


def beside(
    count: int, radio: dict[str, Any], recording: Recording, name: str, peer: str, python: Path, demand: str = "none"
) -> Row:
    """CPU seconds for each simulated second."""
    print(f"measuring: messages, {count} beside {peer} ...", file=sys.stderr, flush=True)
    span_s = max(2.0, round(WORK / (10 * count * (count - 1)), 1))
    scenario = talk(count, radio, span_s)
    least = None if demand == "none" else float(demand.split()[-3])
    try:
        with program(peer, installed(python), agents=count, span_s=span_s, loss=LOSS) as peer_stretch:
            ours, other, ratio = in_turn(lambda: run_cpu_s(scenario, recording), peer_stretch, ROUNDS)
    except SilentError as error:
        return missing(name, demand, error)
    our_cost, other_cost = f"{1e3 * ours / span_s:.1f} CPU ms a simulated s", f"{1e3 * other / span_s:.1f}"
    return Row(name, our_cost, other_cost, ratio, demand, least is None or ratio <= 1.0 / least)


def decisions(radio: dict[str, Any], case: str) -> Row:
    """A hundred radios that send in turn; all move between two of their frames."""
    print(f"measuring: messages, decisions, {case} ...", file=sys.stderr, flush=True)
    count, ticks = COUNTS[-1], 10
    name = f"decisions of the channel (frame and receiver), {count} radios, {case}, by `Channel.send`; beside gradysim's"
    demand = "goal: >= 1 million / CPU s"
    ours = sends(count, radio, ticks)
    try:
        with program(
            "gradysim_broadcast", installed(PEERS), agents=count, span_s=0.1 * ticks, loss=LOSS, way="decide"
        ) as peer_stretch:
            our_s, other_s, ratio = in_turn(ours, peer_stretch, ROUNDS)
    except SilentError as error:
        return missing(name, demand, error)
    made = 1e-6 * count * (count - 1) * ticks
    return Row(name, f"{made / our_s:.2f} million / CPU s", f"{made / other_s:.2f}", ratio, demand, made / our_s >= 1.0)


def sends(count: int, radio: dict[str, Any], ticks: int) -> Callable[[], float]:
    """Each call lets all send a number of times, every time from other places, and returns the CPU seconds."""
    parsed, source = scenarios.load(talk(count, radio, 1.0))
    with assemble(parsed, source) as assembled:
        (channel,) = (each._channel for each in assembled.federates if isinstance(each, RadioFederate))
    names = assembled.info.vehicles
    messages = [Message(sender=name, body=MESSAGE.encode(), size_bytes=len(MESSAGE), to=None) for name in names]
    places = np.array([(3.0 * (n % 10), 3.0 * (n // 10), 0.0) for n in range(count)])
    tick = 0

    def send() -> None:
        nonlocal tick
        for _ in range(ticks):
            tick += 1
            now = places + 0.01 * (tick % 100)
            for message in messages:
                channel.send(tick * TENTH_NS, message, names, now)

    return partial(cpu, send)


def rows() -> Iterator[Row]:
    """All rows; each is measured when it is requested."""
    for count in COUNTS:
        name = f"{count} vehicles at rest, 10 Hz broadcasts, 20 % lost, not recorded; beside gradysim 0.8.2"
        yield beside(count, IDEAL, "nothing", name, "gradysim_broadcast", PEERS, f"{LEAST[count]} times less")
    name = f"the same {COUNTS[-1]} with tables and metrics, as in a study; beside gradysim 0.8.2, which records nothing"
    yield beside(COUNTS[-1], IDEAL, "tables", name, "gradysim_broadcast", PEERS)
    for count in COUNTS:
        name = f"{count} vehicles at rest, 10 Hz broadcasts, 802.11b levels; beside a SimPy program like UavNetSim"
        yield beside(count, LEVELS, "nothing", name, "simpy_air", Path(sys.executable))
    yield decisions(IDEAL, "losses alone")
    yield decisions(LEVELS, "802.11b levels by distance and losses")


if __name__ == "__main__":
    print(table(list(rows())))
