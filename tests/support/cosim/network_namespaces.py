"""Machines of their own, as network namespaces: one for the run, others for hosts, and between them a slow network that breaks.

::

    far0 --- 10.213.8.10 \\
    far1 --- 10.213.8.11 --- 10.213.8.1  middle  10.213.9.2 --- 10.213.9.1  run
    far2 --- 10.213.8.12 /

Nothing is routed: whoever is far dials a forwarder in the middle, which hands on each piece after a delay, in order. Run as a
program, this file is the forwarder: ``namespaces.py TARGET LISTEN:PORT:MILLISECONDS...``.
"""

import asyncio
import os
import random
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Self

MIDDLE, RUN = "10.213.8.1", "10.213.9.1"
PORT = 7447
RESEND_S = 1.0  # TCP tries a link that was down again within about as long as it was


class Network:
    """Namespaces and the links between them; leave it, and they are gone.

    Args:
        delays_ms: for each machine that is far, the most that the middle keeps a piece back, either way.
    """

    def __init__(self, delays_ms: Sequence[int]) -> None:
        self._delays_ms = delays_ms
        self._spaces: list[str] = []
        self._forwarder: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        from tests.support import requirements  # the forwarder has none

        requirements.program("ip")
        try:
            self._build()
        except subprocess.CalledProcessError as error:
            self.close()
            requirements.not_allowed(f"a network of namespaces: {' '.join(error.cmd)}: {error.stderr.strip()}")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        if self._forwarder is not None:
            self._forwarder.kill()
            self._forwarder.communicate()
        for space in self._spaces:
            subprocess.run(["ip", "netns", "del", space], check=False, capture_output=True)

    def inside(self, name: str) -> tuple[str, ...]:
        """What to write before a command that is to run on the machine ``run``, ``middle``, ``far0``, ``far1``, ..."""
        return ("ip", "netns", "exec", self._space(name))

    def endpoint(self, number: int) -> str:
        """Where the machine ``far<number>`` reaches the run."""
        return f"tls/{MIDDLE}:{PORT + number}"

    def cut(self, number: int, seconds: float) -> None:
        """Pull the plug of a machine for so long: what is sent meanwhile is lost, and nobody is told."""
        port = ("-n", self._space("middle"), "link", "set", f"port{number}")
        _ip(*port, "down")
        time.sleep(seconds)
        _ip(*port, "up")

    def _build(self) -> None:
        far = [f"far{number}" for number in range(len(self._delays_ms))]
        for name in ("run", "middle", *far):
            _ip("netns", "add", self._space(name))
            self._spaces.append(self._space(name))
            _ip("-n", self._space(name), "link", "set", "lo", "up")
        middle = self._space("middle")
        _ip("-n", middle, "link", "add", "bridge", "type", "bridge")
        self._address("middle", "bridge", MIDDLE)
        for number, name in enumerate(far):
            self._link(name, f"port{number}")
            _ip("-n", middle, "link", "set", f"port{number}", "master", "bridge", "up")
            self._address(name, "wire", f"10.213.8.{10 + number}")
        self._link("run", "torun")
        self._address("middle", "torun", "10.213.9.2")
        self._address("run", "wire", RUN)
        ways = [f"{MIDDLE}:{PORT + number}:{delay}" for number, delay in enumerate(self._delays_ms)]
        command = [*self.inside("middle"), sys.executable, __file__, f"{RUN}:{PORT}", *ways]
        self._forwarder = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert self._forwarder.stdout is not None
        assert self._forwarder.stdout.readline() == b"ready\n"

    def _link(self, name: str, port: str) -> None:
        """A cable from the machine to the middle, where it ends in ``port``."""
        there = ("peer", "name", port, "netns", self._space("middle"))
        _ip("-n", self._space(name), "link", "add", "wire", "type", "veth", *there)

    def _address(self, name: str, device: str, address: str) -> None:
        _ip("-n", self._space(name), "addr", "add", f"{address}/24", "dev", device)
        _ip("-n", self._space(name), "link", "set", device, "up")

    @staticmethod
    def _space(name: str) -> str:
        return f"vcmvsp-{os.getpid()}-{name}"


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True, timeout=20)


# --- the forwarder ---


async def _carry(source: asyncio.StreamReader, target: asyncio.StreamWriter, delay_ms: int, draw: random.Random) -> None:
    """Hand on what comes, each piece 0 to ``delay_ms`` later, and none before the one that came before it."""
    waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
    clock = asyncio.get_running_loop().time

    async def take() -> None:
        last = 0.0
        try:
            while data := await source.read(65536):
                last = max(last, clock() + draw.uniform(0, delay_ms / 1000))
                waiting.put_nowait((last, data))
        except OSError:
            pass
        waiting.put_nowait((last, b""))

    taking = asyncio.create_task(take())
    try:
        while True:
            due, data = await waiting.get()
            await asyncio.sleep(due - clock())
            if not data:
                break
            target.write(data)
            await target.drain()
    except OSError:
        pass
    taking.cancel()
    target.close()


async def _forward(target: str, ways: Sequence[str]) -> None:
    host, _, target_port = target.rpartition(":")
    carried = set[asyncio.Task[None]]()

    for way in ways:
        listen, port, delay = way.split(":")

        async def on_connection(
            near: asyncio.StreamReader, to_near: asyncio.StreamWriter, delay_ms: int = int(delay), seed: str = way
        ) -> None:
            try:
                far, to_far = await asyncio.open_connection(host, int(target_port))
            except OSError:  # nobody listens yet
                to_near.close()
                return
            draw = random.Random(seed)
            for source, sink in ((near, to_far), (far, to_near)):
                task = asyncio.create_task(_carry(source, sink, delay_ms, draw))
                carried.add(task)
                task.add_done_callback(carried.discard)

        await asyncio.start_server(on_connection, listen, int(port))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_forward(sys.argv[1], sys.argv[2:]))
