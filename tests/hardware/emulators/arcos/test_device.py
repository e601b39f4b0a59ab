"""Emulated robot: sessions, motion, wheels and sonars, without a clock."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.hardware.arcos_client import AMIGO, SECOND, Client
from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.drivers.arcos.protocol import (
    CONFIG_PACKET,
    COUNT_MASK,
    HEADER,
    MOVING,
    STOPPED,
    Command,
    command,
    decode_config,
    frame,
)
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.device import GAP_NS, Device

pytestmark = pytest.mark.slow


@pytest.fixture
def client() -> Client:
    return Client(Device(AMIGO)).connect()


# Sessions


@pytest.mark.parametrize("kind", ROBOTS)
def test_handshake_sends_name_class_and_kind(kind: str) -> None:
    client = Client(Device(ROBOTS[kind], name="robbi"))
    assert client.reader.feed(client.device.receive(b"WMS2\r" + command(0), 0)) == [b"\0"]  # as to an old radio modem
    assert client.say(1) == [b"\1"]
    assert client.say(2) == [b"\2robbi\0Pioneer\0" + kind.encode() + b"\0"]
    assert client.run(1.0) == []  # packets only in an open session


@pytest.mark.parametrize("argument", [1, None])
def test_ten_packets_a_second_from_open_to_close(argument: int | None) -> None:
    client = Client(Device(AMIGO))
    for number in range(3):
        client.say(number)
    client.run(0.777)
    client.say(Command.OPEN, argument)
    assert len(client.run(10.0)) == 100
    client.say(Command.CLOSE, argument)
    assert client.run(10.0) == []
    client.connect()
    assert len(client.run(1.0)) == 10


def test_lost_answers_of_the_handshake_are_repeated() -> None:
    client = Client(Device(AMIGO))
    assert [client.say(number)[0][0] for number in (0, 0, 1, 1, 2, 2, 0, 1, 2)] == [0, 0, 1, 1, 2, 2, 0, 1, 2]


def test_an_unordered_handshake_restarts() -> None:
    client = Client(Device(AMIGO))
    assert client.say(1) == client.say(0)
    assert client.say(1) == [b"\1"]
    assert Client(Device(AMIGO)).say(2) == [b"\0"]


def test_an_old_session_answers_with_packets_until_it_is_closed() -> None:
    client = Client(Device(AMIGO, old_session=True))
    assert client.say(0) == []
    assert len(client.run(1.0)) == 10
    client.say(Command.CLOSE)
    assert client.run(1.0) == []
    assert client.say(0) == [b"\0"]


def test_in_an_old_session_the_first_byte_of_a_handshake_revives_the_last_speed() -> None:
    client = Client(Device(AMIGO, old_session=True))
    client.drive((Command.VEL, 200), seconds=1.0)
    client.run(5.0)
    assert client.device.commanded() == (0.0, 0.0)
    client.say(0)  # intended as SYNC0
    assert client.device.commanded() == (0.2, 0.0)


def test_configuration(client: Client) -> None:
    client.say(Command.SETV, 400)
    client.say(Command.SETA, 500)
    client.say(Command.SETA, -700)
    (answer,) = client.say(Command.CONFIG, 1)
    assert answer[0] == CONFIG_PACKET
    config = decode_config(answer)
    assert (config.robot_class, config.subclass, config.name, config.auto_baud) == ("Pioneer", "amigo", "emulated", 0)
    assert (config.top_speed, config.top_yaw_rate, config.sip_cycle, config.watchdog) == (1000, 300, 100, 2000)
    assert (config.max_speed, config.accel, config.decel) == (400, 500, 700)


# Watchdog


def test_two_seconds_of_silence_stop_it_and_any_command_revives_it(client: Client) -> None:
    client.drive((Command.VEL, 200), seconds=2.0)
    for _ in range(19):
        assert client.run(0.1)[0].kind == MOVING
    assert client.device.commanded()[0] == 0.2
    assert client.run(0.1)
    assert client.device.watchdog_stopped
    assert client.device.commanded()[0] == 0.0
    still = client.run(5.0)
    assert len(still) == 50  # stands, and still sends packets
    assert all(each.kind == STOPPED for each in still[5:])
    client.say(Command.PULSE)
    assert client.device.commanded()[0] == 0.2
    assert client.run(0.5)[-1].kind == MOVING


def test_the_watchdog_counts_from_open() -> None:
    client = Client(Device(AMIGO))
    client.run(60.0)
    client.connect().run(1.9)
    assert not client.device.watchdog_stopped
    client.run(0.1)
    assert client.device.watchdog_stopped


def test_garbage_is_no_sign_of_life(client: Client) -> None:
    client.drive((Command.VEL, 200), seconds=2.0)
    for _ in range(25):
        client.run(0.1)
        client.device.receive(b"\xfa\xfb\x06\x0b\x3b\xc8\x00\xff\xff", client.now)  # wrong checksum
    assert client.device.watchdog_stopped


def test_closing_stops_it_and_forgets_its_speed(client: Client) -> None:
    client.drive((Command.VEL, 200), seconds=2.0)
    client.say(Command.CLOSE)
    client.run(1.0)
    x = client.device.odometry
    client.connect().drive(seconds=1.0)
    assert client.device.odometry == x


# The line


@given(st.lists(st.integers(1, 400), min_size=1, max_size=20))
def test_the_call_rate_has_no_effect(pauses_ms: list[int]) -> None:
    def run(steps_ms: list[int]) -> tuple[bytes, Vec3]:
        client = Client(Device(AMIGO)).connect()
        client.say(Command.ENABLE, 1)
        client.say(Command.VEL, 300)
        client.say(Command.RVEL, 40)
        sent = b""
        for step in steps_ms:
            client.now += step * 1_000_000
            sent += client.device.advance(client.now)
        return sent, client.device.odometry

    assert run(pauses_ms) == run([sum(pauses_ms)])


def test_due_is_its_next_packet() -> None:
    device = Device(AMIGO)
    assert device.due_ns is None
    client = Client(device).connect()
    for _ in range(30):
        due = device.due_ns
        assert due is not None
        assert device.advance(due - 1) == b""
        assert device.advance(due)
    client.say(Command.CLOSE)
    assert device.due_ns is None
    device.receive(HEADER + b"\xc8" + command(0), 4 * SECOND)
    assert device.due_ns == 4 * SECOND + GAP_NS
    assert device.advance(4 * SECOND + GAP_NS) == frame(b"\0")


def test_noise_neither_breaks_it_nor_moves_it() -> None:
    draws = random.Random(1)
    client = Client(Device(AMIGO, old_session=True))
    pieces = (HEADER, b"\x06\x0b\x3b", b"\x06", b"\x0b\x3b\xc8\x00")
    for _ in range(20_000):
        client.device.receive(draws.choice(pieces) + draws.randbytes(draws.randrange(8)), client.now)
        client.now += 1_000_000
        assert client.device.commanded() == (0.0, 0.0)
    assert client.device.reader.bad_checksums > 1000


def test_well_framed_nonsense_is_ignored(client: Client) -> None:
    client.drive((Command.VEL, 200), seconds=1.0)
    before = len(client.device.heard)
    for data in (b"\x0b\x3b", b"\x0b\x3b\x01\x02\x03", b"\x0f\x2b\x07ab"):
        assert client.device.receive(frame(data), client.now) == b""
    assert len(client.device.heard) == before
    assert client.device.commanded() == (0.2, 0.0)


# Motion


def test_it_accelerates_holds_and_brakes_as_set(client: Client) -> None:
    x, _, _ = client.drive((Command.VEL, 200), seconds=3.0)
    assert x == pytest.approx(0.2 * 3.0 - 0.2**2 / (2 * AMIGO.accel), abs=2e-3)
    stopped, _, _ = client.drive((Command.STOP, 0), seconds=1.0)
    assert stopped - x == pytest.approx(0.2**2 / (2 * AMIGO.decel), abs=2e-3)


def test_estop_stands_without_braking(client: Client) -> None:
    x, _, _ = client.drive((Command.VEL, 400), seconds=3.0)
    client.say(Command.ESTOP)
    client.run(0.1)
    assert client.device.odometry[0] == x
    assert client.drive((Command.VEL, 400), seconds=1.0)[0] > x + 0.1


def test_wheel_speeds_and_rotation_are_sent_in_counts(client: Client) -> None:
    client.drive((Command.VEL, 200), (Command.RVEL, 30), seconds=3.0)
    sip = client.run(0.1)[-1]
    turning = math.radians(30) * 1e3 * AMIGO.track_m / 2
    assert sip.left == round((200 - turning) / AMIGO.vel_factor)
    assert sip.right == round((200 + turning) / AMIGO.vel_factor)
    assert sip.rotation == 300


@pytest.mark.parametrize("argument", [0x0A0A, 0xF60A, -0x09F6])  # the last one in ARIA's form
def test_vel2_sets_both_wheels(client: Client, argument: int) -> None:
    """20 mm/s per count, right wheel in the low byte."""
    client.say(Command.SETRV, 300)
    client.drive((Command.RVEL, 10), (Command.VEL2, argument), seconds=3.0)
    sip = client.run(0.1)[-1]
    left = 10 if argument == 0x0A0A else -10
    assert sip.right * AMIGO.vel_factor == pytest.approx(200, abs=0.5)
    assert sip.left * AMIGO.vel_factor == pytest.approx(20 * left, abs=0.5)


def test_vel_and_rvel_hold_side_by_side(client: Client) -> None:
    """A circle of radius v / w."""
    client.drive((Command.VEL, 200), (Command.RVEL, 36), seconds=2.0)
    before = client.device.odometry
    after = client.drive(seconds=5.0)
    assert math.dist(before[:2], after[:2]) == pytest.approx(2 * 0.2 / math.radians(36), abs=2e-3)


@pytest.mark.parametrize("mm", [500, -300, 1])
def test_move_ends_at_its_distance(client: Client, mm: int) -> None:
    pose = client.drive((Command.MOVE, mm), seconds=6.0)
    assert pose == pytest.approx((mm / 1e3, 0.0, 0.0), abs=3e-3)
    assert client.run(0.1)[-1].kind == STOPPED


def test_turns_end_at_their_heading(client: Client) -> None:
    def heading(number: Command, degrees: int) -> float:
        return math.degrees(client.drive((number, degrees), seconds=8.0)[2])

    assert heading(Command.DHEAD, 90) == pytest.approx(90, abs=0.5)
    assert heading(Command.DHEAD, -120) == pytest.approx(-30, abs=0.5)
    assert heading(Command.HEAD, 190) == pytest.approx(-170, abs=0.5)
    assert client.run(0.1)[-1].setpoint == round(math.radians(-170) / AMIGO.angle_factor)


@given(
    st.lists(st.tuples(st.integers(0, 255), st.none() | st.integers(-0x8000, 0xFFFF) | st.binary(max_size=20)), max_size=30),
    st.sampled_from(sorted(ROBOTS)),
)
def test_no_command_exceeds_its_greatest_speeds(commands: list[tuple[int, int | bytes | None]], kind: str) -> None:
    robot = ROBOTS[kind]
    client = Client(Device(robot)).connect()
    client.say(Command.ENABLE, 1)
    for number, argument in commands:
        client.say(number, argument)
        client.run(0.05)
        v, w = client.device.commanded()
        assert abs(v) <= robot.max_speed
        assert abs(w) <= robot.max_yaw_rate


def test_a_new_command_ends_a_move_and_a_turn(client: Client) -> None:
    client.drive((Command.MOVE, 200), (Command.DHEAD, 30), seconds=0.5)
    client.say(Command.VEL, -100)
    client.say(Command.RVEL, 20)
    assert client.device.commanded() == (-0.1, math.radians(20))
    client.say(Command.MOVE, 200)
    client.say(Command.DHEAD, 30)
    client.say(Command.STOP)
    assert client.device.commanded() == (0.0, 0.0)


def test_limits_and_baud_rate_hold_until_the_end_of_the_session(client: Client) -> None:
    client.say(Command.SETV, 100)
    client.say(Command.SETRV, 20)
    client.drive((Command.VEL, 900), (Command.RVEL, -200), seconds=2.0)
    assert client.device.commanded() == (0.1, -math.radians(20))
    client.say(Command.HOSTBAUD, 2)
    assert client.device.baud == 38400
    client.say(Command.CLOSE)
    assert client.device.baud == 9600
    client.connect().say(Command.ENABLE, 1)
    client.say(Command.VEL, 300)
    assert client.device.commanded() == (0.3, 0.0)


def test_without_motors_nothing_moves_and_the_last_speed_waits(client: Client) -> None:
    client.say(Command.VEL, 200)
    assert [each.motors_on for each in client.run(1.0)] == [False] * 10
    assert client.device.odometry == (0.0, 0.0, 0.0)
    assert client.drive(seconds=1.0)[0] > 0.05
    client.say(Command.ENABLE, 0)
    assert client.device.commanded() == (0.0, 0.0)
    client.say(Command.ENABLE, 1)
    assert client.device.commanded() == (0.0, 0.0)


# Odometry and sonars


def test_seto_makes_here_and_now_the_origin(client: Client) -> None:
    client.drive((Command.VEL, 200), (Command.RVEL, 20), seconds=3.0)
    client.drive((Command.STOP, 0), seconds=1.0)
    client.say(Command.SETO)
    sip = client.run(0.1)[-1]
    assert (sip.x, sip.y, sip.heading) == (0, 0, 0)


@pytest.mark.parametrize("kind", ROBOTS)
def test_positions_wrap_at_15_bits_and_differences_do_not(kind: str) -> None:
    """A host drives it 100 m along its x axis, which does not point east, and backwards in y."""
    robot = ROBOTS[kind]
    device = Device(robot, start=None)
    client = Client(device).connect()
    device.moved((3.0, -2.0, 0.5), 0.0, 0.0)
    total, last = [0, 0], None
    for k in range(2001):
        ahead, left = 0.05 * k, -0.03 * k
        x = 3.0 + ahead * math.cos(0.5) - left * math.sin(0.5)
        device.moved((x, -2.0 + ahead * math.sin(0.5) + left * math.cos(0.5), 0.5), 0.5, 0.0)
        (sip,) = client.run(0.1)
        assert max(sip.x, sip.y) <= COUNT_MASK
        if last is not None:
            for i, (new, old) in enumerate(((sip.x, last.x), (sip.y, last.y))):
                total[i] += (new - old + 0x4000) % 0x8000 - 0x4000
        last = sip
    assert [each * robot.dist_factor / 1e3 for each in total] == pytest.approx([100.0, -60.0], abs=2e-3)


def test_a_moving_host_gets_its_command() -> None:
    device = Device(AMIGO, start=None)
    client = Client(device).connect()
    client.say(Command.ENABLE, 1)
    client.say(Command.VEL, 200)
    client.say(Command.RVEL, -10)
    client.run(1.0)
    assert device.odometry == (0.0, 0.0, 0.0)  # not moved by the host
    assert device.commanded() == (0.2, -math.radians(10))
    device.moved((5.0, 5.0, 1.0), 0.2, 0.0, stall=0x0101)
    sip = client.run(0.1)[-1]
    assert (sip.x, sip.y, sip.stalled) == (0, 0, (True, True))
    with pytest.raises(ValueError, match="8 sonars, not 3"):
        device.moved((5.0, 5.0, 1.0), 0.2, 0.0, ranges=(1.0, 1.0, 1.0))


@pytest.mark.parametrize("kind", ROBOTS)
def test_each_sonar_fires_once_per_round(kind: str) -> None:
    """Arrays of 8 fire every 40 ms, a round takes 320 ms; 1.6 s are five rounds and 16 packets."""
    robot = ROBOTS[kind]
    device = Device(robot)
    client = Client(device).connect()
    ranges = [0.5 + 0.1 * each for each in range(len(robot.sonars))]
    ranges[3] = math.inf
    device.moved((0.0, 0.0, 0.0), 0.0, 0.0, ranges)
    sips = client.run(1.6)
    numbers = [number for each in sips for number, _ in each.sonars]
    assert sorted(numbers) == sorted(5 * list(range(len(robot.sonars))))
    assert all(len(each.sonars) in (2 * len(robot.sonars) // 8, 3 * len(robot.sonars) // 8) for each in sips)
    for number, counts in (reading for each in sips for reading in each.sonars):
        assert counts * robot.range_factor / 1e3 == pytest.approx(min(ranges[number], 5.0), abs=1e-3)
    with pytest.raises(ValueError, match="multiple of 5 ms, not 12"):
        Device(robot, ping_ms=12)
    client.run(0.05)  # some sonars have fired
    client.say(Command.SONAR, 0)
    assert all(each.sonars == () and each.flags & 0x1E == 0 for each in client.run(1.0))
