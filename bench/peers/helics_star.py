"""HELICS (helics.org) over its ZeroMQ core: a broker, a world, and a federate in each process that holds the agents of it.

Values of bytes, one publication for each agent and way. With a latency all step together and see what was said a step
before, which takes one time barrier a step; without one, agents step between the steps of the world, which takes two. Agents
that wait to be woken by values take longer.
"""

import contextlib
import socket
from collections.abc import Sequence
from typing import Any

import helics as h  # type: ignore[import-not-found,import-untyped,unused-ignore]

from bench.peers.pace import Options, Pace, busy, child, options

CORE = "zmq"


def federate(name: str, port: int, offset_s: float = 0.0) -> Any:
    """One that steps once a second, so long after the full second."""
    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, CORE)
    h.helicsFederateInfoSetCoreInitString(info, f"--federates=1 --brokerport={port} --loglevel=no_print")
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_PERIOD, 1.0)
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_OFFSET, offset_s)
    h.helicsFederateInfoSetFlagOption(info, h.HELICS_FLAG_UNINTERRUPTIBLE, True)
    return h.helicsCreateValueFederate(name, info)


def both(own: Any, numbers: Sequence[int], says: str, hears: str) -> tuple[list[Any], list[Any]]:
    """Publications and subscriptions for these agents."""
    said = [h.helicsFederateRegisterGlobalPublication(own, f"{n}/{says}", h.HELICS_DATA_TYPE_STRING, "") for n in numbers]
    return said, [h.helicsFederateRegisterSubscription(own, f"{n}/{hears}", "") for n in numbers]


def world(wanted: Options) -> None:
    """Publish to all agents, and read what they have said."""
    pace, groups = Pace(wanted), wanted.processes
    port = free_port()
    broker = h.helicsCreateBroker(CORE, "broker", f"-f {groups + 1} --port={port} --loglevel=no_print")
    given = ["--agents", str(wanted.agents), "--processes", str(groups), "--answered", str(wanted.answered)]
    given += ["--latency_s", str(wanted.latency_s)]
    children = [child("bench.peers.helics_star", "--at", f"{port} {n}", *given) for n in range(groups)]
    own = federate("world", port)
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
    for each in said:
        h.helicsPublicationPublishBytes(each, b"end")
    h.helicsFederateRequestTime(own, now + 1.0)
    h.helicsFederateDisconnect(own)
    for each in children:
        each.communicate()
    h.helicsBrokerWaitForDisconnect(broker, 5000)
    h.helicsCloseLibrary()


def host(wanted: Options) -> None:
    """Answer whatever is seen, until the end."""
    port, number = map(int, wanted.at.split())
    first = 1.0 if wanted.latency_s else 0.5
    own = federate(f"host{number}", port, first % 1.0)
    said, heard = both(own, range(number, wanted.agents, wanted.processes), "command", "seen")
    h.helicsFederateEnterExecutingMode(own)
    command, now, seen = bytes(wanted.answered), first - 1.0, b""
    while seen != b"end":
        now = h.helicsFederateRequestTime(own, now + 1.0)
        for mine, its in zip(said, heard, strict=True):
            seen = h.helicsInputGetBytes(its)
            busy(wanted.busy_s)
            h.helicsPublicationPublishBytes(mine, command)
    h.helicsFederateDisconnect(own)
    h.helicsCloseLibrary()


def free_port() -> int:
    """The first of two free ports in a row, away from those that systems give to whoever asks for any."""
    for port in range(20_000, 30_000, 2):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)), socket.create_server(("", port + 1)):
            return port
    raise OSError("no two free ports in a row")


if __name__ == "__main__":
    options_given = options()
    (host if options_given.at else world)(options_given)
