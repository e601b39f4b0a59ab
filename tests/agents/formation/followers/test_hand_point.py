import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.formation.followers.laws import FollowerPlace, axle_velocity, formation_law, hand_point, hand_velocity
from vcmvsp.agents.formation.reports.report import LeaderState
from vcmvsp.cosim.frames import arc

ANGLE = st.floats(-10.0, 10.0)
METRES = st.floats(-5.0, 5.0)
SPEED = st.floats(-1.0, 1.0)


@pytest.mark.parametrize("distance", [0.1, -0.17, 0.5])
@given(v=SPEED, w=SPEED, yaw=ANGLE)
def test_the_inverse_undoes_the_hand_point_transform(distance: float, v: float, w: float, yaw: float) -> None:
    ux, uy = hand_velocity(v, w, yaw, distance)
    assert axle_velocity(ux, uy, yaw, distance) == pytest.approx((v, w), abs=1e-12)


def test_a_hand_on_the_axle_is_refused() -> None:
    with pytest.raises(ValueError, match="must not lie on the axle"):
        axle_velocity(1.0, 0.0, 0.0, 0.0)


@given(x=METRES, y=METRES, yaw=ANGLE, v=SPEED, w=SPEED, distance=st.sampled_from([0.1, -0.17, 0.5]))
def test_the_hand_velocity_is_the_derivative_of_the_hand_point(
    x: float, y: float, yaw: float, v: float, w: float, distance: float
) -> None:
    h = 1e-5
    before, after = (hand_point(*arc((x, y, yaw), v, w, dt), distance) for dt in (-h, h))
    slope = [(b - a) / (2 * h) for a, b in zip(before, after, strict=True)]
    assert hand_velocity(v, w, yaw, distance) == pytest.approx(slope, abs=1e-8)


@given(x=METRES, y=METRES, th=ANGLE, lx=METRES, ly=METRES, lth=ANGLE, v=SPEED, w=SPEED, left=METRES, ell=st.floats(0.2, 2.0))
def test_the_law_moves_the_handle_with_its_point_and_towards_it(
    x: float, y: float, th: float, lx: float, ly: float, lth: float, v: float, w: float, left: float, ell: float
) -> None:
    """The same law by another road: velocity of the point (finite differences) + gains, turned into speeds by (3-4)."""
    place, k1, k2, h = FollowerPlace(0.3, left, ell), 0.8, 0.5, 1e-5

    def point(dt: float) -> complex:
        px, py, pth = arc((lx, ly, lth), v, w, dt)
        return complex(px, py) + complex(0.3, left) * complex(math.cos(pth), math.sin(pth))

    heading = complex(math.cos(th), math.sin(th))
    z = (point(0.0) - complex(*hand_point(x, y, th, ell))) / heading
    wanted = (point(h) - point(-h)) / (2 * h) + heading * complex(k1 * z.real, k2 * z.imag)
    law = formation_law((x, y, th), LeaderState(lx, ly, lth, v, w), place, k1, k2)
    assert (law.z1, law.z2) == pytest.approx((z.real, z.imag), abs=1e-12)
    assert (law.v, law.w) == pytest.approx(axle_velocity(wanted.real, wanted.imag, th, ell), abs=1e-6)
