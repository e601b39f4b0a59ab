"""Silence, clocks that jump, stops that last: exact times in nanoseconds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.hardware.supervised_flight import safety_of
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.safety.obstacles import Others, Polygon
from vcmvsp.hardware.safety.supervisor import Cause, Deadman, GroundSupervisor, LastReceived, Limits, clamp

pytestmark = pytest.mark.slow

MS = 10**6
SECOND = 10**9
AMIGO = Limits(max_speed=0.75, max_yaw_rate=1.74, accel=0.3, decel=0.75, yaw_accel=2.0, yaw_decel=2.0)
ROBOT = safety_of(AMIGO, radius_m=0.18)
FENCE = Polygon([(-9, -9), (9, -9), (9, 9), (-9, 9)])
SOURCES = ("operator", "command", "positioning", "federation")


def all_heard(now: int, **other: int | None) -> LastReceived:
    """All at ``now``, but for some."""
    return LastReceived(**({f"{name}_ns": now for name in SOURCES} | {f"{name}_ns": time for name, time in other.items()}))


@pytest.mark.parametrize("name", SOURCES)
def test_each_may_be_silent_for_exactly_its_time_out(name: str) -> None:
    deadman = Deadman(safety_of(AMIGO, radius_m=0.18, **{f"{name}_s": 0.3}))
    assert deadman.check(SECOND, all_heard(SECOND, **{name: SECOND - 300 * MS})) == ()
    assert deadman.check(SECOND, all_heard(SECOND, **{name: SECOND - 300 * MS - 1})) == (Cause(name),)


def test_what_is_not_waited_for_may_be_silent_for_ever() -> None:
    deadman = Deadman(safety_of(AMIGO, radius_m=0.18, **dict.fromkeys([f"{name}_s" for name in (*SOURCES, "clock")])))
    assert deadman.check(10**15, LastReceived()) == ()
    assert deadman.check(0, LastReceived()) == ()


def test_latched_causes_last_and_others_end_by_themselves() -> None:
    deadman = Deadman(ROBOT)
    late = all_heard(SECOND, operator=0, command=0)
    assert deadman.check(SECOND, late) == (Cause.OPERATOR, Cause.COMMAND)
    for now in range(SECOND + 100 * MS, 10 * SECOND, 100 * MS):
        assert deadman.check(now, all_heard(now)) == (Cause.OPERATOR,)


def test_what_was_never_heard_stops_without_latching() -> None:
    deadman = Deadman(ROBOT)
    assert deadman.check(0, LastReceived()) == tuple(Cause(name) for name in SOURCES)
    assert deadman.check(MS, all_heard(MS)) == ()


@pytest.mark.parametrize("then", [SECOND - 1, SECOND + 500 * MS + 1])
def test_a_clock_that_jumps_stops_for_good(then: int) -> None:
    deadman = Deadman(ROBOT)
    assert deadman.check(SECOND, all_heard(SECOND)) == ()
    assert deadman.check(then, all_heard(then)) == (Cause.CLOCK,)
    assert deadman.check(then + MS, all_heard(then + MS)) == (Cause.CLOCK,)


def test_what_is_heard_in_the_future_is_a_fault_of_the_clock() -> None:
    assert Deadman(ROBOT).check(SECOND, all_heard(SECOND, federation=SECOND + 1)) == (Cause.CLOCK,)


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.inf, math.nan])
def test_a_time_out_must_be_a_time(wrong: float) -> None:
    with pytest.raises(ValueError, match="positioning_s"):
        Deadman(safety_of(AMIGO, radius_m=0.18, positioning_s=wrong))


@settings(max_examples=600)
@given(steps=st.lists(st.tuples(st.integers(-(10**8), 10**9), *4 * (st.none() | st.integers(-(10**8), 10**9),)), max_size=8))
def test_the_causes_are_those_of_a_plain_reading_of_the_rules(
    steps: list[tuple[int, int | None, int | None, int | None, int | None]],
) -> None:
    deadman, limits = Deadman(ROBOT), (500 * MS, 500 * MS, SECOND, 500 * MS)
    now, held, before = 0, set[Cause](), None
    for elapsed, *ages in steps:
        now += elapsed
        causes = {Cause(n) for n, age, limit in zip(SOURCES, ages, limits, strict=True) if age is not None and age > limit}
        if any(age is not None and age < 0 for age in ages) or (before is not None and not 0 <= now - before <= 500 * MS):
            causes.add(Cause.CLOCK)
        held |= causes & {Cause.OPERATOR, Cause.FEDERATION, Cause.CLOCK}
        expected = causes | held | {Cause(n) for n, age in zip(SOURCES, ages, strict=True) if age is None}
        times = {f"{n}_ns": None if age is None else now - age for n, age in zip(SOURCES, ages, strict=True)}
        assert set(deadman.check(now, LastReceived(**times))) == expected
        before = now


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_stops_and_is_named(bad: float) -> None:
    parameters = safety_of(AMIGO, radius_m=0.18, fence=FENCE)
    one = Others(np.array([[5.0, 5.0]]), np.zeros((1, 2)), np.array([0.2]))
    ill = Others(np.array([[5.0, bad]]), np.zeros((1, 2)), np.array([0.2]))
    go, here = Velocity(linear=(0.5, 0.0, 0.0)), (0.0, 0.0, 0.0)
    cases = [
        (Velocity(linear=(bad, 0.0, 0.0)), here, one),
        (Velocity(yaw_rate=bad), here, one),
        (Velocity(linear=(0.5, bad, 0.0)), here, one),
        (go, (0.0, 0.0, bad), one),
        (go, here, ill),
    ]
    for command, pose, others in cases:
        supervisor = GroundSupervisor(parameters)
        supervisor.step(0, go, here, one, all_heard(0))
        supervisor.last = (0.5, 0.3)
        decision = supervisor.step(100 * MS, command, pose, others, all_heard(100 * MS))
        assert decision.stop
        assert decision.causes == decision.began == (Cause.NOT_FINITE,)
        assert (decision.command.linear[0], decision.command.yaw_rate) == pytest.approx((0.425, 0.1))


def test_a_missing_command_or_pose_stops_and_is_named() -> None:
    supervisor = GroundSupervisor(safety_of(AMIGO, radius_m=0.18, fence=FENCE))
    assert supervisor.step(0, None, None, None, all_heard(0)).causes == (Cause.COMMAND, Cause.POSITIONING)
    unfenced = GroundSupervisor(ROBOT)
    assert unfenced.step(0, Velocity(), None, None, all_heard(0)).causes == ()


def test_a_stop_is_told_once_and_lasts() -> None:
    supervisor = GroundSupervisor(ROBOT)
    go, told = Velocity(linear=(0.75, 0.0, 0.0)), []
    for tick in range(60):
        now = tick * 100 * MS
        decision = supervisor.step(now, go, None, None, all_heard(now, operator=min(now, 2 * SECOND)))
        told.append(decision)
    began = [(tick, decision.began) for tick, decision in enumerate(told) if Cause.OPERATOR in decision.began]
    assert began == [(26, (Cause.OPERATOR,))]  # the first step later than 2.5 s
    assert [tick for tick, decision in enumerate(told) if decision.stop] == list(range(26, 60))
    assert told[25].command.linear[0] == pytest.approx(0.75)
    assert told[26].command.linear[0] == pytest.approx(0.675)
    assert [decision.command.linear[0] for decision in told[36:]] == [0.0] * 24


def test_who_was_late_may_not_jump_in_speed() -> None:
    supervisor = GroundSupervisor(ROBOT)
    supervisor.step(0, Velocity(), None, None, all_heard(0))
    late = supervisor.step(400 * MS, Velocity(linear=(0.75, 0.0, 0.0)), None, None, all_heard(400 * MS))
    assert late.command.linear[0] == pytest.approx(0.03)


reals = st.floats(-5.0, 5.0)
anything = reals | st.sampled_from([math.nan, math.inf, -math.inf])


@settings(max_examples=1500)
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
