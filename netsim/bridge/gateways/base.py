"""Protocol of gateways: programs hand datagrams to the radio of a vehicle and take the datagrams that it receives.

Gateways run in the bridge process, all on one asyncio loop. Neither a slow run nor a slow program blocks the other side.
"""

import asyncio
import ipaddress
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Protocol

import msgspec

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.transport.endpoints import is_loopback

BROADCAST = -1
"""Instead of the row of a vehicle: all vehicles in range."""

LARGEST = 65_535
"""Bytes of a payload, at most: an IP packet's total length."""

HIGHEST = 65_535
"""The last port."""

Port = Annotated[int, msgspec.Meta(ge=1, le=HIGHEST)]
Bytes = Annotated[int, msgspec.Meta(ge=1, le=LARGEST)]  # of a payload


class GatewayError(Exception):
    """A gateway cannot be opened; the message says why and what to do."""


class GatewayContext(Protocol):
    """The bridge as a gateway sees it. Call it in the loop's thread only (`asyncio.AbstractEventLoop.call_soon_threadsafe`)."""

    vehicles: tuple[str, ...]  # rows are places in it
    run: str  # name of the scenario
    loop: asyncio.AbstractEventLoop
    radios: Mapping[str, tuple[int, ...]]  # rows of the vehicles with each of several radios, by its name; empty: one radio

    def offer(
        self,
        gateway: "Gateway",
        sender: int,
        to: int,
        payload: bytes,
        *,
        came_ns: int | None = None,
        size_bytes: int | None = None,
        radio: str = "",
    ) -> bool:
        """Hand a datagram to the radio of a vehicle.

        Args:
            gateway: its `Gateway.deliver` is called when the datagram arrives.
            to: row of the destination, or `BROADCAST`.
            payload: at most `LARGEST` bytes.
            came_ns: time of reception from the program, ``time.monotonic_ns()``; None: now.
            size_bytes: payload size on the channel: less than the length of ``payload`` if a header of it is part of the header
                of the radio's standard; None: its length.
            radio: name of one of several radios; empty: that of the gateway's table.

        Returns:
            Whether there was room. If not, the datagram was not taken: stop reading from this program for some milliseconds,
            or drop the datagram and `count` it.
        """

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        """Count datagrams that were dropped, by a reason that the user reads: "longer than mtu_bytes"."""

    def level_dbm(self, sender: int, receiver: int) -> float:
        """Mean received level between two vehicles, dBm, at most 0.1 s old; NaN: not known yet."""


class Gateway(Protocol):
    """A gateway of a table ``[bridge.KIND]``; the keys of the table are its constructor parameters.

    The run builds it to check it, the bridge process builds it again and opens it: a constructor opens nothing.
    Optional: a method ``lost(sender, receiver, payload)``, called when a unicast datagram is lost; the attribute
    ``only_one = True``: a run has at most one gateway of this class. Of several radios a gateway has one, which the key
    ``radio`` of its table names, by default the first; with ``every_radio = True`` and a method
    ``check_radios(radios)``, which gets the vehicles with each radio and raises a `ValueError`, it has all.
    """

    def check(self, vehicles: Sequence[str]) -> None:
        """Raise a `ValueError` that names the key for an invalid value: an unknown vehicle, a port used twice."""

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Open the sockets; returns lines that tell the user their addresses.

        Raises:
            GatewayError: for example a port in use or missing rights.
        """

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Pass a received datagram to the program of ``receiver`` without waiting; count it if the program does not take it."""

    async def close(self) -> None:
        """Release everything; called once, also after `open` has failed."""


def address(key: str, host: str) -> str:
    """A numeric IP address; a `ScenarioError` names the key."""
    try:
        return str(ipaddress.ip_address("127.0.0.1" if host == "localhost" else host))
    except ValueError:
        raise ScenarioError(f"must be an IPv4 or IPv6 address, not {host!r}", key=key) from None


def check_names(key: str, names: Iterable[str], vehicles: Sequence[str], what: str = "vehicle") -> None:
    """Raise a `ValueError` for a name under ``key`` that is not one of ``vehicles``; ``what`` describes a valid one."""
    for name in names:
        if name not in vehicles:
            raise ValueError(f"{key}: {unknown(what, name, vehicles)}")


def check_listen(host: str, *, insecure: bool, instead: str) -> None:
    """Raise a `ValueError` for a ``listen`` address that other machines reach, unless ``insecure``; ``instead`` is advice."""
    if not insecure and not is_loopback(host):
        problem = f"listen: {host} accepts connections from every machine in reach of this address"
        raise ValueError(f"{problem}: {instead}, or set insecure = true on a trusted network")
