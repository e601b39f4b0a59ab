"""Cases outside the random sequences: invalid timeouts, inputs without a timeout, limits of a single step."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hardware.safety.test_ground_laws import AMIGO, heard
from tests.support.hardware.supervised_flight import safety_of
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.safety.obstacles import Polygon
from vcmvsp.hardware.safety.supervisor import Cause, Deadman, GroundSupervisor, LastReceived, clamp

pytestmark = pytest.mark.slow

FENCE = Polygon([(-9, -9), (9, -9), (9, 9), (-9, 9)])
SOURCES = ("operator", "command", "positioning", "federation")


def test_inputs_without_a_timeout_may_be_silent() -> None:
    deadman = Deadman(safety_of(AMIGO, radius_m=0.18, **dict.fromkeys([f"{name}_s" for name in (*SOURCES, "clock")])))
    assert deadman.check(10**15, LastReceived()) == ()
    assert deadman.check(0, LastReceived()) == ()


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.inf, math.nan])
def test_a_time_out_must_be_a_time(wrong: float) -> None:
    with pytest.raises(ValueError, match="positioning_s"):
        Deadman(safety_of(AMIGO, radius_m=0.18, positioning_s=wrong))


def test_a_missing_command_or_pose_stops_and_is_named() -> None:
    supervisor = GroundSupervisor(safety_of(AMIGO, radius_m=0.18, fence=FENCE))
    assert supervisor.step(0, None, None, None, heard(0)).causes == (Cause.COMMAND, Cause.POSITIONING)
    unfenced = GroundSupervisor(safety_of(AMIGO, radius_m=0.18))
    assert unfenced.step(0, Velocity(), None, None, heard(0)).causes == ()


reals = st.floats(-5.0, 5.0)
anything = reals | st.sampled_from([math.nan, math.inf, -math.inf])


@settings(max_examples=700)
@given(v=anything, w=anything, last=st.tuples(st.floats(-0.75, 0.75), st.floats(-1.74, 1.74)), dt=st.floats(0.0, 2.0))
def test_limits_hold_for_anything_and_are_idempotent(v: float, w: float, last: tuple[float, float], dt: float) -> None:
    safe = clamp(v, w, last, dt, AMIGO)
    assert abs(safe[0]) <= 0.75
    assert abs(safe[1]) <= 1.74
    assert abs(safe[0]) <= abs(last[0]) + 0.3 * dt + 1e-12
    assert abs(safe[0] - last[0]) <= 0.75 * dt + 1e-12
    assert abs(safe[1] - last[1]) <= 2.0 * dt + 1e-12
    assert safe[0] * last[0] >= 0.0
    assert clamp(*safe, last, dt, AMIGO) == safe
    still = clamp(0.0, 0.0, last, dt, AMIGO)
    assert abs(still[0]) == pytest.approx(max(0.0, abs(last[0]) - 0.75 * dt))
    assert abs(still[1]) == pytest.approx(max(0.0, abs(last[1]) - 2.0 * dt))
    if not (math.isfinite(v) and math.isfinite(w)):
        assert safe == still
