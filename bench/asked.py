"""Peers as separate programs: each does a stretch of its work on request, and reports its cost."""

import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.measure import Timed


class SilentError(Exception):
    """A program did not answer; the message is its last line."""


@contextlib.contextmanager
def program(module: str, python: Path, **options: Any) -> Iterator[Timed]:
    """A program of `bench.peers` after its warm-up; each call runs a stretch and returns its cost.

    Raises:
        SilentError: it ended instead of answering.
    """
    command = [str(python), "-m", f"bench.peers.{module}"]
    for name, value in options.items():
        if value:
            command += [f"--{name}"] if value is True else [f"--{name}", str(value)]
    with tempfile.TemporaryFile("w+") as error_output, _process(command, error_output) as (requests, answers):

        def stretch() -> float:
            if not (answer := answers.readline()):
                error_output.seek(0)
                raise SilentError((error_output.read().strip().splitlines() or ["no word"])[-1])
            return float(answer)

        def timed() -> float:
            requests.write("on\n")
            requests.flush()
            return stretch()

        stretch()
        yield timed


@contextlib.contextmanager
def _process(command: list[str], error_output: Any) -> Iterator[tuple[Any, Any]]:
    """Pipes of a process; leaving the block ends it and its children."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    child = subprocess.Popen(command, text=True, stderr=error_output, start_new_session=True, **pipes)  # type: ignore[call-overload]
    try:
        yield child.stdin, child.stdout
    finally:
        with contextlib.suppress(OSError):
            child.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(10)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        child.stdout.close()


def installed(python: Path) -> Path:
    """The Python of an environment with some peers.

    Raises:
        SilentError: there is none.
    """
    if not python.exists():
        raise SilentError(f"it is not installed: make {python.parts[0]}/.ready")
    return python
