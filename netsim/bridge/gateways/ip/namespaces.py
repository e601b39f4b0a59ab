"""Network namespaces of Linux, and a vehicle's interfaces there: the radio (TAP or TUN), and the port (veth) to real machines.

Names are as ``ip netns`` gives them: a file each in `NAMES`. A namespace is a property of a thread: work inside one is done by
a thread that ends there.
"""

import contextlib
import ctypes
import errno
import fcntl
import functools
import ipaddress
import itertools
import os
import socket
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

T = TypeVar("T")

NAMES = Path("/run/netns")
TUN = Path("/dev/net/tun")

_NEW_NET, _NEW_MOUNTS = 0x40000000, 0x00020000  # linux/sched.h
_BIND, _RECURSIVE, _SLAVE, _SHARED, _DETACH = 1 << 12, 1 << 14, 1 << 19, 1 << 20, 2  # linux/mount.h, sys/mount.h
_NET_ADMIN, _SYS_ADMIN = 12, 21  # linux/capability.h
_libc = ctypes.CDLL(None, use_errno=True)

Network = ipaddress.IPv4Network | ipaddress.IPv6Network

RADIO = "radio0"  # of several radios each interface has the name of its radio
PORT = "port0"  # in the namespace; the host's end has another name
RESERVED = ("lo", PORT, "all", "default")  # names of interfaces and of settings there
NAME_LENGTH = 15  # characters of an interface's name, at most (IFNAMSIZ, linux/if.h)
QUEUE = 500  # packets that wait in the kernel

_SET_INTERFACE = 0x400454CA  # TUNSETIFF, linux/if_tun.h
_TUN, _TAP, _WITHOUT_HEADER = 0x0001, 0x0002, 0x1000  # IFF_TUN, IFF_TAP, IFF_NO_PI
_NO_DUPLICATES_SOUGHT = 0x02  # IFA_F_NODAD: no duplicate address detection, usable at once
_BROADCAST_ROUTE, _ON_LINK = 3, 253  # RTN_BROADCAST, RT_SCOPE_LINK
_RULE_PRIORITY = 7700  # before the main table's
_HOST_SIDE, _INSIDE = "fe80::1", "fe80::2"  # of a port
_NO_REDIRECTS = {"send_redirects": "0", "accept_redirects": "0"}
"""The radio is one link, but not all vehicles on it reach each other: no router may say that a detour is needless."""
_OWN_ADDRESS = {"arp_ignore": "1", "arp_announce": "2"}
"""Of several radios each answers for its own addresses, and asks with them."""
_QUIET = {"accept_ra": "0", "router_solicitations": "0", "addr_gen_mode": "1", "disable_ipv6": "0"}


def missing() -> str:
    """Capabilities and files that this process needs for namespaces and lacks; empty: none."""
    try:
        lines = Path("/proc/self/status").read_text("ascii").splitlines()
    except OSError:
        return "Linux"
    rights = next(int(line.split()[1], 16) for line in lines if line.startswith("CapEff"))
    lacks = [name for name, bit in (("CAP_NET_ADMIN", _NET_ADMIN), ("CAP_SYS_ADMIN", _SYS_ADMIN)) if not rights >> bit & 1]
    if not os.access(TUN, os.R_OK | os.W_OK):
        lacks.append(str(TUN))
    elif not os.access(next(each for each in (NAMES, *NAMES.parents) if each.exists()), os.W_OK):
        lacks.append(f"write access to {NAMES}")
    return " and ".join(lacks)


def create(name: str) -> None:
    """Create a namespace. Raises `OSError` (it exists (`FileExistsError`), or this process lacks the rights)."""
    NAMES.mkdir(parents=True, exist_ok=True)
    if _mount(None, NAMES, _SHARED | _RECURSIVE):  # so that processes in other mount namespaces see new files
        _call(_mount(NAMES, NAMES, _BIND | _RECURSIVE), NAMES)
        _call(_mount(None, NAMES, _SHARED | _RECURSIVE), NAMES)
    path = NAMES / name
    path.touch(mode=0o444, exist_ok=False)

    def make() -> None:
        _call(_libc.unshare(_NEW_NET), path)
        _call(_mount(Path("/proc/thread-self/ns/net"), path, _BIND), path)

    try:
        in_thread(make)
    except BaseException:
        path.unlink()
        raise


def remove(name: str) -> bool:
    """Remove a namespace's name; returns whether it existed. The namespace ends with its last process."""
    path = NAMES / name
    if not path.exists():
        return False
    _libc.umount2(os.fsencode(path), _DETACH)
    path.unlink(missing_ok=True)
    return True


def inside(name: str, work: Callable[[], T]) -> T:
    """Call ``work`` in a namespace; returns its result or raises its error."""

    def enter_first() -> T:
        enter(name)
        return work()

    return in_thread(enter_first)


def enter(name: str) -> None:
    """Move the calling thread, and its children, into a namespace."""
    path = NAMES / name
    descriptor = os.open(path, os.O_RDONLY)
    try:
        _call(_libc.setns(descriptor, _NEW_NET), path)
    finally:
        os.close(descriptor)


