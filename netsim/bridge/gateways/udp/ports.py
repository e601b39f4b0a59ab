"""Which UDP port is what, for every vehicle."""

import ipaddress
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Name
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, HIGHEST, Port, address, check_names

BLOCK = 100
UNICAST, RECEIVE = 1, 99
MOST_VEHICLES = RECEIVE - UNICAST

_ELSEWHERE = "give this machine's address, and insecure = true"


class Ports(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[bridge.udp.ports.VEHICLE]``: other ports than those of its block."""

    send: Port | None = None  # what comes there, its radio broadcasts
    receive: str | None = None  # HOST:PORT or [HOST]:PORT: where what its radio receives is sent to
    unicast: Mapping[Name, Port] = {}  # by vehicle: what comes there, is for that one


class Place(NamedTuple):
    """Where a program is."""

    host: str
    port: int


class PortPlan:
    """All ports of the vehicles whose programs take part; see `netsim.bridge.gateways.udp.gateway.Udp` for the arguments.

    Raises:
        ScenarioError: an address that is none.
    """

    def __init__(
        self, listen: str, first_port: int, vehicles: Sequence[str], ports: Mapping[str, Ports], receive_host: str
    ) -> None:
        self.listen = address("listen", listen)
        self._receive_host = address("receive_host", receive_host)
        self._first_port, self._bridged, self._ports = first_port, tuple(vehicles), dict(ports)
        self._places = {
            name: _place(f"ports.{name}.receive", own.receive) for name, own in ports.items() if own.receive is not None
        }

    def rows(self, vehicles: Sequence[str]) -> list[int]:
        """Of the vehicles whose programs take part."""
        return [row for row, name in enumerate(vehicles) if not self._bridged or name in self._bridged]

    def sending(self, vehicles: Sequence[str]) -> dict[tuple[int, int], int]:
        """The port of each of them for each other vehicle, and for `BROADCAST`."""
        found = {}
        for row in self.rows(vehicles):
            own, first = self._ports.get(vehicles[row], Ports()), self._first_port + BLOCK * row
            found[row, BROADCAST] = own.send or first
            for to, name in enumerate(vehicles):
                if to != row:
                    found[row, to] = own.unicast.get(name, first + UNICAST + to)
        return found

    def receiving(self, vehicles: Sequence[str]) -> dict[int, Place]:
        """Where the program of each of them is."""
        return {
            row: self._places.get(vehicles[row], Place(self._receive_host, self._first_port + BLOCK * row + RECEIVE))
            for row in self.rows(vehicles)
        }

    def check(self, vehicles: Sequence[str]) -> None:
        """Refuse vehicles that there are not, and ports that would be two things, by a ``ValueError``."""
        check_names("vehicles", self._bridged, vehicles)
        check_names("ports", self._ports, vehicles)
        for vehicle, own in self._ports.items():
            others = [name for name in vehicles if name != vehicle]
            check_names(f"ports.{vehicle}.unicast", own.unicast, others, "other vehicle")
        if len(vehicles) > MOST_VEHICLES:
            most = f"a run with UDP ports has {MOST_VEHICLES} at most, whoever takes part"
            raise ValueError(f"there are {len(vehicles)} vehicles; {most}: use [bridge.ip] or [bridge.zenoh]")
        sending = self._check_sending(vehicles)
        for row, place in self.receiving(vehicles).items():
            self._check_receiving(vehicles[row], place, sending)

    def _check_sending(self, vehicles: Sequence[str]) -> set[int]:
        taken: set[int] = set()
        for (row, _), port in self.sending(vehicles).items():
            if port > HIGHEST:
                raise ValueError(f"first_port: {self._first_port} leads to port {port}; the last is {HIGHEST}")
            if port in taken:
                raise ValueError(f"ports: {port} of {vehicles[row]} would be two things")
            taken.add(port)
        return taken

    def _check_receiving(self, vehicle: str, place: Place, sending: set[int]) -> None:
        here, there = ipaddress.ip_address(self.listen), ipaddress.ip_address(place.host)
        if here.version != there.version:
            raise ValueError(f"listen: from {here} nothing can be sent to {there} of {vehicle}: give addresses of one kind")
        if here.is_loopback and not there.is_loopback:
            raise ValueError(f"listen: from {here} nothing can be sent to {there} of {vehicle}: {_ELSEWHERE}")
        if place.port > HIGHEST:
            raise ValueError(f"first_port: {self._first_port} leads to port {place.port}; the last is {HIGHEST}")
        if place.port in sending and (here == there or here.is_unspecified):
            raise ValueError(f"ports: {vehicle} would receive at port {place.port}, which is one to send to")


def _place(key: str, text: str) -> Place:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not port.isascii() or not 1 <= int(port) <= HIGHEST:
        raise ScenarioError(f"must be HOST:PORT, not {text!r}", key=key)
    return Place(address(key, host.removeprefix("[").removesuffix("]")), int(port))
