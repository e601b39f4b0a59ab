"""Three delays and their different effects: of the leader's reports (the radio's delay), of the follower's loop (its agent's
latency), and between its decisions (its agent's period).
"""

import math

import numpy as np
import pytest

import vcmvsp
from tests.support.step_responses import overshoot
from tests.support.validation.fleets import K1, UNLIMITED, Floats, T, V, errors, fleet, lossy

pytestmark = pytest.mark.slow

START = 0.5  # m behind the slot
FINE = 0.01  # s: short against the delays
LATE = 0.3  # s of latency, thirty such periods


def follower_of_a_leader_at_rest(
    k1: float, latency_s: float, duration_s: float, *, period_s: float = FINE
) -> tuple[Floats, Floats]:
    """Times and z1 of a follower behind its slot at a leader at rest, with latency in its loop."""
    scenario = fleet(duration_s, [{"pose": (-1.0 - START, 0.0, 0.0), "k1": k1, **UNLIMITED}], path="straight", radio=lossy())
    settings = {
        "vehicle.car1.agent.speed": 0.0,
        "vehicle.car2.agent.latency_s": latency_s,
        "agents.period_s": period_s,
        "record.period_s": period_s,
    }
    times, z = errors(vcmvsp.run(scenario, set=settings, mcap=False))
    return times, z[:, 0, 0]


@pytest.mark.parametrize("delay_s", [0.1, 1.0, 5.0, 10.0])
def test_late_reports_shift_the_follower_and_never_destabilise_it(delay_s: float) -> None:
    """Lag v d, reached as exp(-k t) at any delay; k d up to 8, five times the stability limit of the loop."""
    radio = lossy(delay_s=delay_s)
    times, z = errors(
        vcmvsp.run(fleet(delay_s + 25.0, [UNLIMITED], path="straight", radio=radio, agents={"estimator": "hold"}), mcap=False)
    )
    assert z[-1, 0, 0] == pytest.approx(V * delay_s, rel=1e-6)
    deviation = z[times >= delay_s + 0.05, 0, 0] - V * delay_s
    assert deviation[:50] == pytest.approx(deviation[0] * (1.0 - K1 * T) ** np.arange(50), abs=1e-9)


def test_a_late_loop_overshoots_for_k_d_above_one_over_e() -> None:
    """z' = -k z(t - d). Sampled, the double root is at k T = d^d / (d + 1)^(d + 1), d in ticks: k d = 0.362 for d = 30."""
    ticks = round(LATE / FINE)
    limit = ticks**ticks / (ticks + 1) ** (ticks + 1) * ticks
    assert limit == pytest.approx(1.0 / math.e, rel=0.02)
    for k_d, overshoots in ((0.34, False), (0.97 * limit, False), (1.04 * limit, True), (0.40, True)):
        _, z = follower_of_a_leader_at_rest(k_d / LATE, LATE, 6.0)
        assert (z.min() < 0.0) == overshoots


@pytest.mark.parametrize(("period_s", "share"), [(0.1, 0.0), (0.5, 0.0), (1.0, 0.0), (2.0, 0.6), (2.4, 0.92), (2.6, None)])
def test_a_slow_agent_bounds_the_gain(period_s: float, share: float | None) -> None:
    """z1[n + 1] = (1 - k1 T) z1[n] (Fig 33): overshoot k1 T - 1, unstable (None) for k1 T > 2."""
    _, z = follower_of_a_leader_at_rest(K1, 0.0, 20 * period_s, period_s=period_s)
    assert z[1:] == pytest.approx(START * (1.0 - K1 * period_s) ** np.arange(len(z) - 1), abs=1e-6)
    if share is None:
        assert abs(z[-1]) > 2.0 * START
    else:
        assert overshoot(z) == pytest.approx(share, abs=1e-9)


K = 2.0  # 1/s, for the test of three delays


@pytest.mark.parametrize(
    ("delay_s", "latency_s", "period_s"),
    [
        (0.1, 0.0, 0.1),
        (0.6, 0.0, 0.1),
        (3.0, 0.0, 0.1),
        (0.1, 0.3, 0.1),
        (0.1, 0.6, 0.1),
        (0.1, 0.0, 0.3),
        (0.1, 0.0, 0.6),
        (0.6, 0.3, 0.3),
    ],
)
def test_each_of_three_delays_has_its_own_effect_only(delay_s: float, latency_s: float, period_s: float) -> None:
    """The steady lag gives the age of reports, v d; the decay of a start error, the latency and the period of the loop.

    The leader decides at 10 Hz throughout; latency and period are those of the follower's agent.
    """
    follower = {"pose": (-1.0 - START, 0.0, 0.0), "k1": K, "estimator": "hold", **UNLIMITED}
    scenario = fleet(90.0, [follower], path="straight", radio=lossy(delay_s=delay_s))
    settings = {"vehicle.car2.agent.latency_s": latency_s, "vehicle.car2.agent.period_s": period_s}
    _, z = errors(vcmvsp.run(scenario, set=settings, mcap=False))
    lag = z[-1, 0, 0]
    assert lag == pytest.approx(V * delay_s, abs=1e-6)
    ticks = z[:: round(period_s / T), 0, 0] - lag  # at the follower's own ticks
    age = round(latency_s / period_s)
    first = math.ceil(delay_s / period_s - 1e-9)  # tick of its first report; it acts ``age`` later
    expected = [*ticks[: first + age + 1]]
    while len(expected) < len(ticks):
        expected.append(expected[-1] - K * period_s * expected[-1 - age])
    assert ticks == pytest.approx(expected, abs=1e-6)
