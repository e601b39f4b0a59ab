"""Lines of the control connection of USARSim's Wireless Simulation Server: ``KIND {Key value} {Key value}``, then CR LF.

The messages are those of its manual. A value is one word; an invalid line is answered, too.
"""

import math
import re
from typing import NamedTuple

from vcmvsp.netsim.bridge.gateways.base import HIGHEST

LONGEST_LINE = 4096  # bytes; a longer line ends the connection
MOST_PORTS = 16  # on which a robot may listen

_LINE = re.compile(r"([A-Z]+)((?:\s*\{[^{}\s]+(?:\s+[^{}\s]+)?\s*\})*)\s*", re.ASCII)
_FIELD = re.compile(r"\{([^{}\s]+)(?:\s+([^{}\s]+))?\s*\}", re.ASCII)
_PORT = re.compile(r"[0-9]{1,5}", re.ASCII)


class WssMessage(NamedTuple):
    """A message of a robot's program."""

    kind: str
    fields: dict[str, str]

    def robot(self) -> str:
        """Field ``Robot``; empty: none."""
        return self.fields.get("Robot", "")

    def port(self) -> int | None:
        """Field ``Port``; None: none, or invalid."""
        return _port(self.fields.get("Port", ""))

    def ports(self) -> tuple[int, ...] | None:
        """Field ``Port`` as a list without repetitions; None: none, too many, or invalid."""
        words = self.fields.get("Port", "").split(",")
        ports = [port for word in words if (port := _port(word)) is not None]
        return tuple(dict.fromkeys(ports)) if len(ports) == len(words) <= MOST_PORTS else None


def parse(line: bytes) -> WssMessage | None:
    """The message in a line; None: invalid."""
    match = _LINE.fullmatch(line.decode(errors="surrogateescape"))
    return WssMessage(match[1], dict(_FIELD.findall(match[2]))) if match else None


def compose(kind: str, **fields: object) -> bytes:
    """The line of a message with these fields, in this order."""
    words = [kind, *(f"{{{key} {value}}}" for key, value in fields.items())]
    return " ".join(words).encode(errors="surrogateescape") + b"\r\n"


def error(reason: str) -> bytes:
    """The line of an error; ``reason`` has dots instead of spaces."""
    return compose("ERROR", Reason=reason)


def strength(level_dbm: float) -> str:
    """Text of a level."""
    return "NaN" if math.isnan(level_dbm) else f"{level_dbm:.6g}".replace("inf", "INF")


def _port(word: str) -> int | None:
    return int(word) if _PORT.fullmatch(word) and 0 < int(word) <= HIGHEST else None
