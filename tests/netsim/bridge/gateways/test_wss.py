"""USARSim's Wireless Simulation Server, tested by a client that is written from its manual."""

import asyncio
import contextlib
import random
import re
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.netsim.gateway_context import PATIENCE_S, RunlessContext, free_ports, open_gateway, until
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import GatewayError
from vcmvsp.netsim.bridge.gateways.wss import LONGEST_LINE, MOST_GUESTS, Wss, parse
from vcmvsp.netsim.bridge.gateways.wss_relay import WINDOW, RelayStream, Window

pytestmark = pytest.mark.sockets

CARS = "car1", "car2", "car3"
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Robot:
    """Client of a robot's program."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def dial(cls, port: int) -> "Robot":
        sock = _narrow("127.0.0.1", 0)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port))
        return cls(*await asyncio.open_connection(sock=sock))

    async def ask(self, line: str) -> str:
        self.writer.write(line.encode() + b"\r\n")
        return await self.hear()

    async def hear(self) -> str:
        line = await asyncio.wait_for(self.reader.readline(), PATIENCE_S)
        assert not line or line.endswith(b"\r\n")
        return line.decode().removesuffix("\r\n")

    async def port_to(self, robot: str) -> int:
        found = re.fullmatch(rf"DNSREPLY \{{Robot {robot}\}} \{{Port (\d+)\}}", await self.ask(f"DNS {{Robot {robot}}}"))
        assert found
        return int(found[1])

    def leave(self) -> None:
        self.writer.close()


def _narrow(host: str, port: int) -> socket.socket:
    """A socket with a small buffer."""
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
    made.setblocking(False)
    made.bind((host, port))
    return made


class World:
    """A gateway, its context, and robots."""

    def __init__(self, context: RunlessContext, gateway: Wss, port: int) -> None:
        self.context, self.gateway, self.port = context, gateway, port
        self._open: list[asyncio.StreamWriter | asyncio.Server] = []

    def levels(self, dbm: float) -> None:
        for one in range(len(CARS)):
            for other in range(len(CARS)):
                self.context.levels[one, other] = dbm

    async def robot(self, name: str = "", ports: str = "10") -> Robot:
        robot = await Robot.dial(self.port)
        self._open.append(robot.writer)
        if name:
            assert await robot.ask(f"INIT {{Robot {name}}} {{Port {ports}}}") == "INITREPLY {Status OK}"
        return robot

    async def listening(self, name: str, serve: Serve) -> Robot:
        """A robot that listens on a port."""
        server = await asyncio.start_server(serve, sock=_narrow("127.0.0.1", 0))
        self._open.append(server)
        return await self.robot(name, str(server.sockets[0].getsockname()[1]))

    async def connected(self, serve: Serve) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection of car1's program to car2, which serves it."""
        car1, _ = await self.robot("car1"), await self.listening("car2", serve)
        return await self.connect(await car1.port_to("car2"))

    async def connect(self, port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        self._open.append(writer)
        return reader, writer

    def close(self) -> None:
        for each in self._open:
            if isinstance(each, asyncio.StreamWriter):
                each.transport.abort()  # whatever is still to be sent
            else:
                each.close()


@contextlib.asynccontextmanager
async def served(
    *, delay_s: float = 0.0, hears: Callable[[int, int, int], bool] = lambda *_: True, first_port: int = 0
) -> AsyncIterator[World]:
    """A running gateway, all vehicles in range of each other."""
    context = RunlessContext(CARS, delay_s=delay_s, hears=hears)
    gateway = Wss(port=free_ports(1, socket.SOCK_STREAM), first_port=first_port)
    world = World(context, gateway, gateway._port)
    world.levels(-50.0)
    async with open_gateway(gateway, context):
        try:
            yield world
        finally:
            world.close()


async def refused(port: int) -> bool:
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except ConnectionRefusedError:
        return True
    writer.close()
    return False


async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(5000):
            writer.write(data)
            await writer.drain()
    writer.close()


async def echoed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, data: bytes) -> None:
    writer.write(data)
    assert await asyncio.wait_for(reader.readexactly(len(data)), PATIENCE_S) == data


