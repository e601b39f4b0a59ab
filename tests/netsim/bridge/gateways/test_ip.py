"""IP gateway on layer 3: programs in two or three network namespaces, and a context that delivers every packet."""

import asyncio
import errno
import fcntl
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.support.netsim.gateway_context import PATIENCE_S, RunlessContext, open_gateway, until
from tests.support.netsim.vehicle_namespaces import (
    CARS,
    IN_NAMESPACES,
    RUN,
    machines,
    next_datagram,
    remains_of_run,
    run_command,
    shell,
    space,
    udp,
)
from tests.support.paths import ROOT
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, GatewayError
from vcmvsp.netsim.bridge.gateways.ip import namespaces, run_networks
from vcmvsp.netsim.bridge.gateways.ip.gateway import MEMBERSHIP, NO_ADDRESS, NO_ROOM, Ip

pytestmark = IN_NAMESPACES


@pytest.mark.parametrize(("first", "second", "header"), [("10.77.0.1", "10.77.0.2", 28), ("fd77::1", "fd77::2", 48)])
async def test_a_datagram_reaches_the_vehicle_that_has_its_address_and_no_other(first: str, second: str, header: int) -> None:
    async with machines(layer=3) as context:
        with udp("car1", first) as sender, udp("car2", second, 9000) as listener:
            sender.sendto(b"x" * 100, (second, 9000))
            assert await next_datagram(listener) == (b"x" * 100, first)
    assert [(each.sender, each.to, len(each.payload)) for each in context.offered] == [(0, 1, 100 + header)]
    assert not context.counts


@pytest.mark.parametrize("to", ["10.77.255.255", "255.255.255.255"])
async def test_a_broadcast_is_a_broadcast_by_radio(to: str) -> None:
    async with machines(layer=3) as context:
        with udp("car2", "10.77.0.2") as sender, udp("car1", "", 9000) as one, udp("car3", "", 9000) as other:
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            sender.sendto(b"all", (to, 9000))
            for listener in (one, other):
                assert await next_datagram(listener) == (b"all", "10.77.0.2")
    assert [(each.sender, each.to) for each in context.offered] == [(1, BROADCAST)]


@pytest.mark.parametrize(("group", "own"), [("239.255.0.1", "10.77.0.1"), ("ff05::77", "fd77::1")])
async def test_a_multicast_reaches_members_and_memberships_cost_no_air_time(group: str, own: str) -> None:
    async with machines(layer=3) as context:
        anywhere = "::" if ":" in group else "0.0.0.0"
        with udp("car1", own) as sender, udp("car3", anywhere, 9000) as joined, udp("car2", anywhere, 9000) as not_joined:
            if ":" in group:
                member = socket.inet_pton(socket.AF_INET6, group) + struct.pack("@I", 0)
                joined.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, member)
            else:
                joined.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + bytes(4))
            await until(lambda: MEMBERSHIP in context.counts.get("car3", {}))
            sender.sendto(b"group", (group, 9000))
            assert await next_datagram(joined) == (b"group", own)
            with pytest.raises(TimeoutError):
                await next_datagram(not_joined, 0.05)
    assert [(each.sender, each.to) for each in context.offered] == [(0, BROADCAST)]


async def test_packets_to_unknown_addresses_are_counted_and_not_sent() -> None:
    async with machines(layer=3, vehicles=("car1", "car2")) as context:
        with udp("car1", "10.77.0.1") as sender:
            for nobody in ("10.77.0.3", "10.77.9.9"):  # the third vehicle has no interface
                sender.sendto(b"hello?", (nobody, 9000))
            await until(lambda: context.counts.get("car1", {}).get(NO_ADDRESS) == 2)
    assert not context.offered


async def test_idle_vehicles_send_nothing() -> None:
    """Without programs there is no router solicitation, address detection or neighbour request: the air is free."""
    async with machines(layer=3) as context:
        await asyncio.sleep(1.2)
    assert not context.offered
    assert not context.counts


