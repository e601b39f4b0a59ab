"""Publications of the federate, their times and recipients; equal laws for every engine."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS
from tests.support.physics.external_vehicles import Boat
from tests.support.physics.runs import TENTH, play, run, run_info, values
from tests.support.step_responses import settling_s
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, Federate, Instants, Slot
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Velocity
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.motion import WheelOdometry
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, GroundVehicle, Inertial, Kinematic, Lag, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Movable, Moving, World

pytestmark = pytest.mark.processes


def car(
    name: str = "car1",
    x: float = 0.0,
    y: float = 0.0,
    *,
    model: GroundVehicle | None = None,
    source: str = "truth",
    sensor: Positioning | None = None,
) -> VehicleSpec:
    return VehicleSpec(name=name, model=model or P2DX(), position=(x, y, 0.0), pose_source=source, positioning=sensor)


@KINDS
def test_it_is_a_federate(kind: type[Physics]) -> None:
    physics = kind(world=World(), vehicles=[car(), car("car2", 1.0, model=AmigoBot())])
    assert isinstance(physics, Federate)
    assert (physics.name, physics.slot, physics.wake_slot) == ("physics", Slot.WORLD, Slot.APPLY)
    assert (physics.reads, physics.wakes) == (("*/command", "operator/halted", "operator/moved"), ())


@KINDS
def test_each_instant_has_one_truth_and_values_per_vehicle(kind: type[Physics]) -> None:
    steps = play(kind(world=World(), vehicles=[car("b"), car("a", 1.0)]), [], 0.2)
    keys = ["world/states", "b/estimate", "b/odometry", "a/estimate", "a/odometry"]
    assert [[event.key for event in events] for events in steps] == [keys] * 3
    assert [{event.time_ns for event in events} for events in steps] == [{0}, {10**8}, {2 * 10**8}]
    states: Any = steps[0][0].value
    assert states.names == ("b", "a")
    assert states.position[:, 0] == pytest.approx((0.0, 1.0))
    for array, width in ((states.position, 3), (states.velocity, 3), (states.attitude, 4), (states.angular_velocity, 3)):
        assert array.shape == (2, width)
        assert not array.flags.writeable


@KINDS
def test_instants_are_all_trains_offsets_sensors_and_the_end(kind: type[Physics]) -> None:
    physics = kind(world=World(), vehicles=[car(sensor=Positioning(rate_hz=4.0))])
    steps = play(physics, [], 0.7, (Instants(Ticks.every(0.3)), Instants(Ticks.every(0.3), seconds_to_ns(0.05))))
    assert [events[0].time_ns / 1e9 for events in steps] == pytest.approx([0.0, 0.05, 0.25, 0.3, 0.35, 0.5, 0.6, 0.65, 0.7])
    fixes = [event.time_ns / 1e9 for events in steps for event in events if event.key == "car1/fix"]
    assert fixes == pytest.approx([0.0, 0.25, 0.5])


@KINDS
def test_nothing_is_due_after_the_end(kind: type[Physics]) -> None:
    physics = kind(world=World(), vehicles=[car()])
    assert physics.start(run_info(physics, 1.0)) == 0
    assert physics.step(9 * 10**8, ()).next_ns == SECOND_NS
    assert physics.step(SECOND_NS, ()).next_ns is None
    physics.close()


@KINDS
def test_without_instants_only_start_and_end_are_published(kind: type[Physics]) -> None:
    steps = play(kind(world=World(), vehicles=[car()]), [(0.0, "car1", 0.3, 0.0)], 1.0, ())
    assert [events[0].time_ns for events in steps] == [0, SECOND_NS]


@KINDS
def test_a_late_command_acts_from_its_own_time(kind: type[Physics]) -> None:
    commands = [(0.1, "car1", 0.3, 0.4), (0.7, "car1", 0.1, -0.4), (1.35, "car1", 0.3, 0.0)]

    def end(period_s: float) -> Any:
        return values(
            run(kind(world=World(), vehicles=[car()]), commands, 3.0, [Instants(Ticks.every(period_s))]), "world/states"
        )[-1]

    often, seldom = end(0.05), end(3.0)  # delivered at once; delivered at 3.0 s
    assert seldom.position == pytest.approx(often.position, abs=1e-12)
    if kind is KinematicPhysics:
        pose = arc(arc((0.0, 0.0, 0.0), 0.3, 0.4, 0.6), 0.1, -0.4, 0.65)
        x, y, _ = arc(pose, 0.3, 0.0, 1.65)
        assert seldom.position[0] == pytest.approx((x, y, 0.0), abs=1e-12)


@KINDS
def test_an_estimate_uses_its_pose_source(kind: type[Physics]) -> None:
    sensor = Positioning(rate_hz=5.0)
    vehicles = [car(source="truth"), car("car2", 2.0, source="odometry"), car("car3", 4.0, source="positioning", sensor=sensor)]
    commands = [(0.0, spec.name, 0.3, 0.3) for spec in vehicles]
    steps = play(kind(world=World(floor_friction=0.02), vehicles=vehicles), commands, 2.0)
    fix: Any = None
    for events in steps:
        at: dict[str, Any] = {event.key: event.value for event in events}
        states, fix = at["world/states"], at.get("car3/fix", fix)
        assert at["car1/estimate"].position == tuple(states.position[0])
        assert at["car1/estimate"].velocity == tuple(states.velocity[0])
        for number in (2, 3):
            estimate, odometry = at[f"car{number}/estimate"], at[f"car{number}/odometry"]
            assert np.hypot(*estimate.velocity[:2]) == pytest.approx(abs(odometry.v))
            assert estimate.angular_velocity == (0.0, 0.0, odometry.w)
        x, y, yaw = at["car2/odometry"].pose
        assert at["car2/estimate"].position == (x, y, 0.0)
        assert at["car2/estimate"].yaw == pytest.approx(yaw)
        assert at["car3/estimate"].position == fix.position
        assert at["car3/estimate"].yaw == pytest.approx(fix.yaw)
    assert sum(event.key == "car3/fix" for events in steps for event in events) == 11


def test_fixes_are_drawn_from_the_vehicles_own_stream() -> None:
    sensor = Positioning()
    alone = run(KinematicPhysics(world=World(), vehicles=[car(sensor=sensor)]), [], 1.0)
    among = run(KinematicPhysics(world=World(), vehicles=[car("zero", sensor=sensor), car(sensor=sensor)]), [], 1.0)
    assert values(alone, "car1/fix") == values(among, "car1/fix")
    assert values(among, "zero/fix") != values(among, "car1/fix")
    rng, truth = stream(1, "car1/positioning"), values(alone, "car1/estimate")[0]
    assert values(alone, "car1/fix")[0] == sensor.measure(0, truth, rng)


@pytest.mark.parametrize("source", ["positioning", "gps"])
def test_an_impossible_pose_source_is_refused(source: str) -> None:
    with pytest.raises(ScenarioError, match=source) as raised:
        car(source=source)
    assert raised.value.key == "pose_source"


@KINDS
@pytest.mark.parametrize("command", [(float("nan"), 0.0), (0.0, float("inf"))])
def test_a_non_finite_command_stops_the_run_and_names_the_vehicle(kind: type[Physics], command: tuple[float, float]) -> None:
    with pytest.raises(FederateError, match="car1 is not finite"):
        run(kind(world=World(), vehicles=[car()]), [(0.0, "car1", *command)], 0.5)


@pytest.mark.parametrize(
    ("instants", "duration_s", "rate_hz", "numbers"),
    [
        ((Instants(Ticks.every(0.013)),), 1.0, 120.0, ("0.013", "1/120 s")),
        ((Instants(Ticks.every(0.1), seconds_to_ns(0.004)),), 1.0, 120.0, ("0.004", "1/120 s")),
        (TENTH, 1.003, 120.0, ("1.003", "1/120 s")),
        (TENTH, 1.0, 55.0, ("0.1", "1/55 s")),
    ],
)
def test_publications_between_two_bullet_steps_are_refused(
    instants: tuple[Instants, ...], duration_s: float, rate_hz: float, numbers: tuple[str, str]
) -> None:
    with pytest.raises(ScenarioError) as raised:
        run(BulletPhysics(world=World(), vehicles=[car()], rate_hz=rate_hz), [], duration_s, instants)
    assert raised.value.key == ("duration_s" if duration_s == 1.003 else "physics.rate_hz")  # these instants name no key
    assert all(number in raised.value.problem for number in numbers)


def test_a_sensor_between_two_bullet_steps_is_refused_and_a_fitting_one_is_not() -> None:
    with pytest.raises(ScenarioError, match="whole number of physics steps"):
        run(BulletPhysics(world=World(), vehicles=[car(sensor=Positioning(rate_hz=7.0))]), [], 1.0)
    events = run(BulletPhysics(world=World(), vehicles=[car(sensor=Positioning(rate_hz=60.0))]), [], 1.0)
    assert len(values(events, "car1/fix")) == 61


def box(name: str, x: float, z: float = 0.2) -> Movable:
    return Movable(name=name, solid=Box(center=(x, 0.0, z), size=(0.4, 0.4, 0.4)), mass_kg=1.0)


def test_movables_that_start_inside_anything_but_a_moving_obstacle_are_refused_by_name() -> None:
    wall = Box(center=(3.0, 0.0, 0.5), size=(1.0, 1.0, 1.0))
    ram = Moving(name="ram", solid=wall, times_s=(0.0,), way=((-3.0, 0.0, 0.5, 0.0),))

    def start(*movables: Movable) -> None:
        world = World(solids=(wall,), movables=movables, moving=(ram,))
        run(BulletPhysics(world=world, vehicles=[car("car", 0.0)]), (), 0.1)

    start(box("a", 1.0), box("b", 1.4), box("c", 1.0, 0.6), box("d", -3.0))  # side by side, on top, and in the ram's place
    for movables, words, key in (
        ([box("a", 2.4)], r"a and the box at .* overlap at the start, by 0\.1 m", "world.movables"),
        ([box("a", 1.0), box("b", 1.1)], r"b and a overlap at the start, by 0\.3 m", "world.movables"),
        ([box("a", 0.3)], "car and a overlap at the start, by 0.116 m", "vehicle.car.position"),  # front at 0.2155 m
    ):
        with pytest.raises(ScenarioError, match=words) as raised:
            start(*movables)
        assert raised.value.key == key
    with pytest.raises(ScenarioError, match="ram overlap"):
        run(BulletPhysics(world=World(moving=(ram,)), vehicles=[car("car", -3.0)]), (), 0.1)


@KINDS
def test_all_bodies_have_names_of_their_own(kind: type[Physics]) -> None:
    post = Box(center=(0.0, 0.0, 0.5), size=(0.1, 0.1, 1.0))
    ram = Moving(name="ram", solid=post, times_s=(0.0,), way=((9.0, 0.0, 0.5, 0.0),))
    for movables, moving, key in (
        ((box("car", 2.0),), (), "world.movables"),
        ((box("a", 2.0), box("a", 3.0)), (), "world.movables"),
        ((box("ram", 2.0),), (ram,), "world.moving"),
    ):
        with pytest.raises(ScenarioError, match="use distinct names") as raised:
            run(kind(world=World(movables=movables, moving=moving), vehicles=[car("car")]), (), 0.1)
        assert raised.value.key == key


@KINDS
def test_a_vehicle_that_no_engine_moves_is_refused(kind: type[Physics]) -> None:
    boat = VehicleSpec(name="tug", model=Boat(), position=(0.0, 5.0, 0.0))
    with pytest.raises(ScenarioError, match="tug is a Boat, a model without an engine: derive it from GroundVehicle") as raised:
        run(kind(world=World(), vehicles=[car(), boat]), (), 0.1)
    assert raised.value.key == "vehicle.tug.kind"


@KINDS
def test_sensors_that_a_vehicle_cannot_carry_are_refused_at_the_start(kind: type[Physics]) -> None:
    spec = VehicleSpec(name="uav", model=Quadrotor(), position=(0, 0, 1), sensors={"odo": WheelOdometry()})
    with pytest.raises(ScenarioError, match="uav has no two driven wheels") as raised:
        run(kind(world=World(), vehicles=[spec]))
    assert raised.value.key == "vehicle.uav.sensors.odo"


def test_a_too_heavy_quadrotor_is_refused_by_name() -> None:
    heavy = VehicleSpec(name="uav", model=Quadrotor(mass_kg=2.5), position=(0.0, 0.0, 1.0))
    with pytest.raises(ScenarioError, match=r"2\.5 kg at max_tilt_rad need") as raised:
        run(BulletPhysics(world=World(), vehicles=[heavy]), (), 0.1)
    assert raised.value.key == "vehicle.uav"


def test_bodiless_vehicles_move_in_bullet_as_without_it() -> None:
    models = {"body": P2DX(), "unicycle": Kinematic(), "lag": Lag()}
    commands = [(0.0, name, 0.3, 0.3) for name in models]

    def moved(kind: type[Physics], *names: str) -> list[Event]:
        return run(kind(world=World(), vehicles=[car(name, model=models[name]) for name in names]), commands, 2.0)

    mixed, alone = moved(BulletPhysics, "unicycle", "body", "lag"), moved(KinematicPhysics, "unicycle", "lag")
    for name in ("unicycle", "lag"):
        assert values(mixed, f"{name}/estimate") == values(alone, f"{name}/estimate")
    assert values(mixed, "world/states")[0].names == ("unicycle", "body", "lag")
    assert values(mixed, "world/contact") == []


def start_errors(kind: type[Physics], model: GroundVehicle) -> list[float]:
    """Errors, m, every 0.1 s, of a follower at rest in its slot whose leader starts at 0.30 m/s."""
    physics = kind(world=World(), vehicles=[car("follower", model=model)])
    next_ns: int | None = physics.start(run_info(physics, 20.0))
    inbox: tuple[Event, ...] = ()
    errors = []
    while next_ns is not None:
        step = physics.step(next_ns, inbox)
        at: dict[str, Any] = {event.key: event.value for event in step.events}
        error = 0.3 * next_ns / 1e9 - at["follower/estimate"].position[0]
        errors.append(error)
        command = Velocity(linear=(0.3 + 0.8 * error, 0.0, 0.0))
        inbox = (Event("follower/command", next_ns, command),)
        next_ns = step.next_ns
    physics.close()
    return errors


@pytest.mark.parametrize(
    ("kind", "model", "expected_s"),
    [
        (KinematicPhysics, P2DX(), 0.0),
        (KinematicPhysics, Inertial(), 2.6),
        (BulletPhysics, P2DX(), 2.5),
        (BulletPhysics, AmigoBot(), 2.5),
    ],
)
def test_momentum_delays_settling(kind: type[Physics], model: GroundVehicle, expected_s: float) -> None:
    assert settling_s(start_errors(kind, model), 0.1, within=0.05) == pytest.approx(expected_s, abs=0.11)  # one tick


QUIET = """
import sys
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Instants, RunInfo
from vcmvsp.physics.federate import {kind}
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World
world = World(solids=(Box(center=(3.0, 0.0, 0.5), size=(0.1, 1.0, 1.0)),))
physics = {kind}(world=world, vehicles=[VehicleSpec(name="car", model=P2DX())])
physics.start(RunInfo(scenario="test", seed=1, duration_ns=10**9, vehicles=("car",), instants=(Instants(Ticks.every(0.1)),)))
physics.step(10**9, ())
physics.close()
sys.exit(40 + ("pybullet" in sys.modules) + 2 * ("mujoco" in sys.modules))
"""


@pytest.mark.parametrize(("kind", "code"), [("KinematicPhysics", 40), ("BulletPhysics", 41), ("MujocoPhysics", 42)])
def test_nothing_is_printed_and_each_engine_loads_its_own_library(kind: str, code: int) -> None:
    done = subprocess.run([sys.executable, "-c", QUIET.format(kind=kind)], capture_output=True, check=False, timeout=500)
    assert (done.returncode, done.stdout, done.stderr) == (code, b"", b"")
