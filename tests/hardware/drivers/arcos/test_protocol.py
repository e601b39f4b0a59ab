"""ARCOS messages: known bytes, round trips, positions of fields, and frames on a noisy line."""

import contextlib
import math
import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.arcos.protocol import (
    HEADER,
    MAX_BYTES,
    Command,
    Config,
    PacketReader,
    Sip,
    checksum,
    command,
    decode_config,
    decode_sip,
    encode_config,
    encode_sip,
    frame,
    parse_command,
    setting_warnings,
    speeds,
)
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.device import SetPoints

pytestmark = pytest.mark.slow

GOLDEN = [  # AmigoBot manual; frames sent to simulators of other makers
    ("fafb03000000", 0, None),
    ("fafb03020002", 2, None),
    ("fafb06043b0100053b", 4, 1),
    ("fafb060b3bc800d33b", 11, 200),
    ("fafb060b1bc800d31b", 11, -200),
    ("fafb06153b0a001f3b", 21, 10),
    ("fafb031d001d", 29, None),
    ("fafb06203b0af62b31", 32, 0xF60A),
]
SEND = [bytes.fromhex(each) for each, _, _ in GOLDEN]
packets = st.binary(min_size=1, max_size=MAX_BYTES - 2)


@pytest.mark.parametrize(("line", "number", "argument"), GOLDEN)
def test_known_commands(line: str, number: int, argument: int | None) -> None:
    assert command(number, argument).hex() == line
    (data,) = PacketReader().feed(bytes.fromhex(line))
    assert parse_command(data) == (number, argument)


def test_checksum_of_an_odd_length_takes_the_last_byte_into_the_low_one() -> None:
    assert checksum(b"\x12\x34\xff\xff\x56") == ((0x1234 + 0xFFFF) & 0xFFFF) ^ 0x56


TEXTS = st.text(st.characters(max_codepoint=255), max_size=MAX_BYTES - 5)


@given(st.integers(0, 255), st.none() | st.integers(-0x8000, 0xFFFF) | TEXTS | st.just(bytes(13)))
def test_arguments_survive(number: int, argument: int | str | bytes | None) -> None:
    (data,) = PacketReader().feed(command(number, argument))
    assert parse_command(data) == (number, argument.encode("latin-1") if isinstance(argument, str) else argument)


@pytest.mark.parametrize("argument", [0x10000, -0x8001, "x" * 196, bytes(198)])
def test_oversized_ones_are_refused(argument: int | str | bytes) -> None:
    with pytest.raises(ValueError, match=r"a command|a packet"):
        command(11, argument)


@pytest.mark.parametrize("data", [b"", b"\x0b\x3b", b"\x0b\x3b\x01", b"\x0b\x1b\x01\x02\x03", b"\x0f\x2b", b"\x0f\x2b\x03ab"])
def test_malformed_commands_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="command"):
        parse_command(data)


@given(st.lists(st.one_of(packets.map(frame), st.binary(max_size=30)), max_size=8), st.data())
def test_any_split_of_the_stream_is_read_equally(parts: list[bytes], data: st.DataObject) -> None:
    line = b"".join(parts)
    whole, cut, found, start = PacketReader(), PacketReader(), [], 0
    while start < len(line):
        end = data.draw(st.integers(start + 1, len(line)))
        found += cut.feed(line[start:end])
        start = end
    assert found == whole.feed(line)
    assert (cut.dropped_bytes, cut.bad_checksums, cut.waiting) == (whole.dropped_bytes, whole.bad_checksums, whole.waiting)


@given(st.lists(packets, max_size=6))
def test_packets_in_a_row_are_all_found_and_nothing_is_dropped(sent: list[bytes]) -> None:
    reader = PacketReader()
    assert reader.feed(b"".join(frame(each) for each in sent)) == sent
    assert (reader.dropped_bytes, reader.bad_checksums, reader.waiting) == (0, 0, 0)


