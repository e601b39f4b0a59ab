"""Network namespaces of vehicles in tests: an open gateway on the loop, and sockets and commands inside."""

import asyncio
import os
import socket
from collections.abc import Sequence

from tests.support.netsim.gateway_context import PATIENCE_S
from vcmvsp.netsim.bridge.gateways.ip import namespaces, run_networks

RUN = f"test{os.getpid()}"


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
