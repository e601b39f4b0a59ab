"""Handshake with the emulated robot in logical time, in any state of the robot and with losses."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.rng import stream
from vcmvsp.hardware.drivers.arcos.handshake import Handshake, Settings
from vcmvsp.hardware.drivers.arcos.protocol import Command, PacketReader, command, frame, parse_command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.drivers.base import HandshakeError
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import Faults, Wire

MS = 1_000_000


def handshake(**options: object) -> Handshake:
    defaults: dict[str, object] = {"device": "/dev/x", "kind": "", "settings": Settings(), "baud": 9600, "give_up_s": 10.0}
    return Handshake(**(defaults | options))  # type: ignore[arg-type]


def shake_hands(
    client: Handshake, robot: Device, *, faults: Faults | None = None, start_ns: int = 0
) -> list[tuple[int, bytes]]:
    """Runs the handshake in steps of 1 ms; returns the client's data with times, ns."""
    faults = faults or Faults()
    down, up = (Wire(faults, stream(faults.seed, name)) for name in ("down", "up"))
    sent = [(start_ns, client.start(start_ns))]
    down.push(sent[0][1], start_ns)
    now = start_ns
    while not client.is_done:
        now += MS
        up.push(robot.receive(down.pop(now), now), now)
        data = up.pop(now)
        answer = client.receive(data, now) if data else client.advance(now)
        if answer:
            sent.append((now, answer))
            down.push(answer, now)
    return sent


def commands(data: bytes) -> list[tuple[int, int | bytes | None]]:
    return [parse_command(each) for each in PacketReader().feed(data)]


def test_connects_and_leaves_the_robot_standing_with_motors_on_after_zero_speeds() -> None:
    robot, client = Device(ROBOTS["p2dx"], name="rosa"), handshake()
    sent = shake_hands(client, robot)
    assert client.robot is ROBOTS["p2dx"]
    assert client.name == "rosa"
    assert robot.is_open
    assert robot.motors_on
    assert robot.odometry == (0.0, 0.0, 0.0)
    line = b"".join(data for _, data in sent)
    assert line.startswith(bytes.fromhex("fafb060b3b00000b3b fafb06153b0000153b fafb03000000"))  # zero speed comes first
    orders = commands(line)
    others = [number for number, _ in orders if number not in (Command.VEL, Command.RVEL)]
    assert others == [0, 1, 2, 1, Command.CONFIG, Command.ENABLE]
    enable = orders.index((Command.ENABLE, 1))
    assert orders[enable - 3 : enable - 1] == [(Command.VEL, 0), (Command.RVEL, 0)]
    assert all(argument == 0 for number, argument in orders if number in (Command.VEL, Command.RVEL))


@pytest.mark.parametrize("turning", [0, 30])
def test_a_robot_stopped_by_its_watchdog_stays_stopped(turning: int) -> None:
    robot = Device(ROBOTS["amigo"], old_session=True)
    robot.receive(command(Command.VEL, 200) + command(Command.RVEL, turning), 0)
    robot.advance(6000 * MS)
    assert robot.watchdog_stopped
    before = robot.odometry
    assert before[0] != 0.0
    shake_hands(handshake(), robot, start_ns=6000 * MS)
    robot.advance(12_000 * MS)
    assert robot.odometry == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_connects_over_a_bad_line(seed: int) -> None:
    """One byte in 250 is lost, one in 250 changed, in both directions: about 7 % of 9-byte packets, 38 % of 59-byte packets."""
    robot, client = Device(ROBOTS["amigo"], old_session=seed % 2 == 1), handshake(give_up_s=60.0)
    shake_hands(client, robot, faults=Faults(drop=0.004, flip=0.004, split=0.01, seed=seed))
    assert robot.is_open
    assert robot.motors_on


def test_garbage_before_the_answers_has_no_effect() -> None:
    robot, client = Device(ROBOTS["amigo"]), handshake()
    robot.receive(b"WMS2\r", 0)
    answer = client.start(0)
    now = 0
    while not client.is_done:
        now += MS
        reply = robot.receive(answer, now)
        answer = client.receive(b"login: \xfa\xfa\xfb\x00" + reply, now) if reply else client.advance(now)
    assert now < 1000 * MS