def cover(files: dict[Path, Path]) -> None:
    """Mount other files over some, and ``/sys`` of the own network, for this process and its children only.

    Args:
        files: covered path -> path of the replacement.
    """
    _call(_libc.unshare(_NEW_MOUNTS), Path("/"))
    _call(_mount(None, Path("/"), _SLAVE | _RECURSIVE), Path("/"))
    with contextlib.suppress(OSError):  # containers may forbid it, and few programs read it
        _call(_libc.mount(b"sysfs", b"/sys", b"sysfs", 0, None), Path("/sys"))
    for covered, replacement in files.items():
        _call(_mount(replacement, covered, _BIND), covered)


def _mount(source: Path | None, target: Path, flags: int) -> int:
    name = b"none" if source is None else os.fsencode(source)
    return _libc.mount(name, os.fsencode(target), b"none", flags, None)


def _call(status: int, path: Path) -> None:
    if status:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(path))


def in_thread(work: Callable[[], T]) -> T:
    """Call ``work`` in a new thread, which ends afterwards; returns its result or raises its error."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(work).result()


class Port(msgspec.Struct, frozen=True, kw_only=True):
    """A cable between a vehicle's namespace and the host.

    Neither end needs an IPv4 address: routes go to link-local IPv6 addresses (RFC 8950), which cannot conflict.
    """

    interface: str  # the end on the host's side
    table: int  # routing table of the host for packets from the machines behind this vehicle
    behind: tuple[str, ...]  # networks of the machines there
    others: tuple[str, ...]  # networks to which the radio leads


def port_of(run: str, vehicle: str, behind: Iterable[Network], others: Iterable[Network]) -> Port:
    """A port with a unique name and number: names of interfaces have at most 15 characters."""
    number = zlib.crc32(f"{run}/{vehicle}".encode())
    behind_networks, other_networks = tuple(map(str, behind)), tuple(map(str, others))
    return Port(interface=f"vcmvsp-{number:08x}", table=number | 1 << 31, behind=behind_networks, others=other_networks)


class RadioInterface(NamedTuple):
    """The radio's interface in a vehicle's namespace."""

    addresses: Sequence[tuple[str, int]]  # of the vehicle, each with the prefix length of its network
    routes: Sequence[tuple[Network, str | None]]  # further networks: by a vehicle's address, or directly
    mtu_bytes: int
    mac: bytes | None = None  # Ethernet address, of a TAP; None: a TUN
    name: str = RADIO
    metric: int | None = None  # of several radios, for broadcasts and multicast: the first radio sends them


def open_radio(interface: RadioInterface) -> int:
    """Create the radio's interface in this thread's namespace; returns the descriptor of its packets.

    The kernel completes checksums and divides segments by itself, as this interface offers no offloads.
    """
    _sysctl("ipv6", ("all", "default"), _QUIET)
    kind, name = _TUN if interface.mac is None else _TAP, interface.name
    descriptor = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(descriptor, _SET_INTERFACE, struct.pack("16sH22x", name.encode(), kind | _WITHOUT_HEADER))
        _sysctl("ipv6", (name,), _QUIET)
        if interface.mac is not None:
            _sysctl("ipv4", ("all", "default", name), _NO_REDIRECTS)
            _sysctl("ipv6", ("all", "default", name), {"accept_redirects": "0"})
        if interface.metric is not None:
            _sysctl("ipv4", (name,), _OWN_ADDRESS)
        with _netlink() as links:
            radio = links.link_lookup(ifname=name)[0]
            links.link("set", index=1, state="up")
            if interface.mac is not None:
                links.link("set", index=radio, address=interface.mac.hex(":"))
            links.link("set", index=radio, mtu=interface.mtu_bytes, txqlen=QUEUE, state="up")
            for address, bits in interface.addresses:
                links.addr("add", index=radio, address=address, prefixlen=bits, **_kind(address))
            metric = {} if interface.metric is None else {"priority": interface.metric}
            links.route("add", dst="224.0.0.0/4", oif=radio, **metric)
            links.route("add", dst="255.255.255.255/32", oif=radio, type=_BROADCAST_ROUTE, scope=_ON_LINK, **metric)
            for network, gateway in interface.routes:
                by = {} if gateway is None else {"gateway": gateway}
                links.route("add", dst=str(network), oif=radio, family=_family(network), **by)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def open_port(port: Port, namespace: str) -> None:
    """Connect the host to a vehicle's namespace by a veth pair that forwards packets both ways."""
    with (NAMES / namespace).open() as file, _netlink() as links:
        links.link("add", ifname=port.interface, kind="veth", peer={"ifname": PORT, "net_ns_fd": file.fileno()})
        index = links.link_lookup(ifname=port.interface)[0]
        _sysctl("ipv6", (port.interface,), {**_QUIET, "forwarding": "1"})
        _sysctl("ipv4", (port.interface,), {"forwarding": "1"})
        links.link("set", index=index, state="up")
        inside(namespace, lambda: _open_inside(port))
        links.addr("add", index=index, address=_HOST_SIDE, prefixlen=64, **_kind(_HOST_SIDE))
        for network in map(ipaddress.ip_network, port.others):
            links.route("add", dst=str(network), oif=index, table=port.table, **_via(network, _INSIDE))
        for rule in _rules(port):
            links.rule("add", **rule)


