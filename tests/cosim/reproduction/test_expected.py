"""Theoretical values: given only where they hold, and within their stated range."""

import math
import tomllib
from collections import Counter
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.studies import two
from vcmvsp.cosim.analysis.links import links_of
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.report import laws as theory
from vcmvsp.cosim.report.laws import Expected, MeasuredRun
from vcmvsp.cosim.tables.schema import Recording

pytestmark = pytest.mark.slow

LOSS, DELAY = "share of frames lost by chance", "delay, mean"
AGE, PEAK = "age of information, over all time", "age of information, peaks"
BURSTS, ERROR = "share of frames lost in bursts", "formation error, mean"


def measured_run(scenario: Any, **settings: Any) -> MeasuredRun:
    """A run as the report reads it."""
    result = vcmvsp.run(scenario, set={name.replace("__", "."): value for name, value in settings.items()}, mcap=False)
    facts = result._recorder.facts
    return MeasuredRun(
        tomllib.loads(result.scenario),
        result.metrics,
        Recording(result.states, result.radio, facts, result.metrics),
        result.radio,
        links_of(result.radio, facts.vehicles),
        motion(result.states),
    )


def laws(found: MeasuredRun) -> dict[str, Expected]:
    return {each.quantity: each for each in theory.laws(found)}


def lossy(**more: Any) -> dict[str, Any]:
    radio = {
        "preset": "ideal",
        "loss": {"kind": "bernoulli", "probability": 0.3},
        "delay": {"kind": "fixed", "seconds": 0.05, "jitter_s": 0.02},
    }
    return two(duration_s=10.0, **{"radio": radio, **more})


def test_95_percent_of_runs_are_inside() -> None:
    inside: Counter[str] = Counter()
    for seed in range(1, 21):
        for name, each in laws(measured_run(lossy(seed=seed))).items():
            if each.spread is not None:
                assert each.measured is not None
                inside[name] += abs(each.measured - each.expected) <= each.spread
    assert set(inside) == {LOSS, DELAY, AGE, PEAK}
    assert min(inside.values()) >= 16, inside  # 19 on average, 15 or less once in 400


def test_bursts_scatter_more_than_independent_losses() -> None:
    burst = {"kind": "gilbert_elliott", "to_bad_per_s": 1.0, "to_good_per_s": 1.0, "bad_loss": 0.9, "good_loss": 0.1}
    inside = 0
    for seed in range(1, 13):
        radio = {"preset": "ideal", "loss": burst}
        (found,) = (
            each for name, each in laws(measured_run(two(duration_s=10.0, radio=radio, seed=seed))).items() if name == BURSTS
        )
        assert found.expected == pytest.approx(0.5)
        assert found.measured is not None
        assert found.spread is not None
        assert found.spread > 2.0 * 1.96 * math.sqrt(0.25 / 100)
        inside += abs(found.measured - found.expected) <= found.spread
    assert inside >= 10


def test_followers_without_prediction_lag_by_speed_times_age() -> None:
    scenario = lossy(
        radio={"preset": "ideal", "loss": {"probability": 0.3}, "delay": {"seconds": 0.3}}, metrics={"from_s": 20.0}
    )
    scenario["vehicle"][0]["agent"] = {"kind": "trajectory", "path": "straight", "speed": 0.4}
    found = laws(measured_run(scenario, duration_s=120.0))
    assert found[ERROR].expected == pytest.approx(0.4 * (0.3 + 0.1 * 0.3 / 0.7))
    assert found[ERROR].measured == pytest.approx(found[ERROR].expected, abs=2.0 * (found[ERROR].spread or 0.0))
    assert found["formation error, RMS"].expected > found[ERROR].expected


