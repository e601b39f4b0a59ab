"""Assignment of UDP ports to vehicles."""

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

    send: Port | None = None  # datagrams sent here are broadcast
    receive: str | None = None  # HOST:PORT or [HOST]:PORT: destination of the datagrams that the vehicle receives
    unicast: Mapping[Name, Port] = {}  # by vehicle: datagrams sent here go to that vehicle


class ProgramAddress(NamedTuple):
    """Address of a program."""

    host: str
    port: int


class PortPlan:
    """All ports of the vehicles with sockets; arguments: see `netsim.bridge.gateways.udp.gateway.Udp`.

    Raises:
        ScenarioError: an invalid address.
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
        """Rows of the vehicles with sockets."""
        return [row for row, name in enumerate(vehicles) if not self._bridged or name in self._bridged]

    def sending(self, vehicles: Sequence[str]) -> dict[tuple[int, int], int]:
        """The port of each of these rows for each destination, a row or `BROADCAST`."""
        ports = {}
        for row in self.rows(vehicles):
            own, first = self._ports.get(vehicles[row], Ports()), self._first_port + BLOCK * row
            ports[row, BROADCAST] = own.send or first
            for to, name in enumerate(vehicles):
                if to != row:
                    ports[row, to] = own.unicast.get(name, first + UNICAST + to)
        return ports

    def receiving(self, vehicles: Sequence[str]) -> dict[int, ProgramAddress]:
        """Address of the program of each of these rows."""
        return {
            row: self._places.get(vehicles[row], ProgramAddress(self._receive_host, self._first_port + BLOCK * row + RECEIVE))
            for row in self.rows(vehicles)
        }

    def check(self, vehicles: Sequence[str]) -> None:
        """Raise a `ValueError` for unknown vehicles and for conflicting ports."""
        check_names("vehicles", self._bridged, vehicles)
        check_names("ports", self._ports, vehicles)
        for vehicle, own in self._ports.items():
            others = [name for name in vehicles if name != vehicle]
            check_names(f"ports.{vehicle}.unicast", own.unicast, others, "other vehicle")
        if len(vehicles) > MOST_VEHICLES:
            most = f"a run with UDP ports has {MOST_VEHICLES} at most"
            raise ValueError(f"there are {len(vehicles)} vehicles; {most}: use [bridge.ip] or [bridge.zenoh]")
        sending = self._check_sending(vehicles)
        for row, place in self.receiving(vehicles).items():
            self._check_receiving(vehicles[row], place, sending)

    def _check_sending(self, vehicles: Sequence[str]) -> set[int]:
        used: set[int] = set()
        for (row, _), port in self.sending(vehicles).items():
            if port > HIGHEST:
                raise ValueError(f"first_port: {self._first_port} leads to port {port}; the last is {HIGHEST}")
            if port in used:
                raise ValueError(f"ports: {port} of {vehicles[row]} is used twice")
            used.add(port)
        return used

    def _check_receiving(self, vehicle: str, place: ProgramAddress, sending: set[int]) -> None:
        here, there = ipaddress.ip_address(self.listen), ipaddress.ip_address(place.host)
        if here.version != there.version:
            raise ValueError(f"listen: from {here} nothing can be sent to {there} of {vehicle}: give addresses of one kind")
        if here.is_loopback and not there.is_loopback:
            raise ValueError(f"listen: from {here} nothing can be sent to {there} of {vehicle}: {_ELSEWHERE}")
        if place.port > HIGHEST:
            raise ValueError(f"first_port: {self._first_port} leads to port {place.port}; the last is {HIGHEST}")
        if place.port in sending and (here == there or here.is_unspecified):
            raise ValueError(f"ports: {vehicle} would receive at port {place.port}, which is one to send to")


def _place(key: str, text: str) -> ProgramAddress:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not port.isascii() or not 1 <= int(port) <= HIGHEST:
        raise ScenarioError(f"must be HOST:PORT, not {text!r}", key=key)
    return ProgramAddress(address(key, host.removeprefix("[").removesuffix("]")), int(port))
