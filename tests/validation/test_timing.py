"""Delays to the very tick: an agent's latency closes the loop late, a radio's delay makes what is heard old."""

import math

import numpy as np
import pytest

import vcmvsp
from tests.support.validation.fleets import ASIDE, UNLIMITED, Floats, R, T, V, W, errors, fleet, lossy

START = 0.5  # m behind the slot


def late_loop(k: float, latency_s: float, duration_s: float) -> tuple[Floats, Floats]:
    """A leader at rest and a follower behind its slot whose commands take effect ``latency_s`` later: times and z1."""
    follower = {"pose": (-1.0 - START, 0.0, 0.0), "k1": k, **UNLIMITED}
    scenario = fleet(duration_s, [follower], path="straight", radio={"preset": "ideal"})
    settings = {"vehicle.car1.agent.speed": 0.0, "vehicle.car2.agent.latency_s": latency_s}
    times, z = errors(vcmvsp.run(scenario, set=settings, mcap=False))
    return times, z[:, 0, 0]


def sampled(k: float, ticks: float, n: int) -> Floats:
    """z[i+1] = z[i] - k T ((1 - f) z[i - d] + f z[i - d - 1]) with ``ticks`` = d + f; the first command is that of tick 1."""
    d, f = divmod(ticks, 1.0)
    z = [START]
    for i in range(n - 1):
        old = [z[j] if j >= 1 else 0.0 for j in (i - int(d), i - int(d) - 1)]
        z.append(z[i] - k * T * ((1 - f) * old[0] + f * old[1]))
    return np.array(z)


@pytest.mark.parametrize("latency_s", [0.0, 0.05, 0.1, 0.25, 0.3])
def test_a_command_takes_effect_after_the_latency_and_not_a_tick_earlier_or_later(latency_s: float) -> None:
    """z' = -k z(t - d), sampled and held: the recursion to the last digits, also for latencies between ticks."""
    times, z = late_loop(2.0, latency_s, 10.0)
    assert z == pytest.approx(sampled(2.0, latency_s / T, len(times)), abs=1e-9)


@pytest.mark.parametrize("ticks", [0, 1, 2, 3, 5])
def test_the_limit_of_stability(ticks: int) -> None:
    """Sampled at T with d ticks of latency, stable iff k T < 2 sin(pi / (2 (2 d + 1))); a delay wrong by one tick turns it."""
    limit = 2.0 * math.sin(math.pi / (2 * (2 * ticks + 1))) / T
    for factor, grows in ((0.97, False), (1.03, True)):
        times, z = late_loop(factor * limit, ticks * T, 40.0)
        early, late = np.abs(z[(times > 5) & (times <= 15)]).max(), np.abs(z[times > 30]).max()
        assert (late > early) == grows


@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.25, 0.3, 1.0])
def test_hold_on_a_circle_lags_by_the_chord_of_the_age(delay_s: float) -> None:
    """|z| = 2 (R + L') sin(w a / 2), where a message is a = T ceil(D / T) old when it is used, at least T."""
    age = T * max(1, math.ceil(delay_s / T - 1e-9))
    result = vcmvsp.run(
        fleet(60.0, radio=lossy(delay_s=delay_s), agents={"estimator": "hold"}, metrics={"from_s": 40.0}), mcap=False
    )
    _, z = errors(result)
    expected = [2 * (R + left) * math.sin(W * age / 2) for left in (ASIDE, -ASIDE)]
    assert np.hypot(*z[-1].T) == pytest.approx(expected, rel=1e-4)
    assert result.metrics["radio"]["age_s"]["mean"] == pytest.approx(age, abs=1e-9)
    assert result.metrics["radio"]["age_s"]["max"] == pytest.approx(age, abs=1e-9)


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_hold_on_a_line_lags_by_speed_times_age(delay_s: float) -> None:
    result = vcmvsp.run(fleet(60.0, path="straight", radio=lossy(delay_s=delay_s), agents={"estimator": "hold"}), mcap=False)
    assert result.metrics["formation"]["final_m"] == pytest.approx(V * max(T, delay_s), rel=1e-6)


@pytest.mark.parametrize("path", ["straight", "circle"])
@pytest.mark.parametrize(("probability", "delay_s"), [(0.0, 0.0), (0.0, 1.0), (0.6, 0.0), (0.6, 0.3)])
def test_dead_reckoning_leaves_nothing_on_lines_and_circles(path: str, probability: float, delay_s: float) -> None:
    """Whatever the loss and the delay: the leader's speeds are constant."""
    result = vcmvsp.run(
        fleet(70.0, path=path, radio=lossy(probability, delay_s, 0.02 if delay_s else 0.0), agents=UNLIMITED), mcap=False
    )
    assert result.metrics["formation"]["final_m"] < 1e-6
