"""The control law against its proof and its closed forms (Toh 2012, chapter 3, corrected)."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Pose, drive
from tests.support.step_responses import overshoot, servo_step, settling_s
from vcmvsp.agents.formation import LeaderFollower, LeaderState, Trajectory
from vcmvsp.agents.formation.followers.laws import Demand, FollowerPlace, formation_law
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.rng import stream

L, LEFT = math.cos(math.radians(30.0)), 0.5  # the standard triangle: 1 m at +-30 degrees
V, W, R = 0.3, 0.15, 2.0
BAND = 0.05 * 0.5  # m: 5 % of a start 0.5 m away


def triangle(**params: float) -> list[LeaderFollower]:
    return [LeaderFollower("leader", 1.0, bearing, **params) for bearing in (30.0, -30.0)]  # type: ignore[arg-type]


def behind(k1: float, **params: float) -> LeaderFollower:
    """A follower whose slot is L straight behind the leader, free to reverse so that the loop stays linear."""
    return LeaderFollower("leader", L, k1=k1, max_reverse=1e9, **params)  # type: ignore[arg-type]


# --- the proof: V' = -k1 z1^2 - k2 z2^2 ---


@given(
    pose=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-4, 4)),
    v=st.floats(-0.5, 0.5),
    w=st.floats(-0.5, 0.5),
    place=st.builds(FollowerPlace, st.floats(-1, 1), st.floats(-1, 1), st.floats(0.3, 1.5)),
    k1=st.floats(0.1, 3),
    k2=st.floats(0.1, 3),
)
def test_the_energy_of_the_error_falls_at_the_rate_of_the_proof(
    pose: Pose, v: float, w: float, place: FollowerPlace, k1: float, k2: float
) -> None:
    """V' by a central difference of the true motion, for any start, leader, slot, handle and gains."""
    h, leader = 1e-5, LeaderState(0.0, 0.0, 0.0, v, w)
    law = formation_law(pose, leader, place, k1, k2)

    def energy(dt: float) -> float:
        moved = formation_law(arc(pose, law.v, law.w, dt), LeaderState(*arc((0.0, 0.0, 0.0), v, w, dt), v, w), place, k1, k2)
        return 0.5 * (moved.z1**2 + moved.z2**2)

    rate = (energy(h) - energy(-h)) / (2 * h)
    assert rate == pytest.approx(-k1 * law.z1**2 - k2 * law.z2**2, rel=1e-5, abs=1e-6)


def test_the_error_decays_exponentially_whatever_the_leader_does() -> None:
    """200 random starts and leaders in near-continuous time: V never rises, and |z(t)| = |z(0)| exp(-k t)."""
    draws, k, T, ticks = stream(0, "law/proof"), 0.5, 1e-3, 2000
    expected = np.exp(-k * T * np.arange(ticks))
    for side in (LEFT, -LEFT) * 100:
        place = FollowerPlace(0.0, -side, L)
        off_x, off_y, th, w_l = draws.uniform((-1.0, -1.0, -1.5, -W), (1.0, 1.0, 1.5, W)).tolist()
        pose, leader = (off_x - L, off_y - side, th), LeaderState(0.0, 0.0, 0.0, V, w_l)
        squares = []
        for _ in range(ticks):
            v, w, z1, z2 = formation_law(pose, leader, place, k, k)
            squares.append(z1 * z1 + z2 * z2)
            pose = arc(pose, v, w, T)
            leader = LeaderState(*arc(leader[:3], V, w_l, T), V, w_l)
        assert np.diff(squares).max() < 1e-9
        np.testing.assert_allclose(np.sqrt(np.divide(squares, squares[0])), expected, rtol=1e-3)


def test_with_different_gains_the_smaller_one_bounds_the_decay() -> None:
    run = drive(
        Trajectory("slalom"),
        triangle(k1=0.8, k2=0.5),
        poses=[(-1.2, -0.9, 0.3), (-0.5, 0.9, -0.4)],
        duration_s=8,
        period_s=1e-2,
    )
    bound = run.error[0] * np.exp(-0.5 * 1e-2 * np.arange(len(run.error)))[:, None]
    assert (run.error <= bound + 1e-3).all()


def printed_law(pose: Pose, leader: LeaderState, place: FollowerPlace, k1: float, k2: float) -> Demand:
    """The law with the term that (3-33) adds to v_f: rho_d w_l sin(phi_d + thb), here of the standard triangle."""
    law = formation_law(pose, leader, place, k1, k2)
    return law._replace(v=law.v + leader.w * math.sin(math.radians(30.0) + leader.th - pose[2]))


@pytest.mark.parametrize(("law", "left_over"), [(formation_law, 0.0), (printed_law, 0.135)])
def test_the_printed_extra_term_leaves_an_error_on_a_circle(
    law: Callable[[Pose, LeaderState, FollowerPlace, float, float], Demand], left_over: float
) -> None:
    pose: Pose = (-L, -LEFT, 0.0)
    leader = LeaderState(0.0, 0.0, 0.0, V, W)
    for _ in range(900):
        demand = law(pose, leader, FollowerPlace(0.0, -LEFT, L), 0.8, 0.8)
        pose = arc(pose, demand.v, demand.w, 0.1)
        leader = LeaderState(*arc(leader[:3], V, W, 0.1), V, W)
    assert math.hypot(demand.z1, demand.z2) == pytest.approx(left_over, abs=5e-4)