@pytest.mark.needs("ping")
@pytest.mark.parametrize("to", ["10.77.0.2", "fd77::2"])
async def test_ping_measures_the_channels_delay_and_loss(to: str) -> None:
    def number(packet: bytes) -> int:
        return int(struct.unpack_from(">H", packet, 26 if packet[0] >> 4 == 4 else 46)[0])  # icmp_seq

    def least_ms(output: str) -> float:
        found = re.search(r"min/avg/max/mdev = ([\d.]+)", output)
        return float(found[1]) if found else float("inf")

    context = RunlessContext(CARS[:2], run=RUN, delay_s=0.02, hears=lambda sender, receiver, place: (place * 7) % 10 >= 3)
    in_time: set[int] = set()

    class Noted(Ip):
        """Records replies until the last request is sent; ping certainly listens until then."""

        def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
            super().deliver(sender, receiver, payload)
            self._read(self._radios[0, ""])  # requests sent by now
            if sender == 1 and sum(each.sender == 0 for each in context.offered) < 40:
                in_time.add(number(payload))

    async with open_gateway(Noted(layer=3), context):
        _, out = await run_command("car1", "ping", "-n", "-c", "40", "-i", "0.01", "-W", "5", to)
        offered = list(context.offered)
        quickest_ms, until_s = least_ms(out), time.monotonic() + 20.0
        while quickest_ms >= 80.0 and time.monotonic() < until_s:  # held up all the time, it is slower than others
            _, more = await run_command("car1", "ping", "-n", "-c", "10", "-i", "0.01", "-W", "5", to)
            quickest_ms = min(quickest_ms, least_ms(more))
    back = {number(each.payload) for each in offered if each.sender == 1}
    delivered_back = {number(each.payload) for place, each in enumerate(offered) if each.sender == 1 and (place * 7) % 10 >= 3}
    sequence_numbers = {int(each) for each in re.findall(r"icmp_seq=(\d+) ", out)}
    assert 40 == sum(each.sender == 0 for each in offered) > len(back) > len(delivered_back)
    assert in_time <= sequence_numbers <= delivered_back
    assert sequence_numbers
    assert f"40 packets transmitted, {len(sequence_numbers)} received" in out
    assert 40.0 <= quickest_ms < 80.0


async def test_the_kernel_splits_a_long_datagram_at_the_mtu() -> None:
    async with machines(layer=3, mtu_bytes=127) as context:
        with udp("car1", "10.77.0.1") as sender, udp("car2", "10.77.0.2", 9000) as listener:
            sender.sendto(bytes(1000), ("10.77.0.2", 9000))
            assert await next_datagram(listener) == (bytes(1000), "10.77.0.1")
    assert len(context.offered) == 10  # 1008 bytes with the header of UDP, at most 104 of them in a packet (RFC 791)
    assert max(len(each.payload) for each in context.offered) == 124
    assert not any("fd77" in line for line in context.lines)  # IPv6 needs 1280 bytes


async def test_without_room_packets_wait_in_the_kernel_and_more_than_its_queue_holds_is_counted() -> None:
    def sent(context: RunlessContext) -> list[bytes]:
        return [each.payload for each in context.offered if each.sender == 0]

    async with machines(layer=3) as context:
        with udp("car1", "10.77.0.1") as sender:
            context.room = False
            for number in range(2 * namespaces.QUEUE):
                sender.sendto(struct.pack(">I", number), ("10.77.0.2", 9000))
                await asyncio.sleep(0)
            await until(lambda: NO_ROOM in context.counts.get("car1", {}))
            assert not context.offered
            context.room = True
            await until(lambda: len(sent(context)) + context.counts["car1"][NO_ROOM] == 2 * namespaces.QUEUE)
    numbers = [struct.unpack(">I", each[28:])[0] for each in sent(context)]
    assert namespaces.QUEUE <= len(numbers) <= namespaces.QUEUE + 2
    assert numbers == list(range(len(numbers)))  # the first packets, in order; later ones find no room


NEITHER = (b"", b"\x93agents speak MessagePack", bytes(65535))


