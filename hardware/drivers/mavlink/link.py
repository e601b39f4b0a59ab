"""Link to a vehicle: UDP, TCP or a serial port, by the addresses of pymavlink and MAVSDK.

An open UDP port accepts bytes from any sender: bytes come with their source, and answers go to one source.
"""

import contextlib
import re
import socket
from typing import Any

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.transport.endpoints import check_interfaces
from vcmvsp.cosim.types import Value
from vcmvsp.hardware.drivers.base import HandshakeError, PortError
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.protocol import Autopilot, Kind, Message, MessageReader, Sender, mavlink, type_name

DATAGRAM = 65_535
DATAGRAMS = 100  # in one read
SOURCES = 32  # known while the vehicle is searched; a new one replaces the oldest
_ADVICE = "write udpin:127.0.0.1:14540, udpout:HOST:PORT, tcp:HOST:PORT or a serial port such as /dev/ttyACM0"
_NETWORK = re.compile(r"(udpin|udpout|tcp|socket)(?:://|:|/)(\[[0-9a-fA-F:.]+\]|[^:/\[\]]+):(\d{1,5})")
Chunks = list[tuple[str, bytes]]  # source, bytes


class StreamLink:
    """A serial port or a TCP connection, with one other side. `read` and `write` raise `LinkLost` when that is gone."""

    def __init__(self, line: ByteLink) -> None:
        self._line = line
        self.fileno, self.write, self.close = line.fileno, line.write, line.close

    def read(self) -> Chunks:
        """Available bytes; call it when select reports some."""
        return [("", self._line.read())]

    def answer(self, source: str) -> None:
        """No effect: there is one source only."""


class UdpLink:
    """A UDP port. One that listens sends nothing before `answer`; one that does not receives from its target only."""

    def __init__(self, address: str, host: str, port: int, *, listens: bool) -> None:
        self._source = ""
        self._sources: dict[str, Any] = {}  # addresses of the operating system
        self._connected = not listens
        try:
            family, _, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except OSError as error:
            raise PortError(address, f"no address ({error.strerror or error})", "check host name and network") from None
        self.fileno, self.close = self._socket.fileno, self._socket.close
        try:
            self._socket.setblocking(False)
            (self._socket.bind if listens else self._socket.connect)(where)
        except OSError as error:
            self._socket.close()
            advice = "close the other program that has it open, or choose another port" if listens else "check the network"
            raise PortError(address, error.strerror or str(error), advice) from None

    def read(self) -> Chunks:
        """Datagrams that are there, with their sources."""
        chunks: Chunks = []
        for _ in range(DATAGRAMS):
            try:
                data, where = self._socket.recvfrom(DATAGRAM)
            except ConnectionRefusedError:  # the target does not listen yet
                continue
            except OSError:  # no more datagrams
                break
            source = "" if self._connected else f"{where[0]}:{where[1]}"
            if self._source in ("", source):
                chunks.append((source, data))
                self._sources[source] = where
                if len(self._sources) > SOURCES:
                    del self._sources[next(iter(self._sources))]
        return chunks

    def answer(self, source: str) -> None:
        """Exchange bytes with this source only from now on."""
        self._source = source

    def write(self, data: bytes) -> None:
        """Send to the source of `answer`, if there is one; datagrams may be lost."""
        with contextlib.suppress(OSError):
            if self._connected:
                self._socket.send(data)
            elif (to := self._sources.get(self._source)) is not None:
                self._socket.sendto(data, to)


MavlinkLink = StreamLink | UdpLink


def open_link(address: str, baud: int, *, insecure: bool = False) -> MavlinkLink:
    """Open ``udpin:HOST:PORT`` (wait there), ``udpout:HOST:PORT`` (send first), ``tcp:HOST:PORT`` or a serial port.

    ``/`` and ``://`` mean the first ``:``.

    Raises:
        PortError: it cannot be opened.
    """
    match = _NETWORK.fullmatch(address)
    if match is None:
        if ":" in address or not address:
            raise PortError(address or "''", "not an address", _ADVICE)
        return StreamLink(open_line(address, baud))
    scheme, host, port = match[1], match[2].strip("[]"), int(match[3])
    if not 0 < port < 65_536:
        raise PortError(address, f"invalid port {port}", "ports are from 1 to 65535")
    if scheme in ("tcp", "socket"):
        return StreamLink(open_line(f"socket://{match[2]}:{port}", baud))
    if scheme == "udpin":
        try:
            check_interfaces(host, insecure=insecure)
        except ValueError as error:
            problem, _, advice = str(error).partition(": ")
            raise PortError(address, problem, advice) from None
    return UdpLink(address, host, port, listens=scheme == "udpin")


LISTEN_S = 1.5  # after the first vehicle, for another; heartbeats come once a second
READERS = 32  # maximum number of sources


class Peer(Value, frozen=True, kw_only=True):
    """The vehicle at the other end of a link."""

    sender: Sender
    source: str
    vehicle_type: int
    autopilot: Autopilot
    heartbeat: Message  # the newest

    @property
    def on_ground(self) -> bool:
        """Whether it is a ground vehicle or a boat: velocities are in its body frame."""
        return self.vehicle_type in protocol.GROUND

    @property
    def name(self) -> str:
        """Name of the vehicle in messages."""
        return f"system {self.sender.system}: {type_name(self.vehicle_type)} with {self.autopilot.name}"


