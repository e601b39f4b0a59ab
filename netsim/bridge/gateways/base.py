"""What a door is: where programs hand over what their vehicles' radios are to send, and take what these receive.

Doors live in the bridge's process, beside the run and not in it: whatever a program does to its sockets, and however long the
run computes, the other side goes on. One asyncio loop turns all of them.
"""

import asyncio
import ipaddress
from collections.abc import Iterable, Sequence
from typing import Annotated, Protocol

import msgspec

from vcmvsp.cosim.config.messages import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.transport.endpoints import is_loopback

BROADCAST = -1
"""In place of the row of a vehicle: all who can hear it."""

LARGEST = 65_535
"""Bytes of a payload, at most: an IP packet's total length."""

HIGHEST = 65_535
"""The last port."""

Port = Annotated[int, msgspec.Meta(ge=1, le=HIGHEST)]
Bytes = Annotated[int, msgspec.Meta(ge=1, le=LARGEST)]  # of a payload


class DoorError(Exception):
    """A door cannot be opened; its words are for the user: what, and what to do."""


class Hall(Protocol):
    """What a door sees of the bridge. All is for the loop's own thread (`asyncio.AbstractEventLoop.call_soon_threadsafe`)."""

    vehicles: tuple[str, ...]  # rows are places in it
    run: str  # name of the scenario
    loop: asyncio.AbstractEventLoop

    def offer(self, door: "Door", sender: int, to: int, payload: bytes, *, came_ns: int | None = None) -> bool:
        """Hand a datagram to the radio of a vehicle.

        Args:
            door: whose `Door.deliver` is called when it arrives.
            sender: row of the vehicle.
            to: row of the only one meant, or `BROADCAST`.
            payload: at most `LARGEST` bytes; its length is the payload size that the channel reckons with.
            came_ns: when it came, on ``time.monotonic_ns()``; None: now.

        Returns:
            Whether there was room. If not, nothing was taken: the vehicle has sent more than the run has dealt with; stop
            reading from this program for some milliseconds, or drop the datagram and `count` it.
        """

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        """Count what was not handed over, or not delivered, in words for the user: "longer than mtu_bytes"."""

    def level_dbm(self, sender: int, receiver: int) -> float:
        """The mean level of one vehicle's radio at another's, as of the last tenth of a second; NaN: not known yet."""


class Door(Protocol):
    """A class of this kind is named by a table ``[bridge.KIND]``, whose keys are its constructor parameters.

    It may also have a method ``lost(sender, receiver, payload)``: nothing is to come of what was for one vehicle alone.

    An attribute ``only_one = True`` says that a run can have no second one of the class.

    It is built twice: in the run, which only checks it, and in the bridge's process, which opens it. Constructors open nothing.
    """

    def check(self, vehicles: Sequence[str]) -> None:
        """Refuse what cannot be, with a `ValueError` that names the key: a vehicle that there is not, two equal ports, ..."""

    async def open(self, hall: Hall) -> Sequence[str]:
        """Open sockets or whatever it has; the answer is lines that tell a user where what is.

        Raises:
            DoorError: it cannot be had: a port in use, no rights.
        """

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Give a program of ``receiver`` what its radio received, without waiting; who does not take it, loses it, counted."""

    async def close(self) -> None:
        """Let go of everything; called once, also where `open` failed half-way."""


def address(key: str, host: str) -> str:
    """The numbers of an address; a `ScenarioError` names the key."""
    try:
        return str(ipaddress.ip_address("127.0.0.1" if host == "localhost" else host))
    except ValueError:
        raise ScenarioError(f"must be an IPv4 or IPv6 address, not {host!r}", key=key) from None


def check_names(key: str, names: Iterable[str], vehicles: Sequence[str], what: str = "vehicle") -> None:
    """Refuse names that no vehicle has which may be named, with a `ValueError`.

    Args:
        key: where they stand.
        names: of vehicles.
        vehicles: that may be named there.
        what: such a vehicle is called.
    """
    for name in names:
        if name not in vehicles:
            raise ValueError(f"{key}: {unknown(what, name, vehicles)}")


def check_listen(host: str, *, insecure: bool, instead: str) -> None:
    """Refuse to listen where other machines reach it, with a `ValueError`, unless the user has said that they may.

    Args:
        host: address, under the key ``listen``.
        insecure: the user has.
        instead: what to do else.
    """
    if not insecure and not is_loopback(host):
        problem = f"listen: {host} lets in everybody who can reach that address"
        raise ValueError(f"{problem}: {instead}, or add insecure = true where you trust everybody")