def test_an_answer_behind_a_false_header_is_found_after_a_wait() -> None:
    """Noise announces a packet of 200 bytes that never arrive; the answer behind it counts after the wait."""
    client = handshake()
    client.start(0)
    assert client.receive(b"\xfa\xfb\xc8" + frame(b"\0"), 10 * MS) == b""
    assert client.advance(client.due_ns) == command(1)


def test_settings_are_sent_in_the_robots_units() -> None:
    robot = Device(ROBOTS["p2dx"])
    settings = Settings(max_speed=0.6, accel=0.25, decel=0.5, max_yaw_rate=1.0, yaw_accel=2.0)
    shake_hands(handshake(settings=settings), robot)
    motion = robot.motion
    assert (motion.max_speed, motion.accel, motion.decel) == pytest.approx((0.6, 0.25, 0.5))
    assert (motion.max_yaw_rate, motion.yaw_accel, motion.yaw_decel) == pytest.approx((1.0, 2.0, 2.0), abs=0.01)


def test_the_wrong_kind_and_motors_that_stay_off_are_named() -> None:
    robot = Device(ROBOTS["amigo"], name="rosa")
    with pytest.raises(HandshakeError, match=r"/dev/x: the robot is of kind amigo \(rosa\), not p2dx; set robot = 'amigo'"):
        shake_hands(handshake(kind="p2dx"), robot)
    robot.estop_pressed = True
    with pytest.raises(HandshakeError, match="its motors stay off; release the stop button"):
        shake_hands(handshake(give_up_s=2.5), robot, start_ns=robot.now_ns)


def test_kinds_are_compared_without_case_and_unknown_ones_are_named() -> None:
    def connect(names: bytes) -> Handshake:
        client = handshake()
        client.start(0)
        for data in (b"\x00", b"\x01", b"\x02" + names):
            client.receive(frame(data), 0)
        return client

    assert connect(b"x\0Pioneer\0P2DX\0").robot is ROBOTS["p2dx"]
    with pytest.raises(HandshakeError, match=r"Pioneer 'peoplebot', whose parameters are unknown; .*p2dx, amigo, amigo-sh"):
        connect(b"x\0Pioneer\0peoplebot\0")
    with pytest.raises(HandshakeError, match="the link echoes all bytes; check for a loop-back"):
        connect(b"")


def error_text(data: bytes) -> str:
    """Error text after ten seconds of repeated input."""
    client, now = handshake(), 0
    client.start(now)
    while now < 20_000 * MS:
        now += 10 * MS
        try:
            if data:
                client.receive(data, now)
            client.advance(now)
        except HandshakeError as error:
            assert now == 10_000 * MS
            return str(error)
    pytest.fail("it never gave up")


def test_causes_of_failure() -> None:
    assert "no byte was received for 10 s; check that the robot is on" in error_text(b"")
    assert "but no packet; the baud rate may be wrong (it is 9600; try 19200, 38400, 57600, 115200)" in error_text(
        b"\x80\xff\x00"
    )
    assert "another client may be connected" in error_text(frame(b"\x32" + bytes(24)))


@given(st.lists(st.one_of(st.binary(min_size=1, max_size=60), st.binary(max_size=60).map(lambda rest: b"\x32" + rest))))
def test_any_packets_connect_or_give_an_error(packets: list[bytes]) -> None:
    """Packets of any content, at every stage."""
    for echoes in ([], [b"\0"], [b"\0", b"\1"], [b"\0", b"\1", b"\2x\0Pioneer\0amigo\0"]):
        client, now = handshake(), 0
        client.start(now)
        with suppress(HandshakeError):
            for data in echoes + packets:
                now += 100 * MS
                client.receive(frame(data), now)
                client.advance(now)
            assert not client.is_done or client.robot is not None
