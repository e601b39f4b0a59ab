"""USARSim's Wireless Simulation Server (WSS) on the run's channel: programs written for it work unchanged.

Each robot opens a control connection, on which it registers the name of a vehicle and the ports on which it listens. It
requests the port through which it reaches another robot; connections to that port are relayed. Two robots have a link while
the mean level is at least the cutoff; otherwise their connections are closed and new ones are rejected.

A line of a control connection is ``KIND {Key value} {Key value}``, then CR LF, as in the manual of WSS. A value is one word; an
invalid line is answered, too.
"""

import asyncio
import contextlib
import itertools
import math
import re
import secrets
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from vcmvsp.netsim.bridge.gateways.base import HIGHEST, LARGEST, GatewayContext, GatewayError, Port, address, check_listen
from vcmvsp.netsim.bridge.gateways.wss_relay import HEADER, MOST_RELAYS, Pair, Relay, RelayPort

LONGEST_LINE = 4096  # bytes; a longer line ends the connection
MOST_PORTS = 16  # on which a robot may listen

_LINE = re.compile(r"([A-Z]+)((?:\s*\{[^{}\s]+(?:\s+[^{}\s]+)?\s*\})*)\s*", re.ASCII)
_FIELD = re.compile(r"\{([^{}\s]+)(?:\s+([^{}\s]+))?\s*\}", re.ASCII)
_PORT = re.compile(r"[0-9]{1,5}", re.ASCII)

LOOK_S = 0.1  # period of the link checks
TRIED = 100  # ports, in search of a free one
MOST_GUESTS = 64  # control connections without a registered robot; the oldest is closed

FirstPort = Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)]
ChunkBytes = Annotated[int, msgspec.Meta(gt=HEADER.size, le=LARGEST)]


class WssMessage(NamedTuple):
    """A message of a robot's program."""

    kind: str
    fields: dict[str, str]

    def robot(self) -> str:
        """Field ``Robot``; empty: none."""
        return self.fields.get("Robot", "")

    def port(self) -> int | None:
        """Field ``Port``; None: missing or invalid."""
        return _port(self.fields.get("Port", ""))

    def ports(self) -> tuple[int, ...] | None:
        """Field ``Port`` as a list without repetitions; None: missing, too long or invalid."""
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
    """A level (dBm) as text of the protocol; NaN and infinity are ``NaN`` and ``INF``."""
    return "NaN" if math.isnan(level_dbm) else f"{level_dbm:.6g}".replace("inf", "INF")


def _port(word: str) -> int | None:
    return int(word) if _PORT.fullmatch(word) and 0 < int(word) <= HIGHEST else None


@dataclass(frozen=True)
class RobotClient:
    """A vehicle with a control connection."""

    row: int
    host: str  # address of its program
    ports: tuple[int, ...]


