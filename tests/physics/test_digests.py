"""Runs of a mixed world are equal to the last bit, in other processes and beside other runs in one process."""

import hashlib
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from itertools import zip_longest
from typing import NamedTuple

import pytest

from tests.support.paths import ROOT
from tests.support.physics.runs import Command, steps_of
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.types import Later, Velocity, Waypoint
from vcmvsp.cosim.util.codec import encode
from vcmvsp.physics.federate import BulletPhysics
from vcmvsp.physics.sensors.camera import Camera, NadirCamera
from vcmvsp.physics.sensors.detectors import Bumper
from vcmvsp.physics.sensors.motion import InertialUnit
from vcmvsp.physics.sensors.positioning import Gps, Positioning
from vcmvsp.physics.sensors.range_scanner import Lms, Ring
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import Box, Cylinder
from vcmvsp.physics.world.world import Movable, Moving, Wind, World, Zone

pytestmark = pytest.mark.processes


class Digest(NamedTuple):
    """Digest of all published events, in order."""

    bits: str
    kinds: Mapping[str, int]  # number of values of each type


def mixed_world() -> World:
    """A world with every kind of object."""
    return World(
        solids=(
            Box(center=(6.0, 0.0, 1.0), size=(1.0, 8.0, 2.0), yaw_rad=0.2),
            Box(center=(-3.0, 4.0, 2.0), size=(2.0, 2.0, 4.0), color=(200, 40, 40)),
            Cylinder(center=(0.0, -5.0, 1.5), radius=0.7, height=3.0),
        ),
        movables=(
            Movable(name="crate", solid=Box(center=(1.2, -0.3, 0.15), size=(0.3, 0.25, 0.3)), mass_kg=0.5),
            Movable(name="box", solid=Box(center=(1.2, 0.0, 0.15), size=(0.3, 0.25, 0.3), yaw_rad=0.4), mass_kg=0.5),
            Movable(name="bin", solid=Cylinder(center=(1.7, 0.1, 0.2), radius=0.15, height=0.4), mass_kg=1.0),
        ),
        moving=(
            Moving(
                name="gate",
                solid=Box(center=(0, 0, 0), size=(0.2, 2.0, 1.0)),
                times_s=(0.0, 2.0, 4.0),
                way=((-2.0, -1.0, 0.6, 0.0), (-2.0, 1.0, 0.6, 1.0), (-2.0, -1.0, 0.6, 2.0)),
            ),
        ),
        zones=(Zone(center=(2.0, 2.0), size=(2.0, 2.0), friction=0.1),),
        ground=GroundPicture(marks=(Mark(center=(1.0, 1.0), radius=0.5, color=(220, 30, 160)),)),
        wind=Wind(velocity=(1.0, -0.5, 0.0), gust=2.0, gust_time_s=0.5),
    )


def vehicles() -> list[VehicleSpec]:
    """Robots that push crates, quadrotors that hit walls and each other, sensors with errors and drop-outs."""

    def spec(
        name: str, model: Vehicle, place: tuple[float, float, float], heading: float = 0.0, **sensors: Sensor
    ) -> VehicleSpec:
        return VehicleSpec(
            name=name, model=model, position=place, heading=heading, sensors=sensors, positioning=Positioning(rate_hz=5.0)
        )

    scan = Lms(no_return=0.02, outlier_probability=0.02, drop_out=0.1)  # a run copies its sensors
    ahead = Camera(rate_hz=5.0, width=80, height=60, noise=3.0, depth=True)
    down = NadirCamera(rate_hz=5.0, width=80, height=60, latency_s=0.1)
    return [
        spec("car0", P2DX(), (0.0, 0.0, 0.0), scan=scan, camera=ahead, imu=InertialUnit(), bumper=Bumper()),
        spec("car1", P2DX(), (0.0, 1.5, 0.0), 0.3, scan=scan, gps=Gps()),
        spec("amigo", AmigoBot(), (3.4, 0.1, 0.0), 3.1, scan=Lms(), camera=ahead),
        spec("uav0", Quadrotor(downwash=True), (0.0, 0.0, 3.0), scan=Ring(), camera=down, imu=InertialUnit()),
        spec("uav1", Quadrotor(), (4.0, 0.0, 1.2), scan=Ring(), camera=down),
        spec("uav2", Quadrotor(ground_effect=True), (0.0, 0.0, 4.5), 1.0, gps=Gps(), camera=down),
        spec("point", Point(tau_s=0.3), (-4.0, -4.0, 2.0), camera=down),
    ]


