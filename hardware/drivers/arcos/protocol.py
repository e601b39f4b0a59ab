"""Messages of ARCOS as bytes and back: frames, commands, information packets, the configuration packet. No clock, no line.

A frame is ``FA FB``, a count, that many bytes of data and checksum. Frames are not acknowledged and not repeated: the receiver
drops packets with a wrong checksum. Integers in the data are little-endian, the checksum is big-endian. Sources: Pioneer 2
operations manual, "Communications packets"; AmigoBot and Pioneer 2 manuals, tables of client commands.
"""

import math
import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Literal

import msgspec

from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot

HEADER = b"\xfa\xfb"
MAX_BYTES = 200  # greatest count: data and checksum
MIN_BYTES = 3  # least count: one byte of data and the checksum

POSITIVE, NEGATIVE, STRING = 0x3B, 0x1B, 0x2B  # types of an argument


def checksum(data: bytes) -> int:
    """Sum of big-endian pairs modulo 2**16; an odd last byte is XORed into the low byte."""
    even = len(data) & ~1
    total: int = sum(struct.unpack(f">{even // 2}H", data[:even])) & 0xFFFF
    return total ^ data[-1] if len(data) & 1 else total


def frame(data: bytes) -> bytes:
    """Header, count, data, checksum."""
    count = len(data) + 2
    if not MIN_BYTES <= count <= MAX_BYTES:
        raise ValueError(f"a packet holds 1 to {MAX_BYTES - 2} bytes of data, not {len(data)}")
    return HEADER + bytes((count,)) + data + checksum(data).to_bytes(2, "big")


def command(number: int, argument: int | str | bytes | None = None) -> bytes:
    """A framed command of a client.

    An int (-32768 to 65535) is sent as its absolute value in 16 bits behind the type byte of its sign, a str (up to 195
    characters, Latin-1) behind its length. Bytes are appended as they are.
    """
    if not 0 <= number <= 0xFF:
        raise ValueError(f"a command is a number from 0 to 255, not {number}")
    data = bytes((number,))
    if isinstance(argument, bytes):
        data += argument
    elif isinstance(argument, str):
        text = argument.encode("latin-1")
        if len(text) > MAX_BYTES - 5:
            raise ValueError(f"a command's text has at most {MAX_BYTES - 5} characters, not {len(text)}")
        data += bytes((STRING, len(text))) + text
    elif argument is not None:
        if not -0x8000 <= argument <= 0xFFFF:
            raise ValueError(f"a command's number is from -32768 to 65535, not {argument}")
        data += struct.pack("<BH", POSITIVE if argument >= 0 else NEGATIVE, abs(argument))
    return frame(data)


def parse_command(data: bytes) -> tuple[int, int | bytes | None]:
    """Number and argument of a command's data part (bytes: a string, or of unknown type); `ValueError`: wrong length."""
    if not data:
        raise ValueError("an empty packet is no command")
    number, rest = data[0], data[1:]
    if not rest:
        return number, None
    kind, value = rest[0], rest[1:]
    if kind in (POSITIVE, NEGATIVE):
        if len(value) != 2:
            raise ValueError(f"command {number}: an integer has 2 bytes, not {len(value)}")
        amount = int.from_bytes(value, "little")
        return number, amount if kind == POSITIVE else -amount
    if kind == STRING:
        if not value or value[0] != len(value) - 1:
            raise ValueError(f"command {number}: the length of its text does not match")
        return number, value[1:]
    return number, rest


