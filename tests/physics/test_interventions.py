"""Operator interventions on vehicles and movables: halts and moves; other bodies continue."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS
from tests.support.physics.external_vehicles import Courses, spec, straight
from tests.support.physics.runs import run, run_info, steps_of
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.types import Array, Contact, Halted, Moved, Pushed, States, Velocity, Waypoint
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.range_scanner import RangeScanner
from vcmvsp.physics.vehicles.models import Inertial, Kinematic, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import Vehicle
from vcmvsp.physics.world.solids import Box, Cylinder
from vcmvsp.physics.world.world import Movable, Moving, World

pytestmark = pytest.mark.slow

CRATE = Movable(name="crate", solid=Box(center=(5.0, 0.0, 0.2), size=(0.4, 0.4, 0.4)), mass_kg=5.0)
BARREL = Movable(name="barrel", solid=Cylinder(center=(8.0, 3.0, 0.5), radius=0.3, height=1.0), mass_kg=5.0)
CART = Moving(name="cart", solid=CRATE.solid, times_s=(0.0, 1.0), way=((-5.0, 0.0, 0.2, 0.0), (-5.0, 0.0, 0.2, 0.0)))
WALL = Box(center=(2.0, 4.0, 0.5), size=(0.2, 2.0, 1.0))
WORLD = World(solids=(WALL,), movables=(CRATE, BARREL), moving=(CART,), bounds=(-20.0, -20.0, 20.0, 20.0), name="yard")


def drive(at_s: float, name: str, v: float, w: float = 0.0) -> Event:
    return Event(f"{name}/command", seconds_to_ns(at_s), Velocity(linear=(v, 0.0, 0.0), yaw_rate=w))


def fly(at_s: float, name: str, *place: float) -> Event:
    return Event(f"{name}/command", seconds_to_ns(at_s), Waypoint(position=place, speed=2.0))  # type: ignore[arg-type]


def halt(at_s: float, *names: str, halted: bool = True) -> Event:
    return Event("operator/halted", seconds_to_ns(at_s), Halted(vehicles=names, halted=halted))


def move(at_s: float, name: str, x: float, y: float, yaw: float = 0.0) -> Event:
    return Event("operator/moved", seconds_to_ns(at_s), Moved(obstacle=name, position=(x, y), yaw=yaw))


def positions(events: Sequence[Event], row: int = 0) -> Array:
    """Positions (t, 3) m of a vehicle."""
    return np.array([event.value.position[row] for event in events if isinstance(event.value, States)])


def ranges(events: Sequence[Event]) -> dict[int, float]:
    """Forward range of car1's scanner, m, by tenths of a second."""
    found: list[tuple[int, Any]] = [(event.time_ns // 10**8, event.value) for event in events if event.key == "car1/scan"]
    return {tick: float(later.get().ranges[0]) for tick, later in found}


def contacts(events: Sequence[Event]) -> list[str | None]:
    """Bodies in contact, in order of time."""
    return [event.value.other for event in events if isinstance(event.value, Contact)]


@KINDS
def test_a_halted_vehicle_resumes_with_its_newest_command(kind: type[Physics]) -> None:
    physics = kind(world=World(), vehicles=[spec("car1"), spec("car2", y=3.0)])
    orders = [drive(0.0, "car1", 0.4), drive(0.0, "car2", 0.4), halt(2.0, "car1"), drive(3.0, "car1", -0.2)]
    events = run(physics, [*orders, halt(5.0, "car1", halted=False), halt(5.0, "car2", halted=False)], 8.0)
    own, other = positions(events)[:, 0], positions(events, 1)[:, 0]
    assert own[20] == pytest.approx(other[20], abs=5e-3)
    stood = own[30]
    assert own[20] <= stood < own[20] + 0.3  # brakes as for any other command
    assert own[30:51] == pytest.approx(stood, abs=5e-3)
    assert own[80] - own[70] == pytest.approx(-0.2, abs=0.01)  # the command received while halted
    assert other[80] - other[70] == pytest.approx(0.4, abs=0.01)


def test_without_new_commands_motion_resumes() -> None:
    physics = KinematicPhysics(
        world=World(), vehicles=[spec("car1", model=Kinematic()), spec("car2", y=3.0, model=Kinematic())]
    )
    orders = [drive(0.0, "car1", 0.5, 0.3), halt(1.0, "car1", "car2"), halt(1.5, "car2", "car1", halted=False)]
    events = run(physics, orders, 3.0)
    plain = run(physics, orders[:1], 2.5)
    assert positions(events)[15:] == pytest.approx(positions(plain)[10:], abs=1e-12)
    assert np.ptp(positions(events)[10:16], axis=0) == pytest.approx(0.0, abs=0.0)
    assert np.ptp(positions(events, 1), axis=0) == pytest.approx(0.0, abs=0.0)


@KINDS
@pytest.mark.parametrize("model", [Quadrotor(), Point(tau_s=0.3)], ids=["quadrotor", "point"])
def test_a_halted_quadrotor_hovers_and_resumes_to_its_waypoint(kind: type[Physics], model: Vehicle) -> None:
    physics = kind(world=World(), vehicles=[spec("uav", z=2.0, model=model)])
    orders = [fly(0.0, "uav", 8.0, 0.0, 3.0), halt(1.0, "uav"), halt(6.0, "uav", halted=False)]
    way = positions(run(physics, orders, 14.0))
    assert 1.0 < way[10, 0] <= way[60, 0] < 4.0
    assert way[40:61] == pytest.approx(np.tile(way[60], (21, 1)), abs=0.03)
    assert way[-1] == pytest.approx((8.0, 0.0, 3.0), abs=0.05)


def test_wrong_commands_are_refused_during_a_halt() -> None:
    physics = KinematicPhysics(world=World(), vehicles=[spec("car1")])
    with pytest.raises(FederateError, match="car1 received a Waypoint but cannot fly"):
        run(physics, [halt(0.0, "car1"), fly(0.5, "car1", 1.0, 1.0, 1.0)], 1.0)


@KINDS
def test_an_external_vehicle_is_not_halted_here(kind: type[Physics]) -> None:
    vehicles = [spec("real"), spec("car1", y=3.0)]
    physics = kind(world=World(), vehicles=vehicles, outside=Courses(real=straight(0.0, 0.5)))
    assert positions(run(physics, [halt(0.3, "real", "car1")], 1.0))[-1] == pytest.approx((0.5, 0.0, 0.0))


# --- movables ---------------------------------------------------------------------------------------------------------------

RAYS = RangeScanner(beams=2, field_of_view=0.02, range_max=20.0, rate_hz=10.0, position=(0.0, 0.0, 0.2))


@KINDS
def test_moved_obstacles_are_in_place_also_for_scanners(kind: type[Physics]) -> None:
    physics = kind(world=WORLD, vehicles=[spec("car1", sensors={"scan": RAYS})])
    orders = [move(1.0, "crate", 0.0, 6.0), move(2.0, "barrel", 3.0, 0.0), move(3.0, "crate", 2.0, 0.0, math.pi / 4)]
    events = run(physics, orders, 4.0)
    distances = ranges(events)
    for tick, edge_m in (
        (9, 4.8),
        (11, math.inf),
        (19, math.inf),
        (21, 2.7),
        (29, 2.7),
        (31, 1.735),  # range of the edge; the beams are 0.01 rad off
        (39, 1.735),
    ):
        assert distances[tick] == pytest.approx(edge_m, abs=0.01), tick


@KINDS
def test_changed_poses_of_movables_are_published(kind: type[Physics]) -> None:
    events = run(kind(world=WORLD, vehicles=[spec("car1")]), [move(1.0, "crate", 0.0, 6.0)], 5.0)
    pushes = [(event.time_ns, event.value) for event in events if isinstance(event.value, Pushed)]
    times = [time_ns for time_ns, _ in pushes if time_ns >= 10**9]
    assert times[0] == 10**9
    assert times == [10**9] or (kind is not KinematicPhysics and times[-1] < 4 * 10**9)  # until it is asleep
    assert pushes[-1][1].names == ("crate", "barrel")
    assert pushes[-1][1].position == pytest.approx(np.array([(0.0, 6.0, 0.2), (8.0, 3.0, 0.5)]), abs=2e-3)


def test_a_pushed_and_moved_obstacle_is_at_rest() -> None:
    physics = BulletPhysics(world=World(movables=(CRATE,)), vehicles=[spec("car1", 4.0)])
    orders = [drive(0.0, "car1", 0.6), halt(3.0, "car1"), move(3.5, "crate", 9.0, 1.0, 0.3)]
    before, after = list[Array](), list[Array]()
    for tick, _ in enumerate(steps_of(physics, orders, 6.0)):
        motion = physics._movables()
        assert motion is not None
        (before if tick < 35 else after).append(np.concatenate([motion.position[0], motion.velocity[0]]))
    assert before[30][0] > 5.3  # pushed
    assert after == [pytest.approx((9.0, 1.0, 0.2, 0.0, 0.0, 0.0), abs=2e-2)] * 26


def test_a_body_on_top_of_it_falls() -> None:
    """Although it was asleep."""
    lid = Movable(name="lid", solid=Box(center=(5.0, 0.0, 0.45), size=(0.3, 0.3, 0.1)), mass_kg=1.0)
    physics = BulletPhysics(world=World(movables=(CRATE, lid)), vehicles=[spec("car1")])
    for _ in steps_of(physics, [move(5.0, "crate", 8.0, 0.0)], 6.0):
        motion = physics._movables()
    assert motion is not None
    assert motion.position == pytest.approx(np.array([(8.0, 0.0, 0.2), (5.0, 0.0, 0.05)]), abs=5e-3)


def test_a_quadrotor_hits_a_placed_obstacle_at_once() -> None:
    """Although its proximity check runs at 20 Hz only, and the last one was just before."""

    def flown(*orders: Event) -> list[Event]:
        physics = BulletPhysics(world=World(movables=(BARREL,)), vehicles=[spec("uav", z=0.5, model=Quadrotor())])
        return run(physics, [fly(0.0, "uav", 9.0, 0.0, 0.5), *orders], 1.2, [Instants(Ticks.rate(120.0))])

    reach = 0.3 + Quadrotor().radius_m
    x = positions(flown())[122, 0] + reach + 0.02
    events = flown(move(122 / 120, "barrel", x, 0.0))
    assert contacts(events)[:1] == ["barrel"]
    assert positions(events)[:, 0].max() < x - reach + 0.03


@pytest.mark.parametrize(
    ("obstacle", "position", "yaw", "words"),
    [
        ("crat", (0.0, 0.0), 0.0, r"unknown movable 'crat'; did you mean 'crate'\? \(allowed: barrel, crate\)"),
        ("cart", (0.0, 0.0), 0.0, r"'cart' moves by its timetable; movable obstacles: barrel, crate"),
        ("crate", (math.nan, 0.0), 0.0, r"crate: position and yaw must be finite, not \(nan, 0\.0\), yaw 0\.0"),
        ("crate", (0.0, 0.0), math.inf, r"crate: position and yaw must be finite"),
        ("crate", (23.0, 0.0), 0.0, r"crate cannot stand at \(23, 0\): the place is 3 m outside the world \(yard\)"),
        ("crate", (1.75, 4.0), 0.0, r"crate cannot stand at \(1\.75, 4\): it would overlap .*box.* by 0\.05 m"),
    ],
)
@KINDS
def test_impossible_places_are_refused_at_any_time(
    kind: type[Physics], obstacle: str, position: tuple[float, float], yaw: float, words: str
) -> None:
    physics = kind(world=WORLD, vehicles=[spec("car1")])
    with pytest.raises(ValueError, match=words):
        physics.check_move(obstacle, position, yaw)
    physics.start(run_info(physics, 1.0))
    with pytest.raises(ValueError, match=words):
        physics.check_move(obstacle, position, yaw)
    physics.close()


@KINDS
def test_occupied_places_are_refused_after_the_start(kind: type[Physics]) -> None:
    vehicles = [spec("car1", model=Inertial()), spec("uav", y=-2.0, z=0.3, model=Quadrotor())]
    physics = kind(world=WORLD, vehicles=vehicles)
    physics.check_move("crate", (0.0, 0.0), 0.0)  # its starting position may be free by then
    physics.start(run_info(physics, 3.0))
    for position, name in (((0.0, 0.0), "car1"), ((0.0, -2.0), "uav"), ((8.0, 3.0), "barrel"), ((-5.0, 0.3), "cart")):
        with pytest.raises(ValueError, match=f"{name} is there"):
            physics.check_move("crate", position, 0.0)
    for position in ((5.1, 0.0), (1.0, 0.0), (0.0, 1.0)):  # its own place does not block
        physics.check_move("crate", position, 0.3)
    physics.step(0, [])
    now = 0
    while now < 2 * SECOND_NS:
        now += SECOND_NS // 10
        physics.step(now, [drive(0.0, "car1", 0.5)] if now == SECOND_NS // 10 else [])
    x = 0.5 * 2.0
    physics.check_move("crate", (0.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="car1 is there"):
        physics.check_move("crate", (x, 0.0), 0.0)
    physics.close()


@KINDS
def test_a_move_onto_a_vehicle_ends_the_run_by_name(kind: type[Physics]) -> None:
    physics = kind(world=WORLD, vehicles=[spec("car1")])
    with pytest.raises(FederateError, match=r"crate cannot stand at \(0, 0\): car1 is there"):
        run(physics, [move(0.5, "crate", 0.0, 0.0)], 1.0)


def test_an_approaching_vehicle_blocks_places() -> None:
    physics = KinematicPhysics(world=WORLD, vehicles=[spec("car1", model=Kinematic())])
    physics.start(run_info(physics, 1.0))
    near = (0.5 * 0.511 + 0.2 + 0.05, 0.0)
    physics.check_move("crate", near, 0.0)
    physics.step(SECOND_NS // 10, [drive(0.1, "car1", 1.0)])
    physics.step(SECOND_NS // 5, [])
    with pytest.raises(ValueError, match="car1 is there"):
        physics.check_move("crate", (near[0] + 0.1 + 0.1, 0.0), 0.0)
