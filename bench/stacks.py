"""Cost of ROS 2 nodes in a run at wall pace: ``python -m bench.stacks``, two minutes.

Ten cars with scanners of 10 Hz: processor time of the run's process while nodes subscribe to nothing, or in one more process
to scans and odometry of all cars, beside the same run with agents that read as much.
"""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import vcmvsp
from bench.bridge import _cpu_s
from bench.measure import Row, medians, table
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.drivers.ros2.node import Node
from vcmvsp.hardware.drivers.ros2.protocol import Endpoint, RmwZenoh

CARS, PORT, ROUNDS = 10, 7461, 3
STARTS_S, SPAN_S = 6.0, 12.0  # the measurement begins when nodes and agents are connected
KINDS = {"scan": "sensor_msgs/msg/LaserScan", "odom": "nav_msgs/msg/Odometry"}


class Looking(Agent):
    """Reads its scan."""

    def act(self, obs: Observation, radio: Radio) -> None:
        """Ten times a second."""
        _ = obs.readings["scan"].ranges  # type: ignore[union-attr]


class Standing(Agent):
    """Stays in place."""

    def act(self, obs: Observation, radio: Radio) -> None:
        """Ten times a second."""


def run(agent: str) -> None:
    """A run at wall pace, with these agents, or nodes (empty)."""
    names = [f"car{number}" for number in range(CARS)]
    driven = {"agents": {"kind": f"bench.stacks:{agent}"}} if agent else {}
    stack = {} if agent else {"stack": {"ros2": {"vehicles": names, "endpoint": f"tcp/127.0.0.1:{PORT}"}}}
    agent_keys: dict[str, Any] = {"agent": {}} if agent else {}
    vcmvsp.run(
        {
            "name": "stacks",
            "duration_s": STARTS_S + SPAN_S + 2.0,
            "world": {"kind": "boxes", "boxes": [{"center": [6.0, 0.0, 0.5], "size": [0.2, 40.0, 1.0]}]},
            "radio": {"preset": "ideal"},
            "vehicles": {"kind": "p2dx", "sensors": {"scan": {"kind": "lms", "rate_hz": 10.0}}},
            "vehicle": [{"name": name, "pose": [0.0, 2.0 * n, 0.0], **agent_keys} for n, name in enumerate(names)],
            **driven,
            **stack,
        },
        realtime=True,
        agents="inprocess",
        mcap=False,
    )


def subscribe() -> None:
    """A node that receives scans and odometry of all cars; it prints the number of each."""
    counts = dict.fromkeys(KINDS, 0)

    def count(topic: str, *_: object) -> None:
        counts[topic] += 1

    node = None
    begin_s = time.monotonic()
    while node is None:
        with suppress(PortError):  # the run is not listening yet
            node = Node(f"tcp/127.0.0.1:{PORT}", "connect", RmwZenoh(0, "bench"), ())
    for number in range(CARS):
        for topic, kind in KINDS.items():
            endpoint = Endpoint("MS", f"car{number}/{topic}", kind)
            node.add(endpoint)
            node.hear(endpoint, partial(count, topic))
    time.sleep(STARTS_S + SPAN_S + begin_s - time.monotonic())
    print(json.dumps(counts))
    node.close()


def loads(agent: str, *, has_subscriber: bool) -> tuple[float, float, str]:
    """Shares of a core of a run with nodes and of one with agents, at the same time, and the node's receptions."""
    runs = [subprocess.Popen([sys.executable, "-m", "bench.stacks", "run", kind]) for kind in ("", agent)]
    node = (
        subprocess.Popen([sys.executable, "-m", "bench.stacks", "subscribe"], stdout=subprocess.PIPE)
        if has_subscriber
        else None
    )
    time.sleep(STARTS_S)
    before = [_cpu_s(each.pid) for each in runs]
    time.sleep(SPAN_S)
    ours, other = ((_cpu_s(each.pid) - begin) / SPAN_S for each, begin in zip(runs, before, strict=True))
    receptions = node.communicate()[0].decode().strip() if node is not None else ""
    for each in runs:
        each.wait()
    return ours, other, receptions


def rows() -> Iterator[Row]:
    """Both rows; each is measured when it is requested."""
    for agent, has_subscriber, most in (("Standing", False, 0.01), ("Looking", True, 0.10)):
        case = "a node hears all scans and odometry" if has_subscriber else "no topic has subscribers"
        print(f"measuring: stacks, {case} ...", file=sys.stderr, flush=True)
        pairs = [loads(agent, has_subscriber=has_subscriber) for _ in range(ROUNDS)]
        ours, beside, ratio = medians([(our_share, other_share) for our_share, other_share, _ in pairs])
        more = statistics.median(our_share - other_share for our_share, other_share, _ in pairs)
        name = f"stack.ros2, {CARS} p2dx with scanners of 10 Hz, {case}; beside agents"
        cost = f"{100 * ours:.1f} % of a core, {100 * more:+.1f} {pairs[-1][2]}"
        yield Row(name, cost, f"{100 * beside:.1f} %", ratio, f"<= {100 * most:.0f} % of a core more", more <= most)


if __name__ == "__main__":
    if sys.argv[1:2] == ["run"]:
        run(sys.argv[2])
    elif sys.argv[1:] == ["subscribe"]:
        subscribe()
    else:
        print(table(list(rows())))
