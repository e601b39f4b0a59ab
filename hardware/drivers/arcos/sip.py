"""Standard server information packet (SIP), sent by the robot every 100 ms.

Values are raw counts; `hardware.drivers.arcos.robot_parameters.Robot` has the factors to millimetres. Sources: AmigoBot
manual, table 4; Pioneer 2 operations manual, table "Standard server information packet".
"""

import struct

import msgspec

STOPPED, MOVING = 0x32, 0x33
KINDS = range(0x30, 0x35)  # first data bytes that clients take for a SIP
COUNT_BITS = 15  # of x and y; the counters wrap
COUNT_MASK = (1 << COUNT_BITS) - 1

_HEAD = struct.Struct("<BHHhhhBHhHBB")
_SONAR = struct.Struct("<BH")
_PORTS = struct.Struct("<BBBBB")
_TAIL = (
    ("battery_x10", "H"),
    ("charge_state", "B"),
    ("rotation", "h"),
    ("faults", "H"),
    ("lateral", "h"),
    ("temperature", "b"),
    ("charge", "B"),
)


class Sip(msgspec.Struct, frozen=True, kw_only=True):
    """Fields of a SIP. Fields that may be None are absent in shorter packets; an absent field ends the packet."""

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
    def left_stalled(self) -> bool:
        """Whether the left wheel is blocked."""
        return bool(self.stall & 1)

    @property
    def right_stalled(self) -> bool:
        """Whether the right wheel is blocked."""
        return bool(self.stall & 0x100)


def is_sip(data: bytes) -> bool:
    """Whether a packet's data part is a SIP, by its first byte."""
    return bool(data) and data[0] in KINDS


def decode(data: bytes) -> Sip:
    """The fields of a SIP's data part; bytes behind the last known field are ignored.

    Raises:
        ValueError: it is no SIP, or is cut off before its ports.
    """
    if not is_sip(data):
        raise ValueError(f"not an information packet: {data[:1].hex() or 'empty'}")
    ports = _HEAD.size + (_SONAR.size * data[19] if len(data) >= _HEAD.size else 0)
    if len(data) < ports + _PORTS.size:
        raise ValueError(f"an information packet of {len(data)} bytes is cut off: {ports + _PORTS.size} are announced")
    kind, x, y, heading, left, right, battery, stall, setpoint, flags, compass, _ = _HEAD.unpack_from(data)
    gripper, analog_port, analog, digital_in, digital_out = _PORTS.unpack_from(data, ports)
    return Sip(
        kind=kind,
        x=x & COUNT_MASK,
        y=y & COUNT_MASK,
        heading=heading,
        left=left,
        right=right,
        battery=battery,
        stall=stall,
        setpoint=setpoint,
        flags=flags,
        compass=compass,
        sonars=tuple(_SONAR.iter_unpack(data[_HEAD.size : ports])),
        gripper=gripper,
        analog_port=analog_port,
        analog=analog,
        digital_in=digital_in,
        digital_out=digital_out,
        **_optional(data[ports + _PORTS.size :]),
    )


def _optional(tail: bytes) -> dict[str, int]:
    """The fields behind the ports, as far as they are whole."""
    fields, offset = {}, 0
    for name, code in _TAIL:
        if offset + struct.calcsize(code) > len(tail):
            break
        (fields[name],) = struct.unpack_from(f"<{code}", tail, offset)
        offset += struct.calcsize(code)
    return fields


def encode(sip: Sip) -> bytes:
    """The data part.

    Raises:
        ValueError: a value does not fit into its field.
    """
    try:
        data = _HEAD.pack(
            sip.kind,
            sip.x & COUNT_MASK,
            sip.y & COUNT_MASK,
            sip.heading,
            sip.left,
            sip.right,
            sip.battery,
            sip.stall,
            sip.setpoint,
            sip.flags,
            sip.compass,
            len(sip.sonars),
        )
        data += b"".join(_SONAR.pack(number, counts) for number, counts in sip.sonars)
        data += _PORTS.pack(sip.gripper, sip.analog_port, sip.analog, sip.digital_in, sip.digital_out)
        for name, code in _TAIL:
            value = getattr(sip, name)
            if value is None:
                break
            data += struct.pack(f"<{code}", value)
    except struct.error as error:
        raise ValueError(f"a value does not fit into an information packet: {error}") from None
    return data
