"""The keys of the protocol, in which the name of the machine stands that may use them.

With a machine's name NAME from its certificate and ZID, the id of its Zenoh session::

    vcmvsp/join/NAME             queryable of the hub: a host that wants to take part
    vcmvsp/about/NAME            queryable of the hub: what run this is, and what NAME is to it
    vcmvsp/host/NAME/ZID/ask     the hub publishes questions to a host
    vcmvsp/host/NAME/ZID/answer  the host publishes its answers
    vcmvsp/host/NAME/ZID/alive   liveliness token of a host
    vcmvsp/hub/alive             liveliness token of the hub
    vcmvsp/topic/...             what the run shows to observers

Where a driver of the run waits for the robot of its vehicle, which has a program of its own aboard (`hardware.remote_robot`)::

    vcmvsp/robot/NAME/greet              queryable of the driver: a robot that wants to be driven
    vcmvsp/robot/NAME/VEHICLE/ZID/down   the driver publishes velocities to a robot
    vcmvsp/robot/NAME/VEHICLE/ZID/up     the robot publishes what it knows of itself
    vcmvsp/robot/NAME/VEHICLE/ZID/alive  liveliness token of a robot

The hub lets a machine use no key but its own (`cosim.transport.access_control`). So the key says for certain who speaks, and
what a payload says of it is worth nothing.
"""

import re
from typing import Literal

OPEN = "anyone"
"""The name that stands in the keys of a host without a certificate (on this machine, or where the user wants none)."""

JOIN, ABOUT, HUB_ALIVE = "vcmvsp/join/*", "vcmvsp/about/*", "vcmvsp/hub/alive"
TOPIC, TOPICS = "vcmvsp/topic/", "vcmvsp/topic/**"
GREET = "vcmvsp/robot/*/greet"
ALIVE = "vcmvsp/host/*/*/alive"

_KEY = re.compile(r"vcmvsp/(?:(?:join|about)/([A-Za-z0-9_-]+)|host/([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:ask|alive))")
_ROBOT = re.compile(r"vcmvsp/robot/([A-Za-z0-9_-]+)/(?:greet|([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:up|down|alive))")


def join_key(name: str) -> str:
    """Where a host greets the hub."""
    return f"vcmvsp/join/{name}"


def about_key(name: str) -> str:
    """Where a machine asks what run this is."""
    return f"vcmvsp/about/{name}"


def answer_key(ask: str) -> str:
    """Where a host answers what it is asked under this key."""
    return f"{ask.removesuffix('ask')}answer"


def host_key(name: str, zid: str, what: Literal["ask", "alive"]) -> str:
    """A key of a host. Raises `ValueError` (the name or the id has characters that could make it another host's key)."""
    key = f"vcmvsp/host/{name}/{zid}/{what}"
    if speaker(key) is None:
        raise ValueError(f"no key of a host: {key!r}")
    return key


def speaker(key: str) -> tuple[str, str] | None:
    """Name and session id (empty unless it is a host's key) of the machine that a key belongs to.

    None: the key is none, or is for many.
    """
    found = _KEY.fullmatch(key)
    return (found[1] or found[2], found[3] or "") if found else None


def greet_key(name: str) -> str:
    """Where a robot greets the driver that waits for it."""
    return f"vcmvsp/robot/{name}/greet"


def robot_key(name: str, vehicle: str, zid: str, what: Literal["up", "down", "alive"]) -> str:
    """A key of a robot. Raises `ValueError` (one of these has characters that could make it another robot's key)."""
    key = f"vcmvsp/robot/{name}/{vehicle}/{zid}/{what}"
    if robot_speaker(key) is None:
        raise ValueError(f"no key of a robot: {key!r}")
    return key


def robot_speaker(key: str) -> tuple[str, str, str] | None:
    """Name of the machine, vehicle and session id (empty where it greets) of the robot that a key belongs to.

    None: the key is none, or is for many.
    """
    found = _ROBOT.fullmatch(key)
    return (found[1], found[2] or "", found[3] or "") if found else None
