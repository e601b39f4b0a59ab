"""Formation error over a channel that delays and loses: closed forms and reference curves (kinematic vehicles)."""

import math

import numpy as np
import pytest

from tests.support.agents.agent_loop import Drive, Lost, drive
from vcmvsp.agents.formation import LeaderFollower, Trajectory
from vcmvsp.cosim.rng import stream

V, W, R, T, K1 = 0.3, 0.15, 2.0, 0.1, 0.8
LEFT = 0.5


def bernoulli(p: float, ticks: int, followers: int, name: str) -> Lost:
    draws = (stream(1, name).random((ticks + 1, followers)) < p).tolist()
    return lambda tick, follower: bool(draws[tick][follower])


def many(n: int, estimator: str) -> list[LeaderFollower]:
    """Followers of the standard triangle; the leader is never given up, since the closed forms know no such rule."""
    sides = (30.0, -30.0)
    return [LeaderFollower("leader", 1.0, sides[i % 2], estimator=estimator, timeout_s=1e9, max_reverse=1e9) for i in range(n)]


def rms(run: Drive, from_s: float = 20.0) -> float:
    return float(np.sqrt(np.mean(run.error[round(from_s / T) :] ** 2)))


@pytest.mark.parametrize("p", [0.1, 0.5])
def test_hold_on_a_straight_line_has_the_mean_and_rms_of_the_closed_form(p: float) -> None:
    """mean |z| = v (d + T p/(1-p)); var = v^2 (k1 T)^2/(1-a^2) T^2 p/(1-p)^2 (1+a p)/(1-a p), a = 1 - k1 T; here d = T."""
    n, duration = 60, 220.0
    lost = bernoulli(p, round(duration / T), n, f"hold/{p}")
    run = drive(Trajectory("straight"), many(n, "hold"), duration_s=duration, delay_ticks=1, lost=lost)
    a = 1 - K1 * T
    mean = V * (T + T * p / (1 - p))
    var = V**2 * (K1 * T) ** 2 / (1 - a**2) * T**2 * p / (1 - p) ** 2 * (1 + a * p) / (1 - a * p)
    assert run.error[200:].mean() == pytest.approx(mean, rel=0.03)
    assert rms(run) == pytest.approx(math.sqrt(mean**2 + var), rel=0.03)
    # The spread itself, which the mean outweighs in the RMS (its sampling error is the larger one).
    assert run.z[200:, :, 0].var() == pytest.approx(var, rel=0.12)


@pytest.mark.parametrize("delay_s", [0.1, 0.5, 1.0, 2.0])
def test_hold_on_a_circle_lags_by_the_chord_of_the_delay(delay_s: float) -> None:
    """|z| = 2 (R + L') sin(w d / 2) without loss."""
    run = drive(Trajectory("circle"), many(2, "hold"), duration_s=100, delay_ticks=round(delay_s / T))
    expected = [2 * (R + left) * math.sin(W * delay_s / 2) for left in (LEFT, -LEFT)]
    assert run.error[-1] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("path", ["straight", "circle"])
def test_dead_reckoning_leaves_nothing_on_lines_and_circles(path: str) -> None:
    """For any delay and loss, as long as no age passes the horizon."""
    lost = bernoulli(0.6, 1000, 2, "dr")
    followers = [LeaderFollower("leader", 1.0, side, horizon_s=10.0, timeout_s=1e9) for side in (30.0, -30.0)]
    run = drive(Trajectory(path), followers, duration_s=100, delay_ticks=5, lost=lost)  # type: ignore[arg-type]
    assert run.error[-1].max() < 1e-6


# Simulated references: RMS |z| in m at a loss p in the very tick (d = 0), and at a delay without loss.
REFERENCE = {
    ("slalom", "hold", "loss", 0.5): 0.039,
    ("random", "dr", "loss", 0.5): 0.016,
    ("slalom", "hold", "delay", 0.5): 0.169,
    ("random", "dr", "delay", 1.0): 0.120,
    ("slalom", "acc", "loss", 0.5): 0.0060,
    ("random", "plan", "loss", 0.5): 0.0033,
    ("slalom", "acc", "delay", 2.0): 0.154,
    ("random", "acc", "delay", 2.0): 0.244,
    ("slalom", "plan", "delay", 2.0): 0.0061,
}


@pytest.mark.parametrize(("case", "expected"), REFERENCE.items(), ids=["-".join(map(str, case)) for case in REFERENCE])
def test_the_reference_curves(case: tuple[str, str, str, float], expected: float) -> None:
    path, estimator, kind, value = case
    n = 20 if kind == "loss" else 2
    lost = bernoulli(value if kind == "loss" else 0.0, 1200, n, "curve")
    delay = round(value / T) if kind == "delay" else 0
    leader = Trajectory(path, estimator=estimator)  # type: ignore[arg-type]
    run = drive(leader, many(n, estimator), duration_s=120, delay_ticks=delay, lost=lost)
    assert rms(run) == pytest.approx(expected, rel=0.10)
