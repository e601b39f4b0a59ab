import asyncio
import contextlib
import errno
import socket
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

from tests.support import requirements
from tests.support.netsim.gateway_context import PATIENCE_S, RunlessContext, free_ports, open_gateway, until
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, GatewayError
from vcmvsp.netsim.bridge.gateways.udp import PortPlan, Ports, Udp

pytestmark = pytest.mark.sockets

NAMES = ("a", "b", "c")


@contextlib.contextmanager
def program(port: int, host: str = "127.0.0.1") -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as client:
        client.bind((host, port))
        client.setblocking(False)
        yield client


@contextlib.asynccontextmanager
async def served(*names: str) -> AsyncIterator[tuple[RunlessContext, int, list[socket.socket]]]:
    """The context of an open gateway for all vehicles, its first port, and programs of the vehicles with these names."""
    first = free_ports(300)
    with contextlib.ExitStack() as programs:
        sockets = [programs.enter_context(program(first + 100 * NAMES.index(name) + 99)) for name in names]
        async with open_gateway(Udp(first_port=first), RunlessContext(NAMES)) as context:
            yield context, first, sockets


async def next_datagram(by: socket.socket) -> tuple[bytes, Any]:
    return await asyncio.wait_for(asyncio.get_running_loop().sock_recvfrom(by, 65_536), PATIENCE_S)


async def test_a_broadcast_reaches_all_others() -> None:
    async with served("a", "b", "c") as (context, first, (a, b, c)):
        a.sendto(b"hello", ("127.0.0.1", first))
        assert (await next_datagram(b))[0] == (await next_datagram(c))[0] == b"hello"
        assert [(each.sender, each.to) for each in context.offered] == [(0, BROADCAST)]
        with pytest.raises(BlockingIOError):
            a.recv(100)


async def test_a_reply_to_the_source_address_reaches_the_sender() -> None:
    async with served("a", "b") as (context, first, (a, b)):
        a.sendto(b"question", ("127.0.0.1", first + 2))
        question, source = await next_datagram(b)
        b.sendto(question + b", answer", source)
        assert (await next_datagram(a))[0] == b"question, answer"
        assert [(each.sender, each.to) for each in context.offered] == [(0, 1), (1, 0)]
        a.sendto(b"all", ("127.0.0.1", first))
        _, source = await next_datagram(b)
        assert source == ("127.0.0.1", first + 101)  # back to a, the sender of the broadcast


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
async def test_bytes_stay_as_they_are_from_none_to_the_longest(host: str) -> None:
    try:
        with program(0, host):
            pass
    except OSError as error:
        requirements.not_allowed(f"sockets at {host}: {error}")
    first = free_ports(200)
    gateway = Udp(listen=host, receive_host=host, first_port=first, max_bytes=65_535)
    with program(first + 199, host) as b, program(first + 99, host) as a:
        async with open_gateway(gateway, RunlessContext(("a", "b"))):
            for payload in (b"", b"\x00\xff" * 700, bytes(range(256)) * 255):
                a.sendto(payload, (host, first + 2))
                assert (await next_datagram(b))[0] == payload


async def test_an_oversized_datagram_is_counted_and_not_sent() -> None:
    async with served("b", "a") as (context, first, (b, a)):
        a.sendto(bytes(1473), ("127.0.0.1", first + 2))
        a.sendto(bytes(60_000), ("127.0.0.1", first))
        a.sendto(bytes(1472), ("127.0.0.1", first + 2))
        assert len((await next_datagram(b))[0]) == 1472
        await until(lambda: context.counts == {"a": {"longer than max_bytes": 2}})
        assert len(context.offered) == 1


async def test_where_there_is_no_room_nothing_is_lost_nor_overtaken_until_the_operating_system_has_none() -> None:
    async with served("a") as (context, first, (a,)):
        context.room = False
        for k in range(1000):
            a.sendto(b"%d" % k, ("127.0.0.1", first))
        await asyncio.sleep(0.02)
        assert context.offered == []
        read_ns = time.monotonic_ns()
        context.room = True
        await until(lambda: len(context.offered) == 1000)
        assert [each.payload for each in context.offered] == [b"%d" % k for k in range(1000)]
        # Times of arrival, not of reading; their order may change if the wall clock is set, and the store restores it.
        assert max(each.came_ns for each in context.offered) < read_ns