# --- circles ---


@pytest.mark.parametrize(("delay_ticks", "estimator"), [(0, "hold"), (1, "dr"), (15, "dr")])
def test_on_a_circle_the_followers_settle_on_circles_of_their_own(delay_ticks: int, estimator: str) -> None:
    """R_f^2 = (R + L')^2 - L^2; rho^2 = rho_d^2 - 2 L L' sin thb with sin thb = L w / (v + L' w); v_f = w R_f."""
    run = drive(Trajectory("circle"), triangle(estimator=estimator), duration_s=90, delay_ticks=delay_ticks)  # type: ignore[arg-type]
    sides = np.array([LEFT, -LEFT])
    radius = np.sqrt((R + sides) ** 2 - L**2)
    apart = np.sqrt(1.0 - 2 * L * sides * L * W / (V + sides * W))
    assert run.error[-1] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert np.hypot(*(run.followers[-1, :, :2] - [0.0, R]).T) == pytest.approx(radius, abs=1e-6)
    assert np.hypot(*(run.followers[-1, :, :2] - run.leader[-1, :2]).T) == pytest.approx(apart, abs=1e-6)
    assert run.commands[-1, :, 0] == pytest.approx(W * radius, abs=1e-6)
    assert run.commands[-1, :, 1] == pytest.approx([W, W], abs=1e-6)
    assert radius == pytest.approx([2.34521, 1.22474], abs=1e-5)
    assert apart == pytest.approx([0.83666, 1.22474], abs=1e-5)
    assert W * radius == pytest.approx([0.35178, 0.18371], abs=1e-5)


def test_a_shorter_handle_keeps_the_shape_better_on_a_circle() -> None:
    run = drive(Trajectory("circle"), triangle(handle=0.3), duration_s=90)
    assert run.error[-1] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert np.hypot(*(run.followers[-1, :, :2] - run.leader[-1, :2]).T) == pytest.approx([0.9384, 1.0520], abs=1e-4)


@pytest.mark.parametrize(("distance", "bearing"), [(0.8, 90.0), (0.8, -90.0), (0.8, 180.0), (1.0, 150.0)])
def test_with_a_handle_any_slot_can_be_kept(distance: float, bearing: float) -> None:
    """Abreast and ahead of the leader too: |z| -> 0 on the circle."""
    run = drive(Trajectory("circle"), [LeaderFollower("leader", distance, bearing, handle=0.4)], duration_s=60)
    assert run.error[-1, 0] < 1e-6


@pytest.mark.parametrize("delay_ticks", [0, 1, 5])
def test_a_chain_of_followers_that_report_measured_speeds_settles_on_a_circle(delay_ticks: int) -> None:
    """A column of four, each behind the one before it and told by it alone."""
    column = [LeaderFollower(parent, 0.8, handle=0.5, broadcast=True) for parent in ("leader", "f0", "f1")]
    starts = [(-0.8, 0.1, 0.0), (-1.6, -0.1, 0.2), (-2.4, 0.0, -0.2)]
    run = drive(Trajectory("circle"), column, poses=starts, duration_s=90, delay_ticks=delay_ticks)
    assert run.error[-1].max() < 1e-6


def test_vehicles_with_inertia_settle_on_a_circle_all_the_same() -> None:
    """The commands become constant there, so a servo's lag leaves no error."""
    run = drive(Trajectory("circle"), triangle(), duration_s=60, tau=(0.5, 0.3))
    assert run.error[-1].max() < 1e-3


def test_a_standing_leader_is_joined() -> None:
    poses: list[Pose] = [(-2.0, -1.0, 0.8), (-1.5, 0.5, -0.5)]
    run = drive(Trajectory("straight", 0.0), triangle(), poses=poses, duration_s=40)
    assert run.error[-1].max() < 1e-6


def test_the_heading_settles_at_the_speed_of_the_leader_only() -> None:
    """With z = 0 on a straight line thb' = -(v/ell) sin thb: tan(thb/2) = tan(thb0/2) exp(-v t/ell), for every k2."""
    th0 = 0.6
    handle_on_its_point: Pose = (-L * math.cos(th0), -L * math.sin(th0), th0)
    for k2 in (0.5, 5.0):
        run = drive(Trajectory("straight"), [behind(0.8, k2=k2)], poses=[handle_on_its_point], duration_s=6, period_s=1e-3)
        t = 1e-3 * np.arange(len(run.z))
        expected = 2 * np.arctan(math.tan(th0 / 2) * np.exp(-V * t / L))
        np.testing.assert_allclose(run.followers[:, 0, 2], expected, atol=1e-3)


# --- gains and sampling (Figs 30, 31, 33) ---


