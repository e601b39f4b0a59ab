"""Addresses of a network of vehicles, and the destination vehicle of an IP packet, by its destination address alone."""

import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import BROADCAST

NO_ADDRESS = "no such address"
NO_IP = "not an IP packet"
MEMBERSHIP = "reports to multicast routers, kept off the air"
"""Reasons to drop a packet, for `GatewayContext.count`."""

HEADER4, HEADER6 = 20, 40  # bytes at least
LEAST_MTU6 = 1280  # RFC 8200, section 5: no IPv6 on a link with less

_IGMP, _HOP_BY_HOP, _ICMP6 = 2, 0, 58  # protocol numbers
_TO_ROUTERS = frozenset((130, 131, 132, 133, 143))  # ICMPv6: listener queries and reports (RFC 2710, 3810), router solicitation

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
Address = ipaddress.IPv4Address | ipaddress.IPv6Address


def network_of(text: str, key: str, version: int | None = None) -> Network:
    """Parse a network of private addresses, e.g. ``10.77.0.0/16``, of this version of IP (None: either).

    Raises:
        ScenarioError: the text under ``key`` is no network, or a reserved one.
    """
    problem = ""
    try:
        network = ipaddress.ip_network(text)
    except ValueError as error:
        example = "fd77::/64" if version == 6 else "10.77.0.0/16"
        raise ScenarioError(f"{error}; write ADDRESS/BITS, e.g. {example}", key=key) from None
    if version not in (None, network.version):
        problem = f"{text} is a network of IPv{network.version}, not of IPv{version}"
    elif network.is_multicast or network.is_loopback or network.is_link_local or network.is_unspecified:
        problem = f"{text} is reserved; private networks are in 10.0.0.0/8, 192.168.0.0/16 and fd00::/8"
    if problem:
        raise ScenarioError(problem, key=key)
    return network


def address_in(network: Network, row: int) -> Address:
    """The address of the vehicle in this row; row 0 has the first host address."""
    return network[row + 1]


@dataclass(frozen=True)
class RoutedNetwork:
    """A network behind a vehicle."""

    network: Network
    row: int  # of the vehicle

    def holds(self, address: bytes) -> bool:
        """Whether the network contains a packed address."""
        bits = self.network.max_prefixlen
        if bits != 8 * len(address):
            return False
        return not (int.from_bytes(address) ^ int(self.network.network_address)) >> (bits - self.network.prefixlen)


class Directory:
    """Vehicle of each address.

    Args:
        networks: shared by the vehicles.
        rows: vehicles with an interface.
        routed: networks behind vehicles, by row; the narrowest network that contains an address counts.
    """

    def __init__(self, networks: Sequence[Network], rows: Sequence[int], routed: Mapping[int, Sequence[Network]]) -> None:
        self._rows = {address_in(network, row).packed: row for network in networks for row in rows}
        shared = {network.broadcast_address.packed for network in networks if network.version == 4}
        self._broadcasts = shared | {b"\xff\xff\xff\xff"}
        behind = [RoutedNetwork(network, row) for row, each in routed.items() for network in each]
        self._routed = sorted(behind, key=lambda each: -each.network.prefixlen)

    def goes_to(self, sender: int, packet: bytes) -> int | str:
        """The row of the destination vehicle, `BROADCAST`, or the reason to drop the packet.

        Multicast membership reports and router solicitations, which the kernel sends by itself, are dropped: there are no
        multicast routers.
        """
        if not is_ip(packet):
            return NO_IP
        if packet[0] >> 4 == 4:
            target = packet[16:HEADER4]
            is_group, is_membership = target[0] >> 4 == 0xE, packet[9] == _IGMP
        else:
            target = packet[24:HEADER6]
            is_group, is_membership = target[0] == 0xFF, _icmp6_type(packet) in _TO_ROUTERS
        if is_membership:
            return MEMBERSHIP
        return BROADCAST if is_group or target in self._broadcasts else self._row(sender, target)

    def _row(self, sender: int, target: bytes) -> int | str:
        row = self._rows.get(target)
        if row is None:
            row = next((each.row for each in self._routed if each.holds(target)), None)
        return NO_ADDRESS if row is None or row == sender else row


def is_ip(packet: bytes) -> bool:
    """Whether the bytes begin with a complete IP header."""
    version = packet[0] >> 4 if packet else 0
    return (version == 4 and len(packet) >= HEADER4) or (version == 6 and len(packet) >= HEADER6)


def _icmp6_type(packet: bytes) -> int:
    """Type of an ICMPv6 message, also after hop-by-hop options; -1: not ICMPv6, or truncated."""
    kind, start = packet[6], HEADER6
    if kind == _HOP_BY_HOP and len(packet) >= HEADER6 + 2:
        kind, start = packet[HEADER6], HEADER6 + 8 * (packet[HEADER6 + 1] + 1)
    return packet[start] if kind == _ICMP6 and len(packet) > start else -1
