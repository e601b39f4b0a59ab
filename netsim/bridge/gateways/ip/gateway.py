"""IP gateway: each vehicle is a network namespace of Linux; unchanged programs in it communicate over its radio.

A namespace has one interface, `namespaces.RADIO`, or one for each of several radios: the gateway reads what the kernel sends
there, and writes there what the vehicle receives. On layer 2 these are Ethernet frames (TAP): the next hop is the receiver, and
ARP and neighbour discovery cross the air. On layer 3 these are IP packets (TUN): the destination of a packet is its receiver. A
hop on the air is a hop of IP.
"""

import asyncio
import contextlib
import functools
import ipaddress
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, GatewayContext, GatewayError, check_names
from vcmvsp.netsim.bridge.gateways.ip import ethernet, namespaces, run_networks
from vcmvsp.netsim.bridge.gateways.ip.namespaces import Network
from vcmvsp.netsim.bridge.gateways.ip.run_networks import Space

NO_ADDRESS = "no such address"
NO_IP = "not an IP packet"
MEMBERSHIP = "reports to multicast routers, kept off the air"
"""Reasons to drop a packet, for `GatewayContext.count`."""

HEADER4, HEADER6 = 20, 40  # bytes at least
LEAST_MTU6 = 1280  # RFC 8200, section 5: no IPv6 on a link with less

_IGMP, _HOP_BY_HOP, _ICMP6 = 2, 0, 58  # protocol numbers
_TO_ROUTERS = frozenset((130, 131, 132, 133, 143))  # ICMPv6: listener queries and reports (RFC 2710, 3810), router solicitation

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

BATCH = 64  # packets of one vehicle before others have their turn
PAUSE_S = 0.002  # without reading when the run has no room; packets wait in the kernel's bounded queue
COUNTING_S = 1.0  # period at which drops of that queue are counted
SHOWN = 12  # vehicles in the list of addresses

NOT_TAKEN = "not taken by the kernel"
NO_ROOM_OF = "no room in the queue of {}"
NO_ROOM = NO_ROOM_OF.format(namespaces.RADIO)

Mtu = Annotated[int, msgspec.Meta(ge=68, le=LARGEST)]  # RFC 791: every link carries 68


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
        problem = f"{text} is an IPv{network.version} network; this key needs IPv{version}"
    elif network.is_multicast or network.is_loopback or network.is_link_local or network.is_unspecified:
        problem = f"{text} is reserved; private networks are in 10.0.0.0/8, 192.168.0.0/16 and fd00::/8"
    if problem:
        raise ScenarioError(problem, key=key)
    return network


def address_in(network: Network, row: int) -> Address:
    """The address of the vehicle in this row; row 0 has the first host address."""
    return network[row + 1]


def network_after(network: Network, number: int) -> Network:
    """The network of equal size that many places later: 10.77.0.0/16, 10.78.0.0/16.

    Raises:
        ValueError: it is not private, as the first one, or none.
    """
    if not number:
        return network
    first = int(network.network_address) + number * network.num_addresses
    with contextlib.suppress(ValueError):
        candidate = ipaddress.ip_network((type(network.network_address)(first), network.prefixlen))
        if candidate.is_private == network.is_private:
            return candidate
    raise ValueError(f"{network} has no {number} private networks of its size after it, one for each further radio")


class Directory:
    """Vehicle of each IP address.

    Args:
        networks: shared by the vehicles.
        routed: networks behind vehicles, by row; the narrowest network that contains an address counts.
    """

    header_bytes = 0  # of a packet, that are no payload on the air

    def __init__(self, networks: Sequence[Network], rows: Sequence[int], routed: Mapping[int, Sequence[Network]]) -> None:
        self._rows = {address_in(network, row).packed: row for network in networks for row in rows}
        shared = {network.broadcast_address.packed for network in networks if network.version == 4}
        self._broadcasts = shared | {b"\xff\xff\xff\xff"}
        behind = [(network, row) for row, each in routed.items() for network in each]
        self._routed = sorted(behind, key=lambda each: -each[0].prefixlen)

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

    def carries(self, sender: int, payload: bytes) -> bool:
        """Whether a payload is an IP packet; messages of agents are none."""
        return is_ip(payload)

    def _row(self, sender: int, target: bytes) -> int | str:
        row = self._rows.get(target)
        if row is None:
            address = ipaddress.ip_address(target)
            row = next((row for network, row in self._routed if address in network), None)
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


@dataclass(frozen=True)
class _Link:
    radio: str  # its name; empty: the only one
    interface: str
    networks: tuple[Network, ...]
    rows: tuple[int, ...]
    addressing: Directory | ethernet.Stations

    def addresses(self, row: int) -> tuple[str, ...]:
        return tuple(str(address_in(each, row)) for each in self.networks)


