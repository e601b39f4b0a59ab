"""Configuration packet: the robot's answer to CONFIG, with its kind and its settings.

Its fields have a fixed order without offsets, strings end with a zero byte. Packets of older firmware are shorter, those of
newer firmware have more fields after the version. Source: order and widths of ARIA's decoder.

`warnings` checks settings on which a driver relies without control over them.
"""

import math
import struct

import msgspec

from vcmvsp.hardware.drivers.arcos.command_numbers import CONFIG_PACKET
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Fields in their order on the line. Speeds are in mm/s and deg/s, accelerations in mm/s2 and deg/s2."""

    robot_class: str = "Pioneer"
    subclass: str = ""
    serial_number: str = ""
    four_motors: int = 0
    top_yaw_rate: int = 0  # cannot be exceeded
    top_speed: int = 0  # cannot be exceeded
    top_yaw_accel: int = 0
    top_accel: int = 0
    pwm_max: int = 0
    name: str = ""
    sip_cycle: int = 0  # ms
    host_baud: int = 0  # as the argument of HOSTBAUD
    aux_baud: int = 0
    gripper: int = 0
    front_sonar: int = 0
    rear_sonar: int = 0
    low_battery: int = 0  # 0.1 V
    rev_count: int = 0  # encoder ticks of half a turn of the robot
    watchdog: int | None = None  # ms; 0: off; None: not in the packet
    plain_packets: int = 0
    stall_value: int = 0
    stall_count: int = 0
    joy_speed: int = 0
    joy_yaw_rate: int = 0
    max_yaw_rate: int = 0  # as set now
    max_speed: int = 0  # as set now
    yaw_accel: int = 0
    yaw_decel: int = 0
    yaw_kp: int = 0
    yaw_kv: int = 0
    yaw_ki: int = 0
    accel: int = 0
    decel: int = 0
    kp: int = 0
    kv: int = 0
    ki: int = 0
    front_bumpers: int = 0
    rear_bumpers: int = 0
    charger: int = 0
    sonar_cycle: int = 0  # ms
    auto_baud: int = 0  # 2: the baud rate goes back to the default when a session ends
    gyro: int = 0
    drift: int = 0
    aux2_baud: int = 0
    aux3_baud: int = 0
    ticks_per_mm: int = 0
    shutdown_voltage: int = 0  # 0.1 V
    version: str = ""


_STRINGS = {"robot_class", "subclass", "serial_number", "name", "version"}
_BYTES = (
    {"four_motors", "sip_cycle", "host_baud", "aux_baud", "rear_sonar", "plain_packets", "front_bumpers", "rear_bumpers"}
    | {"charger", "sonar_cycle", "auto_baud", "gyro", "aux2_baud", "aux3_baud"}
)  # fmt: skip
_CODES = {**dict.fromkeys(_BYTES, "<B"), "drift": "<h"}  # formats for `struct`; others are "<H"


def encode_config(config: Config) -> bytes:
    """The data part.

    Raises:
        ValueError: a value does not fit into its field.
    """
    data = bytearray((CONFIG_PACKET,))
    for name in Config.__struct_fields__:
        value = getattr(config, name)
        try:
            data += value.encode("latin-1") + b"\0" if name in _STRINGS else struct.pack(_CODES.get(name, "<H"), value)
        except struct.error:
            raise ValueError(f"{name} = {value} does not fit into a configuration packet") from None
    return bytes(data)


def decode_config(data: bytes) -> Config:
    """The fields as far as they are whole; the others keep their defaults.

    Raises:
        ValueError: it is no configuration packet.
    """
    if data[:1] != bytes((CONFIG_PACKET,)):
        raise ValueError(f"not a configuration packet: {data[:1].hex() or 'empty'}")
    fields: dict[str, str | int] = {}
    offset = 1
    for name in Config.__struct_fields__:
        if name in _STRINGS:
            end = data.find(b"\0", offset)
            if end < 0:
                break
            fields[name] = data[offset:end].decode("latin-1")
            offset = end + 1
        else:
            code = _CODES.get(name, "<H")
            if offset + struct.calcsize(code) > len(data):
                break
            (fields[name],) = struct.unpack_from(code, data, offset)
            offset += struct.calcsize(code)
    return msgspec.convert(fields, Config)


def warnings(config: Config, robot: Robot, max_speed: float | None, max_yaw_rate: float | None) -> list[str]:
    """Unexpected settings of the robot; each a sentence for a notice.

    Args:
        config: packet of the robot.
        robot: parameters of its kind.
        max_speed: m/s, requested limit; None: none.
        max_yaw_rate: rad/s, requested limit; None: none.
    """
    problems = []
    if config.watchdog == 0:
        problems.append(
            "its watchdog is off: nothing stops it where the driver or the line fails; switch it on in its parameters"
        )
    elif config.watchdog is not None and config.watchdog > 1e3 * robot.watchdog_s:
        problems.append(f"its watchdog waits for {1e-3 * config.watchdog:g} s before it stops it, not {robot.watchdog_s:g} s")
    if config.top_speed and max_speed is not None and round(1e3 * max_speed) > config.top_speed:
        problems.append(f"max_speed = {max_speed:g} m/s, but it is set to drive no faster than {1e-3 * config.top_speed:g} m/s")
    top = math.radians(config.top_yaw_rate)
    if top and max_yaw_rate is not None and round(math.degrees(max_yaw_rate)) > config.top_yaw_rate:
        problems.append(f"max_yaw_rate = {max_yaw_rate:g} rad/s, but it is set to turn no faster than {top:.3g} rad/s")
    return problems