@pytest.mark.parametrize(
    ("layer", "payloads"),
    [(2, (*NEITHER, bytes(13), bytes(14))), (3, (*NEITHER, b"\x45" * 20, b"\x60" * 40, b"\x45" + bytes(40)))],
    ids=["no frames", "no IP packets"],
)
async def test_messages_of_agents_are_ignored(layer: Literal[2, 3], payloads: Sequence[bytes]) -> None:
    gateway = Ip(layer=layer)
    async with open_gateway(gateway, RunlessContext(CARS, run=RUN)):
        with udp("car2", "10.77.0.2", 9000) as listener, udp("car1", "10.77.0.1") as sender:
            for payload in payloads:
                gateway.deliver(0, 1, payload)
            sender.sendto(b"after it", ("10.77.0.2", 9000))
            assert await next_datagram(listener) == (b"after it", "10.77.0.1")


@pytest.mark.needs("ping")
async def test_real_machines_join_through_a_vehicle() -> None:
    """A namespace with cables to the host stands in for a robot behind car1, as a machine in a laboratory would."""
    context = RunlessContext(CARS, run=RUN, delay_s=0.01)
    robot, cable = f"{RUN}-robot", f"v{os.getpid()}"
    ip = f"ip -n {robot}"
    async with open_gateway(Ip(layer=3, routes={"car1": ("192.168.213.0/24", "fd05:213::/64")}), context):
        assert any("behind car1: 192.168.213.0/24" in line for line in context.lines)
        try:
            namespaces.create(robot)
            shell(f"ip link add {cable} type veth peer name eth0 netns {robot}")
            shell(f"ip addr add 192.168.213.1/24 dev {cable}; ip link set {cable} up")
            shell(f"{ip} addr add 192.168.213.10/24 dev eth0; {ip} link set eth0 up; {ip} link set lo up")
            shell(f"{ip} route add default via 192.168.213.1")
            Path(f"/proc/sys/net/ipv4/conf/{cable}/forwarding").write_text("1")
            for _ in range(3):  # one at a time: after the last of many requests, ping waits no longer than two have taken
                code, out = await run_command("car2", "ping", "-n", "-c", "1", "-W", "30", "192.168.213.10")
                assert (code, "1 received" in out) == (0, True), out
            assert [(each.sender, each.to) for each in context.offered] == 3 * [(1, 0), (0, 1)]
            for _ in range(3):
                out = await asyncio.to_thread(shell, f"ip netns exec {robot} ping -n -c 1 -W 30 10.77.0.3")
                assert "1 received" in out
            assert [(each.sender, each.to) for each in context.offered[6:]] == 3 * [(0, 2), (2, 0)]
        finally:
            namespaces.remove(robot)
            subprocess.run(["ip", "link", "del", cable], check=False, capture_output=True)
    assert "192.168.213" not in shell("ip rule")
    assert "fd05:213" not in shell("ip -6 rule")
    assert namespaces.port_of(RUN, "car1", (), ()).interface not in shell("ip link")


# --- refusals ---


@pytest.mark.parametrize(
    ("params", "problem"),
    [
        ({"network": "10.77.0.0"}, "network: 10.77.0.0/32 has too few addresses for 3 vehicles"),
        ({"network": "10.77.0.0/30"}, "network: 10.77.0.0/30 has too few addresses for 3 vehicles"),
        ({"network": "10.77.0.5/16"}, "bridge.ip.network: 10.77.0.5/16 has host bits set"),
        ({"network6": "10.78.0.0/16"}, "bridge.ip.network6: 10.78.0.0/16 is an IPv4 network"),
        ({"mtu_bytes": 60}, "bridge.ip.mtu_bytes: "),
        ({"mtu_bytes": 65_522}, "mtu_bytes: more than 65521 bytes need layer = 3, not 65522 and 2"),
        ({"layer": 4}, "bridge.ip.layer: "),
        ({"vehicles": ["car9"]}, "vehicles: unknown vehicle 'car9'"),
        ({"routes": {"car9": ["192.168.5.0/24"]}}, "routes: unknown vehicle with an interface 'car9'"),
        ({"routes": {"car1": ["10.77.3.0/24"]}}, "10.77.3.0/24 overlaps 10.77.0.0/16"),
        ({"routes": {"car1": ["192.168.5.0/24"], "car2": ["192.168.0.0/16"]}}, "overlaps 192.168.5.0/24"),
        ({"routes": {"car1": ["fd05::/64"]}, "mtu_bytes": 1000}, "fd05::/64 needs IPv6, and mtu_bytes of 1280 or more"),
    ],
)
def test_parameters_without_a_meaning_are_refused_before_anything_is_created(params: dict[str, Any], problem: str) -> None:
    with pytest.raises((ValueError, ScenarioError), match=re.escape(problem)):
        binding.call(Ip, params, key="bridge.ip").check(CARS)


