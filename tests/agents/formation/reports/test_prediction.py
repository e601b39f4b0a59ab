import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.docs.readme_pages import block
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.reports.prediction import Acceleration, DeadReckoning, Hold, PlanPrediction, estimator_of
from vcmvsp.agents.formation.reports.report import LeaderState, Report, accelerations, plan_of
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Positive

pytestmark = pytest.mark.slow

STATES = st.builds(
    LeaderState,
    x=st.floats(-100, 100),
    y=st.floats(-100, 100),
    th=st.floats(-7, 7),
    v=st.floats(-2, 2),
    w=st.floats(-2, 2),
)


def report(state: LeaderState) -> Report:
    return Report(0, state, {})


@given(state=STATES, age=st.floats(0.0, 2.0))
def test_dead_reckoning_continues_at_both_speeds_up_to_its_horizon(state: LeaderState, age: float) -> None:
    then = DeadReckoning().predict(report(state), age)
    assert then == pytest.approx((*arc(state[:3], state.v, state.w, age), state.v, state.w), abs=1e-9)


@pytest.mark.parametrize(("horizon_s", "fade_s"), [(2.0, 1.0), (0.0, 0.5), (1.0, 3.0)])
def test_beyond_the_horizon_both_speeds_fade_linearly_to_zero(horizon_s: float, fade_s: float) -> None:
    """Against a fine numerical integration of the fading speeds."""
    start, h = LeaderState(1.0, -2.0, 0.4, 0.5, -0.7), 1e-4
    pose, ages = start[:3], np.arange(0.0, horizon_s + fade_s + 1.0, h)
    estimator = DeadReckoning(horizon_s, fade_s)
    for i, age in enumerate(ages):
        left = min(1.0, max(0.0, 1.0 - (age + h / 2 - horizon_s) / fade_s))
        if i % 1000 == 0:
            then = estimator.predict(report(start), float(age))
            assert then[:3] == pytest.approx(pose, abs=1e-7)
            assert then.v == pytest.approx(start.v * min(1.0, max(0.0, 1.0 - (age - horizon_s) / fade_s)), abs=1e-12)
            assert then.w * start.v == pytest.approx(then.v * start.w, abs=1e-12)
        pose = arc(pose, start.v * left, start.w * left, h)


@given(state=STATES, age=st.floats(0.0, 100.0))
def test_hold_returns_the_reported_state(state: LeaderState, age: float) -> None:
    assert Hold().predict(report(state), age) == state


def accelerating(state: LeaderState, a: float, al: float) -> Report:
    return Report(0, state, {"a": a, "al": al})


@given(state=STATES, age=st.floats(0.0, 10.0))
def test_without_accelerations_acc_and_plan_are_dead_reckoning(state: LeaderState, age: float) -> None:
    for estimator in (Acceleration(), PlanPrediction()):
        assert estimator.predict(report(state), age) == DeadReckoning().predict(report(state), age)
        assert estimator.predict(accelerating(state, 0.0, 0.0), age) == DeadReckoning().predict(report(state), age)


@given(a=st.floats(-1.0, 1.0), al=st.floats(-1.0, 1.0), age=st.floats(0.0, 2.0), decay_s=st.floats(0.1, 100.0))
def test_a_change_of_speed_fades(a: float, al: float, age: float, decay_s: float) -> None:
    """v(t) solves v'' = -v'/tau, integrated numerically; no limit in reach."""
    estimator = Acceleration(decay_s=decay_s, slowest=-9.0, fastest=9.0, fastest_turn=9.0)
    then = estimator.predict(accelerating(LeaderState(0.0, 0.0, 0.0, 0.3, 0.1), a, al), age)
    steps = 2000
    middles = (np.arange(steps) + 0.5) * age / steps
    gained = float(np.exp(-middles / decay_s).sum() * age / steps)
    assert (then.v, then.w) == pytest.approx((0.3 + a * gained, 0.1 + al * gained), abs=1e-5)


@given(a=st.floats(-0.3, 0.3), age=st.floats(0.0, 1.0))
def test_a_steady_acceleration_on_a_straight_line_is_exact(a: float, age: float) -> None:
    """For a change that does not fade, x = v t + a t^2 / 2."""
    estimator = Acceleration(decay_s=1e6, slowest=-9.0, fastest=9.0)
    then = estimator.predict(accelerating(LeaderState(1.0, 2.0, 0.0, 0.3, 0.0), a, 0.0), age)
    assert then == pytest.approx((1.0 + 0.3 * age + a * age**2 / 2, 2.0, 0.0, 0.3 + a * age, 0.0), abs=1e-6)