def _open_inside(port: Port) -> None:
    _sysctl("ipv6", ("all", PORT), {"forwarding": "1"})
    _sysctl("ipv4", ("all",), {"forwarding": "1"})
    with _netlink() as links:
        index = links.link_lookup(ifname=PORT)[0]
        links.link("set", index=index, state="up")
        links.addr("add", index=index, address=_INSIDE, prefixlen=64, **_kind(_INSIDE))
        for network in map(ipaddress.ip_network, port.behind):
            links.route("add", dst=str(network), oif=index, **_via(network, _HOST_SIDE))


def close_port(port: Port) -> None:
    """Remove the rules and the interface of a port from the host, as far as they exist."""
    with _netlink() as links:
        for rule in _rules(port):
            _unless_gone(functools.partial(links.rule, "del", **rule))
        _delete(links, port.interface)


def drop_radios(names: Iterable[str]) -> None:
    """Remove the interfaces of radios from this thread's namespace, as far as they exist."""
    with _netlink() as links:
        for name in names:
            _delete(links, name)


def statistics() -> int:
    """Descriptor of the interface counters of this thread's namespace, for `dropped` in any thread."""
    return os.open("/proc/thread-self/net/dev", os.O_RDONLY | os.O_CLOEXEC)


def dropped(descriptor: int, name: str = RADIO) -> int:
    """Packets that the radio's queue in the kernel has dropped so far."""
    lines = os.pread(descriptor, 1 << 16, 0).decode("ascii").splitlines()
    return next((int(line.partition(":")[2].split()[11]) for line in lines if line.lstrip().startswith(f"{name}:")), 0)


def in_common(a: Port, b: Port) -> str:
    """Source and destination networks that the host would route through either of two vehicles; empty: none."""
    for (source, target), (source2, target2) in itertools.product(_pairs(a), _pairs(b)):
        if _overlap(source, source2) and _overlap(target, target2):
            return f"from {source} to {target}"
    return ""


def _overlap(a: Network, b: Network) -> bool:
    return a.version == b.version and a.overlaps(b)


def _pairs(port: Port) -> list[tuple[Network, Network]]:
    behind, others = map(ipaddress.ip_network, port.behind), list(map(ipaddress.ip_network, port.others))
    return [(source, target) for source in behind for target in others if source.version == target.version]


def _rules(port: Port) -> list[dict[str, Any]]:
    """Routing rules of the host: packets from the machines behind a vehicle go through that vehicle's radio."""
    rules: list[dict[str, Any]] = []
    for source, target in _pairs(port):
        ends = {"src": str(source.network_address), "src_len": source.prefixlen}
        ends |= {"dst": str(target.network_address), "dst_len": target.prefixlen}
        rules.append({"table": port.table, "priority": _RULE_PRIORITY, "family": _family(source), **ends})
    return rules


def _via(network: Network, neighbour: str) -> dict[str, Any]:
    """Next hop of a route: a neighbour's IPv6 address, also for IPv4 packets."""
    if network.version == 4:
        return {"family": socket.AF_INET, "via": {"family": socket.AF_INET6, "addr": neighbour}}
    return {"family": socket.AF_INET6, "gateway": neighbour}


def _kind(address: str) -> dict[str, Any]:
    return {"family": socket.AF_INET6, "flags": _NO_DUPLICATES_SOUGHT} if ":" in address else {"family": socket.AF_INET}


def _family(network: Network) -> int:
    return socket.AF_INET if network.version == 4 else socket.AF_INET6


def _sysctl(protocol: str, interfaces: Iterable[str], settings: dict[str, str]) -> None:
    """Apply settings; errors are ignored: containers may forbid them, and most runs do not need them."""
    for interface in interfaces:
        for name, value in settings.items():
            with contextlib.suppress(OSError):
                Path(f"/proc/sys/net/{protocol}/conf/{interface}/{name}").write_text(value, "ascii")


@contextlib.contextmanager
def _netlink() -> Iterator[Any]:
    """A netlink connection for threads without an asyncio loop; its errors become `OSError`."""
    from pyroute2 import IPRoute
    from pyroute2.netlink.exceptions import NetlinkError

    try:
        with IPRoute() as links:
            yield links
    except NetlinkError as error:
        raise OSError(error.code, f"{os.strerror(error.code)} ({error})") from error


def _delete(links: Any, interface: str) -> None:
    if indices := links.link_lookup(ifname=interface):
        _unless_gone(lambda: links.link("del", index=indices[0]))


def _unless_gone(remove: Callable[[], object]) -> None:
    from pyroute2.netlink.exceptions import NetlinkError

    try:
        remove()
    except NetlinkError as error:
        if error.code not in (errno.ENOENT, errno.ENODEV, errno.ESRCH, errno.EAFNOSUPPORT):
            raise
