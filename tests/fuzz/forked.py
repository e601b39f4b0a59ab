"""A command in a forked process, which has imported all: how it ends, what it takes and what it writes."""

import contextlib
import os
import resource
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vcmvsp.cosim.cli.app import main

CPU_S, MEMORY_BYTES = 10, 2**30
CODES = (0, 1, 2, 3)  # those of the README, but for Ctrl-C
_WALL_S = 1800  # of a command that waits forever; a loaded machine is slow
_ADDRESSES_BYTES = 8 * MEMORY_BYTES  # beyond, the machine itself would suffer
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_NAMES = {
    "os.mkdir": 0,
    "os.remove": 0,
    "os.rename": 1,
    "os.rmdir": 0,
    "os.symlink": 1,
    "os.truncate": 0,
}  # which argument is written


def problems(words: list[str], folder: Path) -> list[str]:
    """What is wrong with how a command behaves in a folder; its output is in ``said`` beside it."""
    before, said = contents(folder), folder.with_name("said")
    resident, shared = map(int, Path("/proc/self/statm").read_text().split()[1:3])  # pages
    had_kib = (resident - shared) * resource.getpagesize() // 2**10  # with which a fork begins
    child = os.fork()
    if child == 0:
        os._exit(_run(words, folder, said))
    _, status, used = os.wait4(child, 0)
    grown_kib = used.ru_maxrss - had_kib
    code, text = os.waitstatus_to_exitcode(status), said.read_text("utf-8", "replace")
    changed = set(before.items() ^ contents(folder).items())
    return [
        *([f"exit code {code}, of {CODES}"] if code not in CODES else []),
        *(["a traceback"] if "Traceback (most recent call last)" in text else []),
        *(["it fails without a word"] if code and not text.strip() else []),
        *([f"{used.ru_utime + used.ru_stime:.1f} s of processor time"] if used.ru_utime + used.ru_stime > CPU_S else []),
        *([f"{grown_kib / 2**10:.0f} MiB"] if grown_kib * 2**10 > MEMORY_BYTES else []),
        *([f"it wrote outside --out: {', '.join(sorted({name for name, _ in changed}))}"] if changed else []),
        *(line for line in text.splitlines() if line.startswith(_OUTSIDE)),
    ]


_OUTSIDE = "it wrote outside the folder: "


def contents(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder, but for ``out`` or what is called so."""
    found = [path for path in folder.rglob("*") if not path.relative_to(folder).parts[0].startswith(("out", "__pycache__"))]
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in found}


def _run(words: list[str], folder: Path, said: Path) -> int:
    """The child's life."""
    file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", errors="replace") for number in (1, 2))  # noqa: PTH123, SIM115
    for name, inside in (("HOME", "home"), ("TMPDIR", "tmp"), ("XDG_RUNTIME_DIR", "tmp"), ("XDG_CACHE_HOME", "home")):
        (folder.parent / inside).mkdir(exist_ok=True)
        os.environ[name] = str(folder.parent / inside)
    os.chdir(folder)
    signal.alarm(_WALL_S)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S + 1, CPU_S + 2))
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES_BYTES, _ADDRESSES_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    code: Any = 0
    _watch_writes(folder.parent)
    try:
        main(words)
    except SystemExit as end:
        code = end.code or 0
    except BaseException:  # all that would be a traceback
        traceback.print_exc()
        code = 99
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    return code if isinstance(code, int) else 99


def _watch_writes(allowed: Path) -> None:
    """Say on stderr what is opened for writing, made or removed anywhere else (but for devices)."""
    root = os.path.realpath(allowed) + "/"

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        for path in _written(event, arguments):
            place = os.path.realpath(os.fsdecode(path))
            if not place.startswith((root, "/dev/", "/proc/")) and "/__pycache__/" not in place:
                print(f"{_OUTSIDE}{event} {place}", file=sys.stderr)  # noqa: T201

    sys.addaudithook(hook)


def _written(event: str, arguments: tuple[Any, ...]) -> Iterator[str | bytes]:
    if event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITING:
        written = arguments[0]
    elif event in _NAMES:
        written = arguments[_NAMES[event]]
    else:
        return
    if isinstance(written, str | bytes | os.PathLike):
        yield os.fspath(written)