def test_a_follower_on_a_circle_has_its_geometric_place() -> None:
    scenario = two(duration_s=40.0, metrics={"from_s": 30.0}, agents={"period_s": 0.1, "estimator": "dr"})
    scenario["vehicle"][0]["agent"] = {"kind": "trajectory", "path": "circle", "speed": 0.3, "yaw_rate": -0.15}
    scenario["vehicle"][1]["agent"]["bearing_deg"] = 30.0
    found = laws(measured_run(scenario))
    for name, inside in (("speed of car2, mean", 0.15 * math.sqrt(1.5**2 - 0.75)), ("distance of car2 to car1, mean", None)):
        assert found[name].measured == pytest.approx(found[name].expected, rel=1e-3)
        if inside is not None:  # right behind a leader that turns right: the inner circle
            assert found[name].expected == pytest.approx(inside)


@pytest.mark.parametrize(
    ("settings", "absent"),
    [
        ({"radio__loss__probability": 0.0}, {LOSS}),
        ({"radio__delay__jitter_s": 0.08, "radio__delay__seconds": 0.2}, {AGE, PEAK}),  # messages overtake each other
        ({"radio__delay__seconds": 0.0, "radio__delay__jitter_s": 0.0}, {DELAY}),  # only the air time is left
        ({"agents__latency_s": 0.05}, set()),
        ({"radio__script": {"changes": [{"from_s": 1.0, "to_s": 2.0, "loss": 1.0}]}}, {LOSS, AGE, PEAK}),
        ({"radio__script": {"changes": [{"from_s": 1.0, "to_s": 5.0, "delay_s": 0.5}]}}, {LOSS, DELAY, AGE, PEAK}),
    ],
)
def test_a_law_that_does_not_hold_is_absent(settings: dict[str, Any], absent: set[str]) -> None:
    assert {*laws(measured_run(lossy()))} - {*laws(measured_run(lossy(), **settings))} == absent


def straight() -> dict[str, Any]:
    """A scenario long enough for the law of the lag."""
    radio = {"preset": "ideal", "loss": {"probability": 0.3}, "delay": {"seconds": 0.3}}
    scenario = lossy(radio=radio, metrics={"from_s": 8.0})
    scenario["vehicle"][0]["agent"] = {"kind": "trajectory", "path": "straight", "speed": 0.4}
    return scenario


@pytest.mark.parametrize("settings", [{"radio__loss__probability": 1.0}, {"agents__k1": 0.0}, {"agents__k1": 30.0}])
def test_nothing_is_expected_where_a_law_has_no_value(settings: dict[str, Any]) -> None:
    assert ERROR in laws(measured_run(straight()))
    assert ERROR not in laws(measured_run(straight(), **settings))


@pytest.mark.parametrize(
    ("number", "agent", "vehicle"),
    [
        (0, {"period_s": 0.5}, {}),
        (1, {"period_s": 0.5}, {}),
        (1, {"latency_s": 0.05}, {}),
        (0, {"sending": {"when": "needed"}}, {}),
        (1, {"max_speed": 0.4}, {}),
        (1, {}, {"kind": "p2dx", "max_speed": 0.4}),
        (1, {}, {"pose_source": "positioning", "positioning": {"rate_hz": 5.0, "sigma_m": 0.5}}),
        (0, {}, {"pose_source": "positioning", "positioning": {"rate_hz": 5.0, "sigma_m": 0.5}}),
    ],
)
def test_the_law_of_the_lag_needs_undisturbed_followers(number: int, agent: dict[str, Any], vehicle: dict[str, Any]) -> None:
    scenario = straight()
    chosen = scenario["vehicle"][number]
    chosen |= vehicle
    chosen["agent"] |= agent
    assert ERROR not in laws(measured_run(scenario))


def test_periods_of_agents_count_like_a_common_one() -> None:
    common, own = straight(), straight()
    del own["agents"]["period_s"]
    for vehicle in own["vehicle"]:
        vehicle["agent"]["period_s"] = 0.1
    assert laws(measured_run(own))[ERROR] == laws(measured_run(common))[ERROR]
