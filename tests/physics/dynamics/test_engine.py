"""The engine interface: a custom engine, and rows of several engines in one fleet."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS, engine
from tests.support.physics.runs import run, run_info
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.types import Contact, Vec3, Velocity, Waypoint
from vcmvsp.physics.dynamics.engine import BodyMotion, Engine, Touch, gathered, still
from vcmvsp.physics.dynamics.kinematic import AerialEngine, GroundEngine
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.range_scanner import RangeScanner
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, Kinematic, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Moving, World


class JumpEngine(Engine):
    """Custom engine: a velocity command moves a vehicle at once by the distance of one second."""

    def __init__(self, places: list[Vec3]) -> None:
        self.places, self.closed = np.array(places), False

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        self.places[row] += linear

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        self.places[row] = position

    def read(self) -> BodyMotion:
        return still(self.places.copy(), np.zeros(len(self.places)))

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        raise AssertionError("it has nothing that could be put elsewhere")

    def touching(self, *, passing: bool) -> list[Touch]:
        return [Touch(0, 1, (0.5, 0.0, 0.0))]

    def close(self) -> None:
        self.closed = True


class JumpPhysics(Physics):
    def engines(self) -> list[tuple[Engine, list[int]]]:
        self.jumper = JumpEngine([spec.start for spec in self.vehicles[::2]])
        rest = self.vehicles[1::2]
        other = GroundEngine([Kinematic() for _ in rest], [spec.start for spec in rest], [0.0 for _ in rest])
        return [(self.jumper, [0, 2]), (other, [1])]


def test_a_custom_engine_shares_a_run_with_another() -> None:
    vehicles = [VehicleSpec(name=name, model=Point(), position=(2.0 * k, 0.0, 1.0)) for k, name in enumerate("abc")]
    physics = JumpPhysics(world=World(), vehicles=vehicles)
    assert physics.start(run_info(physics, 1.0, [Instants(Ticks.every(1.0))])) == 0
    commands = [
        Event("a/command", 0, Velocity(linear=(0.0, 1.0, 0.0))),
        Event("c/command", 0, Waypoint(position=(7.0, 7.0, 7.0))),
        Event("b/command", 0, Velocity(linear=(0.5, 0.0, 0.0))),
    ]
    values: dict[str, Any] = {event.key: event.value for event in physics.step(SECOND_NS, commands).events}
    assert values["world/states"].position == pytest.approx(np.array([[0, 1, 1], [2.5, 0, 0], [7, 7, 7]]))
    assert (values["world/contact"].vehicle, values["world/contact"].other) == ("a", "c")  # rows 0, 1 of the engine
    physics.close()
    assert physics.jumper.closed


def engines() -> list[Engine]:
    places = [(0.0, 0.0, 1.0), (3.0, 0.0, 1.0)]
    bullet = engine((P2DX(), places[0]), (Quadrotor(), places[1]))
    return [GroundEngine([P2DX()] * 2, places, [0.0, 0.0]), AerialEngine([Point()] * 2, places, [0.0, 0.0]), bullet]


@pytest.mark.parametrize("which", [0, 1, 2], ids=["ground", "air", "bullet"])
def test_reading_has_no_effect_and_readings_stay(which: int) -> None:
    read, unread = engines()[which], engines()[which]
    readings = []
    for tick in range(1, 11):
        for moved in (read, unread):
            moved.command(0, (0.3, 0.0, 0.0), 0.2)
            moved.command(1, (0.2, 0.1, 0.0), 0.2)
            moved.advance(tick * SECOND_NS // 10)
        readings.append((read.read(), [array.copy() for array in read.read()]))
        read.movables()
    for motion, copies in readings:
        for array, copy in zip(motion, copies, strict=True):
            assert np.array_equal(array, copy, equal_nan=True)
    for array, other in zip(read.read(), unread.read(), strict=True):
        assert array.tobytes() == other.tobytes()


def test_wheels_of_a_bodiless_vehicle_follow_its_path() -> None:
    engine, unsensed = (
        GroundEngine([P2DX(), Kinematic()], [(0.0, 0.0, 0.0)] * 2, [0.0] * 2, sensed=each) for each in (True, False)
    )
    for each in (engine, unsensed):
        each.command(0, (0.3, 0.0, 0.0), 0.5)
        each.advance(4 * SECOND_NS)
    left, right = engine.read().wheels[0].tolist()
    assert 0.5 * (left + right) * 0.0825 == pytest.approx(1.2)
    assert (right - left) * 0.0825 / 0.357 == pytest.approx(2.0)
    assert np.isnan(engine.read().wheels[1]).all()
    assert engine.read().acceleration[0] == pytest.approx((-0.15 * np.sin(2.0), 0.15 * np.cos(2.0), 0.0))  # v w, to the left
    for name in set(BodyMotion._fields) - {"acceleration", "wheels"}:  # only for sensors
        assert getattr(engine.read(), name).tobytes() == getattr(unsensed.read(), name).tobytes()


def test_rows_of_several_engines_make_one_fleet_that_cannot_be_written_to() -> None:
    odd, even = still(np.ones((2, 3)), np.ones(2)), still(np.zeros((2, 3)), np.zeros(2))
    both = gathered([(odd, np.array([1, 3])), (even, np.array([0, 2]))], 4)
    assert both.position[:, 0].tolist() == [0.0, 1.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="read-only"):
        both.position[0, 0] = 1.0


def test_rows_that_no_engine_moves_are_not_a_number() -> None:
    some = gathered([(still(np.ones((2, 3)), np.ones(2)), np.array([0, 2]))], 3)
    assert all(np.isnan(array[1]).all() for array in some)


CART = Moving(
    name="cart",
    solid=Box(center=(0.0, 0.0, 0.0), size=(0.4, 0.5, 1.0)),
    times_s=(0.0, 4.0, 8.0),
    way=((2.0, -1.0, 0.5, 0.0), (2.0, 1.0, 0.5, 0.0), (2.0, -1.0, 0.5, 0.0)),
    loop=True,
)


def events_at(kind: type[Physics], x: float, duration_s: float) -> list[Event]:
    """Events of a run with a robot at rest at x that scans ahead."""
    scan = RangeScanner(beams=721, field_of_view=math.pi, range_max=8.0, position=(0.0, 0.0, 0.3))
    sensors: Any = {"scan": scan}
    car = VehicleSpec(name="car", model=AmigoBot(), position=(x, 0.0, 0.0), sensors=sensors)
    return run(kind(world=World(moving=(CART,)), vehicles=[car]), (), duration_s)


@KINDS
def test_scanners_see_it_at_its_current_place(kind: type[Physics]) -> None:
    """Its near side is 1.8 m ahead; the second loop equals the first."""
    scans: list[Any] = [event for event in events_at(kind, 0.0, 16.0) if event.key == "car/scan"]
    assert len(scans) > 100
    for event in scans:
        t = event.time_ns / SECOND_NS % 8.0
        y = -1.0 + 0.5 * t if t < 4.0 else 3.0 - 0.5 * t
        scan = event.value.get()
        ranges = scan.ranges
        assert ranges.min() == pytest.approx(math.hypot(1.8, max(0.0, abs(y) - 0.25)), abs=0.01)
        bearings = scan.angle_min + scan.angle_step * np.flatnonzero(np.isfinite(ranges))
        assert bearings.mean() == pytest.approx(math.atan2(y, 2.0), abs=0.03)


def test_a_robot_in_its_way_is_hit_with_a_contact() -> None:
    """The cart comes from the right at 0.5 m/s; contacts are published every 0.1 s."""
    hits = [event for event in events_at(BulletPhysics, 2.0, 3.0) if event.key == "world/contact"]
    assert {event.value for event in hits} == {Contact(vehicle="car", other="cart")}
    apart_m = 1.0 - 0.25 - 0.5 * AmigoBot().hull.size[1]
    assert apart_m / 0.5 < hits[0].time_ns / SECOND_NS < apart_m / 0.5 + 0.12


def test_without_bodies_there_are_no_contacts() -> None:
    assert not [event for event in events_at(KinematicPhysics, 2.0, 3.0) if event.key == "world/contact"]
