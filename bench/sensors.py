"""Vehicles with sensors in a town, beside the same ones without: cost of scans and pictures, read and unread.

Run with ``python -m bench.sensors``. CPU time of one core; robots carry a scanner of 512 beams, quadrotors one of 32, some
also a camera that looks down, 160 x 120. Scans are taken ten times a second and pictures five times.
"""

from collections.abc import Callable, Sequence
from functools import cache

from bench.camera import PITCH_M, city, crossings
from bench.measure import Row, in_turn, measured, table
from bench.vehicles import Fleet, federate_cpu_s
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.sensors.camera import NadirCamera
from vcmvsp.physics.sensors.range_scanner import Lms, Ring
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.vehicles.models import P2DX, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World

ROUNDS = 5
BUILDINGS = 200
HEIGHT_M = 8.0  # height of the quadrotors: below most of the roofs
ASIDE_M = 1.5  # of the robots below them

town: Callable[[int], World] = cache(city)


def carriers(fleet: Fleet, cameras: int, *, bare: bool = False) -> list[VehicleSpec]:
    """Robots and quadrotors between houses, ``cameras`` of the latter with one; none with a sensor if ``bare``."""
    places = [(x, y + 0.5 * PITCH_M) for x, y in crossings(BUILDINGS)]
    found = []
    for n in range(fleet.robots):
        on_road: dict[str, Sensor] = {} if bare else {"scan": Lms(rate_hz=10.0)}
        found.append(VehicleSpec(name=f"car{n}", model=P2DX(), position=(*places[n], 0.0), sensors=on_road))
    for n in range(fleet.quadrotors):
        x, y = places[n]
        above: Vec3 = (x + ASIDE_M, y, HEIGHT_M)
        in_air: dict[str, Sensor] = {} if bare else {"scan": Ring(rate_hz=10.0)}
        if n < cameras and not bare:
            in_air["camera"] = NadirCamera(rate_hz=5.0)
        found.append(VehicleSpec(name=f"uav{n}", model=Quadrotor(), position=above, sensors=in_air))
    return found


def _looked_at(name: str, fleet: Fleet, cameras: int, least: float) -> Row:
    """All scans and pictures are read."""
    fitted, without = carriers(fleet, cameras), carriers(fleet, cameras, bare=True)
    requested_keys = tuple(f"{spec.name}/{sensor}" for spec in fitted for sensor in spec.sensors)
    world = town(BUILDINGS)
    ours, other, ratio = in_turn(
        lambda: federate_cpu_s(fleet, fitted, world, requested_keys), lambda: federate_cpu_s(fleet, without, world), ROUNDS
    )
    words = f"{name}, all read, among {BUILDINGS} buildings, {fleet.rate_hz:g} Hz, {fleet.iterations} iterations; "
    speed = 1.0 / ours
    what = words + "beside the same without sensors"
    return Row(what, f"{speed:.1f}x real time", f"{1.0 / other:.1f}x", ratio, f"goal: >= {least:g}x real time", speed >= least)


def robots_3() -> Row:
    """Three Pioneers."""
    return _looked_at("3 p2dx with scanners", Fleet(3, 0), 0, 30.0)


def mixed_10() -> Row:
    """Ten of each, four cameras."""
    return _looked_at("10 p2dx, 10 quadrotors with scanners, 4 cameras", Fleet(10, 10), 4, 8.0)


def mixed_50() -> Row:
    """Fifty of each, eight cameras."""
    return _looked_at("50 p2dx, 50 quadrotors with scanners, 8 cameras", Fleet(50, 50, duration_s=2.0), 8, 1.8)


def unread() -> Row:
    """The same sensors without a reader."""
    fleet, world = Fleet(10, 10), town(BUILDINGS)
    fitted, without = carriers(fleet, 4), carriers(fleet, 4, bare=True)
    ours, other, ratio = in_turn(
        lambda: federate_cpu_s(fleet, fitted, world), lambda: federate_cpu_s(fleet, without, world), 2 * ROUNDS + 1
    )
    name = "10 p2dx, 10 quadrotors with scanners, 4 cameras, none read; beside the same without sensors"
    return Row(name, f"{1.0 / ours:.1f}x real time", f"{1.0 / other:.1f}x", ratio, "<= 1.1", ratio <= 1.1)


ALL: Sequence[Callable[[], Row]] = (robots_3, mixed_10, mixed_50, unread)


def rows() -> list[Row]:
    """All rows."""
    return measured(ALL)


if __name__ == "__main__":
    print(table(rows()))