async def rest_of(reader: asyncio.StreamReader) -> bytes:
    """What a connection brings until its end; empty if it is reset."""
    with contextlib.suppress(ConnectionResetError):
        return await asyncio.wait_for(reader.read(), PATIENCE_S)
    return b""


# --- commands -------------------------------------------------------------------------------------------------------------


async def test_the_control_connection_follows_the_manual() -> None:
    async with served() as world:
        world.context.levels[0, 1] = -61.23456789  # the reverse link is stronger
        car1, car2 = await world.robot("car1", "2001,2002"), await world.robot("car2", "3001")
        assert await car1.ask("GETSS {Robot car2}") == "SS {Robot car2} {Strength -61.2346}"
        assert await car2.ask("GETSS {Robot car1}") == "SS {Robot car1} {Strength -61.2346}"
        assert await car1.ask("GETSS {Robot car1}") == "SS {Robot car1} {Strength INF}"
        assert await car1.ask("GETSS {Robot car3}") == "SS {Robot car3} {Strength NaN}"  # has not connected
        assert await car1.ask("GETSS {Robot nobody}") == "SS {Robot nobody} {Strength NaN}"
        no_robot = "{Port -1} {Error NoSuchRobot}"
        for name in ("nobody", "car1", "car3"):
            assert await car1.ask(f"DNS {{Robot {name}}}") == f"DNSREPLY {{Robot {name}}} {no_robot}"
        answer = await car1.ask("DNS {Robot car2} {Port 3002}")
        assert answer == "DNSREPLY {Robot car2} {Port -1} {Error RobotDoesNotListenOnThisPort}"
        ports = {await car2.ask(f"DNS {{Robot car1}}{port}") for port in ("", " {Port 2001}", " {Port 2002}")}
        assert len(ports) == 2  # without a number it is the first
        assert await car1.port_to("car2") == await car1.port_to("car2")
        assert await car1.ask("REVERSEDNS {Port 9}") == "REVERSEDNSREPLY {Port 9} {Error UnknownOrIllegalPort}"
        for wrong in ("", "HELLO", "INIT {Robot car3} {Port 1}", "DNS", "DNS {Robot car2} {Port x}", "GETSS {Robot a b c}"):
            assert re.fullmatch(r"ERROR \{Reason [\w.]+\}", await car1.ask(wrong))


@pytest.mark.parametrize(
    "line",
    [
        "GETSS {Robot car2}",
        "INIT {Robot car9} {Port 10}",  # no such vehicle
        "INIT {Robot car1} {Port 10}",  # already has a program
        "INIT {Robot car2}",
        "INIT {Port 10}",
        "INIT {Robot car2} {Port 0}",
        "INIT {Robot car2} {Port 10,x}",
        "INIT {Robot car2} {Port 65536}",
    ],
)
async def test_a_failed_registration_may_be_repeated(line: str) -> None:
    async with served() as world:
        await world.robot("car1")
        other = await world.robot()
        assert (await other.ask(line)).startswith("ERROR {Reason ")
        assert await other.ask("INIT {Robot car2} {Port 10}") == "INITREPLY {Status OK}"


async def test_lines_may_come_in_pieces_and_together() -> None:
    async with served() as world:
        robot = await world.robot()
        for piece in (b"INIT {Rob", b"ot car1} {Port 1", b"0}\r", b"\nGETSS {Robot car1}\r\nGETSS {Robot car2}\n"):
            robot.writer.write(piece)
            await asyncio.sleep(0.01)
        answers = [await robot.hear() for _ in range(3)]
        assert answers == ["INITREPLY {Status OK}", "SS {Robot car1} {Strength INF}", "SS {Robot car2} {Strength NaN}"]


