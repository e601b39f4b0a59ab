"""UDP gateway: programs send to ports of this machine, and receive the datagrams that their vehicle's radio receives.

A vehicle has a port for broadcasts and one for each other vehicle (`PortPlan`). A program receives a datagram from the port
that leads back to its sender, so programs that reply to the source address work unchanged.
"""

import contextlib
import errno
import ipaddress
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Name
from vcmvsp.netsim.bridge.gateways.base import (
    BROADCAST,
    HIGHEST,
    Bytes,
    Gateway,
    GatewayContext,
    GatewayError,
    Port,
    address,
    check_listen,
    check_names,
)

BLOCK = 100
UNICAST, RECEIVE = 1, 99
MOST_VEHICLES = RECEIVE - UNICAST

_ELSEWHERE = "set listen to this machine's address, and insecure = true"

AT_ONCE = 64  # datagrams of a socket before the next socket
PAUSE_S = 0.002  # without reading from a socket when the run has no room
BUFFER_BYTES = 8 * 2**20  # of a socket, if the operating system allows it
MOST_SHOWN = 6  # ports of a vehicle

_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_MEMINFO = 33, 35, 55  # of Linux; Python names none of them
_TRUNCATED = int(socket.MSG_TRUNC)  # an enumeration's members are slow to compare
_STAMP = struct.Struct("@qq")  # a timespec
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)
_MEMINFO = struct.Struct("@9I")
_DROPS = 8  # index of the datagrams dropped so far

_ADVICE = {
    errno.EADDRINUSE: "`ss -ulnp 'sport = :{port}'` shows the program on it, perhaps another run: end that, or set first_port",
    errno.EADDRNOTAVAIL: "listen must be an address of this machine",
    errno.EACCES: "ports below 1024 need root: set first_port to 1024 or more",
    errno.EMFILE: "each pair of vehicles needs a socket: allow more open files (ulimit -n), or list fewer vehicles",
}