@dataclass
class _Radio:
    row: int
    link: _Link
    packets: int  # descriptor
    statistics: int  # descriptor
    waiting: tuple[int, bytes] | None = None  # packet without room in the run
    dropped: int = 0  # by the kernel


class Ip:
    """A network namespace for each vehicle: ``vcmvsp net exec car1 -- ping car2``.

    The i-th vehicle of the scenario has the i-th address of both networks. Packets to a multicast group or to the broadcast
    address are broadcast. Of several radios each has an interface with its name, and the next networks of the same size:
    10.77.0.0/16, 10.78.0.0/16; the routing table of a vehicle chooses the radio.

    Args:
        layer: 2: Ethernet. Routing tables and ARP of a vehicle choose the next hop, which receives the frame. 3: IP. Packets to
            an address of a vehicle are unicast to it; there is no ARP, and there are no link-local addresses.
        network: IPv4 network of all vehicles.
        network6: IPv6 network of all vehicles; none if ``mtu_bytes`` is less than 1280.
        mtu_bytes: longest packet; programs and kernel fragment longer ones.
        routes: networks of real machines behind vehicles: ``{ car1 = ["192.168.5.0/24"] }``.
        vehicles: vehicles with an interface; empty: all.
    """

    only_one = True  # namespaces and addresses of a run are one network
    every_radio = True

    def __init__(
        self,
        network: str = "10.77.0.0/16",
        network6: str = "fd77::/64",
        mtu_bytes: Mtu = 1500,
        routes: Mapping[str, tuple[str, ...]] | None = None,
        vehicles: tuple[str, ...] = (),
        layer: Literal[2, 3] = 2,
    ) -> None:
        both = network_of(network, "network", 4), network_of(network6, "network6", 6)
        self._networks: tuple[Network, ...] = both if mtu_bytes >= LEAST_MTU6 else both[:1]
        self._mtu_bytes, self._chosen, self._layer = mtu_bytes, vehicles, layer
        network_behind = functools.partial(network_of, key="routes")
        self._routes = {name: list(map(network_behind, behind)) for name, behind in (routes or {}).items()}
        self._radios: dict[tuple[int, str], _Radio] = {}  # by row and radio
        self._links: list[_Link] = []
        self._lease: run_networks.Lease | None = None
        self._counting: asyncio.TimerHandle | None = None

    def check(self, vehicles: Sequence[str]) -> None:
        """Check names, sizes of networks, and overlaps."""
        check_names("vehicles", self._chosen, vehicles)
        check_names("routes", self._routes, self._chosen or vehicles, "vehicle with an interface")
        for network, key in zip(self._networks, ("network", "network6"), strict=False):
            if network.num_addresses - 2 < len(vehicles):  # its own address, and that of all
                raise ValueError(f"{key}: {network} has too few addresses for {len(vehicles)} vehicles: use a larger network")
        if self._layer == 2 and self._mtu_bytes > LARGEST - ethernet.HEADER:
            raise ValueError(
                f"mtu_bytes: more than {LARGEST - ethernet.HEADER} bytes need layer = 3, not {self._mtu_bytes} and 2"
            )
        if self._layer == 2 and len(vehicles) > ethernet.VEHICLES:
            raise ValueError(f"layer: more than {ethernet.VEHICLES} vehicles need layer = 3")
        self._check_routes(self._networks)

    def check_radios(self, radios: Mapping[str, Sequence[str]]) -> None:
        """Check names of interfaces, networks and the layer for several radios."""
        members = {vehicle for each in radios.values() for vehicle in each}
        if self._chosen and not members & {*self._chosen}:
            raise ValueError(f"vehicles: none of these has a radio {' or '.join(radios)}")
        if len(radios) < 2:
            return
        for name in radios:
            if len(name) > namespaces.NAME_LENGTH:
                most = f"an interface's name has at most {namespaces.NAME_LENGTH} characters"
                raise ValueError(f"radio: {most}, and the radio {name} has {len(name)}: shorten its name")
            if name in namespaces.RESERVED:
                raise ValueError(f"radio: no interface may be called {name}: give the radio another name")
        if self._layer == 3:
            raise ValueError(f"layer: 3 needs one radio: choose one (radio = {next(iter(radios))!r}), or layer = 2 for all")
        if len(radios) > ethernet.RADIOS:
            raise ValueError(f"radio: at most {ethernet.RADIOS} radios have interfaces, not {len(radios)}")
        networks: list[Network] = []
        for key, network in zip(("network", "network6"), self._networks, strict=False):
            try:
                networks += [network_after(network, number) for number in range(len(radios))]
            except ValueError as error:
                raise ValueError(f"{key}: {error}: choose a smaller or lower one") from error
        self._check_routes(networks)

    def _check_routes(self, networks: Sequence[Network]) -> None:
        used = list(networks)
        versions = {each.version for each in used}
        for network in (each for behind in self._routes.values() for each in behind):
            if network.version not in versions:
                raise ValueError(f"routes: {network} needs IPv6, and mtu_bytes of {LEAST_MTU6} or more")
            if same := [each for each in used if each.version == network.version and each.overlaps(network)]:
                raise ValueError(f"routes: {network} overlaps {same[0]}: choose another network")
            used.append(network)

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Create the namespaces and read their packets."""
        self._context = context
        if lacks := namespaces.missing():
            raise GatewayError(f"network namespaces need {lacks}: start the run as root (sudo)")
        chosen = [row for row, name in enumerate(context.vehicles) if not self._chosen or name in self._chosen]
        self._links = self._links_of(chosen)
        rows = [row for row in chosen if self._links_at(row)]
        spaces = {row: self._space(row) for row in rows}
        try:
            self._lease = run_networks.Lease(context.run)
            pid = os.getpid()
            network = run_networks.RunNetwork(
                run=context.run, pid=pid, started=run_networks.started(pid), spaces=tuple(spaces.values())
            )
            self._lease.tell(network)
            for row, space in spaces.items():
                self._make(row, space)
                await asyncio.sleep(0)
        except run_networks.NetworkInUse as error:
            raise GatewayError(str(error)) from None
        except OSError as error:
            raise GatewayError(f"the network of {context.run} cannot be created: {error}") from error
        self._count_dropped()
        return self._lines(list(spaces.values()))

    def _links_of(self, chosen: Sequence[int]) -> list[_Link]:
        vehicles, radios = self._context.vehicles, self._context.radios
        routed = {row: self._routes[name] for row, name in enumerate(vehicles) if name in self._routes}
        links = []
        for number, (radio, members) in enumerate((radios or {"": (*range(len(vehicles)),)}).items()):
            rows = tuple([row for row in chosen if row in members])
            networks = tuple([network_after(each, number) for each in self._networks])
            addressing: Directory | ethernet.Stations = ethernet.Stations(rows, BROADCAST, number)
            if self._layer == 3:
                addressing = Directory(networks, rows, routed)
            interface = radio if len(radios) > 1 else namespaces.RADIO
            links.append(_Link(radio, interface, networks, rows, addressing))
        return links

    def _links_at(self, row: int) -> list[_Link]:
        return [link for link in self._links if row in link.rows]

    def _space(self, row: int) -> Space:
        context, links = self._context, self._links_at(row)
        name = context.vehicles[row]
        port = None
        if behind := self._routes.get(name):
            shared = [network for link in links for network in link.networks]
            port = namespaces.port_of(context.run, name, behind, [*shared, *self._beyond(name)])
        namespace, addresses = f"vcmvsp-{context.run}-{name}", links[0].addresses(row)
        if len(self._links) == 1:
            return Space(vehicle=name, namespace=namespace, addresses=addresses, port=port)
        radios = tuple([run_networks.Interface(radio=each.radio, addresses=each.addresses(row)) for each in links])
        return Space(vehicle=name, namespace=namespace, addresses=addresses, port=port, radios=radios)

    def _beyond(self, vehicle: str) -> list[Network]:
        return [network for name, behind in self._routes.items() if name != vehicle for network in behind]

    def _interface_of(self, row: int, link: _Link) -> namespaces.RadioInterface:
        """The interface of a vehicle: its addresses, and routes to the networks behind other vehicles."""
        addresses = [(address, each.prefixlen) for address, each in zip(link.addresses(row), link.networks, strict=True)]
        beyond = self._beyond(self._context.vehicles[row])
        if self._layer == 3:
            return namespaces.RadioInterface(addresses, [(network, None) for network in beyond], self._mtu_bytes)
        number = self._links.index(link)
        mac = ethernet.mac_of(row, number)
        if len(self._networks) > 1:
            addresses.append((ethernet.link_local(mac), 64))
        routes: list[tuple[Network, str | None]] = []
        for network in beyond:
            at = self._behind_whom(network)
            if next((each for each in self._links_at(row) if at in each.rows), None) is link:  # the first radio of both
                shared = next(each for each in link.networks if each.version == network.version)
                routes.append((network, str(address_in(shared, at))))
        metric = number if len(self._links) > 1 else None
        return namespaces.RadioInterface(addresses, routes, self._mtu_bytes, mac, link.interface, metric)

    def _behind_whom(self, network: Network) -> int:
        """Row of the vehicle that has a network behind it."""
        vehicle = next(name for name, behind in self._routes.items() if network in behind)
        return self._context.vehicles.index(vehicle)

    def _make(self, row: int, space: Space) -> None:
        namespaces.create(space.namespace)
        for link in self._links_at(row):
            interface = self._interface_of(row, link)
            packets = namespaces.inside(space.namespace, functools.partial(namespaces.open_radio, interface))
            try:
                statistics = namespaces.inside(space.namespace, namespaces.statistics)
            except BaseException:
                os.close(packets)
                raise
            self._radios[row, link.radio] = _Radio(row, link, packets, statistics)
        if (port := space.port) is not None:
            namespaces.in_thread(lambda: namespaces.open_port(port, space.namespace))
        for link in self._links_at(row):
            radio = self._radios[row, link.radio]
            self._context.loop.add_reader(radio.packets, self._read, radio)

    def _lines(self, spaces: Sequence[Space]) -> list[str]:
        lines = [f"{each.vehicle}  {'  '.join(_addresses_of(each))}" for each in spaces[:SHOWN]]
        behind = [(each.vehicle, each.port) for each in spaces if each.port is not None]
        lines += [f"behind {name}: {', '.join(port.behind)}, through {port.interface} here" for name, port in behind]
        if len(spaces) > SHOWN:
            lines.append(f"and {len(spaces) - SHOWN} more; 'vcmvsp net status' lists all")
        first, last = spaces[0].vehicle, spaces[-1].vehicle
        return [*lines, f"to run a program in a vehicle's namespace: vcmvsp net exec {first} -- ping {last}"]

    def _read(self, radio: _Radio) -> None:
        for _ in range(BATCH):
            try:
                packet = os.read(radio.packets, LARGEST + ethernet.HEADER)
            except BlockingIOError:
                return
            except OSError:  # the interface was removed
                self._context.loop.remove_reader(radio.packets)
                return
            to = radio.link.addressing.goes_to(radio.row, packet)
            if isinstance(to, str):
                self._context.count(radio.row, to)
            elif not self._offer(radio, to, packet):
                radio.waiting = to, packet
                self._context.loop.remove_reader(radio.packets)
                self._context.loop.call_later(PAUSE_S, self._go_on, radio)
                return

    def _offer(self, radio: _Radio, to: int, packet: bytes) -> bool:
        size_bytes = len(packet) - radio.link.addressing.header_bytes
        return self._context.offer(self, radio.row, to, packet, size_bytes=size_bytes, radio=radio.link.radio)

    def _go_on(self, radio: _Radio) -> None:
        if radio.waiting is None or (radio.row, radio.link.radio) not in self._radios:
            return
        to, packet = radio.waiting
        if self._offer(radio, to, packet):
            radio.waiting = None
            self._context.loop.add_reader(radio.packets, self._read, radio)
        else:
            self._context.loop.call_later(PAUSE_S, self._go_on, radio)

    def _count_dropped(self) -> None:
        for radio in self._radios.values():
            dropped = namespaces.dropped(radio.statistics, radio.link.interface)
            if dropped > radio.dropped:
                self._context.count(radio.row, NO_ROOM_OF.format(radio.link.interface), dropped - radio.dropped)
                radio.dropped = dropped
        self._counting = self._context.loop.call_later(COUNTING_S, self._count_dropped)

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Write a packet to the interface of a vehicle, if it has one."""
        link = next((each for each in self._links if each.addressing.carries(sender, payload)), None)
        radio = None if link is None else self._radios.get((receiver, link.radio))
        if radio is None:
            return
        try:
            os.write(radio.packets, payload)
        except OSError:
            self._context.count(receiver, NOT_TAKEN)

    async def close(self) -> None:
        """Remove the namespaces and their interfaces."""
        if self._counting is not None:
            self._counting.cancel()
        radios, self._radios = list(self._radios.values()), {}
        for radio in radios:
            self._context.loop.remove_reader(radio.packets)
            os.close(radio.statistics)
        run_networks.close_all(radio.packets for radio in radios)
        if self._lease is not None:
            lease, self._lease = self._lease, None
            with contextlib.suppress(FileNotFoundError):  # removed by vcmvsp net down --force
                lease.end()


def _addresses_of(space: Space) -> list[str]:
    """Addresses; of several radios with their names."""
    if not space.radios:
        return [*space.addresses]
    return [each for radio in space.radios for each in (radio.radio, *radio.addresses)]
