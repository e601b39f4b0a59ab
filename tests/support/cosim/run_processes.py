"""Runs and hosts as processes of a folder, and a network between them that can be cut: a TCP forwarder of this machine."""

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

PROGRAM = ["-P", "-m", "vcmvsp.cosim.cli.app"]
VCMVSP = [sys.executable, *PROGRAM]


@contextlib.contextmanager
def reserved() -> Iterator[int]:
    """A TCP port of 127.0.0.1 where nobody listens, and which Linux gives to nobody else who asks for any.

    Who knows it may listen there, if he lets others use the address again (``SO_REUSEADDR``), as all servers do.
    """
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


class Stage:
    """A folder, a port that is its own, and the processes that are started there; leave it, and they are gone."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        self._held = contextlib.ExitStack()
        self.port = self.another_port()
        self.processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self.processes:
            process.kill()
            process.communicate()
        self._held.close()

    def another_port(self) -> int:
        return self._held.enter_context(reserved())

    def start(self, *arguments: str, before: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start ``vcmvsp`` with these arguments; ``before`` is a command that starts commands, such as ``ip netns exec``."""
        return self.python(*PROGRAM, *arguments, before=before)

    def python(self, *arguments: str, before: Sequence[str] = ()) -> subprocess.Popen[str]:
        command = [*before, sys.executable, *arguments]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=self.folder)
        self.processes.append(process)
        return process


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Its exit code, and what it said on the way."""
    _, said = process.communicate(timeout=500)
    assert "Traceback" not in said
    return process.returncode, said


def ended_with(code: int, process: subprocess.Popen[str]) -> str:
    """What it said until it ended with this exit code."""
    found, said = ended(process)
    assert found == code, said
    return said


def said_by(process: subprocess.Popen[str], what: str) -> str:
    """Read what it says until this; the line that has it."""
    assert process.stderr is not None
    found = next((line for line in process.stderr if what in line), None)
    assert found is not None, what
    return found


def wait_for(path: Path) -> None:
    """Until there is such a file."""
    last = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < last
        time.sleep(0.02)


class Wire:
    """Forwards connections to ``port``; cut, it carries nothing, or breaks what there is and lets nobody in."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._door.getsockname()[1]
        self._whole = threading.Event()
        self._whole.set()
        self._refuses = False
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def freeze(self, seconds: float) -> None:
        """Carry nothing for so long, and then what has been waiting: a cable that is pulled and put back."""
        self._whole.clear()
        time.sleep(seconds)
        self._whole.set()

    def reset(self, seconds: float) -> None:
        """Break all connections, and let nobody in for so long."""
        self._refuses = True
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        time.sleep(seconds)
        self._refuses = False

    def close(self) -> None:
        self._door.close()
        for end in self._ends:
            end.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._door.accept()
                far = None if self._refuses else self._dial()
                if far is None:
                    near.close()
                    continue
                self._ends += [near, far]
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _dial(self) -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", self._target))
        except OSError:  # nobody listens yet
            return None

    def _carry(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(65536):
                self._whole.wait()
                other.sendall(data)
        for end in (one, other):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