class Ports(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[bridge.udp.ports.VEHICLE]``: ports of a vehicle that replace the defaults."""

    send: Port | None = None  # datagrams sent here are broadcast
    receive: str | None = None  # HOST:PORT or [HOST]:PORT: destination of the datagrams that the vehicle receives
    unicast: Mapping[Name, Port] = {}  # by vehicle: datagrams sent here go to that vehicle


class ProgramAddress(NamedTuple):
    """Address of a program."""

    host: str
    port: int


class PortPlan:
    """All ports of the vehicles with sockets; arguments: see `netsim.bridge.gateways.udp.Udp`.

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
            problem = f"{len(vehicles)} vehicles are too many for UDP ports (at most {MOST_VEHICLES})"
            raise ValueError(f"{problem}: use [bridge.ip] or [bridge.zenoh]")
        sending = self._check_sending(vehicles)
        for row, place in self.receiving(vehicles).items():
            self._check_receiving(vehicles[row], place, sending)

    def _check_sending(self, vehicles: Sequence[str]) -> set[int]:
        used: set[int] = set()
        for (row, _), port in self.sending(vehicles).items():
            if port > HIGHEST:
                raise ValueError(f"first_port: {self._first_port} leads to port {port}, above the maximum {HIGHEST}")
            if port in used:
                raise ValueError(f"ports: {port} of {vehicles[row]} is assigned twice")
            used.add(port)
        return used

    def _check_receiving(self, vehicle: str, place: ProgramAddress, sending: set[int]) -> None:
        own, remote = ipaddress.ip_address(self.listen), ipaddress.ip_address(place.host)
        if own.version != remote.version:
            raise ValueError(f"listen: {own} cannot send to {remote} of {vehicle}: use IPv4 for both, or IPv6 for both")
        if own.is_loopback and not remote.is_loopback:
            raise ValueError(f"listen: {own} cannot send to {remote} of {vehicle}, another machine: {_ELSEWHERE}")
        if place.port > HIGHEST:
            raise ValueError(f"first_port: {self._first_port} leads to port {place.port}, above the maximum {HIGHEST}")
        if place.port in sending and (own == remote or own.is_unspecified):
            raise ValueError(f"ports: receive port {place.port} of {vehicle} is also a port to send to; choose another one")


def _place(key: str, text: str) -> ProgramAddress:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not port.isascii() or not 1 <= int(port) <= HIGHEST:
        raise ScenarioError(f"must be HOST:PORT, not {text!r}", key=key)
    return ProgramAddress(address(key, host.removeprefix("[").removesuffix("]")), int(port))


class Udp:
    """UDP sockets for the programs of each vehicle.

    The first vehicle of the run has the ports ``first_port`` to ``first_port + 99``, the next the hundred after them, and so
    on, for at most 98 vehicles. By default all are below 32768, the first ephemeral port of Linux
    (``net.ipv4.ip_local_port_range``)::

        + 0      datagrams sent here are broadcast
        + 1 + j  datagrams sent here go to vehicle j (counted from 0)
        + 99     datagrams that the vehicle receives go to this port of ``receive_host``; its program binds it

    Args:
        listen: address of this machine for the sockets; IPv4 or IPv6.
        insecure: allow a ``listen`` address that other machines reach; there are no passwords and no encryption.
        first_port: of the first vehicle.
        vehicles: vehicles with sockets; empty: all.
        ports: other ports, by vehicle: ``send``, ``receive`` and ``unicast``.
        receive_host: address of the programs.
        max_bytes: longest datagram; a longer one is counted and not sent.
    """

    def __init__(
        self,
        listen: str = "127.0.0.1",
        insecure: bool = False,
        first_port: Port = 18_000,
        vehicles: tuple[Name, ...] = (),
        ports: Mapping[Name, Ports] | None = None,
        receive_host: str = "127.0.0.1",
        max_bytes: Bytes = 1472,
    ) -> None:
        self._plan = PortPlan(listen, first_port, vehicles, ports or {}, receive_host)
        self._insecure = insecure
        self._max_bytes = max_bytes
        self._sockets: dict[tuple[int, int], UdpSocket] = {}  # by vehicle and destination
        self._programs: dict[int, ProgramAddress] = {}

    def check(self, vehicles: Sequence[str]) -> None:
        """Check vehicles, ports and addresses."""
        self._plan.check(vehicles)
        check_listen(self._plan.listen, insecure=self._insecure, instead="listen at 127.0.0.1")

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Bind all sockets."""
        self._context = context
        for (row, to), port in self._plan.sending(context.vehicles).items():
            self._sockets[row, to] = UdpSocket(context, self, row, to, _bound(self._plan.listen, port), self._max_bytes)
        self._programs = self._plan.receiving(context.vehicles)
        for each in self._sockets.values():
            each.listen()
        return [self._description(row) for row in self._programs]

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Send to the receiver's program, from the port that leads back to the sender."""
        if receiver not in self._programs:
            return
        try:
            self._sockets[receiver, sender].socket.sendto(payload, self._programs[receiver])
        except OSError as error:
            self._context.count(receiver, f"not taken by the operating system ({error.strerror})")

    async def close(self) -> None:
        """Close all sockets."""
        for each in self._sockets.values():
            each.close()
        self._sockets.clear()

    def _description(self, row: int) -> str:
        vehicles, program = self._context.vehicles, self._programs[row]
        own = [(to, each.port) for (sender, to), each in self._sockets.items() if sender == row and to != BROADCAST]
        others = [f"{port} to {vehicles[to]}" for to, port in own]
        if len(others) > MOST_SHOWN:
            others[MOST_SHOWN - 2 : -1] = ["..."]
        ports = ", ".join([f"{self._sockets[row, BROADCAST].port} to all", *others])
        return f"{vehicles[row]} sends at {self._plan.listen} port {ports}; hears at {program.host} port {program.port}"


class UdpSocket:
    """A bound socket: datagrams that it receives go from the vehicle ``row`` to the row ``to`` or to `BROADCAST`."""

    def __init__(
        self, context: GatewayContext, gateway: Gateway, row: int, to: int, bound: socket.socket, max_bytes: int
    ) -> None:
        self.socket, self.port = bound, int(bound.getsockname()[1])
        self._context, self._gateway, self._row, self._to, self._max_bytes = context, gateway, row, to, max_bytes
        self._refused: tuple[bytes, int] | None = None  # datagram without room in the run, and its time
        self._dropped = 0

    def listen(self) -> None:
        """Start to read."""
        self._context.loop.add_reader(self.socket.fileno(), self._read)

    def close(self) -> None:
        """Stop to read and close."""
        self._context.loop.remove_reader(self.socket.fileno())
        self._count_dropped()
        self.socket.close()

    def _read(self) -> None:
        receive, most = self.socket.recvmsg, self._max_bytes
        ahead_ns = _wall_clock_ahead_ns()  # time stamps are of the wall clock
        for _ in range(AT_ONCE):
            try:
                payload, stamps, flags, _ = receive(most, _STAMP_SPACE)
            except BlockingIOError:
                return
            if flags & _TRUNCATED:
                self._context.count(self._row, "longer than max_bytes")
                continue
            seconds, ns = _STAMP.unpack(stamps[0][2])
            came_ns = seconds * SECOND_NS + ns - ahead_ns
            if not self._context.offer(self._gateway, self._row, self._to, payload, came_ns=came_ns):
                self._refused = payload, came_ns
                self._context.loop.remove_reader(self.socket.fileno())  # the socket's buffer keeps later datagrams
                self._context.loop.call_later(PAUSE_S, self._go_on)
                return

    def _go_on(self) -> None:
        if self._refused is None or self.socket.fileno() < 0:
            return
        payload, came_ns = self._refused
        if self._context.offer(self._gateway, self._row, self._to, payload, came_ns=came_ns):
            self._refused = None
            self._count_dropped()
            self.listen()
        else:
            self._context.loop.call_later(PAUSE_S, self._go_on)

    def _count_dropped(self) -> None:
        """Count datagrams that the operating system dropped because the socket's buffer was full."""
        dropped = _MEMINFO.unpack(self.socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))[_DROPS]
        if dropped != self._dropped:
            self._context.count(self._row, "dropped by the operating system", (dropped - self._dropped) % 2**32)
            self._dropped = dropped


def _bound(host: str, port: int) -> socket.socket:
    opened: socket.socket | None = None
    try:
        opened = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        with contextlib.suppress(PermissionError):
            opened.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, BUFFER_BYTES)
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        opened.bind((host, port))
    except OSError as error:
        if opened is not None:
            opened.close()
        advice = _ADVICE.get(error.errno or 0, "choose other ports").format(port=port)
        raise GatewayError(f"port {port} of {host} cannot be opened ({error.strerror}); {advice}") from error
    return opened


def _wall_clock_ahead_ns() -> int:
    """Wall clock minus monotonic clock: the quickest of three readings, as the process may be held up within one."""
    readings = []
    for _ in range(3):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, wall_ns - before_ns))
    return min(readings)[1]
