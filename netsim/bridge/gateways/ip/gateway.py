"""IP: each vehicle is a machine of its own, and whatever runs on it speaks over its radio, unchanged.

A vehicle has a network namespace of Linux with one TUN interface, `interfaces.RADIO`: what the kernel sends there comes to this
gateway as an IP packet, and what the radio receives is written there. One hop on the air is one hop of IP.
"""

import asyncio
import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec

from vcmvsp.netsim.bridge.gateways.base import LARGEST, GatewayContext, GatewayError, check_names
from vcmvsp.netsim.bridge.gateways.ip import interfaces, namespaces, run_networks
from vcmvsp.netsim.bridge.gateways.ip.addresses import LEAST_MTU6, Directory, Network, address_in, is_ip, network_of
from vcmvsp.netsim.bridge.gateways.ip.run_networks import Space

BATCH = 64  # packets of one vehicle before others have their turn
PAUSE_S = 0.002  # without room in the run; meanwhile they wait in the kernel's queue, which has an end
COUNTING_S = 1.0  # between two looks at what that queue had no room for
SHOWN = 12  # vehicles whose addresses are said at once

NOT_TAKEN = "not taken by the kernel"
NO_ROOM = f"no room in the queue of {interfaces.RADIO}"

Mtu = Annotated[int, msgspec.Meta(ge=68, le=LARGEST)]  # RFC 791: every link carries 68


@dataclass
class _Radio:
    """The interface of a vehicle, seen from here."""

    row: int
    packets: int  # descriptor
    statistics: int  # descriptor
    waiting: tuple[int, bytes] | None = None  # read, but there was no room for it
    dropped: int = 0  # by the kernel


