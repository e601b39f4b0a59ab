"""Receivers of IP packets: the correct one for real packets, an answer for any bytes."""

import ipaddress
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import BROADCAST
from vcmvsp.netsim.bridge.gateways.ip.gateway import MEMBERSHIP, NO_ADDRESS, NO_IP, Directory, address_in, network_of
from vcmvsp.netsim.bridge.gateways.ip.namespaces import Network

SHARED = network_of("10.77.0.0/16", "network", 4), network_of("fd77::/64", "network6", 6)
VEHICLES = 3
BEHIND = {
    0: [network_of("192.168.0.0/16", "routes"), network_of("fd05::/64", "routes")],
    1: [network_of("192.168.5.0/24", "routes"), network_of("fd05::5:0/112", "routes")],
}
DIRECTORY = Directory(SHARED, range(VEHICLES), BEHIND)


def packet4(target: str, protocol: int = 17, payload: bytes = b"data") -> bytes:
    ends = ipaddress.IPv4Address("10.77.0.1").packed + ipaddress.IPv4Address(target).packed
    return struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(payload), 0, 0, 64, protocol, 0) + ends + payload


def packet6(target: str, following: int = 17, payload: bytes = b"data") -> bytes:
    ends = ipaddress.IPv6Address("fd77::1").packed + ipaddress.IPv6Address(target).packed
    return struct.pack(">IHBB", 6 << 28, len(payload), following, 64) + ends + payload


@pytest.mark.parametrize(
    ("packet", "goes_to"),
    [
        (packet4("10.77.0.2"), 1),
        (packet6("fd77::3"), 2),
        (packet4("10.77.0.4"), NO_ADDRESS),  # there is no fourth vehicle
        (packet4("10.77.0.1"), NO_ADDRESS),  # no vehicle sends to itself by radio
        (packet4("8.8.8.8"), NO_ADDRESS),
        (packet4("10.77.255.255"), BROADCAST),
        (packet4("255.255.255.255"), BROADCAST),
        (packet4("224.0.0.251"), BROADCAST),
        (packet4("239.255.0.1"), BROADCAST),
        (packet6("ff02::fb"), BROADCAST),
        (packet4("192.168.5.7"), 1),  # the longest prefix wins
        (packet6("fd05::5:7"), 1),
        (packet4("192.168.6.7"), NO_ADDRESS),  # behind the sender itself
        (packet4("224.0.0.22", protocol=2), MEMBERSHIP),
        (packet6("ff02::2", 58, bytes([133, 0, 0, 0])), MEMBERSHIP),  # router solicitation
        (packet6("ff02::16", 0, bytes([58, 0, 5, 2, 0, 0, 1, 0, 143, 0])), MEMBERSHIP),  # behind hop-by-hop options
        (packet6("fd77::2", 58, bytes([128, 0])), 1),  # an echo request
        (packet6("fd77::2", 0, bytes([17, 0, 1, 4, 0, 0, 0, 0, 143, 0])), 1),  # options, but UDP behind them
        (b"", NO_IP),
        (packet4("10.77.0.2")[:19], NO_IP),
        (packet6("fd77::3")[:39], NO_IP),
        (b"\x55" + packet4("10.77.0.2")[1:], NO_IP),
    ],
)
def test_a_packet_goes_to_its_destination(packet: bytes, goes_to: int | str) -> None:
    assert DIRECTORY.goes_to(0, packet) == goes_to


@given(st.binary(max_size=80) | st.tuples(st.sampled_from([b"\x45", b"\x60"]), st.binary(max_size=120)).map(b"".join))
def test_for_any_bytes_there_is_an_answer(packet: bytes) -> None:
    answer = DIRECTORY.goes_to(2, packet)
    assert answer in (0, 1, BROADCAST, NO_ADDRESS, NO_IP, MEMBERSHIP)


NEAR = ("10.77.0.0/29", "192.168.0.0/16", "192.168.5.0/24", "fd77::/125", "fd05::/64", "fd05::5:0/112")


@given(
    st.ip_addresses() | st.sampled_from(NEAR).flatmap(lambda near: st.ip_addresses(network=near)), st.integers(0, VEHICLES - 1)
)
def test_routes_are_chosen_as_the_library_of_addresses_would(
    address: ipaddress.IPv4Address | ipaddress.IPv6Address, sender: int
) -> None:
    packet = packet4(str(address)) if address.version == 4 else packet6(str(address))
    holding = [(each.prefixlen, row) for row, behind in BEHIND.items() for each in behind if address in each]
    own = {address_in(network, row): row for network in SHARED for row in range(VEHICLES)}
    if address.is_multicast or str(address) in ("255.255.255.255", "10.77.255.255"):
        expected: int | str = BROADCAST
    else:
        expected = own.get(address, max(holding)[1] if holding else NO_ADDRESS)
    assert DIRECTORY.goes_to(sender, packet) == (NO_ADDRESS if expected == sender else expected)


@given(st.sampled_from(SHARED), st.integers(0, 1000))
def test_vehicles_have_addresses_of_their_own(network: Network, row: int) -> None:
    directory = Directory(SHARED, range(1001), {})
    packet = packet4 if network.version == 4 else packet6
    sender = 0 if row else 1
    assert directory.goes_to(sender, packet(str(address_in(network, row)))) == row


@pytest.mark.parametrize(
    ("text", "version", "problem"),
    [
        ("10.77.0.1/16", 4, "has host bits set"),
        ("nowhere", 4, "write ADDRESS/BITS"),
        ("fd77::/64", 4, "is an IPv6 network; this key needs IPv4"),
        ("10.77.0.0/16", 6, "is an IPv4 network; this key needs IPv6"),
        ("127.0.0.0/8", 4, "is reserved"),
        ("224.0.0.0/8", 4, "is reserved"),
        ("fe80::/64", 6, "is reserved"),
    ],
)
def test_an_unsuitable_network_is_refused(text: str, version: int, problem: str) -> None:
    with pytest.raises(ScenarioError, match=rf"^network: .*{problem}"):
        network_of(text, "network", version)
