"""The emulated robot: what clients see of it in a session, and what it survives. No clock runs here."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.hardware.arcos_client import AMIGO, SECOND, Client
from vcmvsp.hardware.drivers.arcos.command_numbers import CONFIG_PACKET, Command
from vcmvsp.hardware.drivers.arcos.config_packet import decode_config
from vcmvsp.hardware.drivers.arcos.packet import HEADER, command, frame
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.drivers.arcos.sip import MOVING, STOPPED
from vcmvsp.hardware.emulators.arcos.device import GAP_NS, Device
from vcmvsp.hardware.emulators.arcos.motion import Pose


@pytest.fixture
def client() -> Client:
    return Client(Device(AMIGO)).connect()


# Sessions


@pytest.mark.parametrize("kind", ROBOTS)
def test_handshake_tells_name_class_and_kind(kind: str) -> None:
    client = Client(Device(ROBOTS[kind], name="robbi"))
    assert client.reader.feed(client.device.receive(b"WMS2\r" + command(0), 0)) == [b"\0"]  # as to an old radio modem
    assert client.say(1) == [b"\1"]
    assert client.say(2) == [b"\2robbi\0Pioneer\0" + kind.encode() + b"\0"]
    assert client.run(1.0) == []  # packets only flow in an open session


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


def test_answers_of_the_handshake_that_are_lost_may_be_asked_for_again() -> None:
    client = Client(Device(AMIGO))
    assert [client.say(number)[0][0] for number in (0, 0, 1, 1, 2, 2, 0, 1, 2)] == [0, 0, 1, 1, 2, 2, 0, 1, 2]


def test_a_handshake_out_of_turn_begins_again() -> None:
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
    client.say(0)  # meant as SYNC0
    assert client.device.commanded() == (0.2, 0.0)


def test_configuration(client: Client) -> None:
    client.say(Command.SETV, 400)
    client.say(Command.SETA, 500)
    client.say(Command.SETA, -700)
    (answer,) = client.say(Command.CONFIG, 1)
    assert answer[0] == CONFIG_PACKET
    told = decode_config(answer)
    assert (told.robot_class, told.subclass, told.name, told.auto_baud) == ("Pioneer", "amigo", "emulated", 0)
    assert (told.top_speed, told.top_yaw_rate, told.sip_cycle, told.watchdog) == (1000, 300, 100, 2000)
    assert (told.max_speed, told.accel, told.decel) == (400, 500, 700)


def test_baud_rate_is_set_and_forgotten_with_the_session(client: Client) -> None:
    client.say(Command.HOSTBAUD, 2)
    assert client.device.baud == 38400
    client.say(Command.CLOSE)
    assert client.device.baud == 9600


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
    assert len(still) == 50  # it stands, and goes on telling
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


def test_zero_speed_first_makes_it_stay(client: Client) -> None:
    client.drive((Command.VEL, 200), (Command.RVEL, 20), seconds=2.0)
    client.run(5.0)
    client.say(Command.VEL, 0)
    client.say(Command.RVEL, 0)
    x = client.device.odometry
    client.say(Command.PULSE)
    client.run(1.0)
    assert client.device.odometry == pytest.approx(x, abs=1e-3)


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
def test_it_does_not_matter_how_often_it_is_asked(pauses_ms: list[int]) -> None:
    def run(steps_ms: list[int]) -> tuple[bytes, Pose]:
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


def test_due_is_when_it_speaks_next() -> None:
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


def test_a_false_header_delays_a_command_by_no_more_than_the_gap(client: Client) -> None:
    client.drive((Command.VEL, 200), seconds=2.0)
    client.device.receive(HEADER + b"\xc8" + command(Command.STOP), client.now)
    assert client.device.commanded()[0] == 0.2
    client.run(0.2)
    assert client.device.commanded()[0] == 0.0


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
