"""Network namespaces of Linux, with names as ``ip netns`` gives them: a file each in `NAMES`.

A namespace is a property of a thread: work inside one is done by a thread that ends there.
"""

import contextlib
import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
        lacks.append(f"the right to write into {NAMES}")
    return " and ".join(lacks)


def create(name: str) -> None:
    """Create a namespace.

    Raises:
        OSError: it exists (`FileExistsError`), or this process lacks the rights.
    """
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
    status: int = _libc.mount(name, os.fsencode(target), b"none", flags, None)
    return status


def _call(status: int, path: Path) -> None:
    if status:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(path))


def in_thread(work: Callable[[], T]) -> T:
    """Call ``work`` in a new thread, which ends afterwards; returns its result or raises its error."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(work).result()
