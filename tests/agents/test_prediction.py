import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.formation import DeadReckoning, Hold, LeaderFollower, LeaderState, Report
from agents.formation.prediction import estimator_of
from cosim.frames import arc

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


def on_circle(state: LeaderState, t: float) -> tuple[float, float, float]:
    """Where constant speeds lead, from the centre of the circle (not from its chord)."""
    x, y, th, v, w = state
    if abs(w) < 1e-3:
        raise ValueError("a straight line")
    return x + v / w * (math.sin(th + w * t) - math.sin(th)), y - v / w * (math.cos(th + w * t) - math.cos(th)), th + w * t


@given(state=STATES.filter(lambda state: abs(state.w) > 1e-3), age=st.floats(0.0, 2.0))
def test_dead_reckoning_is_exact_on_circles_up_to_its_horizon(state: LeaderState, age: float) -> None:
    then = DeadReckoning().predict(report(state), age)
    assert then[:3] == pytest.approx(on_circle(state, age), abs=1e-9)
    assert then[3:] == state[3:]


@given(state=STATES, age=st.floats(0.0, 2.0))
def test_dead_reckoning_is_exact_on_straight_lines(state: LeaderState, age: float) -> None:
    straight = state._replace(w=0.0)
    x, y, th, v, _ = straight
    then = DeadReckoning().predict(report(straight), age)
    assert then == pytest.approx((x + v * age * math.cos(th), y + v * age * math.sin(th), th, v, 0.0), abs=1e-12)


@given(state=STATES, first=st.floats(0.0, 5.0), second=st.floats(0.0, 5.0))
def test_arcs_compose(state: LeaderState, first: float, second: float) -> None:
    x, y, th, v, w = state
    in_two = arc(arc((x, y, th), v, w, first), v, w, second)
    assert in_two == pytest.approx(arc((x, y, th), v, w, first + second), abs=1e-9)


@pytest.mark.parametrize(("horizon_s", "fade_s"), [(2.0, 1.0), (0.0, 0.5), (1.0, 3.0)])
def test_beyond_the_horizon_both_speeds_fade_linearly_to_zero(horizon_s: float, fade_s: float) -> None:
    """Against a fine integration of the fading speeds."""
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


@given(state=STATES, age=st.floats(3.0, 1e6))
def test_after_the_fade_the_leader_is_taken_to_stand_still(state: LeaderState, age: float) -> None:
    estimator = DeadReckoning()
    then = estimator.predict(report(state), age)
    assert (then.v, then.w) == (0.0, 0.0)
    assert then == estimator.predict(report(state), 3.0)


@given(state=STATES, age=st.floats(0.0, 100.0))
def test_hold_takes_the_report_as_it_is(state: LeaderState, age: float) -> None:
    assert Hold().predict(report(state), age) == state


class Elsewhere:
    """An estimator of one's own: the leader is always at the origin."""

    def predict(self, report: Report, age_s: float) -> LeaderState:
        return LeaderState(0.0, 0.0, 0.0, 0.0, 0.0)


def test_an_estimator_of_ones_own_is_an_object_or_a_name() -> None:
    own = Elsewhere()
    assert LeaderFollower("lead", estimator=own).estimator is own
    assert type(estimator_of("agents.formation.prediction:Hold", horizon_s=2.0, fade_s=1.0)) is Hold


def test_the_estimator_of_the_readme_works() -> None:
    blocks = (Path(__file__).parents[2] / "agents" / "README.md").read_text(encoding="utf-8").split("```python\n")[1:]
    names: dict[str, Any] = {}
    exec(next(block for block in blocks if "class Cautious" in block).split("```")[0], names)
    follower = LeaderFollower("lead", estimator=names["Cautious"]())
    start = LeaderState(1.0, 2.0, 0.3, 0.4, -0.2)
    assert follower.estimator.predict(report(start), 0.1) == (1.0, 2.0, 0.3, 0.2, -0.1)


@pytest.mark.parametrize(
    ("kind", "says"), [("dead", "allowed: dr, hold"), (7, "no method predict"), (None, "no method predict")]
)
def test_what_is_no_estimator_is_refused_with_what_is_allowed(kind: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LeaderFollower("lead", estimator=kind)
