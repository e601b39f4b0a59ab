"""Child processes of a run: started afresh (never forked), ended with it, however it ends."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence

from vcmvsp.cosim.processes.local_link import LocalLink, pair

LEAVE_S = 0.3  # for a host to leave by itself, before it is made to; its agents are closed by then


BOOT = """
import json, os, sys
line = b""
while not line.endswith(b"\\n"):
    line += os.read(0, 1) or sys.exit()  # its parent has died
sys.path[:] = json.loads(line)
from {module} import main
sys.exit(main())
"""


class HostProcess:
    """One child; it ends by itself when this process does, because its standard input then closes.

    Args:
        module: Python module to run, with ``--connect`` and ``--vehicle`` options.
        endpoint: where it is to dial in.
        vehicles: whose agents it hosts.
        token: a secret that it repeats in its greeting.
        files: file descriptors that it inherits.
    """

    def __init__(self, module: str, endpoint: str, vehicles: Sequence[str], token: str, files: Sequence[int]) -> None:
        # The child looks for modules where this process does, and nowhere else: not in the current folder.
        command = [sys.executable, "-P", "-c", BOOT.format(module=module), "--connect", endpoint]
        for vehicle in vehicles:
            command += ["--vehicle", vehicle]
        # A group of its own keeps Ctrl-C away from it; what agents print must not mix with the run's own output.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.__stderr__, pass_fds=files, process_group=0)
        if self._process.stdin:
            self._process.stdin.write(f"{json.dumps(sys.path)}\n{token}\n".encode())
            self._process.stdin.flush()

    @property
    def running(self) -> bool:
        """Whether it is still there."""
        return self._process.poll() is None

    def why_ended(self) -> str:
        """How it ended, in words; empty: it has not."""
        code = self._process.poll()
        return "" if code is None else ending(code)

    def close(self, patient: bool = True) -> None:
        """Let it leave, or make it; at once if it has been waited for already."""
        if not patient:
            self._process.kill()
        if self._process.stdin:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def linked(module: str, *arguments: str) -> tuple[subprocess.Popen[bytes], LocalLink]:
    """A process beside the run, ``python -m MODULE FD ARGUMENTS``, and the link to it, whose other end it inherits as FD."""
    here, there = pair()
    # The child looks for modules where this process does, and nowhere else: not in the current folder.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with there:
        # A session of its own keeps away Ctrl-C, and the end of the terminal: what it holds is let go of in order first.
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, str(there.fileno()), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=sys.__stderr__,
            env=environment,
            pass_fds=(there.fileno(),),
            start_new_session=True,
        )
    return process, here


def ending(code: int) -> str:
    """How a process ended, in words."""
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