LINES = st.one_of(
    st.binary(max_size=60),
    st.text("{} \tRobotPrt15c\r\x00,-", max_size=40).map(str.encode),
    st.builds(
        lambda kind, robot, port: f"{kind} {{Robot {robot}}} {{Port {port}}}".encode(),
        st.sampled_from(["INIT", "GETSS", "DNS", "REVERSEDNS", "ERROR"]),
        st.sampled_from(["car1", "car2", "car9", "é", "{", ""]),
        st.sampled_from(["1", "10,11", "99999", "-1", "1" * 30, ""]),
    ),
)


@settings(max_examples=60)
@given(lines=st.lists(LINES, max_size=12))
def test_every_line_has_one_answer(lines: list[bytes]) -> None:
    expected = sum(line.count(b"\n") + 1 for line in lines)

    async def answered() -> list[str]:
        async with served() as world:
            await world.robot("car2")
            robot = await world.robot()
            robot.writer.write(b"".join(line + b"\n" for line in lines))
            robot.writer.write_eof()
            replies = (await asyncio.wait_for(robot.reader.read(), PATIENCE_S)).split(b"\r\n")
            assert replies.pop() == b""
            return [each.decode(errors="replace") for each in replies]

    answers = asyncio.run(answered())
    assert len(answers) == expected
    assert all(re.match(r"(INITREPLY|SS|DNSREPLY|REVERSEDNSREPLY|ERROR) \{", each) for each in answers)


@given(line=st.binary(max_size=300) | LINES)
def test_a_message_is_made_of_words(line: bytes) -> None:
    message = parse(line)
    if message is not None:
        assert not any(set(word) & set("{} \r\n") for word in (message.kind, *message.fields, *message.fields.values()))


# --- connections ------------------------------------------------------------------------------------------------------------


async def test_a_megabyte_each_way_arrives_complete_over_a_lossy_link() -> None:
    draws = random.Random(1)
    sent = random.Random(2).randbytes(1_000_000)
    async with served(delay_s=0.0005, hears=lambda *_: draws.random() > 0.05) as world:
        reader, writer = await world.connected(echo)
        writer.write(sent)
        writer.write_eof()
        assert await rest_of(reader) == sent
        await until(lambda: not world.gateway._relays)
    context = world.context
    assert {(each.sender, each.to) for each in context.offered} == {(0, 1), (1, 0)}
    assert max(len(each.payload) for each in context.offered) == 1400
    assert sum(each["chunks of connections sent again"] for each in context.counts.values()) > 30


@settings(max_examples=40)
@given(size=st.integers(0, 3000), seed=st.integers(0, 99))
def test_chunks_come_out_in_order_whatever_is_lost_doubled_or_overtakes(size: int, seed: int) -> None:
    draws = random.Random(seed)
    sent = draws.randbytes(size)
    air: list[tuple[int, bytes]] = []

    async def output() -> bytes:
        loop = asyncio.get_running_loop()

        def offer(number: int, chunk: bytes) -> bool:
            room = draws.random() > 0.1
            air.extend([(number, chunk)] * room)
            return room

        stream = RelayStream(loop, offer, 20)
        (inlet, source), (sink, outlet) = socket.socketpair(), socket.socketpair()
        with inlet, source, sink, outlet:
            for each in (source, sink):
                each.setblocking(False)
            inlet.sendall(sent)
            inlet.shutdown(socket.SHUT_WR)
            carried = loop.create_task(stream.run(source, sink))
            while not carried.done():
                await asyncio.sleep(0)
                if air:
                    number, chunk = air.pop(draws.randrange(len(air)))
                    fate = draws.random()
                    if fate > 0.03:
                        stream.deliver(number, chunk)
                    if 0.3 < fate < 0.5:
                        stream.deliver(number, chunk)  # twice
                    if fate < 0.5:
                        stream.lost(number)  # only one of them, or none, has hung up
            await carried
            outlet.settimeout(5)
            return b"".join(iter(lambda: outlet.recv(4096), b""))

    with mock.patch.multiple("vcmvsp.netsim.bridge.gateways.wss_relay", AGAIN_S=0.0, NO_ROOM_S=0.0):
        assert asyncio.run(output()) == sent


