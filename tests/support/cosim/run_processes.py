"""Runs and hosts as processes in a folder, and a network between them that can be cut: a local TCP forwarder."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, cast

import pytest

from tests.support.cosim.forked_programs import ForkedProgram

NOTHING: Mapping[str, str] = {}
PROGRAM = ["-P", "-m", "vcmvsp.cosim.cli.app"]
VCMVSP = [sys.executable, *PROGRAM]


@contextlib.contextmanager
def reserve_port() -> Iterator[int]:
    """A free TCP port of 127.0.0.1 that Linux assigns to no other socket.

    A program that is given the number may listen there with ``SO_REUSEADDR``, as all servers do.
    """
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


class Stage:
    """A folder, a port of its own, and the processes started there; leaving the block ends them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        self._held = contextlib.ExitStack()
        self.port = self.another_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self.processes:
            process.kill()
            process.communicate()
        self._held.close()

    def another_port(self) -> int:
        return self._held.enter_context(reserve_port())

    def written(self, name: str = "metrics.json") -> Any:
        """Content of a JSON file of the run."""
        return json.loads((self.out / name).read_text())

    def digest(self) -> str:
        return self.written()["digest"]

    def start(self, *arguments: str, more: Mapping[str, str] = NOTHING, stdout: int = 1) -> subprocess.Popen[str]:
        """Start ``vcmvsp`` with these arguments, and more variables in its environment."""
        program = ForkedProgram(*arguments, folder=self.folder, environment={**os.environ, **more}, stdout=stdout)
        self.processes.append(cast("subprocess.Popen[str]", program))
        return self.processes[-1]

    def python(self, *arguments: str, before: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start Python afresh; ``before`` is a prefix command, such as ``ip netns exec``."""
        command = [*before, sys.executable, *arguments]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=self.folder)
        self.processes.append(process)
        return process


def staged(kind: Callable[[Path], Stage]) -> Any:
    """A fixture that gives each test a stage of this kind, in the test's folder."""

    @pytest.fixture
    def stage(tmp_path: Path) -> Iterator[Stage]:
        with kind(tmp_path) as made:
            yield made

    return stage


def exit_of(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and output of a process."""
    _, output = process.communicate(timeout=500)
    assert "Traceback" not in output
    return process.returncode, output


def output_at_exit(code: int, process: subprocess.Popen[str]) -> str:
    """Output of a process that ended with this exit code."""
    found, output = exit_of(process)
    assert found == code, output
    return output


def read_until(process: subprocess.Popen[str], text: str) -> str:
    """Read the output up to this text; returns the line that contains it."""
    assert process.stderr is not None
    found = next((line for line in process.stderr if text in line), None)
    assert found is not None, text
    return found


@contextlib.contextmanager
def served(folder: Path, label: str, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A ``vcmvsp`` process in a folder, and the address that it prints behind a label; leaving the block ends it."""
    with Stage(folder) as stage:
        process = stage.start(*arguments)
        yield process, read_until(process, label).split()[-1]


def wait_for(path: Path) -> None:
    """Wait for a file."""
    last = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < last
        time.sleep(0.02)


class Forwarder:
    """Forwards connections to ``port``; a cut either holds data back, or breaks connections and refuses new ones."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._door.getsockname()[1]
        self._whole = threading.Event()
        self._whole.set()
        self._refuses = False
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def hold(self) -> None:
        """Hold all data back until `release`."""
        self._whole.clear()

    def release(self) -> None:
        """Forward the data that were held back."""
        self._whole.set()

    def freeze(self, seconds: float) -> None:
        """Hold all data back for a time, then forward them: a cable that is pulled and put back."""
        self.hold()
        time.sleep(seconds)
        self.release()

    def reset(self, seconds: float) -> None:
        """Break all connections and refuse new ones for a time."""
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
        except OSError:  # no process listens yet
            return None

    def _carry(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(65536):
                self._whole.wait()
                other.sendall(data)
        for end in (one, other):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
