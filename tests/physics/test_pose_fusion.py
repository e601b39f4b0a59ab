"""Pose source "fusion": the estimator of real robots, on simulated ones."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from tests.support.physics.engines import KINDS
from tests.support.physics.external_vehicles import Courses, spec, straight
from tests.support.physics.runs import run, values
from vcmvsp.cosim.clock import Ticks, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.fusion import FusedPose, Fusion
from vcmvsp.cosim.estimation.kalman_filter import OdometryNoise
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.frames import arc, travelled, wrap, yaw_of
from vcmvsp.physics.federate import KinematicPhysics, Physics
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World

pytestmark = pytest.mark.slow

TURNS = [(0.0, "car", 0.4, 0.2), (4.0, "car", 0.4, -0.3), (9.0, "car", 0.3, 0.5)]
SIGMA_M = 0.15
NONE = OdometryNoise(distance=0.0, turn=0.0, veer=0.0, time_m=0.0, time_rad=0.0)


class RecordedFusion(Fusion):
    """Records its poses; shared with the test instead of copied."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(**parameters)
        self.poses: list[FusedPose | None] = []

    def estimate(self, now_ns: int) -> FusedPose | None:
        self.poses.append(super().estimate(now_ns))
        return self.poses[-1]

    def __deepcopy__(self, memo: Any) -> "RecordedFusion":
        return self


class InputRecorder:
    """Estimator that only records its inputs."""

    def __init__(self) -> None:
        self.inputs: list[tuple[Any, ...]] = []

    def odometry(self, time_ns: int, distance_m: float, turn_rad: float) -> None:
        self.inputs.append(("odometry", time_ns, distance_m, turn_rad))

    def fix(self, time_ns: int, x: float, y: float, sigma_m: float) -> None:
        self.inputs.append(("fix", time_ns, x, y, sigma_m))

    def estimate(self, now_ns: int) -> None:
        return None

    def __deepcopy__(self, memo: Any) -> "InputRecorder":
        return self


def fusion_spec(fusion: Any, name: str = "car", *, rate_hz: float = 5.0, **rest: Any) -> VehicleSpec:
    sensor = Positioning(rate_hz=rate_hz, sigma_m=SIGMA_M, heading=False)
    return spec(name, fusion=fusion, pose_source="fusion", positioning=sensor, **rest)


class Errors(NamedTuple):
    """Errors of the estimates with known heading, (n, 3) x m, y m, yaw rad; and covariances (n, 3, 3)."""

    of: np.ndarray
    covariance: np.ndarray


def errors(kind: type[Physics], fusion: RecordedFusion, seed: int, seconds: float = 14.0) -> Errors:
    events = run(kind(world=World(), vehicles=[fusion_spec(fusion)]), TURNS, seconds, seed=seed)
    found = []
    for states, believed, pose in zip(
        values(events, "world/states"), values(events, "car/estimate"), fusion.poses, strict=True
    ):
        if pose is not None and pose.heading_known:
            x, y, _ = (np.array(believed.position) - states.position[0]).tolist()
            found.append(((x, y, wrap(believed.yaw - yaw_of(tuple(states.attitude[0].tolist())))), pose.covariance))
    return Errors(*(np.array(each) for each in zip(*found, strict=True)))


@KINDS
def test_it_is_better_than_its_fixes(kind: type[Physics]) -> None:
    seeds = [errors(kind, RecordedFusion(), seed) for seed in range(5)]
    assert all(len(each.of) > 80 for each in seeds)  # of 141: the heading is known after some metres
    rms = np.sqrt(np.mean([np.mean(each.of**2, axis=0) for each in seeds], axis=0))
    assert rms.max() < 0.6 * SIGMA_M
    settled = np.sqrt(np.mean([np.mean(each.of[-40:] ** 2, axis=0) for each in seeds], axis=0))
    assert settled.max() < 0.35 * SIGMA_M


def test_errors_match_the_covariance_with_exact_odometry() -> None:
    """Without bodies odometry is exact: NEES is chi-square with 3 degrees of freedom."""
    seeds = [errors(KinematicPhysics, RecordedFusion(noise=NONE), seed, 10.0) for seed in range(30)]
    nees = sum(each.of[-1] @ np.linalg.solve(each.covariance[-1], each.of[-1]) for each in seeds)
    low, high = chi2.ppf((0.0005, 0.9995), 3 * len(seeds))
    assert low < nees < high


@KINDS
def test_before_motion_the_heading_is_odometry_and_the_place_that_of_fixes(kind: type[Physics]) -> None:
    events = run(kind(world=World(), vehicles=[fusion_spec(Fusion(), heading=0.7)]), seconds=1.0)  # at rest
    estimates = [event for event in events if event.key == "car/estimate"]
    fixes = [event for event in events if event.key == "car/fix"]
    for event in estimates:
        newest: Any = next(fix.value for fix in reversed(fixes) if fix.time_ns <= event.time_ns)
        believed: Any = event.value
        assert believed.position == pytest.approx((*newest.position[:2], 0.0), abs=1e-3)
        assert believed.yaw == pytest.approx(0.7, abs=1e-3)


