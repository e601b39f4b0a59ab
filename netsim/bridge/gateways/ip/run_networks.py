"""Which runs have a network on this machine: a folder for each, which says what it consists of before any of it is made.

Its process holds a lock in the folder, which goes when the process does, however it ends. So whoever comes later can tell a run
that is alive from one that was killed, and clear away what that one has left.
"""

import contextlib
import fcntl
import functools
import os
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
from vcmvsp.netsim.bridge.gateways.ip import interfaces, namespaces
from vcmvsp.netsim.bridge.gateways.ip.caller import become, caller
from vcmvsp.netsim.bridge.gateways.ip.interfaces import Port

FOLDER = Path("/run/vcmvsp-net")
HOSTS = Path("/etc/hosts")

AT_ONCE = 32  # vehicles; the kernel takes 20 ms to let go of an interface, of one as of many
LOOKED_S, PAUSE_S = 0.1, 0.002  # others have the lock for a moment, to look; between two attempts

_LOCK, _ABOUT, _NAMES = "lock", "network.json", "hosts"


class Space(Value, frozen=True, kw_only=True):
    """A vehicle's namespace."""

    vehicle: str
    namespace: str
    addresses: tuple[str, ...]
    port: Port | None = None


class RunNetwork(Value, frozen=True, kw_only=True):
    """The network of a run."""

    run: str
    pid: int  # of the process that carries its packets
    started: int = 0  # when that did, as `started` tells: another process may have its number by now
    spaces: tuple[Space, ...]
    alive: bool = True

    def space(self, vehicle: str) -> Space | None:
        """That of a vehicle, if it has one."""
        return next((each for each in self.spaces if each.vehicle == vehicle), None)


class NetworkInUse(OSError):
    """Somebody else has what is wanted; the words are for the user."""


class RunAlive(NetworkInUse):
    """A run of this name is alive."""

    def __init__(self, run: str, pid: int) -> None:
        which = f" (process {pid})" if pid else ""  # it has yet to say
        who = f"a run named {run} has its network on this machine{which}"
        super().__init__(f"{who}: end it, or give this one another name (--set name=...)")


class NameTaken(NetworkInUse):
    """Somebody else has made something of this name."""

    def __init__(self, what: str, name: str, delete: str) -> None:
        super().__init__(f"there is a {what} {name}, made by somebody else; if nobody needs it: {delete} {name}")


class Lease:
    """A run's right to its network; whoever has it has cleared away what was there before.

    Raises:
        RunAlive: another process has it.
        OSError: no right to write there.
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
        """Say what the network is to consist of; and have its names known inside.

        Raises:
            NameTaken: somebody else has made a namespace or an interface of such a name.
            Taken: the networks behind its vehicles are behind those of another run.
        """
        present = {name for _, name in socket.if_nameindex()}
        for each in network.spaces:
            if (namespaces.NAMES / each.namespace).exists():
                raise NameTaken("network namespace", each.namespace, "ip netns delete")
            if each.port is not None and each.port.interface in present:
                raise NameTaken("network interface", each.port.interface, "ip link delete")
        lines = [f"{address}\t{each.vehicle}" for each in network.spaces for address in each.addresses]
        usual = HOSTS.read_text("utf-8", "replace") if HOSTS.exists() else ""
        (self._folder / _NAMES).write_text("\n".join([usual.rstrip("\n"), "# vehicles", *lines, ""]), "utf-8")
        (self._folder / _NAMES).chmod(0o644)  # for programs of all users
        (self._folder / f"{_ABOUT}.new").write_bytes(msgspec.json.encode(network))
        (self._folder / f"{_ABOUT}.new").replace(self._folder / _ABOUT)
        _check_routes(network)  # now that others who begin at this moment know of it

    def end(self) -> None:
        """Take the network away, and give back the right to it."""
        try:
            _clear(self._folder)
            shutil.rmtree(self._folder)
        finally:
            os.close(self._lock)


def networks() -> list[RunNetwork]:
    """Those of all runs on this machine, also of those that were killed."""
    folders = sorted(FOLDER.iterdir()) if FOLDER.is_dir() else []
    return [known for each in folders if (known := _known(each)) is not None]


def check_free(run: str) -> None:
    """Refuse, with `RunAlive`, the name of a run that has a network and is alive."""
    if (known := _known(FOLDER / run)) is not None and known.alive:
        raise RunAlive(run, known.pid)


def clear(run: str, *, force: bool = False) -> None:
    """Clear away what a killed run has left; with ``force``, also what one has that is alive: its process is told to end.

    Raises:
        RunAlive: it is alive.
        OSError: no right to do so, or its process is not the one that has its number.
    """
    folder = FOLDER / run
    if force and (known := _known(folder)) is not None and known.alive and known.pid:
        _tell_to_end(known)
        _clear(folder)
        return
    Lease(run).end()


def run_inside(network: RunNetwork, space: Space, command: Sequence[str]) -> NoReturn:
    """Become a program in a vehicle's namespace, where the names of all vehicles are known, of the user who called sudo.

    Raises:
        FileNotFoundError: there is no such program.
        OSError: it cannot be run, or no right to go inside.
    """
    namespaces.enter(space.namespace)
    names = FOLDER / network.run / _NAMES
    namespaces.cover({HOSTS: names} if HOSTS.exists() else {})
    if (user := caller()) is not None:
        become(user)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python has them ignored, and programs inherit that
        signal.signal(number, signal.SIG_DFL)
    os.execvp(command[0], list(command))  # noqa: S606  no shell is wanted


def started(pid: int) -> int:
    """When a process did, in ticks since the machine did: with its number, this is no other's.

    Raises:
        ProcessLookupError: there is no such process.
    """
    try:
        about = Path(f"/proc/{pid}/stat").read_text("ascii", "replace")
    except FileNotFoundError:
        raise ProcessLookupError(f"there is no process {pid}") from None
    return int(about.rpartition(")")[2].split()[19])


def _tell_to_end(network: RunNetwork) -> None:
    """Tell the process that carries a network's packets to end, and no other that has its number by now."""
    with contextlib.suppress(ProcessLookupError):
        process = os.pidfd_open(network.pid)
        try:
            if started(network.pid) != network.started:
                lock = FOLDER / network.run / _LOCK
                raise OSError(f"process {network.pid} is not its own any more: 'fuser {lock}' says who else is to end first")
            signal.pidfd_send_signal(process, signal.SIGTERM)
        finally:
            os.close(process)


