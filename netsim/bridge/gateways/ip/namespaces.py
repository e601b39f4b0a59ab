"""Network namespaces of Linux: a network of its own for whoever is put inside.

They have names as ``ip netns`` gives them, a file each in `NAMES`, and live as long as the file or anybody in them. A thread is
in a namespace by itself: what is to be done inside one is done by a thread that ends there.
"""

import contextlib
import ctypes
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

NAMES = Path("/run/netns")
TUN = Path("/dev/net/tun")

_NEW_NET, _NEW_MOUNTS = 0x40000000, 0x00020000  # linux/sched.h
_BIND, _RECURSIVE, _SLAVE, _SHARED, _DETACH = 1 << 12, 1 << 14, 1 << 19, 1 << 20, 2  # linux/mount.h, sys/mount.h
_NET_ADMIN, _SYS_ADMIN = 12, 21  # linux/capability.h
_libc = ctypes.CDLL(None, use_errno=True)


def missing() -> str:
    """What this process lacks to make namespaces with a network of programs in them; empty: nothing."""
    try:
        lines = Path("/proc/self/status").read_text("ascii").splitlines()
    except OSError:
        return "Linux"
    rights = next(int(line.split()[1], 16) for line in lines if line.startswith("CapEff"))
    lacks = [name for name, bit in (("CAP_NET_ADMIN", _NET_ADMIN), ("CAP_SYS_ADMIN", _SYS_ADMIN)) if not rights >> bit & 1]
    if not os.access(TUN, os.R_OK | os.W_OK):
        lacks.append(str(TUN))
    elif not os.access(next(each for each in (NAMES, *NAMES.parents) if each.exists()), os.W_OK):
        lacks.append(f"the right to write into {NAMES}")
    return " and ".join(lacks)


def create(name: str) -> None:
    """Make a namespace.

    Raises:
        OSError: there is one of this name (`FileExistsError`), or no right to make one.
    """
    NAMES.mkdir(parents=True, exist_ok=True)
    if _mount(None, NAMES, _SHARED | _RECURSIVE):  # so that others see what is made, also in mount namespaces of their own
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
    """Take a namespace's name away; it ends with whoever is still inside. Whether there was one."""
    path = NAMES / name
    if not path.exists():
        return False
    _libc.umount2(os.fsencode(path), _DETACH)
    path.unlink(missing_ok=True)
    return True


def inside(name: str, work: Callable[[], T]) -> T:
    """Do something in a namespace, and return or raise what it returns or raises."""

    def enter_first() -> T:
        enter(name)
        return work()

    return in_thread(enter_first)


def enter(name: str) -> None:
    """Have the calling thread, and what it starts, be in a namespace from now on."""
    path = NAMES / name
    descriptor = os.open(path, os.O_RDONLY)
    try:
        _call(_libc.setns(descriptor, _NEW_NET), path)
    finally:
        os.close(descriptor)


def cover(files: dict[Path, Path]) -> None:
    """Have this process, and what it starts, see other files in the place of some, and ``/sys`` as of its own network.

    Args:
        files: what is covered -> what is seen there. Nobody else sees it.
    """
    _call(_libc.unshare(_NEW_MOUNTS), Path("/"))
    _call(_mount(None, Path("/"), _SLAVE | _RECURSIVE), Path("/"))
    with contextlib.suppress(OSError):  # in a container it may be forbidden, and few programs look there
        _call(_libc.mount(b"sysfs", b"/sys", b"sysfs", 0, None), Path("/sys"))
    for covered, seen in files.items():
        _call(_mount(seen, covered, _BIND), covered)


def _mount(source: Path | None, target: Path, flags: int) -> int:
    said = b"none" if source is None else os.fsencode(source)
    status: int = _libc.mount(said, os.fsencode(target), b"none", flags, None)
    return status


def _call(status: int, path: Path) -> None:
    if status:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(path))


def in_thread(work: Callable[[], T]) -> T:
    """Do something in a thread of its own, and return or raise what it returns or raises."""
    results: list[T] = []
    errors: list[BaseException] = []

    def body() -> None:
        try:
            results.append(work())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]
