"""ARCOS commands of a velocity."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.command_schedule import speeds
from vcmvsp.hardware.drivers.arcos.packet import PacketReader, parse_command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.motion import SetPoints

AMIGO = ROBOTS["amigo"]


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
    motion = SetPoints(robot)
    motion.max_speed, motion.max_yaw_rate = math.inf, math.inf
    for data in PacketReader().feed(speeds(robot, v, w, mode)):  # type: ignore[arg-type]
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


def test_stopping_is_one_command_in_vel2() -> None:
    assert [parse_command(each) for each in PacketReader().feed(speeds(AMIGO, 0.0, 0.0, "vel2"))] == [(Command.VEL2, 0)]
