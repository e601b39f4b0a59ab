"""Chains through the whole platform: the gain per hop, and remedies.

Of a follower with servo lag tau on a straight line, gain k, delay d: ``|G| = |N| / |tau s^2 + s + k|`` at s = j omega, with N
= s + k (``hold``), (1 + k d) s + k (``dr``), k (speed not fed forward), tau s^2 + s + k (acceleration fed forward, too).
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.figures import checked_figure
from tests.support.validation.fleets import K1, lossy
from tests.support.validation.teams import COLUMN, oscillation, rms_of_links, team
from vcmvsp.cosim.reproduction.figures.formation import chain

pytestmark = pytest.mark.slow

OMEGA, TAU, DELAY_S, STEP_S = 0.8, 0.5, 0.3, 0.01  # rad/s, s, s, s
SURGING = {"path": "stopgo", "yaw_rate": 0.0, "surge_s": math.tau / OMEGA}


def surge(delay_s: float = DELAY_S, count: int = 4, **agents: Any) -> vcmvsp.Result:
    """A column on a straight line, with servos of 0.5 s, behind a leader with a sinusoidal speed; agents at 100 Hz."""
    settings = {"period_s": STEP_S, "max_reverse": 1e9, **agents}
    scenario = team(count, 20.0, COLUMN, leader=SURGING, kind="lag", agents=settings, radio=lossy(0.0, delay_s))
    return vcmvsp.run({**scenario, "record": {"period_s": 0.1}}, mcap=False)


def gain(numerator: complex) -> float:
    s = 1j * OMEGA
    return abs(numerator) / abs(TAU * s * s + s + K1)


@pytest.mark.parametrize("estimator", ["hold", "dr"])
def test_with_the_leaders_speed_the_chain_is_string_stable(estimator: str) -> None:
    """All feed the leader's speed forward: behind the first, errors change by k / |tau s^2 + s + k| <= 1 per hop (k tau <=
    0.5).
    """
    swings = oscillation(surge(estimator=estimator, feed="leader", count=5), OMEGA)
    errors = np.abs(np.diff(swings))
    assert (errors[2:] / errors[1:-1]).max() <= 1.0
    if estimator == "hold":
        assert errors[2:] / errors[1:-1] == pytest.approx(gain(K1), rel=0.015)


def test_without_the_speed_a_steady_error_remains() -> None:
    """Without feed-forward: a lag of v / k at every hop."""
    scenario = team(4, 40.0, COLUMN, leader={"path": "straight"}, agents={"feed": "none"}, metrics={"from_s": 39.0})
    assert rms_of_links(vcmvsp.run(scenario, mcap=False)) == pytest.approx([0.3 / K1] * 3, rel=1e-3)


def test_the_figure_shows_gains_of_hops_and_that_feed_forward_reduces_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Feed-forward of the leader's speed, or of the parent's acceleration: smaller errors at the end of the chain."""
    monkeypatch.setattr(chain, "OMEGAS", (0.8, 0.963))
    monkeypatch.setattr(chain, "DELAYS_S", ())
    monkeypatch.setattr(chain, "WARM_S", 8.0)
    figure = checked_figure("chain", tmp_path, 2, ["largest gain", "column"])
    assert len(figure.rows) == 4 + 1 + 4 + 4 + 2 + 3
    links = {curve.label: curve.y for curve in figure.panels[1].curves}
    plain, led, pushed = (links[chain.LABELS[way]] for way in ("dr", "leader", "acceleration"))
    assert led[-1] < 0.25 * plain[-1]
    assert max(led) < 1.1 * led[0]
    assert pushed[-1] < 0.5 * plain[-1]
