"""Key expressions of the protocol; each contains the name of the machine that may use it.

With a machine's name NAME from its certificate and ZID, the id of its Zenoh session::

    vcmvsp/join/NAME             queryable of the hub: join request of a host
    vcmvsp/about/NAME            queryable of the hub: description of the run, and the role of NAME
    vcmvsp/host/NAME/ZID/ask     the hub publishes questions to a host
    vcmvsp/host/NAME/ZID/answer  the host publishes its answers
    vcmvsp/host/NAME/ZID/alive   liveliness token of a host
    vcmvsp/hub/alive             liveliness token of the hub
    vcmvsp/topic/...             events of the run for observers
    vcmvsp/page/update           updates of the run's page for observers
    vcmvsp/page/scenery          queryable of the hub: constant content of that page, for observers

Between a driver of the run and the program on the robot of its vehicle (`hardware.remote_robot`)::

    vcmvsp/robot/NAME/greet              queryable of the driver: greeting of a robot
    vcmvsp/robot/NAME/VEHICLE/ZID/down   the driver publishes velocities to a robot
    vcmvsp/robot/NAME/VEHICLE/ZID/up     the robot publishes its state
    vcmvsp/robot/NAME/VEHICLE/ZID/alive  liveliness token of a robot

The hub lets a machine use no key but its own (`cosim.transport.access_control`). So the key identifies the sender; a name in
a payload does not.
"""

import re
from typing import Literal

OPEN = "anyone"
"""The name in the keys of a host without a certificate (on this machine, or if the user opts out)."""

JOIN, ABOUT, HUB_ALIVE = "vcmvsp/join/*", "vcmvsp/about/*", "vcmvsp/hub/alive"
TOPIC, TOPICS = "vcmvsp/topic/", "vcmvsp/topic/**"
PAGE_UPDATE, PAGE_SCENERY = "vcmvsp/page/update", "vcmvsp/page/scenery"
GREET = "vcmvsp/robot/*/greet"
ALIVE = "vcmvsp/host/*/*/alive"

_KEY = re.compile(r"vcmvsp/(?:(?:join|about)/([A-Za-z0-9_-]+)|host/([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:ask|alive))")
_ROBOT = re.compile(r"vcmvsp/robot/([A-Za-z0-9_-]+)/(?:greet|([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:up|down|alive))")


def join_key(name: str) -> str:
    """Key of a host's join request."""
    return f"vcmvsp/join/{name}"


def about_key(name: str) -> str:
    """Key under which a machine queries the description of the run."""
    return f"vcmvsp/about/{name}"


def answer_key(ask: str) -> str:
    """Key of a host's answers to the questions under ``ask``."""
    return f"{ask.removesuffix('ask')}answer"


def host_key(name: str, zid: str, purpose: Literal["ask", "alive"]) -> str:
    """A key of a host. Raises `ValueError` (the name or the id has characters that could make it another host's key)."""
    key = f"vcmvsp/host/{name}/{zid}/{purpose}"
    if speaker(key) is None:
        raise ValueError(f"no key of a host: {key!r}")
    return key


def speaker(key: str) -> tuple[str, str] | None:
    """Name and session id (empty unless it is a host's key) of the machine that owns a key.

    None: no machine's key, or one with wildcards.
    """
    match = _KEY.fullmatch(key)
    return (match[1] or match[2], match[3] or "") if match else None


def greet_key(name: str) -> str:
    """Key of a robot's greeting to the driver that waits for it."""
    return f"vcmvsp/robot/{name}/greet"


def robot_key(name: str, vehicle: str, zid: str, purpose: Literal["up", "down", "alive"]) -> str:
    """A key of a robot. Raises `ValueError` (an argument has characters that could make it another robot's key)."""
    key = f"vcmvsp/robot/{name}/{vehicle}/{zid}/{purpose}"
    if robot_speaker(key) is None:
        raise ValueError(f"no key of a robot: {key!r}")
    return key


def robot_speaker(key: str) -> tuple[str, str, str] | None:
    """Machine name, vehicle and session id (empty in a greeting) of the robot that owns a key.

    None: no robot's key, or one with wildcards.
    """
    match = _ROBOT.fullmatch(key)
    return (match[1], match[2] or "", match[3] or "") if match else None