@KINDS
def test_inputs_have_their_own_instants_at_any_state_rate(kind: type[Physics]) -> None:
    def told(*instants: Instants) -> list[tuple[Any, ...]]:
        noted = InputRecorder()
        other = fusion_spec(InputRecorder(), "other", rate_hz=8.0, y=3.0)
        run(kind(world=World(), vehicles=[fusion_spec(noted, rate_hz=4.0), other]), TURNS, 6.0, instants)
        return noted.inputs

    seldom, often = told(), told(Instants(Ticks.every(0.025)), Instants(Ticks.every(0.1), seconds_to_ns(0.05)))
    assert len(seldom) == len(often)
    for a, b in zip(seldom, often, strict=True):
        assert a[:2] == b[:2]
        assert a[2:] == pytest.approx(b[2:], abs=1e-12)
    if kind is not KinematicPhysics:
        assert seldom == often
    tenths, quarters = set(range(0, 61 * 10**8, 10**8)), set(range(0, 6 * 10**9 + 1, 25 * 10**7))
    assert [each[1] for each in seldom if each[0] == "odometry"] == sorted(tenths | quarters)
    assert [each[1] for each in seldom if each[0] == "fix"] == sorted(quarters)
    after = {each[1]: seldom[number - 1][:2] for number, each in enumerate(seldom) if each[0] == "fix"}
    assert after == {time_ns: ("odometry", time_ns) for time_ns in quarters}  # odometry before the fix


@KINDS
def test_odometry_inputs_add_up_to_the_path(kind: type[Physics]) -> None:
    noted = InputRecorder()
    events = run(kind(world=World(), vehicles=[fusion_spec(noted)]), TURNS, 12.0)
    pose = (0.0, 0.0, 0.0)
    for source, _, distance, turn, *_ in noted.inputs:
        if source == "odometry":
            pose = arc(pose, distance, turn, 1.0)
    odometry = values(events, "car/odometry")[-1].pose
    assert pose[:2] == pytest.approx(odometry[:2], abs=2e-3)
    assert wrap(pose[2] - odometry[2]) == pytest.approx(0.0, abs=1e-9)


POSES = st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(-3.0, 3.0))


@given(POSES, st.floats(-2.0, 2.0), st.floats(-3.1, 3.1))
def test_travelled_undoes_an_arc(pose: tuple[float, float, float], distance: float, turn: float) -> None:
    assert travelled(pose, arc(pose, distance, turn, 1.0)) == pytest.approx((distance, turn), abs=1e-8)


def test_fixes_without_a_heading_are_equal() -> None:
    def fixes(*, heading: bool) -> list[Any]:
        car = spec("car", positioning=Positioning(heading=heading, outlier_probability=0.1), pose_source="positioning")
        return values(run(KinematicPhysics(world=World(), vehicles=[car]), TURNS, 5.0), "car/fix")

    with_it, without = fixes(heading=True), fixes(heading=False)
    assert [each.position for each in with_it] == [each.position for each in without]
    assert {(each.yaw, each.sigma_rad) for each in without} == {(None, 0.0)}
    assert all(each.yaw is not None for each in with_it)


def test_an_exact_fix_can_be_fused() -> None:
    car = spec("car", fusion=Fusion(), pose_source="fusion", positioning=Positioning(sigma_m=0.0))
    events = run(KinematicPhysics(world=World(), vehicles=[car]), TURNS, 8.0)
    states, believed = values(events, "world/states")[-1], values(events, "car/estimate")[-1]
    assert believed.position == pytest.approx(tuple(states.position[0]), abs=5e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: spec("car", fusion=Fusion(), pose_source="fusion"), 'sensor "positioning" on the vehicle'),
        (lambda: fusion_spec(Fusion(), model=Quadrotor()), "needs wheels"),
    ],
)
def test_vehicles_that_cannot_fuse_are_refused(make: Callable[[], VehicleSpec], words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as raised:
        make()
    assert raised.value.key == "pose_source"


def test_a_simulated_vehicle_needs_an_estimator_and_an_external_one_does_not() -> None:
    vehicles = [fusion_spec(None)]
    with pytest.raises(ScenarioError, match="needs an estimator") as raised:
        run(KinematicPhysics(world=World(), vehicles=vehicles))
    assert raised.value.key == "vehicle.car.pose_source"
    outside = Courses(car=straight(0.0))
    keys = {event.key for event in run(KinematicPhysics(world=World(), vehicles=vehicles, outside=outside))}
    assert keys == {"world/states"}


def test_outliers_are_rejected() -> None:
    sensor = Positioning(rate_hz=5.0, outlier_probability=0.1, outlier_m=3.0, heading=False)
    far = []
    for source in ("fusion", "positioning"):
        car = spec("car", fusion=Fusion() if source == "fusion" else None, pose_source=source, positioning=sensor)
        events: list[Event] = run(KinematicPhysics(world=World(), vehicles=[car]), TURNS, 14.0, seed=3)
        pairs = zip(values(events, "world/states")[60:], values(events, "car/estimate")[60:], strict=True)
        far.append(max(math.dist(states.position[0], believed.position) for states, believed in pairs))
    assert far[0] < 0.3
    assert far[1] > 2.0