class PacketReader:
    """Finds packets in a stream with lost, changed or split parts; counts bytes outside of valid packets and wrong checksums.

    If a header announces a packet with a valid checksum, the packet is taken and reading continues behind it; otherwise reading
    continues behind the header's first byte, so that a packet inside a false one is still found, once the announced bytes have
    come (at most `MAX_BYTES`). A packet is therefore lost only if it overlaps false bytes that look like a packet with a valid
    checksum: probability 2**-16 per announced packet, some 2e-10 per byte of noise. Every change of one bit of data or checksum
    is detected.
    """

    def __init__(self) -> None:
        self.dropped_bytes = 0
        self.bad_checksums = 0
        self._buffer = bytearray()

    @property
    def waiting(self) -> int:
        """Number of bytes that may be the start of a packet."""
        return len(self._buffer)

    def feed(self, chunk: bytes) -> list[bytes]:
        """Data parts of the packets that these bytes complete."""
        self._buffer += chunk
        packets = []
        start = 0
        while True:
            header = self._next_header(start)
            self.dropped_bytes += header - start
            start = header
            if start + 3 > len(self._buffer):
                break
            end = start + 3 + self._buffer[start + 2]
            if end > len(self._buffer):
                break
            data = bytes(self._buffer[start + 3 : end - 2])
            if checksum(data) == int.from_bytes(self._buffer[end - 2 : end], "big"):
                packets.append(data)
                start = end
            else:
                self.bad_checksums += 1
                self.dropped_bytes += 1
                start += 1
        del self._buffer[:start]
        return packets

    def give_up(self) -> list[bytes]:
        """Stop waiting for the rest of an announced packet; data parts of the packets behind its header.

        For a link that is silent for longer than the gaps in a packet: a false header could otherwise hold back up to
        `MAX_BYTES` of commands.
        """
        packets: list[bytes] = []
        while self._buffer:
            del self._buffer[0]
            self.dropped_bytes += 1
            packets += self.feed(b"")
        return packets

    def _next_header(self, start: int) -> int:
        """Index of the next possible header, which may be cut off; length of the buffer if there is none."""
        buffer = self._buffer
        while (start := buffer.find(0xFA, start)) >= 0:
            rest = buffer[start : start + 3]
            if rest[: len(HEADER)] == HEADER[: len(rest)] and (len(rest) < 3 or MIN_BYTES <= rest[2] <= MAX_BYTES):
                return start
            start += 1
        return len(buffer)


class Command(IntEnum):
    """Number of a command; the argument is an int in the unit of its comment unless it says otherwise."""

    PULSE = 0  # none: only restarts the watchdog
    OPEN = 1  # none or 1: start the information packets
    CLOSE = 2  # none or 1: stop, end the session
    ENABLE = 4  # 0/1: motors
    SETA = 5  # mm/s2, + acceleration, - deceleration
    SETV = 6  # mm/s, greatest speed of MOVE and VEL
    SETO = 7  # none: odometry to 0, 0, 0
    MOVE = 8  # mm, + forward
    ROTATE = 9  # deg/s, + counter-clockwise
    SETRV = 10  # deg/s, greatest yaw rate
    VEL = 11  # mm/s, + forward
    HEAD = 12  # deg, absolute
    DHEAD = 13  # deg, + counter-clockwise
    CONFIG = 18  # none or 1: ask for the configuration packet
    RVEL = 21  # deg/s, + counter-clockwise
    SETRA = 23  # deg/s2, + acceleration, - deceleration
    SONAR = 28  # 0/1
    STOP = 29  # none: decelerate to standstill
    VEL2 = 32  # low byte right wheel, high byte left wheel, signed, 20 mm/s each
    HOSTBAUD = 50  # 0-4: 9600, 19200, 38400, 57600, 115200
    ESTOP = 55  # none: stop at once


SYNC0, SYNC1, SYNC2 = 0, 1, 2  # before a session is open, these numbers shake hands
CONFIG_PACKET = 0x20  # first data byte of the configuration packet
BAUDS = (9600, 19200, 38400, 57600, 115200)  # baud rates by the argument of HOSTBAUD


Mode = Literal["vel", "vel2"]


def speeds(robot: Robot, v: float, w: float, mode: Mode) -> bytes:
    """Commands for ``v`` m/s and ``w`` rad/s, limited to the greatest speeds of the robot.

    ``vel`` sends VEL and RVEL, in whole mm/s and deg/s; ``vel2`` sends both wheels in one command, in steps of 20 mm/s.
    Wheels: v -+ w/2 times the effective track.
    """
    v = min(max(v, -robot.max_speed), robot.max_speed)
    w = min(max(w, -robot.max_yaw_rate), robot.max_yaw_rate)
    if mode == "vel":
        return command(Command.VEL, round(1000.0 * v)) + command(Command.RVEL, round(math.degrees(w)))
    unit = robot.vel2_divisor / 1000.0
    apart = 0.5 * w * robot.track_m
    most = max(1.0, (abs(v) + abs(apart)) / (127 * unit))  # beyond a byte: slower, on the same arc
    left, right = round((v - apart) / most / unit), round((v + apart) / most / unit)
    return command(Command.VEL2, (left & 0xFF) << 8 | right & 0xFF)


STOPPED, MOVING = 0x32, 0x33
KINDS = range(0x30, 0x35)  # first data bytes that clients take for a SIP
COUNT_BITS = 15  # of x and y; the counters wrap
COUNT_MASK = (1 << COUNT_BITS) - 1