ORDERS: list[Command] = [  # time, vehicle, command
    (0.0, "car0", Velocity(linear=(0.9, 0.0, 0.0))),
    (0.0, "car1", Velocity(linear=(0.6, 0.0, 0.0), yaw_rate=0.2)),
    (0.5, "amigo", Velocity(linear=(0.5, 0.0, 0.0))),
    (0.0, "uav0", Velocity(linear=(1.0, 1.0, 0.0), yaw_rate=0.5)),
    (0.1, "uav1", Velocity(linear=(2.5, 0.0, 0.0))),  # into the wall
    (0.0, "uav2", Waypoint(position=(1.0, 1.0, 0.3), yaw=-1.0)),
    (0.3, "point", Waypoint(position=(2.0, -3.0, 1.0))),
    (1.1, "uav0", Velocity(linear=(-1.0, 0.5, 0.3), yaw_rate=-0.5)),
    (2.2, "car1", Velocity(linear=(0.2, 0.0, 0.0), yaw_rate=-0.6)),
]


def run(world: World, *, seed: int = 1, on_demand: bool = False, late: bool = False) -> Generator[None, None, Digest]:
    """One run as a generator that pauses after each step.

    On-demand readings are computed together if ``on_demand``, and at the end if ``late``.
    """
    physics = BulletPhysics(world=world, vehicles=vehicles())
    keys = tuple(f"{spec.name}/{sensor}" for spec in physics.vehicles for sensor in spec.sensors) if on_demand else ()
    needed = (Instants(Ticks.every(0.05)),)
    batch, hashed, kinds = list[Event](), hashlib.blake2b(digest_size=16), Counter[str]()

    def take(events: list[Event]) -> None:
        for event in events:
            hashed.update(encode(event))
            value = event.value.get() if isinstance(event.value, Later) else event.value
            kinds[type(value).__name__] += 1

    for events in steps_of(physics, ORDERS, 3.0, needed, seed=seed, wanted=keys):
        batch += events
        if not late:
            take(batch)
            batch = []
        yield
    take(batch)
    return Digest(hashed.hexdigest(), kinds)


def digests(*runs: Generator[None, None, Digest]) -> list[Digest]:
    """Digests of interleaved runs, one step each in turn."""
    found: dict[int, Digest] = {}

    def watched(number: int, one: Generator[None, None, Digest]) -> Iterator[None]:
        found[number] = yield from one

    for _ in zip_longest(*(watched(number, one) for number, one in enumerate(runs))):
        pass
    return [found[number] for number in range(len(runs))]


@pytest.fixture(scope="module")
def alone() -> Digest:
    """Digest of a single run."""
    return digests(run(mixed_world()))[0]


def test_all_event_types_are_present(alone: Digest) -> None:
    kinds = "States VehicleState Odometry Fix Imu Measured Scan Image Contact Pushed"
    assert set(alone.kinds) == set(kinds.split())
    assert alone.kinds["States"] == 61
    assert alone.kinds["Image"] == 6 * 16
    assert digests(run(mixed_world(), seed=2))[0].bits != alone.bits


def test_runs_in_other_processes_are_equal(alone: Digest) -> None:
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, __file__]
    found = subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=500)
    assert found.stdout.split()[-1] == alone.bits


def test_interleaved_runs_in_one_process_are_equal(alone: Digest) -> None:
    """In one world or in two, beside a run with other gusts; readings computed together, one by one, or at the end."""
    shared = mixed_world()
    first, other, second, third = digests(
        run(shared), run(shared, seed=2), run(shared, on_demand=True), run(mixed_world(), late=True)
    )
    assert first.bits == second.bits == third.bits == alone.bits
    assert other.bits != alone.bits


if __name__ == "__main__":
    sys.stdout.write(digests(run(mixed_world()))[0].bits)
