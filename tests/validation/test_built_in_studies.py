"""The built-in studies show what they describe, at some of their points and with fewer runs.

Reference: a triangle on the slalom, computed independently of this platform with 20 seeds: RMS of the formation error, m, for
an age of the leader's message equal to the delay, to 10 % (20 % at p = 0.9). Here the least age is one period, 0.1 s: a loss
probability p without delay gives T + T p/(1 - p).
"""

import itertools
import math
from functools import cache
from typing import Any

import pytest

import vcmvsp
from vcmvsp.cosim.runs.api import check
from vcmvsp.cosim.scenario import loader

pytestmark = pytest.mark.slow

STUDIES = [name for name in loader.names() if name.startswith("study-")]
T = 0.1  # s, between messages
LOSS, DELAY, BURST, WHO = "radio.loss.probability", "radio.delay.seconds", "radio.loss.mean_burst_s", "agents.estimator"
TWO_PERIODS = {"duration_s": 52.0}


@cache
def metrics(name: str, seed: int, *point: tuple[str, Any]) -> dict[str, Any]:
    return vcmvsp.run(name, seed=seed, set=dict(point), agents="inprocess", mcap=False).metrics


def rms(name: str, point: dict[str, Any], seeds: int = 1) -> float:
    return math.fsum(metrics(name, seed, *point.items())["formation"]["rms_m"] for seed in range(1, seeds + 1)) / seeds


@pytest.mark.parametrize("name", STUDIES)
def test_every_corner_of_a_study_is_a_valid_scenario(name: str) -> None:
    study = loader.load(name)[0].study
    assert study.metrics[0] == ("safety.min_clearance_m" if name == "study-avoidance" else "formation.rms_m")
    for point in itertools.product(*((values[0], values[-1]) for values in study.vary.values())):
        check(name, set=dict(zip(study.vary, point, strict=True)))


# --- delay -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("estimator", "delay_s", "expected"),
    [
        ("hold", 0.1, 0.036),
        ("hold", 2.0, 0.656),
        ("dr", 0.5, 0.041),
        ("acc", 1.0, 0.037),
        ("plan", 2.0, 0.0061),
    ],
)
def test_the_error_over_delay_agrees_with_the_reference(estimator: str, delay_s: float, expected: float) -> None:
    """Over two periods of the slalom, after the start."""
    assert rms("study-delay", {WHO: estimator, DELAY: delay_s, **TWO_PERIODS}) == pytest.approx(expected, rel=0.1)


def test_nothing_is_random_in_the_study_of_delay() -> None:
    point = {WHO: "dr", DELAY: 0.5, **TWO_PERIODS}
    first, second = (metrics("study-delay", seed, *point.items())["formation"] for seed in (1, 2))
    assert first == second


# --- loss --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("probability", [0.3, 0.5, 0.8])
def test_the_age_over_loss_is_the_closed_form(probability: float) -> None:
    expected = T + T * probability / (1.0 - probability)
    found = [metrics("study-loss", seed, (WHO, "hold"), (LOSS, probability))["radio"]["age_s"]["mean"] for seed in (1, 2)]
    assert sum(found) / 2 == pytest.approx(expected, rel=0.06)  # a few thousand ticks, correlated over 1/(1 - p)


def test_losses_matter_less_with_a_better_estimator() -> None:
    hold, dr, acc, plan = (rms("study-loss", {WHO: estimator, LOSS: 0.7}) for estimator in ("hold", "dr", "acc", "plan"))
    assert dr < 0.6 * hold
    assert acc < 0.7 * dr
    assert plan < 0.7 * acc


# --- loss and delay ----------------------------------------------------------------------------------------------------------


def test_loss_and_delay_add_up_to_an_age_with_hold() -> None:
    # The lag is the leader's motion in that time; the mean age is d + T p/(1 - p).
    late, both = (rms("study-loss-delay", {WHO: "hold", LOSS: loss, DELAY: 1.0}) for loss in (0.0, 0.5))
    assert both / late == pytest.approx((1.0 + T) / 1.0, rel=0.03)


def test_loss_and_delay_amplify_each_other_with_extrapolation() -> None:
    nothing, lost, late, both = (
        rms("study-loss-delay", {LOSS: p, DELAY: d}) for p, d in ((0, 0), (0.8, 0), (0, 1.0), (0.8, 1.0))
    )
    assert nothing < lost < late < both
    assert both > lost + late - nothing


# --- bursts ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mean_burst_s", "tolerance"), [(0.05, 0.06), (0.4, 0.15), (0.9, 0.25)])
def test_the_age_over_bursts_is_the_closed_form(mean_burst_s: float, tolerance: float) -> None:
    # A frame is lost with probability 1/2; between frames a link stays bad with 1 - (1 - exp(-2 T/b))/2. Each frame of the
    # present run of losses adds a period to the age: T (1 + P(bad) / P(end)).
    expected = T * (1.0 + 0.5 / (0.5 * (1.0 - math.exp(-2.0 * T / mean_burst_s))))
    found = [metrics("study-bursts", seed, (WHO, "hold"), (BURST, mean_burst_s))["radio"] for seed in (1, 2)]
    assert sum(each["age_s"]["mean"] for each in found) / 2 == pytest.approx(expected, rel=tolerance)
    assert sum(each["delivery_ratio"] for each in found) / 2 == pytest.approx(0.5, abs=0.05)


def test_longer_bursts_of_the_same_share_are_worse() -> None:
    short, middle, long = (rms("study-bursts", {WHO: "hold", BURST: each}, seeds=2) for each in (0.05, 0.4, 0.9))
    assert 1.5 * short < middle
    assert 1.5 * middle < long


# --- size --------------------------------------------------------------------------------------------------------------------


def test_a_large_formation_degrades_only_on_a_shared_channel() -> None:
    def error(count: int, mac: str) -> float:
        point = (("vehicle.car.count", count), ("radio.mac.kind", mac), ("duration_s", 14.0))
        return float(metrics("study-size", 1, *point)["formation"]["rms_m"])

    assert error(24, "ideal") == pytest.approx(error(2, "ideal"), rel=1e-9)  # star: slots along a line are equivalent
    assert error(2, "dcf") < 1.15 * error(2, "ideal")
    assert error(24, "dcf") > 1.5 * error(24, "ideal")
