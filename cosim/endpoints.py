"""Network addresses as text: ``tcp/HOST:PORT``, as Zenoh writes them, or ``tcp://HOST:PORT``. Both mean the same."""

import re
from typing import NamedTuple

_SCHEME = re.compile(r"([a-z0-9-]+)://")
_REST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^\[\]:/?#@\s]*)(?::(\d{1,5}))?/?", re.ASCII)
_HIGHEST = 65535


class Endpoint(NamedTuple):
    """The parts of a network address."""

    protocol: str
    host: str  # an IPv6 address without its brackets; empty: omitted
    port: int | None  # None: omitted

    def __str__(self) -> str:
        return f"{self.protocol}/{bracketed(self.host)}{'' if self.port is None else f':{self.port}'}"


def endpoint_of(text: str) -> Endpoint | None:
    """Parse a network address; None: the text is not one."""
    protocol, slash, rest = with_slash(text).partition("/")
    match = _REST.fullmatch(rest)
    if not (protocol.isalnum() and slash) or not match or int(match[2] or 0) > _HIGHEST:
        return None
    return Endpoint(protocol, match[1].strip("[]"), int(match[2]) if match[2] else None)


def with_slash(text: str) -> str:
    """A network address in Zenoh's form; other text is unchanged."""
    return _SCHEME.sub(r"\1/", text, count=1) if _SCHEME.match(text) else text


def bracketed(host: str) -> str:
    """A host as written in front of a port: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host
