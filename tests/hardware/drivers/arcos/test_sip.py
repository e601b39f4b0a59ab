"""Information and configuration packets: the places of their fields, and what is cut off."""

import contextlib
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.arcos.config_packet import Config, decode_config, encode_config, warnings
from vcmvsp.hardware.drivers.arcos.packet import frame
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS, robot_of
from vcmvsp.hardware.drivers.arcos.sip import Sip, decode, encode

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
    assert decode(encode(sip)) == sip
    assert decode(encode(sip) + bytes(5)).x == sip.x  # more than is known


def test_every_field_is_where_the_manual_puts_it() -> None:
    data = bytearray(41)
    data[0], data[11], data[18], data[19] = 0x33, 120, 45, 2
    struct.pack_into("<HH", data, 1, 0x8000 | 1234, 32767)  # the top bit of a position means nothing
    struct.pack_into("<hhh", data, 5, -1024, -100, 300)
    struct.pack_into("<HhH", data, 12, 0x0100, -5, 0x0003)
    struct.pack_into("<BHBH", data, 20, 0, 5000, 7, 321)
    data[26:31] = bytes((1, 2, 3, 4, 5))
    struct.pack_into("<HBhHh", data, 31, 124, 2, -450, 8, 9)
    data[40] = 0xFF  # temperature -1
    assert decode(bytes(data)) == Sip(
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
    assert len(frame(encode(full))) == size


def test_stalled_wheels_are_told_from_bumpers() -> None:
    def told(stall: int) -> tuple[bool, bool]:
        sip = Sip(stall=stall)
        return sip.left_stalled, sip.right_stalled

    assert told(0x0001) == (True, False)
    assert told(0x0100) == (False, True)
    assert all(told(1 << bit) == (False, False) for bit in range(16) if bit not in (0, 8))


@given(sips())
def test_a_packet_that_is_cut_off_is_refused_or_has_fewer_fields(sip: Sip) -> None:
    data = encode(sip)
    needed = 25 + 3 * len(sip.sonars)
    for length in range(len(data)):
        if length < needed:
            with pytest.raises(ValueError, match="packet"):
                decode(data[:length])
        else:
            assert data.startswith(encode(decode(data[:length])))


@given(st.binary(max_size=198))
def test_no_bytes_break_the_decoders(data: bytes) -> None:
    for read in (decode, decode_config):
        with contextlib.suppress(ValueError):
            read(data)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode(Sip(left=40000))
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


def test_what_a_robot_says_of_itself_is_warned_of_where_it_is_not_what_a_user_expects() -> None:
    amigo = ROBOTS["amigo"]
    usual = Config(watchdog=2000, top_speed=1000, top_yaw_rate=300)
    assert warnings(usual, amigo, 1.0, math.radians(300)) == []
    assert warnings(Config(), amigo, 9.0, 9.0) == []  # it does not say
    assert "watchdog is off" in warnings(Config(watchdog=0), amigo, None, None)[0]
    assert "waits for 3.5 s before it stops it, not 2 s" in warnings(Config(watchdog=3500), amigo, None, None)[0]
    speed, turn = warnings(usual, amigo, 1.2, 6.0)
    assert speed == "max_speed = 1.2 m/s, but it is set to drive no faster than 1 m/s"
    assert turn == "max_yaw_rate = 6 rad/s, but it is set to turn no faster than 5.24 rad/s"


def test_factors_of_the_robots() -> None:
    assert round(1e3 * ROBOTS["p2dx"].track_m) == 357
    assert round(1e3 * ROBOTS["amigo"].track_m) == 182
    assert all(robot.angle_factor == pytest.approx(0.001534, abs=5e-7) for robot in ROBOTS.values())
    assert robot_of("AMIGO-sh") is ROBOTS["amigo-sh"]
    with pytest.raises(ValueError, match="known are p2dx, amigo, amigo-sh"):
        robot_of("rover")


@pytest.mark.parametrize("kind", ROBOTS)
def test_sonars_are_mirrored_about_the_long_axis_and_look_away_from_the_middle(kind: str) -> None:
    places = {(each.x, each.y, round(math.degrees(each.angle))) for each in ROBOTS[kind].sonars}
    assert len(places) == {"p2dx": 16}.get(kind, 8)
    if kind != "amigo-sh":  # whose sonars are not quite, as published
        assert places == {(x, -y, -angle) for x, y, angle in places}
    assert all(each.x * math.cos(each.angle) + each.y * math.sin(each.angle) > 0 for each in ROBOTS[kind].sonars)
