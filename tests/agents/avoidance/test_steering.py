"""Steering: inputs and outputs of a method, limits, notes, and bad scans."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Uav, info
from tests.support.agents.scans import view
from vcmvsp.agents.avoidance import Decision, DynamicWindow, Gap, PotentialField, Task, Vfh, View
from vcmvsp.agents.avoidance.method import Settings
from vcmvsp.agents.avoidance.steering import AvoidanceSteering, ObstacleLevels, limited_drive, limited_flight, second_m
from vcmvsp.cosim.agent import Body, Observation
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Measured, Scan

pytestmark = pytest.mark.slow

MS = 1_000_000
WHEELS, WINGS = Body(width_m=0.4, radius_m=0.25), Body(width_m=0.5, radius_m=0.25, flies=True)
FREE = [math.inf] * 32


class FixedAnswer(Settings, frozen=True, kw_only=True, tag="asked"):
    """A method that returns the task, or a fixed answer, and records its inputs."""

    answer: tuple[float, float, float] | None = None
    reach: float = 1.2

    def default_keep_m(self, body: Body) -> float:
        return 0.5

    def method(self, body: Body, period_s: float) -> "FixedAnswerMethod":
        return FixedAnswerMethod(self)


class FixedAnswerMethod:
    def __init__(self, settings: FixedAnswer) -> None:
        self.settings, self.calls = settings, list[tuple[View, Task]]()

    def decide(self, view: View, task: Task) -> Decision:
        self.calls.append((view, task))
        if self.settings.answer is None:
            return Decision(task.velocity, task.yaw_rate, "task")
        x, y, w = self.settings.answer
        return Decision((x, y), w, "avoid")


def steering(chosen: Settings | None = None, body: Body = WINGS) -> AvoidanceSteering:
    made = AvoidanceSteering(chosen or FixedAnswer())
    made.start(info(body=body, sensors=("scan",)))
    return made


def scan(distances: list[float], at_ms: int = 0, **more: Any) -> Scan:
    step = math.tau / max(len(distances), 1)
    values = {"ranges": np.array(distances, np.float32), "angle_min": 0.0, "angle_step": step, "range_max": 6.0}
    return Scan(**{**values, "time_ns": at_ms * MS, **more})


def obs(reading: Any, at_ms: int = 0, yaw: float = 0.0, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Observation:
    return Uav((1.0, 2.0, 0.0), yaw, velocity).see(at_ms * MS, scan=reading)


def ahead(distance: float) -> list[float]:
    return [distance, *FREE[1:]]


GO = Task((1.0, 0.0), 0.2)

# --- inputs and outputs of a method ---


def test_places_in_the_world_are_handed_on_in_the_body_frame() -> None:
    """At (1, 2), heading north: a place 3 m to the north is ahead, one 1 m to the west is on the left."""
    made = steering(FixedAnswer(max_speed=0.7), WHEELS)
    made.drive(obs(scan(FREE), yaw=math.pi / 2), (0.3, 0.1), aim=(1.0, 5.0), leader=(0.0, 2.0))
    _, task = made._method.calls[0]  # type: ignore[attr-defined]
    assert (task.velocity, task.yaw_rate, task.max_speed) == ((0.3, 0.0), 0.1, 0.7)
    assert task.aim == pytest.approx((3.0, 0.0))
    assert task.leader == pytest.approx((0.0, 1.0))


def test_the_decision_is_limited_near_obstacles() -> None:
    made = steering(FixedAnswer(answer=(2.0, 0.5, 0.3)))
    decision = made.steer(obs(scan(ahead(0.8))), GO)
    assert decision.velocity == pytest.approx((0.4 * 0.27, 0.5), abs=1e-6)
    assert (decision.yaw_rate, decision.mode) == (0.3, "avoid")


def test_level_2_begins_for_the_fastest_of_task_decision_and_own_motion() -> None:
    for task, answer, own in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        made = steering(FixedAnswer(answer=(answer, 0.0, 0.0)))
        made.steer(obs(scan(ahead(2.1)), velocity=(0.0, own, 5.0)), Task((task, 0.0)))
        assert made.level == 2  # 0.5 + 1 / 0.6 m


def test_limits_apply_without_the_method() -> None:
    made = steering(FixedAnswer(answer=(9.0, 9.0, 9.0)), WHEELS)
    assert made.limit(obs(scan(ahead(0.8))), (1.0, 0.1)).velocity == pytest.approx((0.4 * 0.27, 0.0), abs=1e-6)
    assert made.limit(obs(scan(ahead(0.5))), (1.0, 0.1)) == Decision((0.0, 0.0), 0.1, "task")
    assert made.limit(obs(None), (1.0, 0.1)) == Decision((0.0, 0.0), 0.0, "blind")


def test_notes_contain_only_changes() -> None:
    made, notes = steering(), []
    for tick, reading in enumerate([FREE, FREE, ahead(1.1), ahead(0.7), ahead(0.7), [], FREE]):
        made.steer(obs(scan(reading, 100 * tick), 100 * tick), Task((0.1, 0.0)))
        notes.append(made.notes)
    assert notes == [{"mode": "task", "level": 0}, {}, {"level": 1}, {"level": 2}, {}, {"mode": "blind"}, {"mode": "task"}]


def test_a_second_run_begins_afresh() -> None:
    made = steering()
    made.steer(obs(scan(ahead(0.7))), GO)
    made.start(info(body=WINGS))
    made.steer(obs(scan([math.inf] * 16)), GO)
    assert made.notes == {"mode": "task", "level": 0}


# --- refusals at the start ---


def test_a_vehicle_without_that_scanner_is_refused() -> None:
    with pytest.raises(ValueError, match=r"avoidance\.scanner = 'scan': a has no such sensor; its sensors: gps, lidar"):
        AvoidanceSteering(FixedAnswer()).start(info(body=WHEELS, sensors=("gps", "lidar")))
    AvoidanceSteering(FixedAnswer(scanner="lidar")).start(info(body=WHEELS, sensors=("gps", "lidar")))


def test_a_vehicle_of_unknown_size_is_refused() -> None:
    with pytest.raises(ValueError, match="needs the size of a"):
        AvoidanceSteering(FixedAnswer()).start(info())


def test_an_error_of_a_custom_method_names_the_scenario_key() -> None:
    class Refused(FixedAnswer, frozen=True, kw_only=True, tag="refused"):
        def method(self, body: Body, period_s: float) -> FixedAnswerMethod:
            raise ScenarioError("must be > 0", key="avoidance.params.size")

    with pytest.raises(ValueError, match=r"avoidance\.params\.size: must be > 0"):
        steering(Refused())


def test_exceptions_of_a_method_are_not_hidden() -> None:
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


@pytest.mark.parametrize("fault", BAD)
@pytest.mark.parametrize("level", [1, 2])
def test_without_a_usable_scan_the_vehicle_stops(fault: str, level: int) -> None:
    made = steering(PotentialField(level=level))
    made.steer(obs(scan(ahead(3.0))), GO)
    assert made.steer(obs(BAD[fault], 100), GO) == Decision((0.0, 0.0), 0.0, "blind")
    assert made.steer(obs(scan(ahead(3.0), 200), 200), GO).mode == "task"


def test_an_old_scan_is_not_used() -> None:
    made = steering(FixedAnswer(stale_s=0.3))
    modes = [made.steer(obs(scan(FREE, 0), at_ms), GO).mode for at_ms in (0, 300, 301)]
    assert modes == ["task", "task", "blind"]


@pytest.mark.parametrize("range_m", [math.inf, 6.0])
@pytest.mark.parametrize("level", [1, 2])
def test_an_empty_scan_after_near_returns_is_doubted_for_half_a_second(range_m: float, level: int) -> None:
    made = steering(FixedAnswer(level=level))
    slow, later, levels = made.steer(obs(scan(ahead(0.8))), GO).velocity[0], [], []
    for at_ms in (100, 200, 500, 590, 600, 700):
        later.append(made.steer(obs(scan([range_m] * 32, at_ms), at_ms), GO).velocity[0])
        levels.append(made.level)
    if level == 2:
        assert 0.0 < slow < 0.2
        assert later == pytest.approx([slow, slow, slow, slow, 1.0, 1.0])
    assert levels[:4] == [level] * 4  # still within the release time
    assert levels[-1] == 0 or level == 2  # level 2 ends later


def test_blind_ticks_do_not_confirm_an_empty_scan() -> None:
    made = steering()
    made.steer(obs(scan(ahead(0.8))), GO)
    assert made.steer(obs(None, 100), GO).velocity == (0.0, 0.0)
    assert made.steer(obs(scan(FREE, 200), 200), GO).velocity == (0.0, 0.0)


def test_far_returns_may_vanish_at_once() -> None:
    made = steering()
    made.steer(obs(scan(ahead(4.0))), Task((0.2, 0.0)))
    assert made.steer(obs(scan(FREE, 100), 100), GO).velocity == (1.0, 0.0)


near = st.lists(st.floats(0.0, 7.0) | st.just(math.inf), min_size=32, max_size=32)
angles = st.floats(-4.0, 4.0) | st.floats(1e-5, 0.3) | st.floats()
methods = st.sampled_from([PotentialField, Gap, Vfh, DynamicWindow])


@settings(max_examples=100)
@given(
    near, methods, st.sampled_from([*BAD, "all maximum", "no return"]), st.floats(0.0, 3.0), st.booleans(), st.integers(1, 2)
)
def test_a_bad_scan_never_makes_it_faster(
    distances: list[float], kind: type[Any], bad: str, speed: float, flies: bool, level: int
) -> None:
    """With a last usable scan that has returns in the reach of the method."""
    distances = [min(distances[0], 1.1), *distances[1:]]
    made = steering(kind(level=level), WINGS if flies and kind is not DynamicWindow else WHEELS)
    task = Task((speed, 0.0), 0.1)
    before = math.hypot(*made.steer(obs(scan(distances)), task).velocity)
    readings = {**BAD, "all maximum": scan([6.0] * 32), "no return": scan(FREE)}
    assert math.hypot(*made.steer(obs(readings[bad], 100), task).velocity) <= before + 1e-9


@settings(max_examples=100)
@given(methods, st.lists(st.floats(width=32), max_size=40), angles, angles, st.floats())
def test_no_scan_raises_an_exception(kind: type[Any], values: list[float], first: float, step: float, furthest: float) -> None:
    made = steering(kind(), WHEELS)
    made.steer(obs(scan(values, angle_min=first, angle_step=step, range_max=furthest)), GO)
    made.steer(obs(scan(values, 100), 100), GO)
    decision = made.steer(obs(scan(values * 2, 200), 200), GO)
    assert math.isfinite(math.hypot(*decision.velocity))


def test_level_2_begins_earlier_with_command_latency() -> None:
    """Keep 0.5 m; at 1 m/s braking takes 1.67 m, and the latency of a command 0.4 m."""
    for latency_s, level in ((0.0, 0), (0.4, 2)):
        made = AvoidanceSteering(FixedAnswer())
        made.start(info(latency_s=latency_s, body=WINGS, sensors=("scan",)))
        made.steer(obs(scan(ahead(2.3))), GO)
        assert made.level == level


# --- levels of nearness, and limits of the speed: rules, random scans and closed forms ---

KEEP, APPROACH = 0.5, 0.4
AMIGO = Body(width_m=0.279, radius_m=0.216)
DRONE = Body(width_m=0.5, radius_m=0.25, flies=True)

ranges = st.lists(st.floats(0.0, 8.0) | st.just(math.inf), min_size=2, max_size=40)
speeds = st.floats(-3.0, 3.0)


def seen(distances: list[float]) -> View:
    return view(distances, math.tau, 0.0)


def walls(half_width: float, end: float = math.inf) -> View:
    """View of the half turn ahead in a corridor along x, closed by a wall at ``end``."""
    bearing = np.linspace(-math.pi / 2, math.pi / 2, 361)
    with np.errstate(divide="ignore"):
        aside = half_width / np.abs(np.sin(bearing))
        ahead = np.where(np.cos(bearing) > 1e-9, end / np.maximum(np.cos(bearing), 1e-9), np.inf)
    return view(np.minimum(aside, ahead))


def allowed(view: View) -> np.ndarray:
    return APPROACH * np.maximum(view.ranges - KEEP - 0.03, 0.0)


# --- in the air ---


@given(ranges, speeds, speeds)
def test_a_limited_velocity_satisfies_every_beam_and_is_neither_longer_nor_reversed(
    distances: list[float], x: float, y: float
) -> None:
    scan_ = seen(distances)
    limited = np.array(limited_flight((x, y), scan_, KEEP, APPROACH))
    assert (scan_.units @ limited <= allowed(scan_) + 1e-8).all()
    assert np.hypot(*limited) <= math.hypot(x, y) + 1e-9
    assert limited @ (x, y) >= -1e-9
    if (scan_.units @ (x, y) <= allowed(scan_)).all():
        assert limited.tolist() == [x, y]


@given(st.lists(st.floats(0.0, 3.0), min_size=3, max_size=24), speeds, speeds)
def test_no_velocity_that_all_beams_allow_is_nearer_to_the_wanted_one(distances: list[float], x: float, y: float) -> None:
    """By brute force: the nearest of all feet on one limit and crossings of two."""
    view, velocity = seen(distances), np.array((x, y))
    most = allowed(view)
    feet = velocity + (most - view.units @ velocity)[:, None] * view.units
    i, j = np.triu_indices(len(most), 1)
    pairs = np.stack([view.units[i], view.units[j]], axis=1)
    real = np.abs(np.linalg.det(pairs)) > 1e-6
    crossings = np.linalg.solve(pairs[real], np.stack([most[i], most[j]], axis=1)[real][..., None])[..., 0]
    tried = np.vstack([velocity, feet, crossings, (0.0, 0.0)])
    fit = tried[(tried @ view.units.T <= most + 1e-7).all(axis=1)]
    best = np.hypot(*(fit - velocity).T).min()
    assert math.dist(limited_flight((x, y), view, KEEP, APPROACH), (x, y)) == pytest.approx(best, abs=1e-5)


def test_motion_along_a_wall_goes_on_where_motion_into_it_does_not() -> None:
    """A wall on the left at 0.8 m, seen by 64 beams: of an oblique velocity, more than half remains along the wall."""
    bearing = math.tau * np.arange(64) / 64
    with np.errstate(divide="ignore"):
        wall = seen(np.where(np.sin(bearing) > 0.1, 0.8 / np.sin(bearing), np.inf).tolist())
    x, y = limited_flight((0.5, 0.5), wall, KEEP, APPROACH)
    assert x > 0.25
    assert y <= APPROACH * (0.8 - KEEP - 0.03) + 1e-9


def test_512_limiting_beams_stop_it() -> None:
    assert limited_flight((3.0, 1.0), seen([0.2] * 512), KEEP, APPROACH) == pytest.approx((0.0, 0.0), abs=1e-8)


# --- on wheels ---


@given(ranges, st.floats(-2.0, 2.0))
def test_on_wheels_a_speed_is_never_raised_nor_reversed(distances: list[float], v: float) -> None:
    limited = limited_drive(v, seen(distances), KEEP, 0.2, APPROACH)
    assert abs(limited) <= abs(v)
    assert limited * v >= 0.0


@given(ranges, st.floats(0.0, 2.0), st.floats(0.05, KEEP))
def test_on_wheels_returns_in_the_lane_limit_the_speed(distances: list[float], v: float, lane: float) -> None:
    view = seen(distances)
    limited = limited_drive(v, view, KEEP, lane, APPROACH)
    for distance, (x, y) in zip(view.ranges.tolist(), view.units.tolist(), strict=True):
        if distance < math.inf and x > 1e-9 and abs(distance * y) < lane:
            left = distance * x - math.sqrt(KEEP**2 - (distance * y) ** 2)
            assert limited <= APPROACH * max(0.0, left - 0.03) + 1e-9


def test_a_corridor_of_90_cm_does_not_slow_an_amigobot_down_and_its_end_does() -> None:
    assert ObstacleLevels(PotentialField(keep_m=0.266), AMIGO).keep_m < 0.45
    assert limited_drive(0.6, walls(0.45), 0.266, 0.1895, APPROACH) == 0.6
    near_end = limited_drive(0.6, walls(0.45, 1.0), 0.266, 0.1895, APPROACH)
    assert near_end == pytest.approx(APPROACH * (1.0 - 0.266 - 0.03))


def test_levels_limit_an_amigobot_for_walls_ahead_and_not_for_walls_beside_it() -> None:
    for keep in (0.266, 0.6):
        levels = ObstacleLevels(PotentialField(keep_m=keep), AMIGO)
        view = walls(0.45)
        assert levels.update(0, view.nearest_m, 0.6) == 2
        assert levels.limited(view, (0.6, 0.0)) == (0.6, 0.0)
        assert levels.limited(walls(0.45, 0.29), (0.6, 0.0)) == (0.0, 0.0)


@pytest.mark.parametrize(("behind", "v", "left"), [(math.inf, -0.3, -0.1), (0.2, -0.3, 0.0), (0.7, -0.3, -0.068)])
def test_reverse_is_slow_and_limited_by_returns_behind(behind: float, v: float, left: float) -> None:
    view = seen([math.inf, math.inf, behind, math.inf])  # ahead, left, behind, right
    assert limited_drive(v, view, KEEP, 0.2, APPROACH) == pytest.approx(left)


def test_reverse_is_allowed_without_returns() -> None:
    assert limited_drive(-0.1, walls(0.45, 0.3), KEEP, 0.2, APPROACH) == -0.1


# --- levels ---


@pytest.mark.parametrize(
    ("speed", "latency", "begins"), [(0.0, 0.0, 0.9), (0.3, 0.0, 0.9), (0.6, 0.0, 1.2), (0.6, 0.5, 1.5), (3.0, 0.0, 15.6)]
)
def test_level_2_begins_at_the_braking_distance(speed: float, latency: float, begins: float) -> None:
    """The larger of keep + 0.3 m and keep + v latency + v^2 / (2 a), a = 0.3 m/s2."""
    assert second_m(speed, 0.6, 0.3, latency) == pytest.approx(begins)
    levels = ObstacleLevels(PotentialField(keep_m=0.6), DRONE, latency)
    assert levels.update(0, begins + 1e-6, speed) < 2
    assert levels.update(0, begins - 1e-6, speed) == 2


def test_level_1_begins_at_the_reach_of_the_method() -> None:
    levels = ObstacleLevels(PotentialField(), DRONE)
    assert [levels.update(0, nearest, 0.1) for nearest in (math.inf, 1.2, 1.19, 0.91)] == [0, 0, 1, 1]


def test_level_2_ends_after_half_a_second_beyond_its_release_distance() -> None:
    levels = ObstacleLevels(PotentialField(), DRONE)
    places = [0.8, 1.04, 1.04, 1.06, 1.06, 1.04, 1.06, *[1.06] * 4, 1.06]  # begins at 0.9, ends at 1.05; time restarted
    assert [levels.update(100 * MS * tick, nearest, 0.0) for tick, nearest in enumerate(places)] == [2] * 11 + [1]


def test_without_the_second_level_nothing_is_limited() -> None:
    levels = ObstacleLevels(PotentialField(level=1), DRONE)
    assert levels.update(0, 0.1, 1.0) == 1
    assert levels.limited(seen([0.1] * 32), (1.0, 0.0)) == (1.0, 0.0)


@pytest.mark.parametrize("start", [0.8, 1.5, 3.0])
def test_the_remaining_distance_decays_exponentially(start: float) -> None:
    """v = approach (D - keep - 0.03): D - keep - 0.03 decays with exp(-approach t), i.e. by 1 - 0.04 per period of 0.1 s."""
    distance = start
    for _ in range(100):
        distance -= 0.1 * limited_flight((9.0, 0.0), seen([distance, math.inf, math.inf, math.inf]), KEEP, APPROACH)[0]
    assert distance - KEEP - 0.03 == pytest.approx((start - KEEP - 0.03) * 0.96**100)
