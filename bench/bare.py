"""Building blocks alone: SimPy, PyBullet, and Zenoh without the platform."""

import contextlib
import json
import subprocess
import sys
import textwrap
from collections.abc import Generator, Iterator
from typing import Any

import numpy as np
import simpy
import zenoh

from bench.measure import cpu
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, Instants, RunInfo
from vcmvsp.cosim.types import Velocity
from vcmvsp.physics.dynamics.bullet import p as pybullet  # imported there without its greeting
from vcmvsp.physics.federate import BulletPhysics
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World


def simpy_cpu_s(vehicles: int, duration_s: float) -> float:
    """SimPy processes that wake ten times a second and do nothing."""

    def work() -> None:
        env = simpy.Environment()

        def tick() -> Generator[simpy.Event, Any, None]:
            while True:
                yield env.timeout(100_000_000)

        for _ in range(vehicles):
            env.process(tick())
        env.run(until=int(duration_s * 1e9))

    return cpu(work)


def bullet_cpu_s(vehicles: int, duration_s: float) -> float:
    """Bullet's stepSimulation alone, in the world of the same robots on circles."""
    cars = [VehicleSpec(name=f"car{n}", model=P2DX(), position=(0.0, 1.0 * n, 0.0)) for n in range(vehicles)]
    physics = BulletPhysics(world=World(), vehicles=cars)
    names = tuple(car.name for car in cars)
    physics.start(
        RunInfo(scenario="bare", seed=0, duration_ns=SECOND_NS, vehicles=names, instants=(Instants(Ticks.every(1.0)),))
    )
    physics.step(SECOND_NS, [Event(f"{name}/command", 0, Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.15)) for name in names])
    client = physics._engines[0][0]._client  # type: ignore[attr-defined]
    steps = range(int(duration_s * physics.rate_hz))

    def work() -> None:
        for _ in steps:
            pybullet.stepSimulation(client)

    seconds = cpu(work)
    physics.close()
    return seconds


@contextlib.contextmanager
def zenoh_echo(endpoint: str, answer_bytes: int) -> Iterator[None]:
    """Another process that answers each query with a number of bytes."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    code = f"""
        import zenoh
        session = zenoh.open(zenoh.Config.from_json5({json.dumps(config)!r}))
        queries = session.declare_queryable("bench/echo")
        answer = bytes({answer_bytes})
        print("ready", flush=True)
        while True:
            with queries.recv() as query:
                query.payload.to_bytes()
                query.reply("bench/echo", answer)
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE)
    try:
        if process.stdout:
            process.stdout.readline()
        yield
    finally:
        process.kill()
        process.wait()


def ask(session: zenoh.Session, question: bytes) -> bytes:
    """One bare query and its reply."""
    for reply in session.get("bench/echo", payload=question):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
    raise RuntimeError("no answer")


def payload(size: int) -> bytes:
    """Incompressible bytes."""
    return np.random.default_rng(1).bytes(size)
