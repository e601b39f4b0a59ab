"""How a session of Eclipse Zenoh is opened, at whichever end.

The run's end is `cosim.hosts.hub`, the host's `cosim.hosts.host_client`; the keys are in `cosim.transport.key_names`, and
who may use which in `cosim.transport.access_control`. Callbacks are always direct (no thread per callback), and only hand over
to a queue.
"""

import contextlib
import json
import os
from collections.abc import Iterable, Iterator
from typing import Any

import zenoh

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control

UNIX = "unixsock-stream//proc/self/fd/"
"""Before the file descriptor of a Unix socket that has no name any more, or of a folder, and its name therein."""

COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": access_control.LEASE_MS}}},
}


@contextlib.contextmanager
def threads(shared: str) -> Iterator[None]:
    """How Zenoh's threads share their work, which it reads when a process opens its first session; not for children of it."""
    if "ZENOH_RUNTIME" in os.environ:
        yield
        return
    os.environ["ZENOH_RUNTIME"] = shared
    try:
        yield
    finally:
        os.environ.pop("ZENOH_RUNTIME", None)


def opened(own: dict[str, Any], secure: dict[str, Any], failure: str) -> zenoh.Session:
    """A session of this configuration. Raises `UsageError` (there can be none; the message begins with ``failure``)."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(access_control.merge(COMMON, own, secure))))
    except zenoh.ZError as error:
        where_in_its_sources = " at /"
        raise UsageError(f"{failure}: {str(error).splitlines()[0].partition(where_in_its_sources)[0]}") from error


def closed(session: zenoh.Session) -> None:
    """Close a session; connections that never finish their handshake may hold this up for seconds, and do not make it fail."""
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def common_names(session: zenoh.Session) -> Iterable[str | None]:
    """The names on the certificates at the other ends of a session's links."""
    return [link.auth_identifier for link in session.info.links()]