@pytest.mark.parametrize(("k1", "expected"), [(2.0, 0.0), (8.0, 0.0), (12.0, 0.2), (16.0, 0.6)])
def test_sampling_alone_overshoots_by_k1_period_minus_1(k1: float, expected: float) -> None:
    """z1[n+1] = (1 - k1 T) z1[n], also with the standard limit on reversing: the first swing is the largest."""
    for follower in (behind(k1), LeaderFollower("leader", L, k1=k1)):
        run = drive(Trajectory("straight"), [follower], poses=[(-L - 0.5, 0.0, 0.0)], duration_s=10)
        assert overshoot(run.z[:, 0, 0]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("hz", "expected", "settled_s"), [(10, 0.0, 3.6), (2, 0.0, 3.0), (1, 0.0, 2.0), (0.5, 0.6, 12.0)])
def test_a_slow_control_rate_overshoots(hz: float, expected: float, settled_s: float) -> None:
    run = drive(Trajectory("straight"), [behind(0.8)], poses=[(-L - 0.5, 0.0, 0.0)], duration_s=30, period_s=1 / hz)
    assert overshoot(run.z[:, 0, 0]) == pytest.approx(expected, abs=1e-9)
    assert settling_s(run.z[:, 0, 0], 1 / hz, BAND) == pytest.approx(settled_s)


@pytest.mark.parametrize(
    ("k1", "T", "percent", "settled_s"),
    [
        (0.4, 0.1, 0.0, 6.2),
        (0.8, 0.1, 2.6, 2.6),
        (2.0, 0.1, 20.6, 2.7),
        (4.0, 0.1, 39.6, 3.8),
        (8.0, 0.1, 62.2, 5.0),
        (0.8, 0.5, 8.35, None),
        (0.8, 1.0, 20.4, None),
        (0.8, 2.0, 34.3, None),
    ],
)
def test_a_servo_makes_high_gains_overshoot(k1: float, T: float, percent: float, settled_s: float | None) -> None:
    """The whole loop equals the exact matrix of the sampled servo, and both give the published figures."""
    start = (-L - 0.5, 0.0, 0.0)
    run = drive(Trajectory("straight"), [behind(k1)], poses=[start], duration_s=20, period_s=T, tau=(0.5, 0.3), rolling=V)
    np.testing.assert_allclose(run.z[:, 0, 0], 0.5 * servo_step(k1, T, 0.5, len(run.z)), atol=1e-9)
    assert 100 * overshoot(run.z[:, 0, 0]) == pytest.approx(percent, abs=0.06)
    if settled_s is not None:
        assert settling_s(run.z[:, 0, 0], T, BAND) == pytest.approx(settled_s, abs=T + 1e-9)


@pytest.mark.parametrize(("k1", "percent"), [(1.0, 4.3), (2.0, 16.3), (4.0, 30.5)])
def test_in_continuous_time_the_servo_is_a_second_order_loop(k1: float, percent: float) -> None:
    """Overshoot exp(-pi zeta / sqrt(1 - zeta^2)), zeta = 1 / (2 sqrt(k1 tau))."""
    zeta = 1 / (2 * math.sqrt(k1 * 0.5))
    run = drive(
        Trajectory("straight"),
        [behind(k1)],
        poses=[(-L - 0.5, 0.0, 0.0)],
        duration_s=8,
        period_s=2e-3,
        tau=(0.5, 0.3),
        rolling=V,
    )
    assert overshoot(run.z[:, 0, 0]) == pytest.approx(math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2)), abs=2e-3)
    assert 100 * math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2)) == pytest.approx(percent, abs=0.05)


@pytest.mark.parametrize(("k2", "percent"), [(0.4, 0.0), (0.8, 0.0), (2.0, 16.0), (4.0, 37.6), (8.0, 64.6)])
def test_a_servo_makes_high_lateral_gains_overshoot(k2: float, percent: float) -> None:
    """Simulated reference figures, start 0.5 m to the left; the robot's own place is regained at the leader's pace only."""
    start = (-L, 0.5, 0.0)
    run = drive(Trajectory("straight"), [behind(0.8, k2=k2)], poses=[start], duration_s=30, tau=(0.5, 0.3), rolling=V)
    assert 100 * overshoot(run.z[:, 0, 1]) == pytest.approx(percent, rel=0.05, abs=0.5)
    assert settling_s(run.followers[:, 0, 1], 0.1, BAND) > 8.0


@pytest.mark.parametrize(("T", "k2_max"), [(0.1, 19.654), (0.5, 3.6536), (1.0, 1.6536), (2.0, 0.6536)])
def test_the_lateral_loop_is_stable_below_its_bound_only(T: float, k2_max: float) -> None:
    """k2 < 2/T - v/ell for small errors (0.1 mm); z2 changes sign at every tick near the bound."""
    assert k2_max == pytest.approx(2 / T - V / L, abs=5e-4)
    start = (-L, 1e-4, 0.0)
    for share, grows in ((0.95, False), (1.05, True)):
        run = drive(Trajectory("straight"), [behind(0.8, k2=share * k2_max)], poses=[start], duration_s=40 * T, period_s=T)
        early, late = np.abs(run.z[10:12, 0, 1]).max(), np.abs(run.z[-2:, 0, 1]).max()
        assert (late > early) == grows