# --- remains ---


async def test_nothing_is_left_after_closing() -> None:
    async with machines():
        assert len(remains_of_run(CARS)) == 4
        assert [each.alive for each in run_networks.networks() if each.run == RUN] == [True]
        with pytest.raises(run_networks.RunAlive):
            run_networks.clear(RUN)
    assert not remains_of_run(CARS)


async def test_a_second_run_of_one_name_is_refused_and_the_first_goes_on() -> None:
    async with machines(*CARS[:2]):
        with pytest.raises(GatewayError, match=rf"a run named {RUN} already has a network on this machine"):
            async with machines(*CARS[:2]):
                pass
        with udp("car1", "10.77.0.1") as sender, udp("car2", "10.77.0.2", 9000) as listener:
            sender.sendto(b"still", ("10.77.0.2", 9000))
            assert (await next_datagram(listener))[0] == b"still"


async def test_a_foreign_namespace_is_not_changed() -> None:
    namespaces.create(space("car2"))
    try:
        with pytest.raises(GatewayError, match=f"the network namespace {space('car2')} already exists"):
            async with machines():
                pass
        assert (namespaces.NAMES / space("car2")).exists()
    finally:
        namespaces.remove(space("car2"))
    assert not remains_of_run(CARS)


async def test_a_foreign_interface_is_not_changed() -> None:
    interface = namespaces.port_of(RUN, "car1", (), ()).interface
    shell(f"ip link add {interface} type veth peer name r{os.getpid()}")
    try:
        with pytest.raises(
            GatewayError, match=f"the network interface {interface} already exists; .*: ip link delete {interface}"
        ):
            async with machines(routes={"car1": ("192.168.213.0/24",)}):
                pass
        assert interface in shell("ip link")
    finally:
        shell(f"ip link del {interface}")
    assert not remains_of_run(CARS)


async def test_a_kernel_without_time_is_not_taken_for_a_run_of_the_same_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(*_: object) -> int:
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(namespaces, "open_radio", busy)
    with pytest.raises(GatewayError, match=f"the network of {RUN} cannot be created: .*temporarily unavailable"):
        async with machines():
            pass
    assert not remains_of_run(CARS)


async def test_packets_of_a_network_go_through_one_run() -> None:
    """The host routes by source and destination: of two runs with equal addresses, one would receive the other's packets."""

    other = f"{RUN}other"
    async with machines(routes={"car2": ("192.168.213.0/24",)}):
        part_of_it = {"car1": ("192.168.213.64/26",)}
        with pytest.raises(GatewayError) as refused:
            async with machines(run=other, routes=part_of_it):
                pass
        assert f"{RUN} on this machine already routes the traffic from 192.168.213.64/26 to 10.77.0.0/16" in str(refused.value)
        assert not remains_of_run(CARS, other)
        assert shell("ip rule").count("192.168.213.") == 1  # unchanged
        async with machines(run=other, network="10.78.0.0/16", routes=part_of_it):
            pass


