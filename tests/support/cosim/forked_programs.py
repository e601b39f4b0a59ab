"""``vcmvsp`` as forks of one process that has imported its modules: a start takes a tenth of the time."""

import atexit
import functools
import json
import os
import signal
import socket
import sys
from collections.abc import Mapping
from pathlib import Path

from vcmvsp.cosim.processes.fork_server import ForkServer

MODULES = (
    "typer._adapters",
    "vcmvsp.agents.driven_host",
    "vcmvsp.agents.formation.followers.leader_follower",
    "vcmvsp.agents.formation.leaders.trajectory",
    "vcmvsp.agents.host_process",
    "vcmvsp.agents.stack_host",
    "vcmvsp.cosim.analysis.links",
    "vcmvsp.cosim.assembly.run",
    "vcmvsp.cosim.assembly.vehicles",
    "vcmvsp.cosim.assembly.worlds",
    "vcmvsp.cosim.cli.app",
    "vcmvsp.cosim.hosts.observers",
    "vcmvsp.cosim.hosts.page_publisher",
    "vcmvsp.cosim.recording.recorder",
    "vcmvsp.cosim.recording.run_mcap",
    "vcmvsp.cosim.report.run_page",
    "vcmvsp.cosim.runs.launch",
    "vcmvsp.cosim.security.authority",
    "vcmvsp.netsim.impairments.loss",
    "vcmvsp.physics.raycast.surfaces",
    "vcmvsp.physics.worlds.surroundings",
)


class ForkedProgram:
    """``vcmvsp`` with these arguments: the part of `subprocess.Popen` that tests use, with a pipe from its standard error.

    Args:
        stdout: descriptor of its standard output; default: that of this process.
    """

    def __init__(self, *arguments: str, folder: Path, environment: Mapping[str, str], stdout: int = 1) -> None:
        reads, writes = os.pipe()
        near, far = socket.socketpair()
        with near, far:
            socket.send_fds(near, [b" "], [0, stdout, writes])
            os.close(writes)
            self._process = _server().start(str(folder), json.dumps(dict(environment)), *arguments, stdin=far.fileno())
        self.stderr = os.fdopen(reads)
        self.kill = self._process.kill

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.returncode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, when it has ended; pytest's time-out is the limit."""
        return self._process.wait()

    def send_signal(self, number: signal.Signals) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float | None = None) -> tuple[None, str]:
        """Its output, when it has ended."""
        output = "" if self.stderr.closed else self.stderr.read()
        self.stderr.close()
        self.wait()
        return None, output


@functools.cache
def _server() -> ForkServer:
    server = ForkServer(main.__module__, *MODULES)
    atexit.register(server.__exit__)
    return server.__enter__()


def main() -> int:
    """Entry point of the forks: the first arguments are the folder and the environment, standard input brings the streams."""
    from vcmvsp.cosim.cli import app

    signal.signal(signal.SIGINT, signal.default_int_handler)  # the server ignores it
    with socket.socket(fileno=os.dup(0)) as given:
        _, streams, _, _ = socket.recv_fds(given, 1, 3)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(sys.argv.pop(1))
    environment = json.loads(sys.argv.pop(1))
    os.environ.clear()
    os.environ.update(environment)
    app.main()
    return 0
