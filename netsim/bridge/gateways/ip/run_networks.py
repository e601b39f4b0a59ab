"""Networks of runs on this machine: a folder for each, with a description that is written before the network is created.

The process of a run holds a lock in the folder as long as it lives. So a later process can tell a killed run from one that is
alive, and remove its network.
"""

import contextlib
import fcntl
import functools
import os
import pwd
import shutil
import signal
import socket
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NoReturn

import msgspec

from vcmvsp.cosim.types import Value
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.files import write_whole
from vcmvsp.netsim.bridge.gateways.ip import namespaces
from vcmvsp.netsim.bridge.gateways.ip.namespaces import Port

FOLDER = Path("/run/vcmvsp-net")
HOSTS = Path("/etc/hosts")

AT_ONCE = 32  # threads; the kernel takes 20 ms to remove one interface or many
LOOKED_S, PAUSE_S = 0.1, 0.002  # timeout for the lock, which other processes take briefly to look; between two attempts

_LOCK, _ABOUT, _NAMES = "lock", "network.json", "hosts"
_TAKEN = "the network {0} {1} already exists; if no longer needed, delete it: ip {2} delete {1}"


def caller() -> pwd.struct_passwd | None:
    """The user that called sudo; None: not run by sudo, or by root. Raises `KeyError` (no such user on this machine)."""
    number = os.environ.get("SUDO_UID", "")
    behind = os.geteuid() == 0 and number.isdecimal() and int(number) != 0
    return pwd.getpwuid(int(number)) if behind else None


def become(user: pwd.struct_passwd) -> None:
    """Give up root's rights: run this process and its children as this user."""
    os.initgroups(user.pw_name, user.pw_gid)
    os.setresgid(user.pw_gid, user.pw_gid, user.pw_gid)
    os.setresuid(user.pw_uid, user.pw_uid, user.pw_uid)
    os.environ.update(HOME=user.pw_dir, USER=user.pw_name, LOGNAME=user.pw_name)


class Interface(Value, frozen=True, kw_only=True):
    """The interface of one of several radios in a vehicle's namespace; it has the name of the radio."""

    radio: str
    addresses: tuple[str, ...]


class Space(Value, frozen=True, kw_only=True):
    """A vehicle's namespace."""

    vehicle: str
    namespace: str
    addresses: tuple[str, ...]  # of the first radio
    port: Port | None = None
    radios: tuple[Interface, ...] | msgspec.UnsetType = msgspec.UNSET  # of several radios

    @property
    def interfaces(self) -> tuple[str, ...]:
        """Names of the interfaces of its radios."""
        if not self.radios:
            return (namespaces.RADIO,)
        return tuple([each.radio for each in self.radios])

    @property
    def host_names(self) -> list[tuple[str, str]]:
        """Addresses, each with its names: ``car1``; of several radios ``car1 car1.wifi``, and ``car1.lora`` of further ones."""
        if not self.radios:
            return [(address, self.vehicle) for address in self.addresses]
        first = self.radios[0]
        return [
            (address, f"{self.vehicle} " * (each is first) + f"{self.vehicle}.{each.radio}")
            for each in self.radios
            for address in each.addresses
        ]


class RunNetwork(Value, frozen=True, kw_only=True):
    """The network of a run."""

    run: str
    pid: int  # of the process that carries its packets
    started: int = 0  # start time of the process, see `started`: its number may belong to another process by now
    spaces: tuple[Space, ...]
    alive: bool = True

    def space(self, vehicle: str) -> Space | None:
        """The namespace of a vehicle, if it has one."""
        return next((each for each in self.spaces if each.vehicle == vehicle), None)


class NetworkInUse(OSError):
    """A name or a network is in use; the message is for the user."""


class RunAlive(NetworkInUse):
    """A run of this name is alive."""

    def __init__(self, run: str, pid: int) -> None:
        which = f" (process {pid})" if pid else ""
        problem = f"a run named {run} already has a network on this machine{which}"
        super().__init__(f"{problem}: end that run, or choose another name for this one (--set name=...)")


class Lease:
    """Lock on the network of a run; removes a former network of the same name.

    Raises:
        RunAlive: another process holds it.
        OSError: no permission to write.
    """

    def __init__(self, run: str) -> None:
        self._folder = FOLDER / run
        self._lock = _locked(self._folder)
        try:
            _clear(self._folder)
        except BaseException:
            os.close(self._lock)
            raise

    def tell(self, network: RunNetwork) -> None:
        """Write the description of the network and its host names.

        Raises:
            NetworkInUse: a namespace or interface of this name exists, or what is behind its vehicles is behind another run's.
        """
        present = {name for _, name in socket.if_nameindex()}
        for each in network.spaces:
            if (namespaces.NAMES / each.namespace).exists():
                raise NetworkInUse(_TAKEN.format("namespace", each.namespace, "netns"))
            if each.port is not None and each.port.interface in present:
                raise NetworkInUse(_TAKEN.format("interface", each.port.interface, "link"))
        lines = [f"{address}\t{names}" for each in network.spaces for address, names in each.host_names]
        usual = HOSTS.read_text("utf-8", "replace") if HOSTS.exists() else ""
        (self._folder / _NAMES).write_text("\n".join([usual.rstrip("\n"), "# vehicles", *lines, ""]), "utf-8")
        (self._folder / _NAMES).chmod(0o644)  # for programs of all users
        write_whole(self._folder / _ABOUT, msgspec.json.encode(network))
        _check_routes(network)  # after writing: of two runs that start together, at least one sees the other

    def end(self) -> None:
        """Remove the network and release the lock."""
        try:
            _clear(self._folder)
            shutil.rmtree(self._folder)
        finally:
            os.close(self._lock)


