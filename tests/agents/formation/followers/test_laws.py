"""The control law against its proof and its closed forms (Toh 2012, chapter 3, corrected)."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Pose, drive
from vcmvsp.agents.formation.followers.laws import Demand, FollowerPlace, axle_velocity, formation_law, hand_point
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.report import LeaderState
from vcmvsp.cosim.frames import arc

pytestmark = pytest.mark.slow

L, LEFT = math.cos(math.radians(30.0)), 0.5  # the standard triangle: 1 m at +-30 degrees
V, W, R = 0.3, 0.15, 2.0


def triangle(**params: float) -> list[LeaderFollower]:
    return [LeaderFollower("leader", 1.0, bearing, **params) for bearing in (30.0, -30.0)]  # type: ignore[arg-type]


def behind(k1: float, **params: float) -> LeaderFollower:
    """A follower whose slot is L straight behind the leader, free to reverse so that the loop stays linear."""
    return LeaderFollower("leader", L, k1=k1, max_reverse=1e9, **params)  # type: ignore[arg-type]


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


@pytest.mark.parametrize(("distance", "bearing"), [(0.8, 90.0), (0.8, -90.0), (0.8, 180.0), (1.0, 150.0)])
def test_with_a_handle_every_slot_can_be_kept(distance: float, bearing: float) -> None:
    """Abreast and ahead of the leader too: |z| -> 0 on the circle."""
    run = drive(Trajectory("circle"), [LeaderFollower("leader", distance, bearing, handle=0.4)], duration_s=60)
    assert run.error[-1, 0] < 1e-6


@pytest.mark.parametrize("delay_ticks", [0, 1, 5])
def test_a_chain_of_followers_that_report_measured_speeds_settles_on_a_circle(delay_ticks: int) -> None:
    """A column of four; each member receives reports of its predecessor only."""
    column = [LeaderFollower(parent, 0.8, handle=0.5, broadcast=True) for parent in ("leader", "f0", "f1")]
    starts = [(-0.8, 0.1, 0.0), (-1.6, -0.1, 0.2), (-2.4, 0.0, -0.2)]
    run = drive(Trajectory("circle"), column, poses=starts, duration_s=90, delay_ticks=delay_ticks)
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


# --- law of the hand point ---


ANGLE = st.floats(-10.0, 10.0)
METRES = st.floats(-5.0, 5.0)
SPEED = st.floats(-1.0, 1.0)


def test_a_hand_on_the_axle_is_refused() -> None:
    with pytest.raises(ValueError, match="must not lie on the axle"):
        axle_velocity(1.0, 0.0, 0.0, 0.0)


@given(x=METRES, y=METRES, yaw=ANGLE, v=SPEED, w=SPEED, distance=st.sampled_from([0.1, -0.17, 0.5]))
def test_speeds_of_the_axle_give_the_hand_point_its_velocity(
    x: float, y: float, yaw: float, v: float, w: float, distance: float
) -> None:
    h = 1e-5
    before, after = (hand_point(*arc((x, y, yaw), v, w, dt), distance) for dt in (-h, h))
    ux, uy = ((b - a) / (2 * h) for a, b in zip(before, after, strict=True))
    assert axle_velocity(ux, uy, yaw, distance) == pytest.approx((v, w), abs=1e-7)


@given(x=METRES, y=METRES, th=ANGLE, lx=METRES, ly=METRES, lth=ANGLE, v=SPEED, w=SPEED, left=METRES, ell=st.floats(0.2, 2.0))
def test_the_law_moves_the_handle_with_its_point_and_towards_it(
    x: float, y: float, th: float, lx: float, ly: float, lth: float, v: float, w: float, left: float, ell: float
) -> None:
    """Velocity of the point (finite differences) + gains, turned into speeds by (3-4): V' = -k1 z1^2 - k2 z2^2 follows."""
    place, k1, k2, h = FollowerPlace(0.3, left, ell), 0.8, 0.5, 1e-5

    def point(dt: float) -> complex:
        px, py, pth = arc((lx, ly, lth), v, w, dt)
        return complex(px, py) + complex(0.3, left) * complex(math.cos(pth), math.sin(pth))

    heading = complex(math.cos(th), math.sin(th))
    z = (point(0.0) - complex(*hand_point(x, y, th, ell))) / heading
    velocity = (point(h) - point(-h)) / (2 * h) + heading * complex(k1 * z.real, k2 * z.imag)
    law = formation_law((x, y, th), LeaderState(lx, ly, lth, v, w), place, k1, k2)
    assert (law.z1, law.z2) == pytest.approx((z.real, z.imag), abs=1e-12)
    assert (law.v, law.w) == pytest.approx(axle_velocity(velocity.real, velocity.imag, th, ell), abs=1e-6)