async def test_datagrams_without_room_in_the_system_are_counted() -> None:
    def dropped() -> int:
        return context.counts.get("a", {}).get("dropped by the operating system", 0)

    first = free_ports(200)
    with program(0) as a:
        async with open_gateway(gateway := Udp(first_port=first), RunlessContext(("a", "b"))) as context:
            line = gateway._sockets[0, BROADCAST]
            line.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            context.room = False
            for _ in range(500):
                a.sendto(bytes(1000), ("127.0.0.1", first))
            await asyncio.sleep(0.005)
            context.room = True
            await until(lambda: dropped() + len(context.offered) == 500)  # in some iterations of the loop
            assert dropped() > 0


async def test_missing_receivers_have_no_effect_on_others() -> None:
    async with served("a", "c") as (context, first, (a, c)):
        for _ in range(20):  # no program listens on b's port
            a.sendto(b"hello", ("127.0.0.1", first))
            assert (await next_datagram(c))[0] == b"hello"
        assert context.counts == {}


async def test_programs_of_some_vehicles_take_part_and_others_have_no_ports() -> None:
    first = free_ports(300)
    gateway = Udp(first_port=first, vehicles=("b", "c"))
    with program(first + 99), program(first + 199) as b, program(first) as free:
        async with open_gateway(gateway, RunlessContext(NAMES)) as context:
            gateway.deliver(1, 0, b"to nobody")
            b.sendto(b"to a", ("127.0.0.1", first + 101))
            await until(lambda: [each.to for each in context.offered] == [0])
            assert free.getsockname()[1] == first
            assert context.counts == {}


async def test_ports_of_single_vehicles_can_be_others() -> None:
    first = free_ports(400)
    own = Ports(send=first + 300, receive=f"127.0.0.1:{first + 301}", unicast={"b": first + 302})
    gateway = Udp(first_port=first, ports={"a": own})
    with program(first + 301) as a, program(first + 199) as b:
        async with open_gateway(gateway, RunlessContext(NAMES)) as context:
            a.sendto(b"1", ("127.0.0.1", first + 300))
            a.sendto(b"2", ("127.0.0.1", first + 302))
            a.sendto(b"3", ("127.0.0.1", first + 3))
            await until(lambda: len(context.offered) == 3)
            assert sorted((each.payload, each.to) for each in context.offered) == [(b"1", BROADCAST), (b"2", 1), (b"3", 2)]
            b.sendto(b"4", ("127.0.0.1", first + 101))
            assert (await next_datagram(a)) == (b"4", ("127.0.0.1", first + 302))


async def test_a_taken_port_is_named_and_the_others_are_freed() -> None:
    first = free_ports(300)
    with program(first + 103):
        gateway = Udp(first_port=first)
        with pytest.raises(GatewayError, match=rf"port {first + 103} of 127.0.0.1 cannot be opened .*ss -ulnp.*first_port"):
            await gateway.open(RunlessContext(NAMES))
        await gateway.close()
    with program(first), program(first + 2):
        pass


async def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(GatewayError, match=r"192.0.2.1 cannot be opened .*; listen must be an address of this machine"):
        await Udp(listen="192.0.2.1").open(RunlessContext(NAMES))  # addresses reserved for documentation


async def test_too_few_sockets_for_all_pairs_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    context = RunlessContext(NAMES)
    monkeypatch.setattr("vcmvsp.netsim.bridge.gateways.udp.socket.socket", full)
    with pytest.raises(GatewayError, match=r"Too many open files.*; each pair of vehicles needs a socket: .*ulimit -n"):
        await Udp().open(context)
    monkeypatch.undo()


