"""Lines of the control connection of USARSim's Wireless Simulation Server: ``KIND {Key value} {Key value}``, then CR LF.

Its manual says which there are. A value is one word; a line that is no message is answered, too.
"""

import math
import re
from typing import NamedTuple

from vcmvsp.netsim.bridge.gateways.base import HIGHEST

LONGEST_LINE = 4096  # bytes; of whoever sends a longer one no more is read
MOST_PORTS = 16  # on which a robot may listen

_LINE = re.compile(r"([A-Z]+)((?:\s*\{[^{}\s]+(?:\s+[^{}\s]+)?\s*\})*)\s*", re.ASCII)
_FIELD = re.compile(r"\{([^{}\s]+)(?:\s+([^{}\s]+))?\s*\}", re.ASCII)
_PORT = re.compile(r"[0-9]{1,5}", re.ASCII)


class Message(NamedTuple):
    """What a robot's program says."""

    kind: str
    fields: dict[str, str]

    def robot(self) -> str:
        """The robot that it names; empty: none."""
        return self.fields.get("Robot", "")

    def port(self) -> int | None:
        """The port that it names; None: none, or what cannot be one."""
        return _port(self.fields.get("Port", ""))

    def ports(self) -> tuple[int, ...] | None:
        """The list of ports that it names, each once; None: none, too many, or what cannot be one."""
        words = self.fields.get("Port", "").split(",")
        found = [port for word in words if (port := _port(word)) is not None]
        return tuple(dict.fromkeys(found)) if len(found) == len(words) <= MOST_PORTS else None


def parse(line: bytes) -> Message | None:
    """The message in a line; None: it is none."""
    found = _LINE.fullmatch(line.decode(errors="surrogateescape"))
    return Message(found[1], dict(_FIELD.findall(found[2]))) if found else None


def compose(kind: str, **fields: object) -> bytes:
    """A line that says this, in this order."""
    words = [kind, *(f"{{{key} {value}}}" for key, value in fields.items())]
    return " ".join(words).encode(errors="surrogateescape") + b"\r\n"


def error(reason: str) -> bytes:
    """The line that says that something was wrong, in words between dots."""
    return compose("ERROR", Reason=reason)


def strength(level_dbm: float) -> str:
    """A level as robots read it."""
    return "NaN" if math.isnan(level_dbm) else f"{level_dbm:.6g}".replace("inf", "INF")


def _port(word: str) -> int | None:
    return int(word) if _PORT.fullmatch(word) and 0 < int(word) <= HIGHEST else None