def networks() -> list[RunNetwork]:
    """Networks of all runs on this machine, also of killed ones."""
    folders = sorted(FOLDER.iterdir()) if FOLDER.is_dir() else []
    return [network for each in folders if (network := _network_in(each)) is not None]


def check_free(run: str) -> None:
    """Raise `RunAlive` if a run of this name is alive and has a network."""
    if (network := _network_in(FOLDER / run)) is not None and network.alive:
        raise RunAlive(run, network.pid)


def clear(run: str, *, force: bool = False) -> None:
    """Remove the network of a killed run; with ``force`` also of one that is alive, after SIGTERM to its process.

    Raises:
        RunAlive: the run is alive.
        OSError: no permission, or its process number belongs to another process.
    """
    folder = FOLDER / run
    if force and (network := _network_in(folder)) is not None and network.alive and network.pid:
        _terminate(network)
        _clear(folder)
        return
    Lease(run).end()


def run_inside(network: RunNetwork, space: Space, command: Sequence[str]) -> NoReturn:
    """Replace this process by a program in a vehicle's namespace, run by the user that called sudo.

    Raises:
        FileNotFoundError: no such program.
        OSError: it cannot be run, or no permission to enter the namespace.
    """
    namespaces.enter(space.namespace)
    names = FOLDER / network.run / _NAMES
    namespaces.cover({HOSTS: names} if HOSTS.exists() else {})
    if (user := caller()) is not None:
        become(user)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them, and programs would inherit that
        signal.signal(number, signal.SIG_DFL)
    os.execvp(command[0], list(command))  # noqa: S606  no shell on purpose


def started(pid: int) -> int:
    """Start time of a process in clock ticks since boot; unique together with its number.

    Raises:
        ProcessLookupError: no such process.
    """
    try:
        about = Path(f"/proc/{pid}/stat").read_text("ascii", "replace")
    except FileNotFoundError:
        raise ProcessLookupError(f"there is no process {pid}") from None
    return int(about.rpartition(")")[2].split()[19])


def _terminate(network: RunNetwork) -> None:
    """Send SIGTERM to the process of a network, but never to another process with the same number."""
    with contextlib.suppress(ProcessLookupError):
        process = os.pidfd_open(network.pid)
        try:
            if started(network.pid) != network.started:
                lock = FOLDER / network.run / _LOCK
                raise OSError(f"process {network.pid} is not the run's; end the process that 'fuser {lock}' shows first")
            signal.pidfd_send_signal(process, signal.SIGTERM)
        finally:
            os.close(process)


def _check_routes(network: RunNetwork) -> None:
    """Raise `NetworkInUse` for routes of another run: the host could not choose the radio of a packet."""
    others = [each for each in networks() if each.alive and each.run != network.run]
    for run, vehicle, port in ((each.run, space.vehicle, space.port) for each in others for space in each.spaces):
        for own in (each.port for each in network.spaces):
            if own is not None and port is not None and (same := namespaces.in_common(own, port)):
                problem = f"{vehicle} of the run {run} on this machine already routes the traffic {same}"
                raise NetworkInUse(f"routes: {problem}: end that run, or choose another network for this one")


def _network_in(folder: Path) -> RunNetwork | None:
    """The network described in a folder; None: no run has it any more."""
    about = RunNetwork(run=folder.name, pid=0, spaces=())  # not written yet, or removed
    with contextlib.suppress(FileNotFoundError, ValueError):
        about = read_json((folder / _ABOUT).read_bytes(), RunNetwork)
    try:
        lock = os.open(folder / _LOCK, os.O_RDONLY)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return about
    finally:
        os.close(lock)
    return msgspec.structs.replace(about, alive=False)


def _locked(folder: Path) -> int:
    """Create and lock a folder; returns the descriptor of the lock."""
    until = time.monotonic() + LOOKED_S
    while True:
        try:
            if (lock := _lock(folder)) is not None:
                return lock
        except BlockingIOError:
            if time.monotonic() >= until:
                network = _network_in(folder)
                raise RunAlive(folder.name, 0 if network is None else network.pid) from None
            time.sleep(PAUSE_S)


def _lock(folder: Path) -> int | None:
    """Lock a folder; None: it was removed at the same time. Raises `BlockingIOError` if it is locked.

    Only this user may lock it; all users may read the folder.
    """
    with contextlib.suppress(FileNotFoundError):
        for each in (folder.parent, folder):
            each.mkdir(parents=True, exist_ok=True)
            each.chmod(0o755)
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.fchmod(lock, 0o600)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock), (folder / _LOCK).stat()):
                    return lock
        except BaseException:
            os.close(lock)
            raise
        os.close(lock)
    return None


def close_all(descriptors: Iterable[int]) -> None:
    """Close descriptors of interfaces, which removes these; in parallel, as the kernel is slow with each."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(os.close, descriptors))


def _clear(folder: Path) -> None:
    network = _network_in(folder)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(_clear_space, () if network is None else network.spaces))
    (folder / _ABOUT).unlink(missing_ok=True)


def _clear_space(space: Space) -> None:
    if (port := space.port) is not None:
        namespaces.in_thread(functools.partial(namespaces.close_port, port))
    if (namespaces.NAMES / space.namespace).exists():
        with contextlib.suppress(OSError):  # the file exists without a namespace: the run died between creating the two
            namespaces.inside(space.namespace, functools.partial(namespaces.drop_radios, space.interfaces))
        namespaces.remove(space.namespace)
