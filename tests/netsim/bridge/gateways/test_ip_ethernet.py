"""IP gateway on layer 2: the next hop receives, and address resolution crosses the air."""

import asyncio
import ipaddress
import re
import socket
import struct

import pytest

from tests.support.netsim.gateway_context import OfferedPacket, RunlessContext, open_gateway
from tests.support.netsim.vehicle_namespaces import (
    CARS,
    IN_NAMESPACES,
    RUN,
    machines,
    next_datagram,
    run_command,
    shell,
    space,
    udp,
)
from vcmvsp.netsim.bridge.gateways.base import BROADCAST
from vcmvsp.netsim.bridge.gateways.ip import ethernet
from vcmvsp.netsim.bridge.gateways.ip.gateway import Ip

ARP, IPV4, IPV6 = 0x0806, 0x0800, 0x86DD  # EtherTypes of IEEE 802


def kinds(context: RunlessContext, type_: int) -> list[OfferedPacket]:
    return [each for each in context.offered if int.from_bytes(each.payload[12:14], "big") == type_]


def checksum(data: bytes) -> int:
    """Internet checksum (RFC 1071): 0 over data that contain a correct one."""
    words = struct.unpack(f">{(len(data) + 1) // 2}H", data + bytes(len(data) % 2))
    total = sum(words)
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF


def over_ipv4(packet: bytes) -> int:
    """Checksum of UDP or TCP in an IPv4 packet, with the pseudo header."""
    length = (packet[0] & 15) * 4
    segment = packet[length : struct.unpack_from(">H", packet, 2)[0]]
    return checksum(packet[12:20] + struct.pack(">HH", packet[9], len(segment)) + segment)


def test_addresses_are_unicast_local_and_different() -> None:
    """RFC 4291, appendix A: the second lowest bit of the first byte is inverted, ff:fe is inserted in the middle."""
    macs = [ethernet.mac_of(row) for row in (0, 1, 255, ethernet.VEHICLES - 1)]
    assert len({*macs}) == 4
    assert {mac[0] & 3 for mac in macs} == {2}
    assert ethernet.mac_of(0).hex(":") == "02:76:63:6d:00:01"
    assert ethernet.link_local(bytes.fromhex("34567A8B9CDE")) == "fe80::3656:7aff:fe8b:9cde"
    assert ipaddress.IPv6Address(ethernet.link_local(macs[0])).is_link_local


def test_the_destination_address_decides_the_receiver() -> None:
    stations = ethernet.Stations((0, 1), BROADCAST)
    first, second, third = map(ethernet.mac_of, range(3))
    rest = b"\x08\x00" + bytes(46)
    assert stations.goes_to(0, second + first + rest) == 1
    assert stations.goes_to(0, b"\xff" * 6 + first + rest) == BROADCAST
    assert stations.goes_to(1, b"\x33\x33" + bytes(4) + second + rest) == BROADCAST
    assert stations.goes_to(0, third + first + rest) == ethernet.NO_RECEIVER  # no interface
    assert stations.goes_to(0, first + first + rest) == ethernet.NO_RECEIVER
    assert stations.goes_to(0, second + third + rest) == ethernet.FOREIGN
    assert stations.goes_to(0, second + first) == ethernet.NO_FRAME


