"""Samples from information packets: pose with wrapping counters, units, time of measurement."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp.cosim.types import ORIGIN
from vcmvsp.hardware.drivers.arcos.driver import ArcosSampler
from vcmvsp.hardware.drivers.arcos.protocol import Sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS

MS = 1_000_000
AMIGO = ROBOTS["amigo"]


def track(start: tuple[float, float, float] = ORIGIN) -> ArcosSampler:
    result = ArcosSampler(start)
    result.connect(AMIGO)
    return result


@given(st.lists(st.tuples(st.integers(-1500, 1500), st.integers(-1500, 1500), st.integers(-2000, 2000)), max_size=30))
def test_differences_add_up_over_every_wrap(steps: list[tuple[int, int, int]]) -> None:
    path, x, y, heading = track((3.0, -2.0, 1.0)), 32000, 5, 2040
    sample = path.add(Sip(x=x, y=y, heading=0), 0, "")
    path.connect(AMIGO)
    sample = path.add(Sip(x=x & 0x7FFF, y=y & 0x7FFF, heading=heading), 0, "")
    turned = 1.0 - AMIGO.angle_factor * heading
    for k, (dx, dy, turn) in enumerate(steps, 1):
        x, y, heading = x + dx, y + dy, heading + turn
        sip = Sip(x=x & 0x7FFF, y=y & 0x7FFF, heading=(heading + 2048) % 4096 - 2048)
        sample = path.add(sip, k * 1000 * MS, "")
    mm = 1e-3 * AMIGO.dist_factor
    east, north = mm * sum(step[0] for step in steps), mm * sum(step[1] for step in steps)
    c, s = math.cos(turned), math.sin(turned)
    expected = (
        3.0 + c * east - s * north,
        -2.0 + s * east + c * north,
        1.0 + AMIGO.angle_factor * sum(step[2] for step in steps),
    )
    assert sample.odometry.pose == pytest.approx(expected, abs=1e-9)


def test_the_first_packet_after_a_reconnection_only_sets_the_base() -> None:
    path = track((1.0, 2.0, 0.0))
    path.add(Sip(x=100, y=100), 0, "")
    before = path.add(Sip(x=300, y=100), 100 * MS, "")
    path.connect(AMIGO)
    after = path.add(Sip(x=0, y=0, heading=1024), 3000 * MS, "")
    assert after.odometry.pose == before.odometry.pose == pytest.approx((1.0 + 0.2 * 0.5083, 2.0, 0.0))
    assert (before.link, after.link) == (1, 2)
    ahead = path.add(Sip(x=0, y=200, heading=1024), 3100 * MS, "")  # its y axis is our x axis, along its heading
    assert ahead.odometry.pose == pytest.approx((1.0 + 0.4 * 0.5083, 2.0, 0.0))


def test_an_impossible_step_is_omitted_and_counted() -> None:
    path = track()
    path.add(Sip(x=8000), 0, "")
    sample = path.add(Sip(x=0), 100 * MS, "")  # 4 m in 0.1 s: the odometry was reset
    assert sample.odometry.pose == (0.0, 0.0, 0.0)
    assert path.leaps == 1
    assert path.add(Sip(x=100), 200 * MS, "").odometry.pose == pytest.approx((0.05083, 0.0, 0.0))


def test_speeds_and_battery() -> None:
    sample = track().add(Sip(left=100, right=300, battery=121), 0, "")
    factor = 1e-3 * AMIGO.vel_factor
    assert sample.wheels == pytest.approx((100 * factor, 300 * factor))
    assert sample.odometry.v == pytest.approx(200 * factor)
    assert sample.odometry.w == pytest.approx(100 * 0.6154 * 0.011)  # (R-L)/2 x DiffConvFactor, in rad/s
    assert sample.battery_v == pytest.approx(12.1)
    other = track().add(Sip(left=100, right=300, battery=255, battery_x10=268, charge_state=0, rotation=-900), 0, "")
    assert other.odometry.w == pytest.approx(-math.pi / 2)
    assert other.battery_v == pytest.approx(26.8)


def test_flags() -> None:
    sample = track().add(Sip(flags=0x20, stall=0x8103), 0, "geofence")
    assert (sample.motors, sample.emergency_stop, sample.stalled, sample.bumpers) == (False, True, (True, True), 0x8002)
    assert sample.stopped == "geofence"
    sample = track().add(Sip(flags=0x1F, stall=0x0100), 0, "")
    assert (sample.motors, sample.emergency_stop, sample.stalled, sample.bumpers) == (True, False, (False, True), 0)


def test_sonars_are_kept_until_read_and_the_newest_counts() -> None:
    path = track()
    path.add(Sip(sonars=((0, 1000), (1, 1500))), 0, "")
    assert path.add(Sip(sonars=((1, 1600), (7, 300))), 100 * MS, "").sonar == ((0, 1.0), (1, 1.6), (7, 0.3))
    path.clear_sonar()
    assert path.add(Sip(), 200 * MS, "").sonar == ()


@settings(max_examples=50)
@given(late=st.lists(st.integers(0, 40), min_size=30, max_size=60), period=st.sampled_from([99.5, 100.0, 100.5]))
def test_jitter_of_arrivals_is_removed(late: list[int], period: float) -> None:
    """Packets leave every period and arrive up to 40 ms late: the estimate is never later than the arrival and, after a packet
    with little delay, steadier than it.
    """
    path = track()
    late[0] = 0
    for k, delay in enumerate(late):
        sent = round(k * period * MS)
        sample = path.add(Sip(), sent + delay * MS, "")
        assert sample.arrived_ns == sent + delay * MS
        error = (sample.measured_ns + 50 * MS - sent) / MS
        assert -0.001 <= error <= delay
        assert error <= 1.6 * (k + 1)  # 1 % of slack and 0.5 % of the robot's clock per period, from the first, punctual packet


@pytest.mark.parametrize("period_ms", [50, 90, 110, 130])
def test_a_robot_of_another_period_is_never_far_off(period_ms: int) -> None:
    path = track()
    for k in range(300):
        sample = path.add(Sip(), k * period_ms * MS, "")
        assert 50 * MS <= sample.arrived_ns - sample.measured_ns <= 100 * MS


def test_a_gap_has_no_effect() -> None:
    path = track()
    path.add(Sip(), 0, "")
    sample = path.add(Sip(), 1030 * MS, "")  # nine are missing, this one is 30 ms late
    assert sample.measured_ns == pytest.approx(1000 * MS - 50 * MS, abs=11 * MS)
