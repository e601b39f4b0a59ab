"""No effect on a run: additional instants, sensors, bodies out of reach, an earlier run of the same vehicles."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS
from tests.support.physics.external_vehicles import Courses, spec, straight
from tests.support.physics.runs import TENTH, Command, run, values
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.estimation.fusion import Fusion
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Halted, Later, Moved, Waypoint
from vcmvsp.cosim.util.codec import encode
from vcmvsp.physics.federate import KinematicPhysics, Physics
from vcmvsp.physics.sensors.detectors import NeighbourRange
from vcmvsp.physics.sensors.motion import InertialUnit
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.sensors.range_scanner import Ring
from vcmvsp.physics.vehicles.models import P2DX, Kinematic, Lag, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Movable, Moving, Wind, World

pytestmark = pytest.mark.slow

CRATE = Movable(name="crate", solid=Box(center=(5.0, 0.0, 0.2), size=(0.4, 0.4, 0.4)), mass_kg=5.0)
CART = Moving(name="cart", solid=CRATE.solid, times_s=(0.0, 9.0), way=((-9.0, 9.0, 0.3, 0.0), (-9.0, 12.0, 0.3, 3.0)))
WIND = Wind(velocity=(1.0, 0.0, 0.0), gust=1.0)
ORDERS: list[Event | Command] = [
    *((0.5 * k + 0.1, name, 0.4, 0.3 * (-1.0) ** k) for k in range(5) for name in ("car", "lag", "unicycle", "uav")),
    (0.0, "point", Waypoint(position=(2.0, -3.0, 1.0))),
    Event("operator/halted", seconds_to_ns(1.037), Halted(vehicles=("car", "uav"), halted=True)),
    Event("operator/halted", seconds_to_ns(1.241), Halted(vehicles=("car", "uav"), halted=False)),
]


def cast(**sensors: Any) -> list[VehicleSpec]:
    """One vehicle of each kind; the first uses fused poses, the last is external."""
    fixes = Positioning(rate_hz=4.0, heading=False)
    return [
        spec("car", fusion=Fusion(), pose_source="fusion", positioning=fixes, sensors=sensors),
        spec("lag", y=3.0, model=Lag()),
        spec("unicycle", y=6.0, model=Kinematic(), pose_source="odometry"),
        spec("uav", y=-2.0, z=0.4, model=Quadrotor()),
        spec("point", y=-4.0, z=1.0, model=Point(tau_s=0.3)),
        spec("real", -6.0),
    ]


def events(
    kind: type[Physics],
    vehicles: Sequence[VehicleSpec],
    *instants: Instants,
    things: bool = True,
    more: Sequence[VehicleSpec] = (),
    orders: Sequence[Event] = (),
    **rest: Any,
) -> list[Event]:
    outside = Courses(real=straight(-6.0, 0.2), **{each.name: straight(20.0) for each in more if each.name == "other"})
    world = World(movables=(CRATE,), moving=(CART,), wind=WIND) if things else World(wind=WIND)
    physics = kind(world=world, vehicles=[*vehicles, *more], outside=outside)
    return run(physics, [*ORDERS, *orders], 3.0, instants or TENTH, **rest)


def motion(found: Sequence[Event]) -> dict[tuple[int, str], Any]:
    """States and estimates of the cast every 0.1 s, as numbers."""
    rows: dict[tuple[int, str], Any] = {}
    for event in found:
        value: Any = event.value
        if event.time_ns % (SECOND_NS // 10) == 0 and event.key == "world/states":
            for name in ("car", "lag", "unicycle", "uav", "point", "real"):
                row = value.names.index(name)
                rows[event.time_ns, name] = np.concatenate([value.position[row], value.velocity[row], value.attitude[row]])
        if event.time_ns % (SECOND_NS // 10) == 0 and event.key.endswith("/estimate"):
            rows[event.time_ns, event.key] = np.array([*value.position, *value.attitude])
    return rows


def same(kind: type[Physics], one: Sequence[Event], other: Sequence[Event]) -> None:
    """Equal to the last bit in Bullet, with fixed steps; otherwise within the error of arcs with varying speed."""
    a, b = motion(one), motion(other)
    assert len(a) == 31 * 11
    for (time_ns, key), row in a.items():
        exact = kind is not KinematicPhysics and key.startswith(("car", "uav"))
        assert b[time_ns, key] == pytest.approx(row, abs=0.0 if exact else 1e-5 if key.startswith("lag") else 1e-9), key


@KINDS
def test_more_instants_and_sensors_have_no_effect(kind: type[Physics]) -> None:
    """Although, between two steps, a crate is put in front of the car, pushed by it, and removed again."""
    alone = values(events(kind, cast()), "world/states")[20]
    (x, y, _), yaw = alone.position[0].tolist(), yaw_of(tuple(alone.attitude[0].tolist()))
    ahead_m = 0.5 * P2DX().length_m - P2DX().axle_ahead_m + 0.2 + 0.02
    places = {2.0031: (x + ahead_m * math.cos(yaw), y + ahead_m * math.sin(yaw)), 2.4931: (9.0, 9.0)}
    orders = [
        Event("operator/moved", seconds_to_ns(at_s), Moved(obstacle="crate", position=place, yaw=yaw))
        for at_s, place in places.items()
    ]
    plain = events(kind, cast(), orders=orders)
    same(kind, plain, events(kind, cast(), *TENTH, Instants(Ticks.rate(60.0), seconds_to_ns(0.025)), orders=orders))
    same(kind, plain, events(kind, cast(), orders=orders, paced=True))
    same(kind, plain, events(kind, cast(imu=InertialUnit(rate_hz=40.0), scan=Ring()), orders=orders))


@KINDS
def test_bodies_out_of_reach_have_no_effect(kind: type[Physics]) -> None:
    more = [spec("another", 0.0, -3.0, z=0.4, model=Quadrotor()), spec("third", 0.0, 12.0), spec("other", 20.0)]
    same(kind, events(kind, cast(), things=False), events(kind, cast(), more=more))


@KINDS
def test_every_run_begins_afresh(kind: type[Physics]) -> None:
    """Estimators, sensors and movables; the car hits the external vehicle."""
    vehicles = cast(near=NeighbourRange(), imu=InertialUnit(rate_hz=20.0), scan=Ring())
    physics = kind(world=World(movables=(CRATE,), moving=(CART,)), vehicles=vehicles, outside=Courses(real=straight(0.9)))
    orders = [*ORDERS, Event("operator/moved", SECOND_NS, Moved(obstacle="crate", position=(2.0, 9.0), yaw=0.3))]

    def once() -> list[bytes]:
        found = run(physics, orders, 2.0)
        return [encode(each.value.get() if isinstance(each.value, Later) else each.value) for each in found]

    assert once() == once()