class TestOnMachines:
    """Programs in network namespaces of Linux."""

    pytestmark = IN_NAMESPACES

    @pytest.mark.parametrize(
        ("first", "second", "header", "type_"), [("10.77.0.1", "10.77.0.2", 28, IPV4), ("fd77::1", "fd77::2", 48, IPV6)]
    )
    async def test_a_neighbour_is_resolved_by_broadcast_and_then_receives(
        self, first: str, second: str, header: int, type_: int
    ) -> None:
        async with machines() as context:
            with udp("car1", first) as sender, udp("car2", second, 9000) as listener:
                sender.sendto(b"x" * 100, (second, 9000))
                assert await next_datagram(listener) == (b"x" * 100, first)
        (datagram,) = [each for each in kinds(context, type_) if each.payload.endswith(b"x" * 100)]
        assert (datagram.sender, datagram.to, datagram.size_bytes) == (0, 1, 100 + header)
        before = context.offered[: context.offered.index(datagram)]
        if type_ == IPV4:
            assert [(each.sender, each.to, each.size_bytes) for each in kinds(context, ARP)] == [(0, BROADCAST, 28), (1, 0, 28)]
        assert any(each.sender == 0 and each.to == BROADCAST for each in before)
        assert any(each.sender == 1 and each.to == 0 for each in before)
        assert not context.counts

    async def test_address_resolution_has_the_channels_delay_and_losses(self) -> None:
        """The first ARP request is lost, and the kernel repeats it after 1 s: 2 x 30 ms later the datagram is sent."""
        context = RunlessContext(CARS[:2], run=RUN, delay_s=0.03, hears=lambda sender, receiver, place: not is_first_arp(place))

        def is_first_arp(place: int) -> bool:
            return context.offered[place] is kinds(context, ARP)[0] if kinds(context, ARP) else False

        async with open_gateway(Ip(mtu_bytes=1000), context):
            with udp("car1", "10.77.0.1") as sender, udp("car2", "10.77.0.2", 9000) as listener:
                sender.sendto(b"there?", ("10.77.0.2", 9000))
                assert await next_datagram(listener) == (b"there?", "10.77.0.1")
        lost, again, answer = kinds(context, ARP)[:3]
        (datagram,) = [each for each in kinds(context, IPV4) if each.payload.endswith(b"there?")]
        assert [(each.sender, each.to) for each in (lost, again, answer)] == [(0, BROADCAST), (0, BROADCAST), (1, 0)]
        assert again.came_ns - lost.came_ns > 0.9e9
        assert datagram.came_ns - again.came_ns > 0.06e9

    async def test_the_next_hop_receives_and_forwards(self) -> None:
        """Car1 and car3 are out of range of each other; the route leads over car2, which decrements the TTL."""
        chain = {(0, 1), (1, 0), (1, 2), (2, 1)}
        context = RunlessContext(CARS, run=RUN, hears=lambda sender, receiver, place: (sender, receiver) in chain)
        async with open_gateway(Ip(), context):
            for car, to in (("car1", "10.77.0.3"), ("car3", "10.77.0.1")):
                assert (await run_command(car, "ip", "route", "add", to, "via", "10.77.0.2"))[0] == 0
            assert (await run_command("car2", "sysctl", "-qw", "net.ipv4.ip_forward=1"))[0] == 0
            with udp("car1", "10.77.0.1") as sender, udp("car3", "10.77.0.3", 9000) as listener:
                for number in range(3):
                    sender.sendto(b"onwards %d" % number, ("10.77.0.3", 9000))
                    assert await next_datagram(listener) == (b"onwards %d" % number, "10.77.0.1")
        hops = [(each.sender, each.to, each.payload[22]) for each in kinds(context, IPV4) if b"onwards" in each.payload]
        assert hops == 3 * [(0, 1, 64), (1, 2, 63)]
        assert not [each for each in kinds(context, IPV4) if each.payload[23] == 1]  # no ICMP redirect to the direct way

    async def test_link_local_addresses_are_usable_at_once(self) -> None:
        async with machines() as context:
            _, output = await run_command("car1", "ip", "-6", "addr", "show", "radio0", "scope", "link")
            assert ethernet.link_local(ethernet.mac_of(0)) in output
            assert "tentative" not in output
            own = (ethernet.link_local(ethernet.mac_of(0)), 0, 0, 2)
            with udp("car2", "::", 9000) as listener, udp("car1", "::") as sender:
                group = socket.inet_pton(socket.AF_INET6, "ff02::77") + struct.pack("@I", 2)
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, group)
                sender.sendto(b"all on this link", ("ff02::77", 9000, 0, 2))
                data, source = await next_datagram(listener)
            assert (data, source.partition("%")[0]) == (b"all on this link", own[0])
        (datagram,) = [each for each in kinds(context, IPV6) if b"all on this link" in each.payload]
        assert (datagram.to, datagram.size_bytes) == (BROADCAST, 40 + 8 + 16)

    @pytest.mark.needs("iperf3")
    async def test_frames_are_complete_as_they_leave_the_kernel(self) -> None:
        """Checksums are filled in and segments fit the interface: no work is left to a network card."""
        async with machines(*CARS[:2], mtu_bytes=1400) as context:
            await run_command("car2", "iperf3", "-s", "-1", "-D")
            code, output = await run_command("car1", "sh", "-c", "sleep 0.5; exec iperf3 -c 10.77.0.2 -n 300k -w 32k")
            assert code == 0, output
        packets = [each.payload[14:] for each in kinds(context, IPV4)]
        assert sum(len(each) for each in packets) > 200_000  # iperf3 leaves before the last 32 kB have
        assert max(len(each) for each in packets) == 1400
        assert {checksum(each[:20]) for each in packets} == {0}
        assert {over_ipv4(each) for each in packets if each[9] in (6, 17)} == {0}

    @pytest.mark.needs("ping")
    async def test_networks_behind_a_vehicle_are_reached_by_its_address(self) -> None:
        async with machines(routes={"car1": ("192.168.215.0/24", "fd05:215::/64")}) as context:
            for version, to, via in ((4, "192.168.215.0/24", "10.77.0.1"), (6, "fd05:215::/64", "fd77::1")):
                _, output = await run_command("car2", "ip", f"-{version}", "route", "show", to)
                assert f"{to} via {via} dev radio0" in output
            _, output = await run_command("car2", "ping", "-n", "-c", "1", "-W", "1", "192.168.215.1")
            sent = [each for each in kinds(context, IPV4) if each.sender == 1]
        assert [each.to for each in sent] == [0], output

    async def test_the_interface_has_the_configured_mtu(self) -> None:
        async with machines(mtu_bytes=1300):
            output = await asyncio.to_thread(shell, f"ip -n {space('car3')} link show radio0")
        assert re.search(r"mtu 1300\b", output)
        assert f"link/ether {ethernet.mac_of(2).hex(':')}" in output
        assert "POINTOPOINT" not in output