def test_the_window_grows_with_arrivals_and_halves_once_per_burst_of_losses() -> None:
    window = Window()
    for _ in range(100):
        window.grow()
    assert window.chunks == WINDOW
    for number in range(40, 60):
        window.shrink(number, 100)
    assert window.chunks == WINDOW / 2
    for _ in range(32):  # one more than allowed
        window.grow()
    assert window.chunks == pytest.approx(33.0, abs=0.02)
    window.shrink(100, 120)
    assert window.chunks == pytest.approx(16.5, abs=0.02)
    for number in range(1000, 2000):
        window.shrink(number, number + 1)
    assert window.chunks == 2.0


async def test_a_called_robot_can_query_the_caller() -> None:
    answers: list[str] = []

    async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        port = writer.get_extra_info("peername")[1]
        replies = [await robot.ask(f"REVERSEDNS {{Port {port}}}") for robot in (car2, car3)]
        answers.extend(each.replace(str(port), "q") for each in replies)
        writer.close()

    async with served() as world:
        car1, car2, car3 = await world.robot("car1"), await world.listening("car2", ask), await world.robot("car3")
        reader, _ = await world.connect(await car1.port_to("car2"))
        assert await rest_of(reader) == b""
    assert answers == ["REVERSEDNSREPLY {Port q} {Robot car1}", "REVERSEDNSREPLY {Port q} {Error UnknownOrIllegalPort}"]


async def test_out_of_range_connections_are_closed_and_new_ones_refused_until_it_is_back() -> None:
    async with served() as world:
        car1, _ = await world.robot("car1"), await world.listening("car2", echo)
        port = await car1.port_to("car2")
        reader, writer = await world.connect(port)
        await echoed(reader, writer, b"hello")
        world.context.levels[1, 0] = -93.001  # one direction is enough
        assert await rest_of(reader) == b""
        assert await refused(port)
        assert await car1.port_to("car2") == port  # is notified nevertheless
        assert await refused(port)
        world.context.levels[1, 0] = -93.0
        assert await car1.port_to("car2") == port
        reader, writer = await world.connect(port)
        await echoed(reader, writer, b"again")
        assert world.context.counts["car1"]["connections closed, out of range"] == 1
        world.levels(float("nan"))
        assert await rest_of(reader) == b""


async def test_a_robot_that_leaves_is_called_no_more_and_its_name_is_free() -> None:
    async def elsewhere(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"moved")
        writer.close()

    async with served() as world:
        car1, car2 = await world.robot("car1"), await world.listening("car2", echo)
        port = await car1.port_to("car2")
        reader, writer = await world.connect(port)
        car2.leave()
        await until(lambda: 1 not in world.gateway._robots)
        assert await refused(port)
        await echoed(reader, writer, b"still here")  # open connections remain
        await world.listening("car2", elsewhere)
        reader, _ = await world.connect(await car1.port_to("car2"))
        assert await rest_of(reader) == b"moved"


async def test_a_robot_that_does_not_listen_is_not_reached() -> None:
    async with served() as world:
        with _narrow("127.0.0.1", 0) as held:  # occupies the port
            car1, _ = await world.robot("car1"), await world.robot("car2", str(held.getsockname()[1]))
            reader, _ = await world.connect(await car1.port_to("car2"))
            assert await rest_of(reader) == b""