class Wss:
    """Robots that speak USARSim's WSS protocol.

    Args:
        listen: address of this machine for control connections and relays.
        insecure: allow a ``listen`` address that other machines reach; the protocol has no passwords and no encryption.
        port: of the control connections.
        cutoff_dbm: the mean level below which there is no link.
        first_port: first port of relays; 0: any free ports.
        chunk_bytes: longest payload of a frame: a header of 8 bytes and the data of about one TCP segment.
    """

    def __init__(
        self,
        listen: str = "127.0.0.1",
        insecure: bool = False,
        port: Port = 50_000,
        cutoff_dbm: float = -93.0,
        first_port: FirstPort = 0,
        chunk_bytes: ChunkBytes = 1400,
    ) -> None:
        self._address, self._insecure, self._port, self._cutoff_dbm = address("listen", listen), insecure, port, cutoff_dbm
        self._first_port, self._chunk_bytes = first_port, chunk_bytes
        self._context: GatewayContext
        self._robots: dict[int, RobotClient] = {}  # by row
        self._gates: dict[Pair, RelayPort] = {}
        self._relays: dict[int, tuple[Relay, asyncio.Task[None]]] = {}
        self._relay_number = secrets.randbits(32)  # random, so that agents' messages are not taken for chunks
        self._guests: dict[asyncio.StreamWriter, None] = {}  # oldest first
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    def check(self, vehicles: Sequence[str]) -> None:
        """Check the address."""
        tunnel = "ssh -L (for port and for the ports from first_port on) and ssh -R (for ports of the robots)"
        check_listen(self._address, insecure=self._insecure, instead=f"listen at 127.0.0.1 and use {tunnel}")

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Serve robots."""
        self._context = context
        try:
            server = await asyncio.start_server(self._on_control, self._address, self._port, limit=LONGEST_LINE)
        except OSError as problem:
            why = f"cannot serve robots at {self._address} port {self._port}: {problem.strerror}"
            raise GatewayError(f"{why}; end the program that uses the port, or set another port") from problem
        self._server = server
        self._tasks.add(context.loop.create_task(self._look_on()))
        context.level_dbm(0, 0)  # first request, so that levels are known when the first robot needs them
        return [f"robots connect to {self._address} port {self._port} (USARSim WSS); no link below {self._cutoff_dbm:g} dBm"]

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Pass a chunk to its relay; other payloads are not for robots."""
        if len(payload) >= HEADER.size:
            number, place = HEADER.unpack_from(payload)
            if relay := self._relay(number, sender, receiver):
                relay.streams[sender].deliver(place, payload[HEADER.size :])

    def lost(self, sender: int, receiver: int, payload: bytes) -> None:
        """Report a lost chunk to its relay."""
        number, place = HEADER.unpack_from(payload)
        if relay := self._relay(number, sender, receiver):
            self._context.count(sender, "chunks of connections sent again")
            relay.streams[sender].lost(place)

    async def close(self) -> None:
        """Close all connections."""
        tasks = [*self._tasks, *(task for _, task in self._relays.values())]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._server is not None:
            self._server.close()
        for gate in self._gates.values():
            gate.close()

    # --- the control connection ---------------------------------------------------------------------------------------------

    def _on_control(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = self._context.loop.create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._guests[writer] = None
        if len(self._guests) > MOST_GUESTS:
            next(iter(self._guests)).transport.abort()
        robot = None
        try:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):  # it has left
                _notice_death(writer.get_extra_info("socket"))
                host = writer.get_extra_info("peername")[0]
                while True:
                    message = parse(await reader.readuntil(b"\n"))
                    if robot is None:
                        robot, answer = self._greet(message, host)
                        if robot is not None:
                            self._guests.pop(writer, None)
                    else:
                        answer = self._answer(message, robot)
                    writer.write(answer)
                    await writer.drain()  # no further request from a robot that does not read
        except asyncio.LimitOverrunError:
            writer.write(error("Line.Too.Long"))
        finally:
            self._guests.pop(writer, None)
            transport = writer.transport
            transport.abort() if transport.get_write_buffer_size() else transport.close()
            if robot is not None:
                del self._robots[robot.row]
                self._look()

    def _greet(self, message: WssMessage | None, host: str) -> tuple[RobotClient | None, bytes]:
        if message is None:
            return None, error("Message.Not.Understood")
        if message.kind != "INIT":
            return None, error("Must.Use.INIT.Method.First")
        ports, row = message.ports(), self._row(message.robot())
        reason = ""
        if ports is None:
            reason = "Ports.List.Must.Be.Integer"
        elif not message.robot():
            reason = "Robot.Name.Must.Not.Be.Empty"
        elif row is None:
            reason = "No.Such.Vehicle"
        elif row in self._robots:
            reason = "Robot.Already.Exists"
        if reason or row is None or ports is None:
            return None, error(reason)
        robot = self._robots[row] = RobotClient(row, host, ports)
        for pair in [each for each in self._gates if each.called == row and each.port not in ports]:
            self._gates.pop(pair).close()
        self._look()
        return robot, compose("INITREPLY", Status="OK")

    def _answer(self, message: WssMessage | None, robot: RobotClient) -> bytes:
        if message is None:
            return error("Message.Not.Understood")
        answers = {"GETSS": self._on_getss, "DNS": self._on_dns, "REVERSEDNS": self._on_reversedns}
        answer = answers.get(message.kind)
        return answer(message, robot) if answer else error("Method.Unknown.Or.Can.INIT.only.once")

    def _on_getss(self, message: WssMessage, robot: RobotClient) -> bytes:
        name = message.robot()
        if not name:
            return error("Robot.Name.Must.Not.Be.Empty")
        row = self._row(name)
        if row is None or row not in self._robots:
            return compose("SS", Robot=name, Strength="NaN")
        level_dbm = float("inf") if row == robot.row else self._level_dbm(robot.row, row)
        return compose("SS", Robot=name, Strength=strength(level_dbm))

    def _on_dns(self, message: WssMessage, robot: RobotClient) -> bytes:
        name = message.robot()
        if "Port" in message.fields and message.port() is None:
            return error("Port.Must.Be.Integer")
        if not name:
            return error("Robot.Name.Must.Not.Be.Empty")
        row = self._row(name)
        called = self._robots.get(-1 if row is None else row)
        if called is None or called is robot:
            return compose("DNSREPLY", Robot=name, Port=-1, Error="NoSuchRobot")
        port = message.port() or called.ports[0]
        if port not in called.ports:
            return compose("DNSREPLY", Robot=name, Port=-1, Error="RobotDoesNotListenOnThisPort")
        gate = self._gate(Pair(robot.row, called.row, port))
        return error("Could.Not.Allocate.Port") if gate is None else compose("DNSREPLY", Robot=name, Port=gate.port)

    def _on_reversedns(self, message: WssMessage, robot: RobotClient) -> bytes:
        port = message.port()
        if port is None:
            return error("Port.Must.Be.Integer")
        for relay, _ in self._relays.values():
            if relay.origin == port and relay.pair.called == robot.row:
                return compose("REVERSEDNSREPLY", Port=port, Robot=self._context.vehicles[relay.pair.caller])
        return compose("REVERSEDNSREPLY", Port=port, Error="UnknownOrIllegalPort")

    # --- links --------------------------------------------------------------------------------------------------------------

    def _row(self, name: str) -> int | None:
        return self._context.vehicles.index(name) if name in self._context.vehicles else None

    def _level_dbm(self, a: int, b: int) -> float:
        """Level of the weaker direction: TCP needs both."""
        return float(np.minimum(self._context.level_dbm(a, b), self._context.level_dbm(b, a)))  # NaN if either is

    def _linked(self, pair: Pair) -> bool:
        return self._level_dbm(pair.caller, pair.called) >= self._cutoff_dbm

    async def _look_on(self) -> None:
        while True:
            self._look()
            await asyncio.sleep(LOOK_S)

    def _look(self) -> None:
        """Open and close relay ports, and close connections, by the levels and the robots of now."""
        for pair, gate in self._gates.items():
            gate.let(pair.caller in self._robots and pair.called in self._robots and self._linked(pair))
        for relay, task in self._relays.values():
            if not self._linked(relay.pair) and not task.cancelling():
                self._context.count(relay.pair.caller, "connections closed, out of range")
                task.cancel()

    def _gate(self, pair: Pair) -> RelayPort | None:
        """The relay port of a pair, opened at the first request; None: no free port."""
        gate = self._gates.get(pair)
        for port in [] if gate else self._free_ports():
            with contextlib.suppress(OSError):
                gate = RelayPort(self._context.loop, self._address, port, lambda near, host: self._on_call(pair, near, host))
                self._gates[pair] = gate
                break
        self._look()
        return gate

    def _free_ports(self) -> Iterable[int]:
        if not self._first_port:
            return [0]
        held = {gate.port for gate in self._gates.values()}
        return itertools.islice((port for port in range(self._first_port, HIGHEST + 1) if port not in held), TRIED)

    def _on_call(self, pair: Pair, near: socket.socket, host: str) -> None:
        caller, called = self._robots.get(pair.caller), self._robots.get(pair.called)
        busy = sum(relay.pair == pair for relay, _ in self._relays.values()) >= MOST_RELAYS
        if caller is None or called is None or busy or host != caller.host:
            near.close()
            return
        self._relay_number = number = (self._relay_number + 1) % 2**32
        relay = Relay(self._context, self, pair, number, self._chunk_bytes)
        task = self._context.loop.create_task(relay.run(near, called.host))
        self._relays[number] = relay, task

        def over(_: object) -> None:
            del self._relays[number]
            near.close()

        task.add_done_callback(over)

    def _relay(self, number: int, sender: int, receiver: int) -> Relay | None:
        relay, _ = self._relays.get(number, (None, None))
        return relay if relay is not None and {sender, receiver} == {relay.pair.caller, relay.pair.called} else None


def _notice_death(control: socket.socket) -> None:
    """Detect within half a minute that a robot's machine is gone: its name becomes free again."""
    control.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3)):
        control.setsockopt(socket.IPPROTO_TCP, option, value)