@given(v=st.floats(-2, 2), w=st.floats(-2, 2), a=st.floats(-1e3, 1e3), al=st.floats(-1e3, 1e3), age=st.floats(0.0, 100.0))
def test_acceleration_keeps_speeds_within_the_limits_or_the_report(v: float, w: float, a: float, al: float, age: float) -> None:
    then = Acceleration().predict(accelerating(LeaderState(0.0, 0.0, 0.0, v, w), a, al), age)
    assert min(v, -0.1) - 1e-12 <= then.v <= max(v, 0.6) + 1e-12
    assert min(w, -0.8) - 1e-12 <= then.w <= max(w, 0.8) + 1e-12
    if age >= 3.0:
        assert (then.v, then.w) == (0.0, 0.0)


SPEEDS = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=25)


def planning(first: tuple[float, float], speeds: list[tuple[float, float]], dt: float = 0.1, **more: Any) -> Report:
    flat = [each for pair in speeds for each in pair]
    return Report(0, LeaderState(1.0, -2.0, 0.5, *first), {"plan": flat, "dt": dt, **more})


@given(first=st.tuples(st.floats(-1, 1), st.floats(-1, 1)), speeds=SPEEDS, dt=st.sampled_from([0.05, 0.1, 0.3]), data=st.data())
def test_a_plan_that_is_followed_is_exact_at_every_tick_and_between(
    first: tuple[float, float], speeds: list[tuple[float, float]], dt: float, data: st.DataObject
) -> None:
    """The plan's speeds and the present one: 20 speeds at 10 Hz suffice for ages up to 2 s, and 0.1 s more."""
    leader_report, estimator, pose = planning(first, speeds, dt), PlanPrediction(), (1.0, -2.0, 0.5)
    for tick, (v, w) in enumerate([first, *speeds]):
        then = estimator.predict(leader_report, tick * dt)
        assert then == pytest.approx((*pose, v, w), abs=1e-9)
        part = data.draw(st.floats(0.01, 0.99)) * dt
        assert estimator.predict(leader_report, tick * dt + part) == pytest.approx((*arc(pose, v, w, part), v, w), abs=1e-9)
        pose = arc(pose, v, w, dt)


@given(speeds=SPEEDS, age=st.floats(0.0, 5.0))
def test_after_the_plan_its_last_speeds_hold_for_another_horizon(speeds: list[tuple[float, float]], age: float) -> None:
    leader_report, estimator = planning((0.3, 0.1), speeds), PlanPrediction(1.5, 1.0)
    ends_s = 0.1 * (len(speeds) + 1)
    last = estimator.predict(leader_report, ends_s)
    assert estimator.predict(leader_report, ends_s + age) == pytest.approx(
        DeadReckoning(1.5, 1.0).predict(Report(0, last, {}), age), abs=1e-9
    )


@given(speeds=SPEEDS, ages=st.lists(st.tuples(st.booleans(), st.floats(0.0, 4.0)), max_size=10))
def test_earlier_predictions_do_not_change_a_prediction(
    speeds: list[tuple[float, float]], ages: list[tuple[bool, float]]
) -> None:
    """The path along a plan is cached between predictions; reports may alternate."""
    estimator, one, other = PlanPrediction(), planning((0.3, 0.1), speeds), planning((-0.1, 0.4), speeds[::-1])
    for first, age in ages:
        leader_report = one if first else other
        assert estimator.predict(leader_report, age) == PlanPrediction().predict(leader_report, age)


NONSENSE = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=2),
    st.floats(),
    st.integers(-(2**63), 2**64 - 1),
    st.lists(st.floats(), max_size=5),
    st.lists(st.one_of(st.none(), st.text(max_size=1), st.floats(-1, 1)), max_size=4),
    st.dictionaries(st.text(max_size=1), st.none()),
)


@given(plan=NONSENSE, dt=NONSENSE, a=NONSENSE, al=NONSENSE, age=st.floats(0.0, 10.0))
def test_estimates_from_malformed_reports_are_finite(plan: Any, dt: Any, a: Any, al: Any, age: float) -> None:
    leader_report = Report(0, LeaderState(1.0, 2.0, 0.3, 0.3, 0.1), {"plan": plan, "dt": dt, "a": a, "al": al})
    for estimator in (Acceleration(), PlanPrediction()):
        assert all(math.isfinite(each) for each in estimator.predict(leader_report, age))