class Sip(msgspec.Struct, frozen=True, kw_only=True):
    """Fields of a standard server information packet (SIP), sent every 100 ms; `Robot` has the factors to millimetres.

    Fields that may be None are absent in shorter packets; an absent field ends the packet. Sources: AmigoBot manual, table 4;
    Pioneer 2 operations manual, table "Standard server information packet".
    """

    kind: int = STOPPED  # first byte; not to be relied upon: simulators always send STOPPED
    x: int = 0  # counts, 0 to 32767, wraps
    y: int = 0  # counts, 0 to 32767, wraps
    heading: int = 0  # counts, 4096 a turn, counter-clockwise
    left: int = 0  # counts, speed of the left wheel
    right: int = 0  # counts, speed of the right wheel
    battery: int = 0  # 0.1 V
    stall: int = 0  # bit 0 left wheel, 8 right wheel; 1-7 and 9-15 bumpers
    setpoint: int = 0  # counts, heading that is held
    flags: int = 0  # bit 0 motors on, 1-4 sonar arrays on
    compass: int = 0  # 2 degrees
    sonars: tuple[tuple[int, int], ...] = ()  # (number, range in counts): new readings only
    gripper: int = 0
    analog_port: int = 0
    analog: int = 0
    digital_in: int = 0
    digital_out: int = 0
    battery_x10: int | None = None  # 0.1 V
    charge_state: int | None = None
    rotation: int | None = None  # 0.1 deg/s
    faults: int | None = None
    lateral: int | None = None  # mm/s
    temperature: int | None = None  # degrees Celsius; -128: unknown
    charge: int | None = None  # %

    @property
    def motors_on(self) -> bool:
        """Whether the motors are enabled."""
        return bool(self.flags & 1)

    @property
    def stalled(self) -> tuple[bool, bool]:
        """Whether the left and the right wheel are blocked."""
        return bool(self.stall & 1), bool(self.stall & 0x100)


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Fields of a configuration packet that are used here; in mm/s, deg/s, mm/s2 and deg/s2."""

    robot_class: str = "Pioneer"
    subclass: str = ""
    serial_number: str = ""
    top_yaw_rate: int = 0  # cannot be exceeded
    top_speed: int = 0  # cannot be exceeded
    name: str = ""
    sip_cycle: int = 0  # ms
    host_baud: int = 0  # as the argument of HOSTBAUD
    front_sonar: int = 0
    rear_sonar: int = 0
    watchdog: int | None = None  # ms; 0: off; None: not in the packet
    max_yaw_rate: int = 0  # as set now
    max_speed: int = 0  # as set now
    yaw_accel: int = 0
    yaw_decel: int = 0
    accel: int = 0
    decel: int = 0
    sonar_cycle: int = 0  # ms
    auto_baud: int = 0  # 2: the baud rate goes back to the default when a session ends
    drift: int = 0
    version: str = ""


# Fields in their order on the line, and their codes for `struct`; z: text that ends with a zero byte.
_SONAR = {"number": "B", "range": "H"}
_HEAD = dict(zip(Sip.__struct_fields__[:11], "BHHhhhBHhHB", strict=True))
_HEAD_BYTES = 20  # with the number of sonars
_PORTS = dict.fromkeys(("gripper", "analog_port", "analog", "digital_in", "digital_out"), "B")
_TAIL = dict(zip(Sip.__struct_fields__[17:], "HBhHhbB", strict=True))
_LAYOUT = (  # order and widths of ARIA's decoder
    "robot_class:z subclass:z serial_number:z four_motors:B top_yaw_rate:H top_speed:H top_yaw_accel:H top_accel:H "
    "pwm_max:H name:z sip_cycle:B host_baud:B aux_baud:B gripper:H front_sonar:H rear_sonar:B low_battery:H rev_count:H "
    "watchdog:H plain_packets:B stall_value:H stall_count:H joy_speed:H joy_yaw_rate:H max_yaw_rate:H max_speed:H "
    "yaw_accel:H yaw_decel:H yaw_kp:H yaw_kv:H yaw_ki:H accel:H decel:H kp:H kv:H ki:H front_bumpers:B rear_bumpers:B "
    "charger:B sonar_cycle:B auto_baud:B gyro:B drift:h aux2_baud:B aux3_baud:B ticks_per_mm:H shutdown_voltage:H version:z"
)
_CONFIG = dict(field.split(":") for field in _LAYOUT.split())


def _pack(codes: Mapping[str, str], values: Mapping[str, Any]) -> bytes:
    """Fields one behind the other, 0 without a value, until the first that is None; `ValueError` for one that does not fit."""
    data = b""
    for name, code in codes.items():
        value = values.get(name, 0)
        if value is None:
            break
        try:
            data += value.encode("latin-1") + b"\0" if code == "z" else struct.pack(f"<{code}", value)
        except struct.error:
            raise ValueError(f"{name} = {value} does not fit into its field of a packet") from None
    return data


def _unpack(codes: Mapping[str, str], data: bytes) -> dict[str, Any]:
    """Decode the fields that are complete."""
    fields: dict[str, Any] = {}
    for name, code in codes.items():
        size = data.find(b"\0") + 1 if code == "z" else struct.calcsize(code)
        if not 0 < size <= len(data):
            break
        fields[name] = data[: size - 1].decode("latin-1") if code == "z" else struct.unpack_from(f"<{code}", data)[0]
        data = data[size:]
    return fields


def is_sip(data: bytes) -> bool:
    """Whether a packet's data part is a SIP, by its first byte."""
    return bool(data) and data[0] in KINDS


