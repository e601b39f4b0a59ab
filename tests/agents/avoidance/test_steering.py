"""Steering: what goes in and out of a method, limits, notes, and what becomes of bad scans."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp.agents.avoidance import Decision, DynamicWindow, Gap, PotentialField, Task, Vfh, View
from vcmvsp.agents.avoidance.method import Settings
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.cosim.agent import Body, Observation, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Measured, Scan, VehicleState

MS = 1_000_000
WHEELS, WINGS = Body(width_m=0.4, radius_m=0.25), Body(width_m=0.5, radius_m=0.25, flies=True)
INFO: dict[str, Any] = {"name": "a", "vehicles": ("a",), "period_s": 0.1, "latency_s": 0.0, "seed": 1}
FREE = [math.inf] * 32


class Asked(Settings, frozen=True, kw_only=True, tag="asked"):
    """A method that does what the task says, or what it is told here, and keeps what it was asked."""

    answer: tuple[float, float, float] | None = None

    @property
    def reach_m(self) -> float:
        return 1.2

    def default_keep_m(self, body: Body) -> float:
        return 0.5

    def method(self, body: Body, period_s: float) -> "AskedMethod":
        return AskedMethod(self)


class AskedMethod:
    def __init__(self, settings: Asked) -> None:
        self.settings, self.asked = settings, list[tuple[View, Task]]()

    def decide(self, view: View, task: Task) -> Decision:
        self.asked.append((view, task))
        if self.settings.answer is None:
            return Decision(task.velocity, task.yaw_rate, "task")
        x, y, w = self.settings.answer
        return Decision((x, y), w, "avoid")


def steering(chosen: Settings | None = None, body: Body = WINGS) -> AvoidanceSteering:
    made = AvoidanceSteering(chosen or Asked())
    made.start(VehicleInfo(**INFO, body=body, sensors=("scan",)))
    return made


def scan(distances: list[float], at_ms: int = 0, **more: Any) -> Scan:
    step = math.tau / max(len(distances), 1)
    values = {"ranges": np.array(distances, np.float32), "angle_min": 0.0, "angle_step": step, "range_max": 6.0}
    return Scan(**{**values, "time_ns": at_ms * MS, **more})


def obs(reading: Any, at_ms: int = 0, yaw: float = 0.0, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Observation:
    state = VehicleState(position=(1.0, 2.0, 0.0), attitude=quaternion_from_yaw(yaw), velocity=velocity)
    return Observation(
        vehicle="a", time_ns=at_ms * MS, state=state, readings={} if reading is None else {"scan": reading}, heard=()
    )


def ahead(distance: float) -> list[float]:
    return [distance, *FREE[1:]]


GO = Task((1.0, 0.0), 0.2)

# --- what goes in and out ---


def test_a_free_view_leaves_the_task_as_it_is() -> None:
    assert steering().steer(obs(scan(FREE)), GO) == Decision((1.0, 0.0), 0.2, "task")


def test_places_in_the_world_are_handed_on_in_the_body_frame() -> None:
    """At (1, 2), heading north: a place 3 m north of it is ahead, one 1 m west of it on the left."""
    made = steering(Asked(max_speed=0.7), WHEELS)
    made.drive(obs(scan(FREE), yaw=math.pi / 2), (0.3, 0.1), aim=(1.0, 5.0), leader=(0.0, 2.0))
    _, task = made._method.asked[0]  # type: ignore[attr-defined]
    assert (task.velocity, task.yaw_rate, task.max_speed) == ((0.3, 0.0), 0.1, 0.7)
    assert task.aim == pytest.approx((3.0, 0.0))
    assert task.leader == pytest.approx((0.0, 1.0))


def test_what_the_method_wants_is_limited_by_what_it_is_near_to() -> None:
    made = steering(Asked(answer=(2.0, 0.5, 0.3)))
    decision = made.steer(obs(scan(ahead(0.8))), GO)
    assert decision.velocity == pytest.approx((0.4 * 0.27, 0.5), abs=1e-6)
    assert (decision.yaw_rate, decision.mode) == (0.3, "avoid")


def test_level_2_begins_for_the_fastest_of_task_decision_and_own_motion() -> None:
    for task, answer, own in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        made = steering(Asked(answer=(answer, 0.0, 0.0)))
        made.steer(obs(scan(ahead(2.1)), velocity=(0.0, own, 5.0)), Task((task, 0.0)))
        assert made.level == 2  # 0.5 + 1 / 0.6 m


def test_whoever_comes_to_rest_is_limited_but_not_led() -> None:
    made = steering(Asked(answer=(9.0, 9.0, 9.0)), WHEELS)
    assert made.limit(obs(scan(ahead(0.8))), (1.0, 0.1)).velocity == pytest.approx((0.4 * 0.27, 0.0), abs=1e-6)
    assert made.limit(obs(scan(ahead(0.5))), (1.0, 0.1)) == Decision((0.0, 0.0), 0.1, "task")
    assert made.limit(obs(None), (1.0, 0.1)) == Decision((0.0, 0.0), 0.0, "blind")


def test_only_news_is_noted() -> None:
    made, told = steering(), []
    for tick, reading in enumerate([FREE, FREE, ahead(1.1), ahead(0.7), ahead(0.7), [], FREE]):
        made.steer(obs(scan(reading, 100 * tick), 100 * tick), Task((0.1, 0.0)))
        told.append(made.notes)
    assert told == [{"mode": "task", "level": 0}, {}, {"level": 1}, {"level": 2}, {}, {"mode": "blind"}, {"mode": "task"}]


def test_a_second_run_begins_afresh() -> None:
    made = steering()
    made.steer(obs(scan(ahead(0.7))), GO)
    made.start(VehicleInfo(**INFO, body=WINGS))
    made.steer(obs(scan([math.inf] * 16)), GO)
    assert made.notes == {"mode": "task", "level": 0}


# --- what cannot be started ---


def test_a_vehicle_without_that_scanner_is_refused() -> None:
    with pytest.raises(ValueError, match=r"avoidance\.scanner = 'scan': a has no such sensor \(it carries: gps, lidar\)"):
        AvoidanceSteering(Asked()).start(VehicleInfo(**INFO, body=WHEELS, sensors=("gps", "lidar")))
    AvoidanceSteering(Asked(scanner="lidar")).start(VehicleInfo(**INFO, body=WHEELS, sensors=("gps", "lidar")))


def test_a_vehicle_of_unknown_size_is_refused() -> None:
    with pytest.raises(ValueError, match="how much room a takes"):
        AvoidanceSteering(Asked()).start(VehicleInfo(**INFO))


def test_parameters_that_a_method_of_ones_own_refuses_are_the_scenarios() -> None:
    class Refused(Asked, frozen=True, kw_only=True, tag="refused"):
        def method(self, body: Body, period_s: float) -> AskedMethod:
            raise ScenarioError("must be > 0", key="avoidance.params.size")

    with pytest.raises(ValueError, match=r"avoidance\.params\.size: must be > 0"):
        steering(Refused())


def test_what_a_method_raises_is_not_hidden() -> None:
    class Broken:
        def decide(self, view: View, task: Task) -> Decision:
            raise TypeError("mine")

    made = steering()
    made._method = Broken()
    with pytest.raises(TypeError, match="mine"):
        made.steer(obs(scan(FREE)), GO)


# --- bad scans ---

BAD: dict[str, Any] = {
    "none": None,
    "another sensor": Measured(time_ns=0, values={}),
    "no beam": scan([]),
    "one beam": scan([3.0]),
    "wrong length": scan(ahead(3.0)[:31]),
    "another first beam": scan(FREE, angle_min=0.1),
    "all zero": scan([0.0] * 32),
    "all NaN": scan([math.nan] * 32),
    "all nearer than it measures": scan([-math.inf] * 32),
    "negative": scan([-1.0] * 32),
    "a matrix": scan(FREE, ranges=np.ones((32, 2))),
    "words": scan(FREE, ranges=np.array(["a"] * 32)),
    "objects": scan(FREE, ranges=np.array([None] * 32)),
    "no array": scan(FREE, ranges=[1.0] * 32),
    "nothing": scan(FREE, ranges=None),
    "no angle": scan(FREE, angle_min=math.nan),
    "no step": scan(FREE, angle_step=0.0),
    "hardly a step": scan(FREE, angle_step=1e-30),
    "a far angle": scan(FREE, angle_min=1e30),
    "an angle that is a word": scan(FREE, angle_min="a"),
    "a step that is none": scan(FREE, angle_step=None),
    "a range that is none": scan(ahead(3.0), range_max=None),
    "no time": scan(FREE, time_ns=None),
}


@pytest.mark.parametrize("what", BAD)
@pytest.mark.parametrize("level", [1, 2])
def test_who_does_not_see_stands(what: str, level: int) -> None:
    made = steering(PotentialField(level=level))
    made.steer(obs(scan(ahead(3.0))), GO)
    assert made.steer(obs(BAD[what], 100), GO) == Decision((0.0, 0.0), 0.0, "blind")
    assert made.steer(obs(scan(ahead(3.0), 200), 200), GO).mode == "task"


def test_a_scan_that_is_old_is_none() -> None:
    made = steering(Asked(stale_s=0.3))
    modes = [made.steer(obs(scan(FREE, 0), at_ms), GO).mode for at_ms in (0, 300, 301)]
    assert modes == ["task", "task", "blind"]


@pytest.mark.parametrize("gone", [math.inf, 6.0])
def test_where_something_was_near_and_all_is_gone_at_once_it_is_not_believed_for_half_a_second(gone: float) -> None:
    made = steering()
    slow = math.hypot(*made.steer(obs(scan(ahead(0.8))), GO).velocity)
    assert 0.0 < slow < 0.2
    later = [made.steer(obs(scan([gone] * 32, at), at), GO).velocity[0] for at in (100, 200, 500, 590, 600, 700)]
    assert later == pytest.approx([slow, slow, slow, slow, 1.0, 1.0])


def test_neither_do_blind_ticks_between_make_it_believed() -> None:
    made = steering()
    made.steer(obs(scan(ahead(0.8))), GO)
    assert made.steer(obs(None, 100), GO).velocity == (0.0, 0.0)
    assert made.steer(obs(scan(FREE, 200), 200), GO).velocity == (0.0, 0.0)


def test_what_was_far_may_vanish() -> None:
    made = steering()
    made.steer(obs(scan(ahead(4.0))), Task((0.2, 0.0)))
    assert made.steer(obs(scan(FREE, 100), 100), GO).velocity == (1.0, 0.0)


near = st.lists(st.floats(0.0, 7.0) | st.just(math.inf), min_size=32, max_size=32)


angles = st.floats(-4.0, 4.0) | st.floats(1e-5, 0.3) | st.floats()
methods = st.sampled_from([PotentialField, Gap, Vfh, DynamicWindow])


@settings(max_examples=200)
@given(
    near, methods, st.sampled_from([*BAD, "all maximum", "no return"]), st.floats(0.0, 3.0), st.booleans(), st.integers(1, 2)
)
def test_a_bad_scan_never_makes_it_faster(
    distances: list[float], kind: type[Any], bad: str, speed: float, flies: bool, level: int
) -> None:
    """Where something was seen in the reach of the method last; in the open there is nothing to fear."""
    distances = [min(distances[0], 1.1), *distances[1:]]
    made = steering(kind(level=level), WINGS if flies and kind is not DynamicWindow else WHEELS)
    task = Task((speed, 0.0), 0.1)
    before = math.hypot(*made.steer(obs(scan(distances)), task).velocity)
    readings = {**BAD, "all maximum": scan([6.0] * 32), "no return": scan(FREE)}
    assert math.hypot(*made.steer(obs(readings[bad], 100), task).velocity) <= before + 1e-9


@settings(max_examples=200)
@given(methods, st.lists(st.floats(width=32), max_size=40), angles, angles, st.floats())
def test_no_scan_whatever_raises(kind: type[Any], values: list[float], first: float, step: float, furthest: float) -> None:
    made = steering(kind(), WHEELS)
    made.steer(obs(scan(values, angle_min=first, angle_step=step, range_max=furthest)), GO)
    made.steer(obs(scan(values, 100), 100), GO)
    decision = made.steer(obs(scan(values * 2, 200), 200), GO)
    assert math.isfinite(math.hypot(*decision.velocity))


def test_level_2_begins_earlier_where_commands_come_late() -> None:
    """0.5 m are kept; at 1 m/s 1.67 m are needed to brake, and 0.4 m go by until a command counts."""
    for latency_s, level in ((0.0, 0), (0.4, 2)):
        made = AvoidanceSteering(Asked())
        made.start(VehicleInfo(**{**INFO, "latency_s": latency_s}, body=WINGS, sensors=("scan",)))
        made.steer(obs(scan(ahead(2.3))), GO)
        assert made.level == level


def test_while_an_empty_scan_is_not_believed_something_is_near() -> None:
    made = steering(Asked(level=1))
    made.steer(obs(scan(ahead(0.8))), GO)
    levels = []
    for at_ms in (100, 500, 700):
        made.steer(obs(scan(FREE, at_ms), at_ms), GO)
        levels.append(made.level)
    assert levels == [1, 1, 0]
