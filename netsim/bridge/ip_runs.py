"""Which runs have a network on this machine: a folder for each, which says what it consists of before any of it is made.

Its process holds a lock in the folder, which goes when the process does, however it ends. So whoever comes later can tell a run
that is alive from one that was killed, and clear away what that one has left.
"""

import contextlib
import errno
import fcntl
import functools
import os
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import msgspec

from cosim.types import Value
from netsim.bridge import ip_links, netns
from netsim.bridge.ip_links import Port

FOLDER = Path("/run/vcmvsp-net")
HOSTS = Path("/etc/hosts")

_LOCK, _ABOUT, _NAMES = "lock", "network.json", "hosts"


class Space(Value, frozen=True, kw_only=True):
    """A vehicle's namespace."""

    vehicle: str
    namespace: str
    addresses: tuple[str, ...]
    port: Port | None = None


class Network(Value, frozen=True, kw_only=True):
    """The network of a run."""

    run: str
    pid: int  # of the process that carries its packets
    spaces: tuple[Space, ...]
    alive: bool = True

    def space(self, vehicle: str) -> Space | None:
        """That of a vehicle, if it has one."""
        return next((each for each in self.spaces if each.vehicle == vehicle), None)


class Lease:
    """A run's right to its network; whoever has it has cleared away what was there before.

    Raises:
        BlockingIOError: another process has it.
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

    def tell(self, network: Network) -> None:
        """Say what the network is to consist of; and have its names known inside.

        Raises:
            FileExistsError: somebody else has made a namespace of that name.
        """
        for path in (netns.NAMES / each.namespace for each in network.spaces):
            if path.exists():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        lines = [f"{address}\t{each.vehicle}" for each in network.spaces for address in each.addresses]
        usual = HOSTS.read_text("utf-8", "replace") if HOSTS.exists() else ""
        (self._folder / _NAMES).write_text("\n".join([usual.rstrip("\n"), "# vehicles", *lines, ""]), "utf-8")
        (self._folder / f"{_ABOUT}.new").write_bytes(msgspec.json.encode(network))
        (self._folder / f"{_ABOUT}.new").replace(self._folder / _ABOUT)

    def end(self) -> None:
        """Take the network away, and give back the right to it."""
        try:
            _clear(self._folder)
            shutil.rmtree(self._folder)
        finally:
            os.close(self._lock)


def networks() -> list[Network]:
    """Those of all runs on this machine, also of those that were killed."""
    folders = sorted(FOLDER.iterdir()) if FOLDER.is_dir() else []
    return [known for each in folders if (known := _known(each)) is not None]


def clear(run: str, *, force: bool = False) -> None:
    """Clear away what a killed run has left; with ``force``, also what one has that is alive: its process is told to end.

    Raises:
        BlockingIOError: it is alive.
        OSError: no right to do so.
    """
    folder = FOLDER / run
    if force and (known := _known(folder)) is not None and known.alive and known.pid:
        os.kill(known.pid, signal.SIGTERM)
        _clear(folder)
        return
    Lease(run).end()


def run_inside(network: Network, space: Space, command: Sequence[str]) -> NoReturn:
    """Become a program in a vehicle's namespace, where the names of all vehicles are known.

    Raises:
        FileNotFoundError: there is no such program.
        OSError: it cannot be run, or no right to go inside.
    """
    netns.enter(space.namespace)
    names = FOLDER / network.run / _NAMES
    netns.cover({HOSTS: names} if HOSTS.exists() else {})
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # Python has them ignored, and programs inherit that
        signal.signal(number, signal.SIG_DFL)
    os.execvp(command[0], list(command))  # noqa: S606  no shell is wanted


def _known(folder: Path) -> Network | None:
    """What a folder tells; None: it is nobody's any more."""
    about = Network(run=folder.name, pid=0, spaces=())  # it is about to be told, or was taken away
    with contextlib.suppress(FileNotFoundError, msgspec.MsgspecError):
        about = msgspec.json.decode((folder / _ABOUT).read_bytes(), type=Network)
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
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _is(lock, folder / _LOCK):
                    return lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)  # it was cleared away between opening and locking


def _is(descriptor: int, path: Path) -> bool:
    """Whether a path still leads to this open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _clear(folder: Path) -> None:
    """Take away all that a network consists of, as far as it is there; ends quietly however often it is done."""
    known = _known(folder)
    for space in known.spaces if known is not None else ():
        if (port := space.port) is not None:
            netns.in_thread(functools.partial(ip_links.close_port, port))
        if (netns.NAMES / space.namespace).exists():
            with contextlib.suppress(OSError):  # the file is there, but not bound to a namespace: we died between the two
                netns.inside(space.namespace, ip_links.drop_radio)
            netns.remove(space.namespace)
    (folder / _ABOUT).unlink(missing_ok=True)
