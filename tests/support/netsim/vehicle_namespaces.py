"""Network namespaces of vehicles in tests: an open gateway on the loop, and sockets and commands inside."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.run_processes import VCMVSP
from tests.support.netsim.gateway_context import PATIENCE_S, RunlessContext, open_gateway
from vcmvsp.netsim.bridge.gateways.ip import namespaces, run_networks
from vcmvsp.netsim.bridge.gateways.ip.gateway import Ip

RUN = f"test{os.getpid()}"
CARS = ("car1", "car2", "car3")
IN_NAMESPACES = [
    pytest.mark.processes,
    pytest.mark.sockets,
    pytest.mark.needs("ip"),
    pytest.mark.usefixtures("namespaces_allowed"),
]
"""Marks of tests that make network namespaces of Linux."""


@contextlib.asynccontextmanager
async def machines(*vehicles: str, run: str = RUN, **params: Any) -> AsyncIterator[RunlessContext]:
    """Context of an open IP gateway with these parameters; without names of vehicles of `CARS`."""
    async with open_gateway(Ip(**params), RunlessContext(vehicles or CARS, run=run)) as context:
        yield context


@contextlib.contextmanager
def network_up(scenario: Path, name: str) -> Iterator[None]:
    """A run of a scenario file, of this name, in which each vehicle is a machine; ended by Ctrl-C."""
    command = [*VCMVSP, "net", "up", scenario.name, "--out", "out"]
    with subprocess.Popen(command, cwd=scenario.parent, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        try:
            assert run.stderr is not None
            lines = [""]
            while "vcmvsp net exec car1" not in lines[-1]:
                lines.append(run.stderr.readline())
                assert lines[-1], "".join(lines)
            yield
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=PATIENCE_S)
        finally:
            run.kill()
            with contextlib.suppress(run_networks.RunAlive):
                run_networks.clear(name)


def shell(commands: str) -> str:
    """Output of commands, all of which must succeed."""
    result = subprocess.run(["sh", "-ec", commands], check=False, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr + result.stdout
    return result.stdout


def space(vehicle: str, run: str = RUN) -> str:
    return f"vcmvsp-{run}-{vehicle}"


def udp(vehicle: str, address: str, port: int = 0, run: str = RUN) -> socket.socket:
    """A socket on a vehicle's machine."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    made = namespaces.inside(space(vehicle, run), lambda: socket.socket(family, socket.SOCK_DGRAM))
    made.setblocking(False)
    made.bind((address, port))
    return made


async def next_datagram(listener: socket.socket, seconds: float = PATIENCE_S) -> tuple[bytes, str]:
    """Next datagram, and its source address."""
    loop = asyncio.get_running_loop()
    data, sender = await asyncio.wait_for(loop.sock_recvfrom(listener, 65536), seconds)
    return data, sender[0]


async def run_command(vehicle: str, *command: str, run: str = RUN) -> tuple[int, str]:
    """Exit code and output of a command on a vehicle's machine."""
    inside = ("ip", "netns", "exec", space(vehicle, run), *command)
    process = await asyncio.create_subprocess_exec(*inside, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT)
    out, _ = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode is not None
    return process.returncode, out.decode()


def remains_of_run(vehicles: Sequence[str], run: str = RUN) -> list[str]:
    """Interfaces and namespaces of a run that still exist."""
    names = [space(each, run) for each in vehicles if (namespaces.NAMES / space(each, run)).exists()]
    return names + [str(each) for each in (run_networks.FOLDER / run,) if each.exists()]