@pytest.mark.parametrize("line", SEND)
def test_one_changed_bit_is_always_detected(line: bytes) -> None:
    for bit in range(8 * len(line)):
        bad = bytearray(line)
        bad[bit // 8] ^= 1 << bit % 8
        assert PacketReader().feed(bytes(bad) + bytes([0x55] * MAX_BYTES)) == []


@pytest.mark.parametrize("line", SEND)
def test_one_lost_byte_costs_exactly_one_packet(line: bytes) -> None:
    for lost in range(len(line)):
        reader = PacketReader()
        found = reader.feed(line[:lost] + line[lost + 1 :] + b"".join(SEND) * 8)
        assert found == [each[3:-2] for each in SEND] * 8
        assert reader.dropped_bytes == len(line) - 1


def test_a_packet_behind_garbage_is_found_after_the_announced_bytes() -> None:
    """100 000 streams with many false headers. A packet is lost only if false bytes happen to have the right checksum
    (2**-16).
    """
    draws = random.Random(1)
    late, false, announced = 0, 0, 0
    for _ in range(100_000):
        garbage = b"".join(
            draws.choice((b"\xfa", b"\xfb", HEADER + bytes((draws.randint(0, 255),)), draws.randbytes(3)))
            for _ in range(draws.randrange(8))
        )
        data = draws.randbytes(draws.randint(1, 9))
        reader = PacketReader()
        found = reader.feed(garbage + frame(data))
        late += data not in found
        found += reader.feed(b"\x55" * MAX_BYTES)
        announced += reader.bad_checksums
        assert data in found or len(found) > 0  # otherwise replaced by an overlapping false packet
        false += len(found) - (data in found)
        if found == [data]:
            assert reader.dropped_bytes == len(garbage) + MAX_BYTES
    assert late > 10_000  # the streams contain the case under test
    assert announced > 50_000
    assert false < 12  # announced / 2**16 is 1


def test_a_noisy_line_gives_no_unsent_commands() -> None:
    """Bytes lost, changed and inserted, each with probability 1 %. Two changes in one packet may cancel out in its checksum."""
    draws = random.Random(3)
    sent, got, false = 0, 0, 0
    for _ in range(5_000):
        commands = [draws.choice(SEND) for _ in range(10)]
        reader = PacketReader()
        found = reader.feed(bytes(_corrupted(b"".join(commands), draws)) + b"\x55" * MAX_BYTES)
        false += sum(frame(each) not in commands for each in found)
        sent, got = sent + len(commands), got + len(found)
    assert 0.75 * sent < got < 0.85 * sent  # 0.97 to the power of 7.5 bytes
    assert false <= 12  # 2 to 3 are expected: 14 of 240 000 on a longer run, none of 280 000 where bytes are only lost


def _corrupted(line: bytes, draws: random.Random) -> bytearray:
    out = bytearray()
    for byte in line:
        luck = draws.random()
        if luck < 0.01:
            continue
        out.append(byte ^ 1 << draws.randrange(8) if luck < 0.02 else byte)
        if luck > 0.99:
            out.append(draws.randrange(256))
    return out


def test_a_false_header_holds_commands_back_only_until_the_reader_gives_up() -> None:
    reader = PacketReader()
    assert reader.feed(HEADER + b"\xc8" + command(29)) == []
    assert reader.waiting == 9
    assert reader.give_up() == [b"\x1d"]
    assert (reader.waiting, reader.dropped_bytes) == (0, 3)


AMIGO = ROBOTS["amigo"]


def test_golden_bytes() -> None:
    assert speeds(AMIGO, 0.2, math.radians(10), "vel") == bytes.fromhex("fafb060b3bc800d33b fafb06153b0a001f3b")
    assert speeds(AMIGO, -0.2, 0.0, "vel") == bytes.fromhex("fafb060b1bc800d31b fafb06153b0000153b")
    turn = 0.4 / AMIGO.track_m  # wheels at -0.2 and +0.2 m/s: ten steps each
    assert speeds(AMIGO, 0.0, turn, "vel2") == bytes.fromhex("fafb06203b0af62b31")
    assert speeds(AMIGO, 0.0, 0.0, "vel2") == command(Command.VEL2, 0)


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.parametrize("mode", ["vel", "vel2"])
@given(v=st.floats(-5, 5), w=st.floats(-20, 20))
def test_the_robot_decodes_the_speeds(kind: str, mode: str, v: float, w: float) -> None:
    robot = ROBOTS[kind]
    v, w = (max(-most, min(most, each)) for each, most in ((v, robot.max_speed), (w, robot.max_yaw_rate)))
    motion = SetPoints(robot)
    motion.max_speed, motion.max_yaw_rate = math.inf, math.inf
    for data in PacketReader().feed(speeds(robot, v, w, mode)):  # type: ignore[arg-type]
        number, value = parse_command(data)
        assert isinstance(value, int)
        motion.take(number, value, 0.0)
    understood = motion.target_speeds(0.0)
    if mode == "vel":
        assert understood[0] == pytest.approx(v, abs=0.51e-3)
        assert understood[1] == pytest.approx(w, abs=math.radians(0.51))
        return
    slower = max(1.0, (abs(v) + abs(w) * robot.track_m / 2) / 2.54)  # no wheel beyond 127 steps of 20 mm/s
    assert understood[0] == pytest.approx(v / slower, abs=0.0101)
    assert understood[1] == pytest.approx(w / slower, abs=0.0201 / robot.track_m)


u8, u16, s16 = st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(-0x8000, 0x7FFF)
TAIL = {"battery_x10": u16, "charge_state": u8, "rotation": s16, "faults": u16, "lateral": s16}
TAIL |= {"temperature": st.integers(-128, 127), "charge": u8}


@st.composite
def sips(draw: st.DrawFn) -> Sip:
    tail = {name: draw(values) for name, values in list(TAIL.items())[: draw(st.integers(0, len(TAIL)))]}
    return Sip(
        kind=draw(st.sampled_from((0x32, 0x33))),
        x=draw(st.integers(0, 0x7FFF)),
        y=draw(st.integers(0, 0x7FFF)),
        **{name: draw(s16) for name in ("heading", "left", "right", "setpoint")},
        **{name: draw(u16) for name in ("stall", "flags")},
        **{name: draw(u8) for name in ("battery", "compass", "gripper", "analog_port", "analog", "digital_in", "digital_out")},
        sonars=tuple(draw(st.lists(st.tuples(u8, u16), max_size=32))),
        **tail,
    )


@given(sips())
def test_round_trip(sip: Sip) -> None:
    assert decode_sip(encode_sip(sip)) == sip
    assert decode_sip(encode_sip(sip) + bytes(5)).x == sip.x  # further bytes are ignored


def test_every_field_is_placed_as_in_the_manual() -> None:
    data = bytearray(41)
    data[0], data[11], data[18], data[19] = 0x33, 120, 45, 2
    struct.pack_into("<HH", data, 1, 0x8000 | 1234, 32767)  # the top bit of a position is ignored
    struct.pack_into("<hhh", data, 5, -1024, -100, 300)
    struct.pack_into("<HhH", data, 12, 0x0100, -5, 0x0003)
    struct.pack_into("<BHBH", data, 20, 0, 5000, 7, 321)
    data[26:31] = bytes((1, 2, 3, 4, 5))
    struct.pack_into("<HBhHh", data, 31, 124, 2, -450, 8, 9)
    data[40] = 0xFF  # temperature -1
    assert decode_sip(bytes(data)) == Sip(
        kind=0x33,
        x=1234,
        y=32767,
        heading=-1024,
        left=-100,
        right=300,
        battery=120,
        stall=0x100,
        setpoint=-5,
        flags=3,
        compass=45,
        sonars=((0, 5000), (7, 321)),
        gripper=1,
        analog_port=2,
        analog=3,
        digital_in=4,
        digital_out=5,
        battery_x10=124,
        charge_state=2,
        rotation=-450,
        faults=8,
        lateral=9,
        temperature=-1,
    )


@pytest.mark.parametrize(("sonars", "size"), [(8, 59), (16, 83)])
def test_size_on_the_line(sonars: int, size: int) -> None:
    full = Sip(sonars=tuple((each, 5000) for each in range(sonars)), battery_x10=120, charge_state=0, rotation=0)
    assert len(frame(encode_sip(full))) == size


def test_stalled_wheels_are_told_from_bumpers() -> None:
    stalls = {bit: Sip(stall=1 << bit).stalled for bit in range(16)}
    assert stalls == {**dict.fromkeys(range(16), (False, False)), 0: (True, False), 8: (False, True)}


@given(sips())
def test_a_truncated_packet_is_refused_or_has_fewer_fields(sip: Sip) -> None:
    data = encode_sip(sip)
    needed = 25 + 3 * len(sip.sonars)
    for length in range(len(data)):
        if length < needed:
            with pytest.raises(ValueError, match="packet"):
                decode_sip(data[:length])
        else:
            assert data.startswith(encode_sip(decode_sip(data[:length])))


@given(st.binary(max_size=198))
def test_no_bytes_break_the_decoders(data: bytes) -> None:
    for read in (decode_sip, decode_config):
        with contextlib.suppress(ValueError):
            read(data)


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode_sip(Sip(left=40000))
    with pytest.raises(ValueError, match="top_speed = 70000"):
        encode_config(Config(top_speed=70000))


def test_configuration_round_trip_and_older_firmware() -> None:
    config = Config(
        subclass="amigo", serial_number="AB12", name="robbi", top_speed=1000, watchdog=2000, drift=-3, version="1.7"
    )
    data = encode_config(config)
    assert decode_config(data) == config
    head = b"\x20Pioneer\0amigo\0AB12\0" + struct.pack("<BHHHHH", 0, 0, 1000, 0, 0, 0) + b"robbi\0"
    middle = struct.pack("<BBBHHBHHHB", 0, 0, 0, 0, 0, 0, 0, 0, 2000, 0) + struct.pack("<16H", *[0] * 16)
    assert data == head + middle + struct.pack("<BBBBBBhBBHH", 0, 0, 0, 0, 0, 0, -3, 0, 0, 0, 0) + b"1.7\0"
    short = decode_config(data[: data.index(b"robbi") + 9])  # ends after the three bytes behind the name
    assert (short.top_speed, short.name, short.watchdog, short.version) == (1000, "robbi", None, "")


def test_unexpected_settings_of_a_robot_are_warned_of() -> None:
    amigo = ROBOTS["amigo"]
    usual = Config(watchdog=2000, top_speed=1000, top_yaw_rate=300)
    assert setting_warnings(usual, amigo, 1.0, math.radians(300)) == []
    assert setting_warnings(Config(), amigo, 9.0, 9.0) == []  # no values reported
    assert "watchdog is off" in setting_warnings(Config(watchdog=0), amigo, None, None)[0]
    assert "waits for 3.5 s before it stops it, not 2 s" in setting_warnings(Config(watchdog=3500), amigo, None, None)[0]
    speed, turn = setting_warnings(usual, amigo, 1.2, 6.0)
    assert speed == "max_speed = 1.2 m/s, but it is set to drive no faster than 1 m/s"
    assert turn == "max_yaw_rate = 6 rad/s, but it is set to turn no faster than 5.24 rad/s"


def test_factors_of_the_robots() -> None:
    assert round(1e3 * ROBOTS["p2dx"].track_m) == 357
    assert round(1e3 * ROBOTS["amigo"].track_m) == 182
    assert all(robot.angle_factor == pytest.approx(0.001534, abs=5e-7) for robot in ROBOTS.values())


@pytest.mark.parametrize("kind", ROBOTS)
def test_sonars_are_mirrored_about_the_long_axis_and_point_outwards(kind: str) -> None:
    places = {(each.x, each.y, round(math.degrees(each.angle))) for each in ROBOTS[kind].sonars}
    assert len(places) == {"p2dx": 16}.get(kind, 8)
    if kind != "amigo-sh":  # published positions are not quite symmetric
        assert places == {(x, -y, -angle) for x, y, angle in places}
    assert all(each.x * math.cos(each.angle) + each.y * math.sin(each.angle) > 0 for each in ROBOTS[kind].sonars)