async def test_a_slow_reader_holds_the_sender_back() -> None:
    reads = asyncio.Event()

    async def slow(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reads.wait()
        await echo(reader, writer)

    async with served() as world:
        reader, writer = await world.connected(slow)
        writer.write(bytes(12_000_000))
        writer.write_eof()
        before = -1
        while before != len(world.context.offered):  # until the buffers are full
            before = len(world.context.offered)
            await asyncio.sleep(0.2)
        assert sum(len(each.payload) for each in world.context.offered) < 9_000_000
        relay, _ = next(iter(world.gateway._relays.values()))
        stream = relay.streams[0]
        assert len(stream._under_way) + stream._in_order.qsize() <= WINDOW
        reads.set()
        assert len(await rest_of(reader)) == 12_000_000


async def test_payloads_that_are_no_chunk_are_ignored() -> None:
    async with served() as world:
        reader, writer = await world.connected(echo)
        await until(lambda: bool(world.gateway._relays))
        header = next(iter(world.gateway._relays)).to_bytes(4, "big")
        for payload in (b"", b"an agent spoke", header + bytes(4), header + b"\xff" * 10):
            world.gateway.deliver(0, 1, payload)
            world.gateway.deliver(2, 1, payload)
        await echoed(reader, writer, b"hello")


# --- many clients ---------------------------------------------------------------------------------------------------------


async def test_lines_without_end_and_crowds_leave_others_alone() -> None:
    async with served() as world:
        car1, car2 = await world.robot("car1"), await world.listening("car2", echo)
        endless = await world.robot()
        endless.writer.write(b"x" * (10 * LONGEST_LINE))
        with contextlib.suppress(ConnectionResetError):
            assert await endless.hear() == "ERROR {Reason Line.Too.Long}"
        crowd = [await world.robot() for _ in range(300)]
        assert len(world.gateway._guests) <= MOST_GUESTS + 1
        crowd[-1].writer.write(random.Random(4).randbytes(3000))
        port = await car1.port_to("car2")
        for _ in range(100):
            await world.connect(port)
            for target in (port, world.port):  # out of range and back
                with socket.create_connection(("127.0.0.1", target)) as rude:
                    rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert await car2.ask("GETSS {Robot car1}") == "SS {Robot car1} {Strength -50}"
        assert await (await world.robot("car3")).ask("GETSS {Robot car1}") == "SS {Robot car1} {Strength -50}"


async def test_a_client_that_does_not_read_its_answers_is_not_read() -> None:
    async with served() as world:
        deaf = await world.robot("car1")
        deaf.reader._transport.pause_reading()  # type: ignore[attr-defined]
        for _ in range(200):
            deaf.writer.write(b"GETSS {Robot car1}\r\n" * 10_000)
        before = -1
        while before != (before := deaf.writer.transport.get_write_buffer_size()):
            await asyncio.sleep(0.1)
        assert before > 0
        assert await (await world.robot("car2")).ask("GETSS {Robot car2}") == "SS {Robot car2} {Strength INF}"


async def test_ports_in_a_row_and_all_of_them_free_afterwards() -> None:
    first = free_ports(4, socket.SOCK_STREAM)
    for _ in range(2):
        async with served(first_port=first) as world:
            car1, car2 = await world.robot("car1"), await world.robot("car2")
            ports = [await car1.port_to("car2"), await car2.port_to("car1"), await car1.port_to("car2")]
        assert ports == [first, first + 1, first]


async def test_a_port_in_use_is_an_error_that_names_it() -> None:
    async with served() as world:
        second = Wss(port=world.port)
        with pytest.raises(GatewayError, match=f"port {world.port}.*in use"):
            await second.open(world.context)
        await second.close()


def test_an_address_must_be_one() -> None:
    with pytest.raises(ScenarioError, match="listen: must be an IPv4 or IPv6 address, not 'here'"):
        Wss(listen="here")


@pytest.mark.parametrize("listen", ["0.0.0.0", "::", "192.168.0.3"])
def test_other_machines_are_let_in_only_if_that_is_wanted(listen: str) -> None:
    Wss(listen=listen, insecure=True).check(CARS)
    with pytest.raises(
        ValueError, match=f"listen: {listen} accepts connections from every machine .* ssh -L .*, or set insecure = true"
    ):
        Wss(listen=listen).check(CARS)
