"""When which speeds are sent."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.command_schedule import Steering, speeds
from vcmvsp.hardware.drivers.arcos.packet import Reader, parse_command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.motion import Motion

AMIGO = ROBOTS["amigo"]
MS = 1_000_000
ZERO = bytes.fromhex("fafb060b3b00000b3bfafb06153b0000153b")


def sent(steering: Steering, until_ms: int, *, commands: dict[int, tuple[float, float]] | None = None) -> dict[int, bytes]:
    """What is sent at which ms, when it is asked each ms."""
    out = {}
    for ms in range(until_ms):
        if commands and ms in commands:
            steering.command(commands[ms], ms * MS)
        if data := steering.packets(ms * MS):
            out[ms] = data
    return out


def test_golden_bytes() -> None:
    assert speeds(AMIGO, 0.2, math.radians(10), "vel") == bytes.fromhex("fafb060b3bc800d33b fafb06153b0a001f3b")
    assert speeds(AMIGO, -0.2, 0.0, "vel") == bytes.fromhex("fafb060b1bc800d31b fafb06153b0000153b")
    turn = 0.4 / AMIGO.track_m  # wheels at -0.2 and +0.2 m/s: ten steps each
    assert speeds(AMIGO, 0.0, turn, "vel2") == bytes.fromhex("fafb06203b0af62b31")


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.parametrize("mode", ["vel", "vel2"])
@given(v=st.floats(-5, 5), w=st.floats(-20, 20))
def test_the_robot_understands_what_was_meant(kind: str, mode: str, v: float, w: float) -> None:
    robot = ROBOTS[kind]
    v, w = (max(-most, min(most, each)) for each, most in ((v, robot.max_speed), (w, robot.max_yaw_rate)))
    motion = Motion(robot)
    motion.max_speed, motion.max_yaw_rate = math.inf, math.inf
    for data in Reader().feed(speeds(robot, v, w, mode)):  # type: ignore[arg-type]
        number, value = parse_command(data)
        assert isinstance(value, int)
        motion.take(number, value, 0.0)
    understood = motion.wanted(0.0)
    if mode == "vel":
        assert understood[0] == pytest.approx(v, abs=0.51e-3)
        assert understood[1] == pytest.approx(w, abs=math.radians(0.51))
        return
    slower = max(1.0, (abs(v) + abs(w) * robot.track_m / 2) / 2.54)  # no wheel beyond 127 steps of 20 mm/s
    assert understood[0] == pytest.approx(v / slower, abs=0.0101)
    assert understood[1] == pytest.approx(w / slower, abs=0.0201 / robot.track_m)


def test_zero_before_the_first_command_and_five_times_a_second() -> None:
    assert sent(Steering(AMIGO, "vel", 0.5), 1001) == dict.fromkeys(range(0, 1001, 200), ZERO)


def test_at_most_one_burst_a_cycle_and_the_newest_command_wins() -> None:
    steering = Steering(AMIGO, "vel", 0.5)
    out = sent(steering, 1000, commands={ms: (ms / 1e4, 0.0) for ms in range(5, 1000, 5)})
    times = list(out)
    assert min(b - a for a, b in pairwise(times)) == 100
    assert len(times) == 10
    for ms, data in list(out.items())[1:]:
        assert data == speeds(AMIGO, ms / 1e4, 0.0, "vel")


def test_zero_when_nobody_commands_any_more() -> None:
    steering = Steering(AMIGO, "vel", 0.5)
    out = sent(steering, 1500, commands={0: (0.2, 0.1)})
    moving = speeds(AMIGO, 0.2, 0.1, "vel")
    assert [ms for ms, data in out.items() if data == moving] == [100, 300]
    assert [ms for ms, data in out.items() if data == ZERO] == [0, 500, 600, 800, 1000, 1200, 1400]
    assert steering.stopped == "no command for 0.5 s"


def test_a_stop_waits_for_no_cycle_and_is_repeated_in_the_next() -> None:
    steering = Steering(AMIGO, "vel", 0.5)
    sent(steering, 11, commands={0: (0.2, 0.0)})
    steering.stop("geofence")
    assert steering.due_ns <= 11 * MS
    assert steering.packets(11 * MS) == ZERO
    assert steering.stopped == "geofence"
    assert steering.packets(110 * MS) == b""
    assert steering.packets(111 * MS) == ZERO
    steering.command((0.1, 0.0), 112 * MS)
    assert steering.stopped == ""
    assert steering.packets(211 * MS) == speeds(AMIGO, 0.1, 0.0, "vel")


@given(gaps=st.lists(st.integers(1, 900), max_size=8))
def test_due_is_when_something_happens(gaps: list[int]) -> None:
    """Asked only when it is due, it sends the same at the same times as when it is asked each millisecond."""
    given_at = [sum(gaps[: k + 1]) for k in range(len(gaps))]
    commands = dict.fromkeys(given_at, (0.1, 0.0))
    always = sent(Steering(AMIGO, "vel", 0.5), 2000, commands=commands)
    steering, out, now = Steering(AMIGO, "vel", 0.5), {}, 0
    while now < 2000:
        if now in commands:
            steering.command(commands[now], now * MS)
        if data := steering.packets(now * MS):
            out[now] = data
        now = min([max(now + 1, steering.due_ns // MS), *(ms for ms in given_at if ms > now)])
    assert out == always


def test_stopping_is_one_command_in_vel2() -> None:
    assert [parse_command(each) for each in Reader().feed(speeds(AMIGO, 0.0, 0.0, "vel2"))] == [(Command.VEL2, 0)]
