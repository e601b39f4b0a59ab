"""HELICS (helics.org) over its ZeroMQ core: a broker, a world, and processes with a core each, which hold the agents.

``--way each``: a federate per agent, as its users model vehicles. ``--way all``: one federate holds all agents of a process.
Of threads, asynchronous time requests and callback federates, and of time kept by the broker (``--globaltime``) or not, the
quickest here: callback federates and the broker.

Values of bytes, one publication for each agent and way. With a latency all step together and see what was said a step
before, which takes one time barrier a step; without one, agents step between the steps of the world, which takes two. Agents
that wait to be woken by values take longer.
"""

import contextlib
import os
import socket
import sys
from collections.abc import Sequence
from typing import Any

import helics as h  # type: ignore[import-not-found,import-untyped,unused-ignore]

from bench.peers.pace import Options, Pace, busy, child, options

CORE = "zmq"


def told(port: int, federates: int = 1, offset_s: float = 0.0) -> Any:
    """What makes a federate that steps once a second, so long after the full second, in a core of so many."""
    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, CORE)
    h.helicsFederateInfoSetCoreInitString(info, f"--federates={federates} --brokerport={port} --loglevel=no_print")
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_PERIOD, 1.0)
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_OFFSET, offset_s)
    h.helicsFederateInfoSetFlagOption(info, h.HELICS_FLAG_UNINTERRUPTIBLE, True)
    return info


def both(own: Any, numbers: Sequence[int], says: str, hears: str) -> tuple[list[Any], list[Any]]:
    """Publications and subscriptions for these agents."""
    said = [h.helicsFederateRegisterGlobalPublication(own, f"{n}/{says}", h.HELICS_DATA_TYPE_STRING, "") for n in numbers]
    return said, [h.helicsFederateRegisterSubscription(own, f"{n}/{hears}", "") for n in numbers]


def world(wanted: Options) -> None:
    """Publish to all agents, and read what they have said."""
    pace, groups = Pace(wanted), wanted.processes
    port, federates = free_port(), 1 + (wanted.agents if wanted.way == "each" else groups)
    h.helicsCreateBroker(CORE, "broker", f"-f {federates} --globaltime --port={port} --loglevel=no_print")
    given = ["--agents", str(wanted.agents), "--processes", str(groups), "--answered", str(wanted.answered)]
    given += ["--latency_s", str(wanted.latency_s), "--busy_s", str(wanted.busy_s), "--way", wanted.way]
    children = [child("bench.peers.helics_star", "--at", f"{port} {n}", *given) for n in range(groups)]
    own = h.helicsCreateValueFederate("world", told(port))
    said, heard = both(own, range(wanted.agents), "seen", "command")
    h.helicsFederateEnterExecutingMode(own)
    seen, now = bytes(wanted.asked), 0.0
    while pace.step():
        for each in said:
            h.helicsPublicationPublishBytes(each, seen)
        now = h.helicsFederateRequestTime(own, now + 1.0)
        for each in heard:
            command = h.helicsInputGetBytes(each)
        assert now < 3.0 or len(command) == wanted.answered
    for process in children:
        process.kill()
    os._exit(0)  # no farewell: callback federates hang in it now and then


def host(wanted: Options) -> None:
    """Answer whatever is seen, until the world is gone."""
    port, number = map(int, wanted.at.split())
    first = 1.0 if wanted.latency_s else 0.5
    command = bytes(wanted.answered)
    numbers = range(number, wanted.agents, wanted.processes)
    groups = [[n] for n in numbers] if wanted.way == "each" else [numbers]
    info = told(port, len(groups), first % 1.0)

    def stepping(own: Any, group: Sequence[int]) -> Any:
        said, heard = both(own, group, "command", "seen")

        def step(now: float, _: Any) -> float:
            if now >= first:
                for mine, its in zip(said, heard, strict=True):
                    h.helicsInputGetBytes(its)
                    busy(wanted.busy_s)
                    h.helicsPublicationPublishBytes(mine, command)
            return max(now + 1.0, first)

        return h.ffi.callback("double(double, void *)", step)

    federates = [h.helicsCreateCallbackFederate(f"agents{group[0]}", info) for group in groups]
    steps = [stepping(own, group) for own, group in zip(federates, groups, strict=True)]
    for own, step in zip(federates, steps, strict=True):
        h.helicsCallbackFederateNextTimeCallback(own, step, h.ffi.NULL)
        h.helicsFederateEnterInitializingMode(own)
    sys.stdin.buffer.read()
    os._exit(0)


def free_port() -> int:
    """The first of two free ports in a row, away from those that systems give to whoever asks for any."""
    for port in range(20_000, 30_000, 2):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)), socket.create_server(("", port + 1)):
            return port
    raise OSError("no two free ports in a row")


if __name__ == "__main__":
    options_given = options()
    (host if options_given.at else world)(options_given)
