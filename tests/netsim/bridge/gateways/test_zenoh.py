"""Zenoh programs on the emulated network: client sessions opened with default options."""

import asyncio
import contextlib
import json
import os
import random
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st
from zenoh.handlers import Callback

from tests.support.netsim.gateway_context import RunlessContext, free_ports, open_gateway, until
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, GatewayError
from vcmvsp.netsim.bridge.gateways.zenoh import BACKLOG, HEARD, NO_ROOM, TOO_LONG, Inbox, Publication, ZenohGateway

pytestmark = pytest.mark.sockets

CARS = "car1", "car2", "car3"
READY, LAST = "test/ready", "test/last"
Heard = tuple[str, bytes | None]


class Program:
    """Client of a vehicle's gateway, subscribed to everything."""

    def __init__(self, port: int) -> None:
        config = {
            "mode": "client",
            "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": 60_000, "exit_on_failure": True},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"shared_memory": {"enabled": False}},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.samples: list[zenoh.Sample] = []
        self.session.declare_subscriber("**", Callback(self.samples.append, indirect=False))

    def put(self, key: str, payload: str | bytes, **options: Any) -> None:
        """Publish, and wait for room: by default Zenoh drops a message that finds none for a millisecond."""
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK, **options)

    def delete(self, key: str) -> None:
        """Delete, and wait for room."""
        self.session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)

    @property
    def received(self) -> list[Heard]:
        """Received keys and values in order; None: deleted."""
        put = zenoh.SampleKind.PUT
        every = [(str(each.key_expr), each.payload.to_bytes() if each.kind == put else None) for each in self.samples]
        return [(key, value) for key, value in every if key != READY]

    def received_last(self) -> bool:
        return any(key == LAST for key, _ in self.received)


class World:
    """A gateway, its context, and programs."""

    def __init__(self, context: RunlessContext, gateway: ZenohGateway, port: int) -> None:
        self.context, self.gateway, self.port = context, gateway, port
        self.programs: list[Program] = []

    async def program(self, vehicle: str) -> Program:
        """A program that receives all messages delivered to its vehicle."""
        row = CARS.index(vehicle)
        program = await asyncio.to_thread(Program, self.port + row)
        self.programs.append(program)
        ready = encode(Publication(READY, b""))
        while not program.samples:
            self.gateway.deliver((row + 1) % len(CARS), row, ready)
            await asyncio.sleep(0.005)
        return program


@contextlib.asynccontextmanager
async def served(*, hears: Callable[[int, int, int], bool] = lambda *_: True, **params: Any) -> AsyncIterator[World]:
    context = RunlessContext(CARS, hears=hears)
    port = free_ports(len(CARS), socket.SOCK_STREAM)
    world = World(context, ZenohGateway(first_port=port, **params), port)
    async with open_gateway(world.gateway, context):
        try:
            yield world
        finally:
            for program in world.programs:
                program.session.close()  # type: ignore[no-untyped-call]


async def test_a_publication_arrives_once_with_all_its_attributes() -> None:
    async with served() as world:
        car1, mate, car2 = await world.program("car1"), await world.program("car1"), await world.program("car2")
        car1.put("pose", b"\x00\xff", encoding="application/cdr;geometry_msgs/Pose", attachment=b"7")
        car1.delete("pose")
        car1.put("a/*/b", "wild")
        car1.put("spaces and \x00 and ü", "any")
        car1.put(LAST, "")
        strange = [("a/*/b", b"wild"), ("spaces and \x00 and ü", b"any")]
        for program in (car1, mate, car2):
            await until(program.received_last)
            assert program.received == [("pose", b"\x00\xff"), ("pose", None), *strange, (LAST, b"")]
            sample = next(each for each in program.samples if str(each.key_expr) == "pose")
            assert str(sample.encoding) == "application/cdr;geometry_msgs/Pose"
            assert sample.attachment is not None
            assert sample.attachment.to_bytes() == b"7"
        assert [(each.sender, each.to) for each in world.context.offered] == [(0, BROADCAST)] * 5