class VehicleSearch:
    """Search for the vehicle by its heartbeats; each mismatch has its own error. It has no clock and no link.

    ``system_id`` 0: the only one; ``kind`` None: the autopilot of its heartbeat.
    """

    def __init__(self, device: str, system_id: int, kind: Kind | None) -> None:
        self._device, self._system_id, self._kind = device, system_id, kind
        self._readers: dict[str, MessageReader] = {}
        self._heartbeats: dict[tuple[Sender, str], Message] = {}  # newest heartbeat by sender and source
        self._others: dict[int, str] = {}  # other systems
        self._first_ns = 0
        self._received_bytes = 0

    def receive(self, chunks: Chunks, now_ns: int) -> Peer | None:
        """Process bytes; the vehicle, if it is determined now."""
        for source, data in chunks:
            self._received_bytes += len(data)
            reader = self._readers.setdefault(source, MessageReader())
            if len(self._readers) > READERS:
                del self._readers[next(iter(self._readers))]
            for message in reader.feed(data):
                if message.get_type() == "HEARTBEAT":
                    self._take(message, source, now_ns)
        return self.decide(now_ns)

    def decide(self, now_ns: int) -> Peer | None:
        """The vehicle, if it is determined by now."""
        if not self._heartbeats or now_ns < self.due_ns:
            return None
        if len(self._heartbeats) > 1:
            systems = sorted({sender.system for sender, _ in self._heartbeats})
            if len(systems) == 1:
                happened = f"system {systems[0]} sends from more than one address"
                raise HandshakeError(self._device, happened, "give each vehicle its own system id or its own port")
            listed = f"{', '.join(map(str, systems[:-1]))} and {systems[-1]}"
            happened = f"systems {listed} speak here"
            raise HandshakeError(self._device, happened, f"choose one, e.g. system_id = {systems[0]}")
        ((sender, source), heartbeat), *_ = self._heartbeats.items()
        return self._peer(sender, source, heartbeat)

    @property
    def due_ns(self) -> int:
        """Time at which `decide` may have an answer; far away without a vehicle."""
        if not self._first_ns:
            return 1 << 62
        return self._first_ns + (0 if self._system_id else seconds_to_ns(LISTEN_S))

    def failure(self, waited_s: float) -> HandshakeError:
        """Error of a search without result."""
        waited = f"within {waited_s:g} s"
        if not self._received_bytes:
            return HandshakeError(self._device, f"no byte was received {waited}", self._advice())
        if not any(reader.messages for reader in self._readers.values()):
            happened = f"{self._received_bytes} bytes were received {waited}, but no MAVLink message"
            return HandshakeError(self._device, happened, "check baud and the connected device")
        if not self._others:
            happened = f"no heartbeat was received {waited}"
            return HandshakeError(self._device, happened, "let the autopilot send HEARTBEAT on this port")
        systems = ", ".join(f"system {each} ({self._others[each]})" for each in sorted(self._others))
        if self._system_id:
            happened = f"system {self._system_id} was not received {waited}, only {systems}"
            return HandshakeError(self._device, happened, "set system_id to the id of the vehicle, or switch the vehicle on")
        return HandshakeError(self._device, f"no vehicle was received {waited}, only {systems}", "switch the vehicle on")

    def _take(self, heartbeat: Message, source: str, now_ns: int) -> None:
        sender = protocol.sender_of(heartbeat)
        if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_INVALID or self._system_id not in (0, sender.system):
            if len(self._others) < READERS:
                self._others[sender.system] = type_name(heartbeat.type)
            return
        self._heartbeats[sender, source] = heartbeat
        self._first_ns = self._first_ns or now_ns

    def _peer(self, sender: Sender, source: str, heartbeat: Message) -> Peer:
        announced = protocol.KINDS.get(heartbeat.autopilot)
        kind = self._kind or announced
        if kind is None:
            happened = f"the autopilot of system {sender.system} is neither PX4 nor ArduPilot (number {heartbeat.autopilot})"
            raise HandshakeError(self._device, happened, 'if compatible with one, set autopilot = "px4" or "ardupilot"')
        if announced not in (None, kind):
            happened = f'system {sender.system} announces the autopilot "{announced}", not "{kind}"'
            raise HandshakeError(self._device, happened, 'correct the parameter autopilot, or leave it at "auto"')
        if heartbeat.type not in protocol.COPTERS | protocol.GROUND:
            happened = f"system {sender.system} is of type {type_name(heartbeat.type)}"
            raise HandshakeError(self._device, happened, "this driver is for multicopters, helicopters, rovers and boats")
        autopilot = protocol.autopilot_of(kind, heartbeat.type)
        return Peer(sender=sender, source=source, vehicle_type=heartbeat.type, autopilot=autopilot, heartbeat=heartbeat)

    def _advice(self) -> str:
        if self._device.startswith("udpin"):
            return "let the autopilot, its simulator or a MAVLink router send to this port"
        if ":" in self._device:
            return "check that the vehicle or its simulator is running, and that this is its port"
        return "check battery, cable and baud (often 57600 for radios, 115200 or 921600 for companion ports)"