async def test_interfaces_of_many_vehicles_are_closed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel takes 20 ms for each; a bridge that is slow to close is killed."""

    gateway, both, close = Ip(), threading.Barrier(2), os.close
    async with open_gateway(gateway, RunlessContext(CARS[:2], run=RUN)):
        radios = {each.packets for each in gateway._radios.values()}

        def close_together(descriptor: int) -> None:
            if descriptor in radios:
                radios.remove(descriptor)  # the next file to be opened has this number
                both.wait(PATIENCE_S)
            close(descriptor)

        monkeypatch.setattr(os, "close", close_together)
    monkeypatch.undo()
    assert not both.broken
    assert not remains_of_run(CARS)


# --- other interfaces of the machine ---


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(run_networks, "FOLDER", tmp_path / "net")
    return tmp_path / "net" / RUN


def test_the_lock_is_exclusive_and_names_are_readable(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "lock").touch(mode=0o666)  # left by an earlier version or by another program
    for each in (folder, folder.parent):
        each.chmod(0o700)
    usual = os.umask(0o077)
    try:
        lease = run_networks.Lease(RUN)
        lease.tell(run_networks.RunNetwork(run=RUN, pid=os.getpid(), spaces=()))
    finally:
        os.umask(usual)
    found = {each.name: oct(each.stat().st_mode & 0o777) for each in (folder.parent, folder, *folder.iterdir())}
    lease.end()
    assert found | {"network.json": ""} == {"net": "0o755", RUN: "0o755", "lock": "0o600", "hosts": "0o644", "network.json": ""}


def test_a_reader_of_names_does_not_block_a_new_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir(parents=True)
    looking = (folder / "lock").open("w")
    fcntl.flock(looking, fcntl.LOCK_SH)
    monkeypatch.setattr("vcmvsp.netsim.bridge.gateways.ip.run_networks.time.sleep", lambda _: looking.close())
    run_networks.Lease(RUN).end()
    assert looking.closed


@pytest.mark.parametrize("own", [True, False])
def test_force_ends_the_process_of_the_run_and_not_another_that_has_its_number(folder: Path, own: bool) -> None:
    with subprocess.Popen(["sleep", "60"]) as process:
        try:
            started = run_networks.started(process.pid) - (not own)
            lease = run_networks.Lease(RUN)
            lease.tell(run_networks.RunNetwork(run=RUN, pid=process.pid, started=started, spaces=()))
            if own:
                run_networks.clear(RUN, force=True)
                assert process.wait(PATIENCE_S) == -signal.SIGTERM
            else:
                with pytest.raises(OSError, match=f"process {process.pid} is not the run's; .*'fuser {folder}/lock'"):
                    run_networks.clear(RUN, force=True)
                assert process.poll() is None
            lease.end()
        finally:
            process.kill()


KILLED = """
import asyncio, sys
sys.path.insert(0, {root!r})
from vcmvsp.netsim.bridge.gateways.ip.gateway import Ip
from tests.support.netsim.gateway_context import RunlessContext

async def body():
    gateway = Ip(routes={{"car1": ("192.168.214.0/24",)}})
    await gateway.open(RunlessContext(("car1", "car2"), run={run!r}))
    print("open", flush=True)
    await asyncio.sleep(60)

asyncio.run(body())
"""


@pytest.mark.parametrize("cleared_by", ["net down", "the next run"])
def test_remains_of_a_killed_run_are_removed(cleared_by: str) -> None:
    run = f"{RUN}k"
    text = KILLED.format(root=str(ROOT), run=run)
    with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        assert [each.alive for each in run_networks.networks() if each.run == run] == [True]
        process.send_signal(signal.SIGKILL)
    assert [each.alive for each in run_networks.networks() if each.run == run] == [False]
    assert len(remains_of_run(CARS[:2], run)) == 3
    assert "192.168.214.0/24" in shell("ip rule")

    async def body() -> None:
        async with machines(*CARS[:2], run=run):
            pass

    if cleared_by == "net down":
        run_networks.clear(run)
        run_networks.clear(run)  # a second call has no effect
    else:
        asyncio.run(body())
    assert not remains_of_run(CARS[:2], run)
    assert "192.168.214.0/24" not in shell("ip rule")