async def test_the_channel_decides_receptions_and_programs_of_one_vehicle_receive_all() -> None:
    draws = random.Random(1)
    fates = [draws.random() > 0.3 for _ in range(200)] + [True]

    async with served(hears=lambda sender, receiver, place: receiver == 2 and fates[place]) as world:
        car1, mate = await world.program("car1"), await world.program("car1")
        car2, car3 = await world.program("car2"), await world.program("car3")
        for number in range(len(fates) - 1):
            car1.put("count", str(number))
        car1.put(LAST, "")
        await until(car3.received_last)
        await until(mate.received_last)
        assert mate.received == [*(("count", b"%d" % number) for number in range(200)), (LAST, b"")]
        assert car3.received == [each for each, fate in zip(mate.received, fates, strict=True) if fate]
        assert car2.received == []


async def test_answers_go_back_and_nothing_goes_round() -> None:
    async with served() as world:
        programs = [await world.program(name) for name in CARS]
        for program in programs:
            program.put("hello", "")
        await until(lambda: all(len(each.received) >= 3 for each in programs))
        programs[0].put(LAST, "")
        await until(lambda: all(each.received_last() for each in programs))
        assert [len(each.received) for each in programs] == [4] * 3
        assert len(world.context.offered) == 4


async def test_a_message_to_one_vehicle_reaches_it_alone() -> None:
    async with served(unicast_prefix="to") as world:
        car1, car2, car3 = [await world.program(name) for name in CARS]
        car1.put("to/car2/go", "1")
        car1.put("to/car1/note", "2")
        car1.put("to/nobody", "3")
        car1.put(LAST, "")
        await until(car2.received_last)
        await until(car3.received_last)
        assert car2.received == [("to/car2/go", b"1"), ("to/nobody", b"3"), (LAST, b"")]
        assert car3.received == [("to/nobody", b"3"), (LAST, b"")]
        assert [each.to for each in world.context.offered] == [1, BROADCAST, BROADCAST]


async def test_oversized_and_reserved_publications_are_not_sent() -> None:
    async with served(max_bytes=1000) as world:
        car1, car2 = await world.program("car1"), await world.program("car2")
        car1.put("long", bytes(1001))
        car1.put("k" * 600, bytes(500))
        car1.put("vcmvsp/host/a/b/ask", "")
        car1.put("@private/key", "")
        car1.put(LAST, bytes(900))
        await until(car2.received_last)
        assert [key for key, _ in car2.received] == [LAST]
        await until(lambda: world.context.counts == {"car1": {TOO_LONG: 2}})


async def test_a_message_of_an_agent_arrives_under_its_name() -> None:
    async with served() as world:
        car2 = await world.program("car2")
        payloads = [b"any bytes", b"", b"\x81\xa1x\x01", b"\x92\xa2//\xc4\x00"]  # the last one has a key outside of the space
        for payload in payloads:
            world.gateway.deliver(0, 1, payload)
        world.gateway.deliver(0, 1, encode(Publication(LAST, b"")))
        await until(car2.received_last)
        assert car2.received == [*((HEARD + "car1", payload) for payload in payloads[:3]), (LAST, b"")]
        assert world.context.counts == {"car2": {"not taken by Zenoh": 1}}


async def test_some_vehicles_take_part_at_endpoints_of_their_own() -> None:
    port = free_ports(4, socket.SOCK_STREAM)
    endpoints = {"car1": f"tcp/127.0.0.1:{port}", "car3": f"tcp/127.0.0.1:{port + 3}"}
    gateway = ZenohGateway(port, vehicles=tuple(endpoints), listen={"car3": endpoints["car3"]})
    async with open_gateway(gateway, RunlessContext(CARS)) as context:
        gateway.deliver(0, 1, encode(Publication("k", b"")))  # is no member
    assert context.lines == [f"Zenoh clients of {name} connect to {endpoint}" for name, endpoint in endpoints.items()]


async def test_three_hundred_strange_connections_do_not_block_programs() -> None:
    async with served() as world:
        car2 = await world.program("car2")
        with contextlib.ExitStack() as strangers:
            for number in range(300):
                stranger = strangers.enter_context(socket.create_connection(("127.0.0.1", world.port)))
                with contextlib.suppress(OSError):
                    stranger.sendall(os.urandom(number % 50))
            car1 = await world.program("car1")
            car1.put(LAST, "")
            await until(car2.received_last)