class Ip:
    """Programs of a vehicle are on a machine of their own: ``vcmvsp net exec car1 -- ping car2``.

    The i-th vehicle of the scenario has the i-th address of both networks. A packet to an address of a vehicle is sent to it
    alone; one to a multicast group or to the broadcast address, to all who hear it.

    Args:
        network: of all vehicles, IPv4.
        network6: likewise, IPv6; there is none with an ``mtu_bytes`` of less than 1280.
        mtu_bytes: longest packet; programs and kernel split what is longer.
        routes: networks of real machines behind vehicles: ``{ car1 = ["192.168.5.0/24"] }``.
        vehicles: those that have an interface; none named: all.
    """

    only_one = True  # namespaces and addresses of a run are one network

    def __init__(
        self,
        network: str = "10.77.0.0/16",
        network6: str = "fd77::/64",
        mtu_bytes: Mtu = 1500,
        routes: Mapping[str, tuple[str, ...]] | None = None,
        vehicles: tuple[str, ...] = (),
    ) -> None:
        both = network_of(network, "network", 4), network_of(network6, "network6", 6)
        self._networks: tuple[Network, ...] = both if mtu_bytes >= LEAST_MTU6 else both[:1]
        self._mtu_bytes, self._chosen = mtu_bytes, vehicles
        self._routes = {name: [network_of(each, "routes") for each in behind] for name, behind in (routes or {}).items()}
        self._radios: dict[int, _Radio] = {}
        self._lease: run_networks.Lease | None = None
        self._counting: asyncio.TimerHandle | None = None

    def check(self, vehicles: Sequence[str]) -> None:
        """Refuse names that there are not, networks that are too small, and addresses that two would have."""
        check_names("vehicles", self._chosen, vehicles)
        check_names("routes", self._routes, self._chosen or vehicles, "vehicle with an interface")
        for network, key in zip(self._networks, ("network", "network6"), strict=False):
            if network.num_addresses - 2 < len(vehicles):  # its own address, and that of all
                raise ValueError(f"{key}: {network} has no room for {len(vehicles)} vehicles")
        self._check_routes()

    def _check_routes(self) -> None:
        taken = list(self._networks)
        versions = {each.version for each in taken}
        for network in (each for behind in self._routes.values() for each in behind):
            if network.version not in versions:
                raise ValueError(f"routes: {network} needs IPv6, and mtu_bytes of {LEAST_MTU6} or more")
            if same := [each for each in taken if each.version == network.version and each.overlaps(network)]:
                raise ValueError(f"routes: {network} has addresses in common with {same[0]}")
            taken.append(network)

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Make the namespaces, and read what is sent in them."""
        self._context = context
        if lacks := namespaces.missing():
            raise GatewayError(f"networks of namespaces need {lacks}: start the run as root (sudo)")
        rows = [row for row, name in enumerate(context.vehicles) if not self._chosen or name in self._chosen]
        routed = {row: self._routes[name] for row, name in enumerate(context.vehicles) if name in self._routes}
        self._directory = Directory(self._networks, rows, routed)
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
            raise GatewayError(f"the network of {context.run} cannot be made: {error}") from error
        self._count_dropped()
        return self._lines(list(spaces.values()))

    def _space(self, row: int) -> Space:
        context = self._context
        name = context.vehicles[row]
        port = None
        if behind := self._routes.get(name):
            port = interfaces.port_of(context.run, name, behind, [*self._networks, *self._beyond(name)])
        addresses = tuple(str(address_in(each, row)) for each in self._networks)
        return Space(vehicle=name, namespace=f"vcmvsp-{context.run}-{name}", addresses=addresses, port=port)

    def _beyond(self, vehicle: str) -> list[Network]:
        """The networks behind the other vehicles."""
        return [network for name, behind in self._routes.items() if name != vehicle for network in behind]

    def _make(self, row: int, space: Space) -> None:
        """A namespace and what is in it."""
        with_bits = [(address, each.prefixlen) for address, each in zip(space.addresses, self._networks, strict=True)]
        beyond = self._beyond(space.vehicle)
        namespaces.create(space.namespace)
        packets = namespaces.inside(space.namespace, lambda: interfaces.open_radio(with_bits, beyond, self._mtu_bytes))
        try:
            self._radios[row] = _Radio(row, packets, namespaces.inside(space.namespace, interfaces.statistics))
        except BaseException:
            os.close(packets)
            raise
        if (port := space.port) is not None:
            namespaces.in_thread(lambda: interfaces.open_port(port, space.namespace))
        self._context.loop.add_reader(packets, self._read, self._radios[row])

    def _lines(self, spaces: Sequence[Space]) -> list[str]:
        lines = [f"{each.vehicle}  {'  '.join(each.addresses)}" for each in spaces[:SHOWN]]
        behind = [(each.vehicle, each.port) for each in spaces if each.port is not None]
        lines += [f"behind {name}: {', '.join(port.behind)}, through {port.interface} here" for name, port in behind]
        if len(spaces) > SHOWN:
            lines.append(f"and {len(spaces) - SHOWN} more: vcmvsp net status")
        here, there = spaces[0].vehicle, spaces[-1].vehicle
        return [*lines, f"on a vehicle's machine: vcmvsp net exec {here} -- ping {there}"]

    def _read(self, radio: _Radio) -> None:
        """Hand over what a vehicle's kernel sends, as long as there is room."""
        for _ in range(BATCH):
            try:
                packet = os.read(radio.packets, LARGEST)
            except BlockingIOError:
                return
            except OSError:  # the interface was taken away from under us; nothing is sent any more
                self._context.loop.remove_reader(radio.packets)
                return
            to = self._directory.goes_to(radio.row, packet)
            if isinstance(to, str):
                self._context.count(radio.row, to)
            elif not self._context.offer(self, radio.row, to, packet):
                radio.waiting = to, packet
                self._context.loop.remove_reader(radio.packets)
                self._context.loop.call_later(PAUSE_S, self._go_on, radio)
                return

    def _go_on(self, radio: _Radio) -> None:
        """Try again to hand over what there was no room for."""
        if radio.waiting is None or radio.row not in self._radios:
            return
        to, packet = radio.waiting
        if self._context.offer(self, radio.row, to, packet):
            radio.waiting = None
            self._context.loop.add_reader(radio.packets, self._read, radio)
        else:
            self._context.loop.call_later(PAUSE_S, self._go_on, radio)

    def _count_dropped(self) -> None:
        """Have it known what the kernel had no room for: it is no loss of the radio's."""
        for radio in self._radios.values():
            dropped = interfaces.dropped(radio.statistics)
            if dropped > radio.dropped:
                self._context.count(radio.row, NO_ROOM, dropped - radio.dropped)
                radio.dropped = dropped
        self._counting = self._context.loop.call_later(COUNTING_S, self._count_dropped)

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Have the kernel of a vehicle receive a packet; who has no interface, hears nothing."""
        radio = self._radios.get(receiver)
        if radio is None or not is_ip(payload):  # what agents say to each other is not for programs here
            return
        try:
            os.write(radio.packets, payload)
        except OSError:
            self._context.count(receiver, NOT_TAKEN)

    async def close(self) -> None:
        """Take the namespaces away, with whatever was made for them."""
        if self._counting is not None:
            self._counting.cancel()
        radios, self._radios = list(self._radios.values()), {}
        for radio in radios:
            self._context.loop.remove_reader(radio.packets)
            os.close(radio.statistics)
        run_networks.close_all(radio.packets for radio in radios)
        if self._lease is not None:
            lease, self._lease = self._lease, None
            with contextlib.suppress(FileNotFoundError):  # somebody was quicker: vcmvsp net down --force
                lease.end()
