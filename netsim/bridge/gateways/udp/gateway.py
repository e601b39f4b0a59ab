"""Plain UDP: programs send to ports of this machine instead of to each other, and hear what their vehicle's radio receives.

What comes to a vehicle's broadcast port, its radio broadcasts; what comes to its port for another vehicle, it sends to that
one. A program gets what arrives from the port by which an answer goes back to the sender: programs that answer to where a
question came from need not know of any of this.
"""

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Mapping, Sequence

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Name
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, Bytes, Door, DoorError, Hall, Port, check_listen
from vcmvsp.netsim.bridge.gateways.udp.ports import Place, PortPlan, Ports

AT_ONCE = 64  # datagrams of a socket, before others have their turn
PAUSE_S = 0.002  # for which a socket is left alone whose vehicle has sent more than the run has dealt with
BUFFER_BYTES = 8 * 2**20  # of a socket, if the operating system allows it
MOST_TOLD = 6  # ports of a vehicle

_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_MEMINFO = 33, 35, 55  # of Linux; Python names none of them
_TRUNCATED = int(socket.MSG_TRUNC)  # an enumeration's members are slow to compare
_STAMP = struct.Struct("@qq")  # a timespec
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)
_MEMINFO = struct.Struct("@9I")
_DROPS = 8  # its last: what the socket had no room for, so far


class Udp:
    """UDP sockets for the programs of each vehicle.

    The first vehicle of the run has the ports ``first_port`` to ``first_port + 99``, the next the hundred after them, and so
    on; at most 98 vehicles have such blocks. By default all of these are below 32768, from where on Linux gives ports away to
    whoever asks for any (``net.ipv4.ip_local_port_range``)::

        + 0      what comes here, its radio broadcasts
        + 1 + j  what comes here, it sends to vehicle j (counted from 0)
        + 99     what it receives is sent to this port of ``receive_host``, which its program binds

    Args:
        listen: address of this machine at which the sockets are; IPv4 or IPv6.
        insecure: ``listen`` may be reached from other machines, by anybody: there are no passwords and no encryption.
        first_port: of the first vehicle.
        vehicles: whose programs take part; none named: all.
        ports: for vehicles that are to have others, by name: ``send``, ``receive`` and ``unicast``.
        receive_host: address at which the programs are.
        max_bytes: what is longer is counted, not sent: a datagram is one frame.
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
        self._lines: dict[tuple[int, int], Line] = {}  # by vehicle and whom it is for
        self._programs: dict[int, Place] = {}

    def check(self, vehicles: Sequence[str]) -> None:
        """Refuse vehicles that there are not, ports that would be two things, and sockets for everybody by mistake."""
        self._plan.check(vehicles)
        check_listen(self._plan.listen, insecure=self._insecure, instead="listen at 127.0.0.1")

    async def open(self, hall: Hall) -> Sequence[str]:
        """Bind all sockets."""
        self._hall = hall
        for (row, to), port in self._plan.sending(hall.vehicles).items():
            self._lines[row, to] = Line(hall, self, row, to, _bound(self._plan.listen, port), self._max_bytes)
        self._programs = self._plan.receiving(hall.vehicles)
        for line in self._lines.values():
            line.listen()
        return [self._told(row) for row in self._programs]

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Send it to the receiver's program, from where an answer goes back."""
        if receiver not in self._programs:
            return  # no program of this vehicle takes part
        try:
            self._lines[receiver, sender].socket.sendto(payload, self._programs[receiver])
        except OSError as error:
            self._hall.count(receiver, f"not taken by the operating system ({error.strerror})")

    async def close(self) -> None:
        """Close all sockets."""
        for line in self._lines.values():
            line.close()
        self._lines.clear()

    def _told(self, row: int) -> str:
        vehicles, place = self._hall.vehicles, self._programs[row]
        others = [f"{line.port} to {vehicles[to]}" for (own, to), line in self._lines.items() if own == row and to != BROADCAST]
        if len(others) > MOST_TOLD:
            others[MOST_TOLD - 2 : -1] = ["..."]
        ports = ", ".join([f"{self._lines[row, BROADCAST].port} to all", *others])
        return f"{vehicles[row]} sends at {self._plan.listen} port {ports}; hears at {place.host} port {place.port}"


class Line:
    """One of the sockets.

    Args:
        hall: takes what comes.
        door: of which it is a part.
        row: of the vehicle that sends it.
        to: row of the one that is meant, or `BROADCAST`.
        bound: the socket.
        max_bytes: of a datagram.
    """

    def __init__(self, hall: Hall, door: Door, row: int, to: int, bound: socket.socket, max_bytes: int) -> None:
        self.socket, self.port = bound, int(bound.getsockname()[1])
        self._hall, self._door, self._row, self._to, self._max_bytes = hall, door, row, to, max_bytes
        self._refused: tuple[bytes, int] | None = None  # what there was no room for, and when it came
        self._dropped = 0

    def listen(self) -> None:
        """Take what comes."""
        self._hall.loop.add_reader(self.socket.fileno(), self._read)

    def close(self) -> None:
        """Take nothing any more."""
        self._hall.loop.remove_reader(self.socket.fileno())
        self._count_dropped()
        self.socket.close()

    def _read(self) -> None:
        receive, most = self.socket.recvmsg, self._max_bytes
        ahead_ns = time.time_ns() - time.monotonic_ns()  # of the clock that stamps
        for _ in range(AT_ONCE):
            try:
                payload, stamps, flags, _ = receive(most, _STAMP_SPACE)
            except BlockingIOError:
                return
            if flags & _TRUNCATED:
                self._hall.count(self._row, "longer than max_bytes")
                continue
            seconds, ns = _STAMP.unpack(stamps[0][2])
            came_ns = seconds * SECOND_NS + ns - ahead_ns
            if not self._hall.offer(self._door, self._row, self._to, payload, came_ns=came_ns):
                self._refused = payload, came_ns
                self._hall.loop.remove_reader(self.socket.fileno())  # what else comes, the operating system keeps
                self._hall.loop.call_later(PAUSE_S, self._go_on)
                return

    def _go_on(self) -> None:
        """Offer again what was refused; if there is room now, take what has come since."""
        if self._refused is None or self.socket.fileno() < 0:
            return
        payload, came_ns = self._refused
        if self._hall.offer(self._door, self._row, self._to, payload, came_ns=came_ns):
            self._refused = None
            self._count_dropped()
            self.listen()
        else:
            self._hall.loop.call_later(PAUSE_S, self._go_on)

    def _count_dropped(self) -> None:
        """Count what the operating system had no room for: the vehicle sent more than the run can deal with."""
        dropped = _MEMINFO.unpack(self.socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))[_DROPS]
        if dropped != self._dropped:
            self._hall.count(self._row, "dropped by the operating system", (dropped - self._dropped) % 2**32)
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
        advice = _ADVICE.get(error.errno or 0, "give other ports").format(port=port)
        raise DoorError(f"port {port} of {host} cannot be had ({error.strerror}); {advice}") from error
    return opened


_ADVICE = {
    errno.EADDRINUSE: "`ss -ulnp 'sport = :{port}'` says who has it, perhaps another run: end that, or give another first_port",
    errno.EADDRNOTAVAIL: "listen must be an address of this machine",
    errno.EACCES: "ports below 1024 need rights: give others",
    errno.EMFILE: "there is a socket for each pair of vehicles: allow more open files (ulimit -n), or name fewer vehicles",
}