def decode_sip(data: bytes) -> Sip:
    """Fields of a SIP's data part, without unknown last ones; `ValueError`: it is no SIP, or ends before its ports do."""
    if not is_sip(data):
        raise ValueError(f"not an information packet: {data[:1].hex() or 'empty'}")
    ports = _HEAD_BYTES + (3 * data[_HEAD_BYTES - 1] if len(data) >= _HEAD_BYTES else 0)
    if len(data) < ports + len(_PORTS):
        raise ValueError(f"an information packet of {len(data)} bytes is cut off: {ports + len(_PORTS)} are announced")
    head = _unpack(_HEAD, data)
    head |= {name: head[name] & COUNT_MASK for name in ("x", "y")}
    sonars = tuple(struct.iter_unpack("<BH", data[_HEAD_BYTES:ports]))
    return Sip(sonars=sonars, **head, **_unpack({**_PORTS, **_TAIL}, data[ports:]))


def encode_sip(sip: Sip) -> bytes:
    """Data part of a SIP; `ValueError`: a value does not fit into its field."""
    values = msgspec.structs.asdict(sip)
    values |= {"x": sip.x & COUNT_MASK, "y": sip.y & COUNT_MASK}
    head = _pack({**_HEAD, "sonars": "B"}, {**values, "sonars": len(sip.sonars)})
    sonars = b"".join(_pack(_SONAR, {"number": number, "range": counts}) for number, counts in sip.sonars)
    return head + sonars + _pack({**_PORTS, **_TAIL}, values)


def encode_config(config: Config) -> bytes:
    """Data part of a configuration packet; `ValueError`: a value does not fit into its field."""
    return bytes((CONFIG_PACKET,)) + _pack(_CONFIG, msgspec.structs.asdict(config))


def decode_config(data: bytes) -> Config:
    """Fields of a configuration packet, incomplete ones at their defaults; `ValueError`: it is no configuration packet.

    Packets of older firmware are shorter; packets of newer firmware have more fields behind the version.
    """
    if data[:1] != bytes((CONFIG_PACKET,)):
        raise ValueError(f"not a configuration packet: {data[:1].hex() or 'empty'}")
    return msgspec.convert(_unpack(_CONFIG, data[1:]), Config)


def setting_warnings(config: Config, robot: Robot, max_speed: float | None, max_yaw_rate: float | None) -> list[str]:
    """Settings of the robot on which a driver relies and that differ from what was requested (m/s, rad/s), as sentences."""
    problems = []
    if config.watchdog == 0:
        failing = "the robot does not stop if the driver or the line fails"
        problems.append(f"its watchdog is off: {failing}; switch it on in its parameters")
    elif config.watchdog is not None and config.watchdog > 1e3 * robot.watchdog_s:
        problems.append(f"its watchdog waits for {1e-3 * config.watchdog:g} s before it stops it, not {robot.watchdog_s:g} s")
    if config.top_speed and max_speed is not None and round(1e3 * max_speed) > config.top_speed:
        problems.append(f"max_speed = {max_speed:g} m/s, but it is set to drive no faster than {1e-3 * config.top_speed:g} m/s")
    top = math.radians(config.top_yaw_rate)
    if top and max_yaw_rate is not None and round(math.degrees(max_yaw_rate)) > config.top_yaw_rate:
        problems.append(f"max_yaw_rate = {max_yaw_rate:g} rad/s, but it is set to turn no faster than {top:.3g} rad/s")
    return problems