async def test_the_ports_of_every_vehicle_are_printed() -> None:
    first = free_ports(300)
    async with open_gateway(Udp(first_port=first), RunlessContext(NAMES)) as context:
        lines = context.lines
    sends = f"a sends at 127.0.0.1 port {first} to all, {first + 2} to b, {first + 3} to c"
    assert lines[0] == f"{sends}; hears at 127.0.0.1 port {first + 99}"
    assert len(lines) == 3


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"listen": "0.0.0.0"}, "in reach of this address: listen at 127.0.0.1, or set insecure"),
        ({"listen": "::", "receive_host": "::1"}, "set insecure = true on a trusted network"),
        ({"listen": "192.168.0.3", "receive_host": "192.168.0.7"}, "set insecure = true on a trusted network"),
        ({"listen": "nowhere"}, "bridge.udp.listen: must be an IPv4 or IPv6 address, not 'nowhere'"),
        ({"receive_host": "a b"}, "bridge.udp.receive_host: must be an IPv4 or IPv6 address, not 'a b'"),
        ({"vehicles": ["d"]}, "vehicles: unknown vehicle 'd' (allowed: a, b, c)"),
        ({"ports": {"d": {}}}, "ports: unknown vehicle 'd'"),
        ({"ports": {"a": {"unicast": {"a": 5000}}}}, "ports.a.unicast: unknown other vehicle 'a' (allowed: b, c)"),
        ({"ports": {"a": {"unicast": {"d": 5000}}}}, "ports.a.unicast: unknown other vehicle 'd'"),
        ({"ports": {"a": {"send": 18_101}}}, "18101 of b is assigned twice"),
        ({"ports": {"a": {"unicast": {"b": 5000, "c": 5000}}}}, "5000 of a is assigned twice"),
        ({"ports": {"a": {"receive": "127.0.0.1:18000"}}}, "receive port 18000 of a is also a port to send to"),
        ({"ports": {"a": {"receive": "6001"}}}, "bridge.udp.ports.a.receive: must be an IPv4"),
        ({"ports": {"a": {"receive": "127.0.0.1:0"}}}, "bridge.udp.ports.a.receive: must be HOST:PORT"),
        ({"ports": {"a": {"receive": "127.0.0.1:٣٣"}}}, "bridge.udp.ports.a.receive: must be HOST:PORT"),
        ({"ports": {"a": {"sends": 5000}}}, "unknown key 'sends'; did you mean 'send'?"),
        ({"first_port": 65_400}, "first_port: 65400 leads to port 65600, above the maximum 65535"),
        ({"first_port": 65_330}, "first_port: 65330 leads to port 65"),
        ({"receive_host": "192.168.0.7"}, "to 192.168.0.7 of a, another machine: set listen to this machine's address"),
        ({"receive_host": "::1"}, "127.0.0.1 cannot send to ::1 of a: use IPv4 for both"),
    ],
)
def test_parameters_without_a_meaning_are_refused(params: dict[str, Any], problem: str) -> None:
    with pytest.raises((ValueError, ScenarioError)) as error:
        binding.call(Udp, params, key="bridge.udp").check(NAMES)
    assert problem in str(error.value)


def test_other_machines_are_let_in_if_that_is_wanted() -> None:
    Udp(listen="192.168.0.3", receive_host="192.168.0.7", insecure=True).check(NAMES)
    Udp(listen="127.0.0.2").check(NAMES)


def test_blocks_have_room_for_98_vehicles_outside_of_the_ephemeral_range() -> None:
    names = [f"v{k}" for k in range(99)]
    Udp().check(names[:98])
    with pytest.raises(ValueError, match=r"99 vehicles are too many for UDP ports \(at most 98\)"):
        Udp().check(names)
    plan = PortPlan("127.0.0.1", binding.parameters(Udp)["first_port"].default, (), {}, "127.0.0.1")
    ports = [*plan.sending(names[:98]).values(), *(place.port for place in plan.receiving(names[:98]).values())]
    assert len(set(ports)) == len(ports) == 98 * 99
    assert 1024 <= min(ports) <= max(ports) < 32_768  # from there to 60999 (ip-sysctl of Linux)