def _check_routes(network: RunNetwork) -> None:
    """Refuse what another run has already: the host could not tell by whose radio a packet is to go."""
    others = [each for each in networks() if each.alive and each.run != network.run]
    for run, vehicle, port in ((each.run, space.vehicle, space.port) for each in others for space in each.spaces):
        for own in (each.port for each in network.spaces):
            if own is not None and port is not None and (same := interfaces.in_common(own, port)):
                has = f"{same} goes through {vehicle} of the run {run} on this machine"
                raise NetworkInUse(f"routes: what comes {has}: end that run, or give this one another network")


def _known(folder: Path) -> RunNetwork | None:
    """What a folder tells; None: it is nobody's any more."""
    about = RunNetwork(run=folder.name, pid=0, spaces=())  # it is about to be told, or was taken away
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
    """Lock a folder that is there, and stays so."""
    until = time.monotonic() + LOOKED_S
    while True:
        try:
            if (lock := _lock(folder)) is not None:
                return lock
        except BlockingIOError:
            if time.monotonic() >= until:
                known = _known(folder)
                raise RunAlive(folder.name, known.pid if known is not None else 0) from None
            time.sleep(PAUSE_S)


def _lock(folder: Path) -> int | None:
    """Lock a folder; None: it was cleared away at the same time. A `BlockingIOError` says that somebody has it.

    The lock is for nobody else to have, and what there is to read is for all, whatever this process keeps to itself otherwise.
    """
    with contextlib.suppress(FileNotFoundError):
        for each in (folder.parent, folder):
            each.mkdir(parents=True, exist_ok=True)
            each.chmod(0o755)
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.fchmod(lock, 0o600)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is(lock, folder / _LOCK):
                return lock
        except BaseException:
            os.close(lock)
            raise
        os.close(lock)
    return None


def _is(descriptor: int, path: Path) -> bool:
    """Whether a path still leads to this open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def close_all(descriptors: Iterable[int]) -> None:
    """Close what many interfaces are read from, which takes them away, as many at once as the kernel is slow with each."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(os.close, descriptors))


def _clear(folder: Path) -> None:
    """Take away all that a network consists of, as far as it is there; ends quietly however often it is done."""
    known = _known(folder)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(_clear_space, known.spaces if known is not None else ()))
    (folder / _ABOUT).unlink(missing_ok=True)


def _clear_space(space: Space) -> None:
    if (port := space.port) is not None:
        namespaces.in_thread(functools.partial(interfaces.close_port, port))
    if (namespaces.NAMES / space.namespace).exists():
        with contextlib.suppress(OSError):  # the file is there, but not bound to a namespace: we died between the two
            namespaces.inside(space.namespace, interfaces.drop_radio)
        namespaces.remove(space.namespace)