@pytest.mark.parametrize(
    "bad",
    [
        {"plan": []},
        {"plan": [0.3]},
        {"plan": [0.3, math.nan]},
        {"plan": [0.3, math.inf]},
        {"plan": [0.3, 1e12]},
        {"plan": [0.3, "0.1"]},
        {"plan": [[0.3, 0.1]]},
        {"plan": "0.3"},
        {"plan": None},
        {"dt": 0.0},
        {"dt": -0.1},
        {"dt": math.nan},
        {"dt": 1e-300},
        {"dt": "0.1"},
        {"dt": None},
    ],
)
def test_a_malformed_plan_is_ignored(bad: dict[str, Any]) -> None:
    good = planning((0.3, 0.1), [(0.2, 0.2)], a=0.1, al=0.0)
    assert plan_of(good) == (0.1, [(0.3, 0.1), (0.2, 0.2)])
    leader_report = good._replace(body={**good.body, **bad})
    assert plan_of(leader_report) is None
    assert (
        PlanPrediction().predict(leader_report, 0.7)
        == Acceleration().predict(leader_report, 0.7)
        != DeadReckoning().predict(leader_report, 0.7)
    )


def test_malformed_accelerations_count_as_zero() -> None:
    state = LeaderState(0.0, 0.0, 0.0, 0.3, 0.0)
    assert accelerations(accelerating(state, 0.1, -0.2)) == (0.1, -0.2)
    assert accelerations(Report(0, state, {"a": 0.1})) == (0.1, 0.0)
    for bad in (math.nan, math.inf, 1e10, "1", None, [0.1]):
        assert accelerations(Report(0, state, {"a": bad, "al": 0.1})) == (0.0, 0.0)
        assert accelerations(Report(0, state, {"a": 0.1, "al": bad})) == (0.0, 0.0)


class AtOrigin:
    """A custom estimator: the leader is always at the origin."""

    def predict(self, report: Report, age_s: float) -> LeaderState:
        return LeaderState(0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_custom_estimator_is_an_object_or_a_name() -> None:
    own = AtOrigin()
    assert LeaderFollower("lead", estimator=own).estimator is own
    assert type(estimator_of("vcmvsp.agents.formation.reports.prediction:Hold", horizon_s=2.0, fade_s=1.0)) is Hold


class CustomEstimator:
    """A custom estimator with parameters of its own and of its follower."""

    needs = ("a",)

    def __init__(self, fade_s: float, gain: Positive = 2.0) -> None:
        self.fade_s, self.gain = fade_s, gain

    def predict(self, report: Report, age_s: float) -> LeaderState:
        return report.state._replace(v=self.gain)


def test_a_table_sets_the_parameters_of_an_estimator() -> None:
    made = estimator_of({"kind": "acc", "decay_s": 0.5, "horizon_s": 1.0}, horizon_s=2.0, fade_s=3.0)
    assert isinstance(made, Acceleration)
    assert (made.decay_s, made.horizon_s, made.fade_s, made.fastest) == (0.5, 1.0, 3.0, 0.6)
    own = call(
        LeaderFollower, {"leader": "lead", "fade_s": 4.0, "estimator": {"kind": f"{__name__}:CustomEstimator", "gain": 1.5}}
    ).estimator
    assert isinstance(own, CustomEstimator)
    assert (own.fade_s, own.gain) == (4.0, 1.5)


@pytest.mark.parametrize(
    ("estimator", "says"),
    [
        ({"kind": "acc", "decay_s": -1.0}, r"agent.estimator.decay_s: must be a number > 0, not -1.0"),
        ({"kind": "acc", "decays": 1.0}, r"agent.estimator.decays: unknown key 'decays'; did you mean 'decay_s'\?"),
        ({"kind": "pan"}, r"agent.estimator: unknown estimator 'pan'; did you mean 'plan'\?"),
        ({"decay_s": 1.0}, r"agent.estimator.kind: must be a string, one of hold, dr, acc, plan"),
        ("mine.py:Own", r"agent.estimator: there is no file .*mine\.py"),
        (f"{__name__}:LeaderState", r"agent.estimator: .* it lacks predict\(report, age_s\)"),
    ],
)
def test_a_bad_estimator_is_named_with_its_key(estimator: Any, says: str) -> None:
    with pytest.raises(ScenarioError, match=says):
        call(LeaderFollower, {"leader": "lead", "estimator": estimator}, key="agent")


def test_the_estimator_of_the_readme_works() -> None:
    names: dict[str, Any] = {}
    exec(block("docs/reference/agents.md", "class Cautious"), names)
    follower = LeaderFollower("lead", estimator=names["Cautious"]())
    start = LeaderState(1.0, 2.0, 0.3, 0.4, -0.2)
    assert follower.estimator.predict(report(start), 0.1) == (1.0, 2.0, 0.3, 0.2, -0.1)


@pytest.mark.parametrize(
    ("kind", "says"), [("dead", "allowed: acc, dr, hold, plan"), (7, "no method predict"), (None, "no method predict")]
)
def test_an_invalid_estimator_is_refused_with_the_allowed_ones(kind: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LeaderFollower("lead", estimator=kind)
