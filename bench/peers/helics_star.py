"""HELICS (helics.org) over its ZeroMQ core: a broker, a world, and processes with a core each, which hold the agents.

``--way plain``: as in HELICS's own examples. Each agent is a value federate of its own, which blocks in its request for the
next time; several in a process have a thread each.

``--way each`` and ``all``: the fastest here of threads, asynchronous time requests and callback federates, and of time kept by
the broker (``--globaltime``) or not: callback federates and the broker. A federate per agent, or one for all of a process.

With a latency all step together on values of the previous step, which takes one time barrier a step; without one, agents step
between the steps of the world, which takes two. Agents that are woken by values take longer; HELICS refuses more than one that
waits for the values of its own time (``wait_for_current_time_update``).

Values of bytes, one publication for each agent and way.
"""

import contextlib
import os
import socket
import sys
import threading
from collections.abc import Sequence
from typing import Any

import helics as h  # type: ignore[import-not-found,import-untyped,unused-ignore]

from bench.peers.pace import Options, Pace, busy, child, options

CORE = "zmq"


def federate_info(port: int, federates: int = 1, offset_s: float = 0.0) -> Any:
    """Federate information: steps once a second, at an offset, in a core with this number of federates."""
    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, CORE)
    h.helicsFederateInfoSetCoreInitString(info, f"--federates={federates} --brokerport={port} --loglevel=no_print")
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_PERIOD, 1.0)
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_OFFSET, offset_s)
    h.helicsFederateInfoSetFlagOption(info, h.HELICS_FLAG_UNINTERRUPTIBLE, True)
    return info


def both(own: Any, numbers: Sequence[int], says: str, hears: str) -> tuple[list[Any], list[Any]]:
    """Publications and subscriptions for these agents."""
    publications = [
        h.helicsFederateRegisterGlobalPublication(own, f"{n}/{says}", h.HELICS_DATA_TYPE_STRING, "") for n in numbers
    ]
    return publications, [h.helicsFederateRegisterSubscription(own, f"{n}/{hears}", "") for n in numbers]


def world(settings: Options) -> None:
    """Publish to all agents, and read their answers."""
    pace, groups = Pace(settings), settings.processes
    port, federates = free_port(), 1 + (groups if settings.way == "all" else settings.agents)
    keeps = "" if settings.way == "plain" else "--globaltime"
    h.helicsCreateBroker(CORE, "broker", f"-f {federates} {keeps} --port={port} --loglevel=no_print")
    arguments = ["--agents", str(settings.agents), "--processes", str(groups), "--answered", str(settings.answered)]
    arguments += ["--latency_s", str(settings.latency_s), "--busy_s", str(settings.busy_s), "--way", settings.way]
    children = [child("bench.peers.helics_star", "--at", f"{port} {n}", *arguments) for n in range(groups)]
    own = h.helicsCreateValueFederate("world", federate_info(port))
    publications, subscriptions = both(own, range(settings.agents), "seen", "command")
    h.helicsFederateEnterExecutingMode(own)
    observation, now = bytes(settings.asked), 0.0
    while pace.step():
        for each in publications:
            h.helicsPublicationPublishBytes(each, observation)
        now = h.helicsFederateRequestTime(own, now + 1.0)
        for each in subscriptions:
            command = h.helicsInputGetBytes(each)
        assert now < 3.0 or len(command) == settings.answered
    for process in children:
        process.kill()
    os._exit(0)  # not disconnected: callback federates hang there now and then


def host(settings: Options) -> None:
    """Answer every value until the world is gone."""
    port, number = map(int, settings.at.split())
    numbers = range(number, settings.agents, settings.processes)
    groups: list[Sequence[int]] = [numbers]
    if settings.way != "all":
        groups = [[n] for n in numbers]
    first = 1.0 if settings.latency_s else 0.5
    info = federate_info(port, len(groups), first % 1.0)
    create = h.helicsCreateValueFederate if settings.way == "plain" else h.helicsCreateCallbackFederate
    federates = [create(f"agents{group[0]}", info) for group in groups]
    if settings.way == "plain":
        for own, group in zip(federates, groups, strict=True):
            threading.Thread(target=block, args=(own, group, settings, first), daemon=True).start()
    else:
        steps = [stepping(own, group, settings, first) for own, group in zip(federates, groups, strict=True)]
        for own, step in zip(federates, steps, strict=True):
            h.helicsCallbackFederateNextTimeCallback(own, step, h.ffi.NULL)
            h.helicsFederateEnterInitializingMode(own)
    sys.stdin.buffer.read()
    os._exit(0)


def block(own: Any, numbers: Sequence[int], settings: Options, first: float) -> None:
    """Request one time after the other, without end."""
    publications, subscriptions = both(own, numbers, "command", "seen")
    h.helicsFederateEnterExecutingMode(own)
    command, now = bytes(settings.answered), first - 1.0
    while True:
        now = h.helicsFederateRequestTime(own, now + 1.0)
        answer(publications, subscriptions, command, settings.busy_s)


def stepping(own: Any, numbers: Sequence[int], settings: Options, first: float) -> Any:
    """Callback for HELICS; it returns the next time."""
    publications, subscriptions = both(own, numbers, "command", "seen")
    command = bytes(settings.answered)

    def step(now: float, _: Any) -> float:
        if now >= first:
            answer(publications, subscriptions, command, settings.busy_s)
        return max(now + 1.0, first)

    return h.ffi.callback("double(double, void *)", step)


def answer(publications: Sequence[Any], subscriptions: Sequence[Any], command: bytes, busy_s: float) -> None:
    """Read the inputs of these agents, and publish their answers."""
    for publication, subscription in zip(publications, subscriptions, strict=True):
        h.helicsInputGetBytes(subscription)
        busy(busy_s)
        h.helicsPublicationPublishBytes(publication, command)


def free_port() -> int:
    """First of two consecutive free ports outside of the ephemeral range."""
    for port in range(20_000, 30_000, 2):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)), socket.create_server(("", port + 1)):
            return port
    raise OSError("no two free ports in a row")


if __name__ == "__main__":
    options_given = options()
    (host if options_given.at else world)(options_given)