async def test_excess_messages_are_counted_and_the_rest_stays_in_order() -> None:
    context = RunlessContext(CARS)
    taken: list[tuple[int, bytes, int]] = []

    def offer(row: int, _: int, payload: bytes, *, came_ns: int) -> bool:
        taken.append((row, payload, came_ns))
        return payload != b"no room"

    inbox = Inbox(context, offer)
    for number in range(BACKLOG + 10):
        inbox.put(0, BROADCAST, str(number).encode())
    inbox.put(1, BROADCAST, b"another's")
    inbox.put(1, BROADCAST, b"no room")
    inbox.count(1, TOO_LONG)
    await until(lambda: bool(context.counts))
    assert context.counts == {"car1": {NO_ROOM: 10}, "car2": {NO_ROOM: 1, TOO_LONG: 1}}
    assert [payload for row, payload, _ in taken if row == 0] == [b"%d" % number for number in range(BACKLOG)]
    assert [came_ns for *_, came_ns in taken] == sorted(came_ns for *_, came_ns in taken)
    inbox.count(2, TOO_LONG)  # alone
    await until(lambda: "car3" in context.counts)


@given(payload=st.binary(max_size=60))
@example(payload=b"\x92\xa1\x80")  # a key that is no text
@example(payload=b"\x91" * 5000)
def test_any_received_bytes_are_published(payload: bytes) -> None:
    keys: list[str] = []

    class Session:
        def put(self, key: str, *_: object, **__: object) -> None:
            keys.append(key)

        delete = put

    gateway = ZenohGateway()
    gateway._context, gateway._sessions = SimpleNamespace(vehicles=CARS), {0: Session()}  # type: ignore[dict-item]
    gateway.deliver(1, 0, payload)
    assert len(keys) == 1


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"vehicles": ("car9",)}, "vehicles: unknown vehicle 'car9'"),
        ({"listen": {"car9": "tcp/127.0.0.1:1"}}, "listen: unknown vehicle 'car9'"),
        ({"listen": {"car1": "udp/127.0.0.1:1"}}, "must be tcp/HOST:PORT"),
        ({"listen": {"car1": "tcp/127.0.0.1:0"}}, "must be tcp/HOST:PORT"),
        ({"listen": {"car1": "tcp/127.0.0.1:65536"}}, "must be tcp/HOST:PORT"),
        ({"listen": {"car1": "tcp/127.0.0.1:7461"}}, "tcp/127.0.0.1:7461 is assigned to two vehicles"),
        ({"listen": {"car1": "tcp/0.0.0.0:7460"}}, "insecure = true"),
        ({"listen": {"car1": "tcp/[::]:7460"}}, "insecure = true"),
        ({"first_port": 65_534}, "first_port = 65534 is too high: no port is left for 'car3'"),
    ],
)
def test_parameters_without_a_meaning_are_refused(params: Mapping[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem.replace("[", r"\[")):
        ZenohGateway(**params).check(CARS)


def test_other_machines_may_connect_if_configured() -> None:
    ZenohGateway(listen={"car1": "tcp/0.0.0.0:7460"}, insecure=True).check(CARS)


async def test_a_port_in_use_is_an_error_that_names_it() -> None:
    async with served() as world:
        second = ZenohGateway(first_port=world.port)
        with pytest.raises(GatewayError, match=f"cannot serve Zenoh clients at tcp/127.0.0.1:{world.port}"):
            await second.open(world.context)
        await second.close()


async def test_the_largest_publication_is_a_frame_of_the_largest_size() -> None:
    async with served() as world:
        car1, car2 = await world.program("car1"), await world.program("car2")
        beside = len(encode(Publication(LAST, bytes(60_000), "zenoh/bytes"))) - 60_000
        car1.put(LAST, bytes(LARGEST - beside + 1))
        car1.put(LAST, bytes(LARGEST - beside))
        await until(car2.received_last)
        assert [len(payload or b"") for _, payload in car2.received] == [LARGEST - beside]
        assert len(world.context.offered[0].payload) == LARGEST
