"""The simulated robot `Bench`."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.drivers.base import Driver, LinkLost, Sample
from vcmvsp.hardware.drivers.bench_robot import Bench

MS = 1_000_000


class Clock:
    """A clock set by the test."""

    def __init__(self) -> None:
        self.ns = 7_000_000_000

    def __call__(self) -> int:
        return self.ns


def drive(
    seconds: float, v: float = 0.3, w: float = 0.0, step_ms: int = 20, **options: Any
) -> tuple[Bench, list[Sample], Clock]:
    clock = Clock()
    robot = Bench(now=clock, **options)
    robot.open()
    return robot, list(_samples(robot, clock, seconds, v, w, step_ms)), clock


def _samples(robot: Bench, clock: Clock, seconds: float, v: float, w: float, step_ms: int) -> Iterator[Sample]:
    for _ in range(round(1000 * seconds / step_ms)):
        robot.write(Velocity(linear=(v, 0.0, 0.0), yaw_rate=w))
        clock.ns += step_ms * MS
        if (sample := robot.read()) is not None:
            yield sample


def test_moves_as_commanded_within_its_acceleration() -> None:
    robot, samples, _ = drive(5.0)
    assert isinstance(robot, Driver)
    assert robot.pose[0] == pytest.approx(0.3 * 5.0 - 0.3**2 / (2 * 0.3), abs=0.01)  # the ramp costs v2 / 2a
    assert samples[-1].odometry.v == pytest.approx(0.3)
    assert len(samples) in (49, 50)
    assert [each.number for each in samples] == list(range(1, len(samples) + 1))


def test_samples_are_late_by_latency_and_jitter_and_keep_their_order() -> None:
    _, samples, _ = drive(60.0, latency_s=0.05, jitter_s=0.3, step_ms=5)
    late = [each.arrived_ns - each.measured_ns for each in samples]
    assert min(late) >= 50 * MS
    assert 250 * MS < max(late) <= 350 * MS
    assert all(a.arrived_ns <= b.arrived_ns and a.number < b.number for a, b in pairwise(samples))


def test_drop_outs_have_the_stated_rate() -> None:
    _, samples, _ = drive(400.0, drop_out=0.25, v=0.0)
    assert len(samples) == pytest.approx(4000 * 0.75, abs=4 * math.sqrt(4000 * 0.25 * 0.75))


def test_odometry_drifts_and_the_truth_does_not() -> None:
    clean, _, _ = drive(20.0)
    scaled, samples, _ = drive(20.0, scale=1.1)
    assert scaled.pose == clean.pose
    assert samples[-1].odometry.pose[0] == pytest.approx(1.1 * clean.pose[0], rel=0.02)
    _, samples, _ = drive(20.0, turn_per_m=0.1)
    assert samples[-1].odometry.pose[2] == pytest.approx(0.1 * clean.pose[0], rel=0.02)
    clean, _, _ = drive(8.0)
    ends = [drive(8.0, slip=0.05, seed=seed, step_ms=100)[1][-1].odometry.pose[2] for seed in range(40)]
    spread = math.sqrt(sum(end * end for end in ends) / 40)
    assert spread == pytest.approx(0.05 * math.sqrt(clean.pose[0]), rel=0.4)  # 3.5 standard errors of 40 draws


def test_equal_seeds_repeat_and_others_differ() -> None:
    options: dict[str, Any] = {"jitter_s": 0.1, "drop_out": 0.2, "slip": 0.05}
    first, again, other = (drive(10.0, seed=seed, **options)[1] for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_the_call_rate_has_no_effect() -> None:
    rare, often = (drive(4.0, step_ms=step, v=0.2, w=0.3, slip=0.02)[0].pose for step in (400, 10))
    assert rare == often


def test_it_stops_without_commands() -> None:
    robot, _, clock = drive(3.0)
    before = robot.pose[0]
    clock.ns += 5000 * MS
    sample: Any = robot.read()
    assert sample.stopped == "no command for 0.5 s"
    assert sample.odometry.v == 0.0
    held = 0.5 - 0.02  # the last command is one step old
    assert robot.pose[0] - before == pytest.approx(0.3 * held + 0.3**2 / (2 * 0.75), abs=0.01)
    assert [(each.what, each.cause) for each in robot.notices()][1:] == [("stopped", "no command for 0.5 s")]


def test_a_stop_holds_until_the_next_command() -> None:
    robot, _, clock = drive(3.0)
    robot.stop("geofence")
    clock.ns += 1000 * MS
    assert robot.read().stopped == "geofence"  # type: ignore[union-attr]
    where = robot.pose
    clock.ns += 1000 * MS
    robot.read()
    assert robot.pose == where


def test_unplugged() -> None:
    robot, _, clock = drive(1.0, unplugged_s=2.0)
    clock.ns += 1001 * MS
    for call in (robot.read, robot.read, lambda: robot.write(Velocity())):
        with pytest.raises(LinkLost, match="robot at bench: the link is lost"):
            call()
    robot.stop("lost")
    assert [each.what for each in robot.notices()] == ["connected", "stopped", "lost", "stopped"]
    robot.close()
    robot.close()


def test_impossible_commands_are_refused() -> None:
    robot, _, _ = drive(1.0)
    for v, w in ((math.nan, 0.0), (0.0, math.inf)):
        with pytest.raises(ValueError, match="must be finite"):
            robot.write(Velocity(linear=(v, 0.0, 0.0), yaw_rate=w))
