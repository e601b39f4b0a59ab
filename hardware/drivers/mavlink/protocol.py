"""Messages of MAVLink as bytes and back, frames of coordinates, and the modes of autopilots. No clock, no link.

Between NED and ENU a world vector changes x and y and the sign of z (T); between FRD and FLU a body vector changes the signs of
y and z (D). Both are their own inverse. With Euler angles ZYX, as in MAVLink, ``T Rz(yaw) Ry(pitch) Rx(roll) D =
Rz(pi/2 - yaw) Ry(-pitch) Rx(roll)``, since D changes the signs of rotations about y and z, and T D is a quarter turn about z.
"""

import math
from typing import Any, Literal

from pymavlink.dialects.v20 import common  # type: ignore[import-untyped]

from vcmvsp.cosim.frames import Quaternion, wrap
from vcmvsp.cosim.types import Value, Vec3

mavlink = common
Message = Any  # pymavlink makes a class for each kind of message
Kind = Literal["px4", "ardupilot"]

PERIOD_NS = 50_000_000  # PX4 wants more than 2 Hz, ArduPilot one in 3 s; a radio at 57600 baud is filled to a fifth
STATUS_HZ = 1.0  # of battery and landed state
STILL: Vec3 = (0.0, 0.0, 0.0)
VELOCITY_AND_YAW_RATE = 0b0101_1100_0111
"""POSITION_TARGET_TYPEMASK: ignore all but velocities and the yaw rate (bits 3 to 5, and 11)."""

# Magic byte: bytes before and after the payload [mavlink.io, packet serialization].
_AROUND = {0xFE: 8, 0xFD: 12}  # MAVLink 1, MAVLink 2
_SIGNATURE = 13  # bytes, behind a signed message
_SIGNED = 0x01  # of the incompatibility flags

# Bytes and messages


class Sender(Value, frozen=True, kw_only=True):
    """Address of a sender."""

    system: int
    component: int


def sender_of(message: Message) -> Sender:
    """Sender of a message."""
    return Sender(system=message.get_srcSystem(), component=message.get_srcComponent())


class Encoder:
    """Encodes messages of one sender, with sequence numbers, as MAVLink 2."""

    def __init__(self, sender: Sender) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=sender.system, srcComponent=sender.component)

    def __call__(self, *messages: Message) -> bytes:
        """Encoded bytes of the messages."""
        data = b""
        for each in messages:
            data += each.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
        return data


class MessageReader:
    """Finds MAVLink 1 and 2 messages in a stream; messages with a wrong checksum or of unknown type are dropped.

    After a broken message the search continues at the next byte, so that no valid message is lost; pymavlink's parser skips the
    length that a broken message announces. ``messages`` counts those found.
    """

    def __init__(self) -> None:
        self.messages = 0
        self._mav = mavlink.MAVLink(None)
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[Message]:
        """Messages that these bytes complete."""
        self._buffer += chunk
        messages, start, buffer = [], 0, self._buffer
        while start < len(buffer):
            around = _AROUND.get(buffer[start])
            if around is None:
                start += 1
                continue
            if len(buffer) - start < 3:
                break
            length = around + buffer[start + 1]
            if buffer[start] == 0xFD and buffer[start + 2] & _SIGNED:
                length += _SIGNATURE
            if len(buffer) - start < length:
                break
            message = self._decode(buffer[start : start + length])
            if message is not None:
                messages.append(message)
            start += length if message is not None else 1
        del buffer[:start]
        self.messages += len(messages)
        return messages

    def _decode(self, data: bytearray) -> Message | None:
        if data[0] == 0xFD and data[2] & ~_SIGNED:  # unknown feature: MAVLink requires to drop the message
            return None
        try:
            message = self._mav.decode(data)
        except mavlink.MAVError:
            return None
        return message if type(message) is not mavlink.MAVLink_unknown else None  # its checksum is unknown


# Coordinates


def world_flipped(v: Vec3) -> Vec3:
    """A vector of the world from NED to ENU, or back."""
    return v[1], v[0], -v[2]


def body_flipped(v: Vec3) -> Vec3:
    """A vector of the body from FRD to FLU, or back."""
    return v[0], -v[1], -v[2]


def yaw_flipped(yaw: float) -> float:
    """A direction from clockwise of north to counter-clockwise of east, or back, in [-pi, pi)."""
    return wrap(0.5 * math.pi - yaw)


def attitude_flipped(attitude: Quaternion) -> Quaternion:
    """``world_from_body`` in NED and FRD of one in ENU and FLU, or back: the product of the rotations T, ``attitude`` and D.

    T is half a turn about (1, 1, 0), D half a turn about x; quaternions of opposite signs are the same rotation.
    """
    w, x, y, z = attitude
    s = math.sqrt(0.5)
    return s * (w + z), s * (x + y), s * (x - y), s * (w - z)


def attitude_from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """``world_from_body`` in ENU and FLU of Euler angles of NED and FRD, rad: Rz(pi/2 - yaw) Ry(-pitch) Rx(roll)."""
    half = (0.5 * roll, -0.5 * pitch, 0.25 * math.pi - 0.5 * yaw)
    (cr, cp, cy), (sr, sp, sy) = map(math.cos, half), map(math.sin, half)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def euler_from_attitude(attitude: Quaternion) -> Vec3:
    """Roll, pitch and yaw of NED and FRD, rad, of ``world_from_body`` in ENU and FLU."""
    w, x, y, z = attitude
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, -pitch, yaw_flipped(yaw)


# Kinds of vehicles and autopilots [MAV_TYPE; PX4 px4_custom_mode.h; ArduPilot Copter/mode.h and Rover/mode.h]

ROVER, BOAT = mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_TYPE_SURFACE_BOAT
GROUND = frozenset((ROVER, BOAT))
_FLYING = "QUADROTOR COAXIAL HELICOPTER HEXAROTOR OCTOROTOR TRICOPTER DODECAROTOR DECAROTOR GENERIC_MULTIROTOR"
COPTERS = frozenset(getattr(mavlink, f"MAV_TYPE_{name}") for name in _FLYING.split())

KINDS: dict[int, Kind] = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}


def type_name(number: int) -> str:
    """The kind of a vehicle in words."""
    entry = mavlink.enums["MAV_TYPE"].get(number)
    return entry.name.removeprefix("MAV_TYPE_").lower().replace("_", " ") if entry else f"vehicle of type {number}"


def _modes(text: str) -> dict[str, int]:
    """Modes by name, numbered in their order; - is none."""
    return {name: number for number, name in enumerate(text.split()) if name != "-"}


# Main mode in bits 16-23, sub-mode in bits 24-31.
_PX4_MAIN = _modes("- MANUAL ALTITUDE POSITION - ACRO OFFBOARD STABILIZED")
_PX4_AUTO = _modes("- READY TAKEOFF HOLD MISSION RETURN LAND - FOLLOW PRECISION_LAND")
_PX4 = {name: main << 16 for name, main in _PX4_MAIN.items()}
_PX4 |= {name.replace("_", " "): 4 << 16 | sub << 24 for name, sub in _PX4_AUTO.items()}
_PX4["ORBIT"] = 3 << 16 | 1 << 24
_COPTER = _modes(
    "STABILIZE ACRO ALT_HOLD AUTO GUIDED LOITER RTL CIRCLE - LAND - DRIFT - SPORT FLIP AUTOTUNE POSHOLD BRAKE THROW - "
    "GUIDED_NOGPS SMART_RTL FLOWHOLD FOLLOW ZIGZAG"
)
_ROVER = _modes("MANUAL ACRO - STEERING HOLD LOITER FOLLOW SIMPLE DOCK CIRCLE AUTO RTL SMART_RTL - - GUIDED")


class Autopilot(Value, frozen=True, kw_only=True):
    """An autopilot in a kind of vehicle."""

    name: str
    kind: Kind
    modes: dict[str, int]  # name: custom mode
    follows: str  # the mode in which it follows set-points
    holds: tuple[str, ...]  # modes that hold the position, the best first
    lead_s: float  # duration of set-points before the switch to `follows`

    def mode(self, custom_mode: int) -> str:
        """The name of a mode."""
        return next((name for name, number in self.modes.items() if number == custom_mode), f"mode {custom_mode:#x}")


# PX4 wants set-points at more than 2 Hz for over 1 s before it is switched [PX4 guide, Offboard mode]; ArduPilot wants none.
_PX4_AUTOPILOT = Autopilot(name="PX4", kind="px4", modes=_PX4, follows="OFFBOARD", holds=("HOLD",), lead_s=1.5)


def autopilot_of(kind: Kind, vehicle_type: int) -> Autopilot:
    """The autopilot in a vehicle of this ``MAV_TYPE``.

    A copter is left in BRAKE: in LOITER a transmitter on the table, with its throttle stick low, lands it.
    """
    if kind == "px4":
        return _PX4_AUTOPILOT
    modes = _ROVER if vehicle_type in GROUND else _COPTER
    holds = {ROVER: ("HOLD",), BOAT: ("LOITER", "HOLD")}.get(vehicle_type, ("BRAKE",))
    return Autopilot(name="ArduPilot", kind="ardupilot", modes=modes, follows="GUIDED", holds=holds, lead_s=0.0)


# Messages to an autopilot


def heartbeat() -> Message:
    """Heartbeat of a ground station, once a second: an autopilot's data-link failsafe monitors it."""
    kind, invalid = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
    return mavlink.MAVLink_heartbeat_message(kind, invalid, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)


def command_long(to: Sender, number: int, *parameters: float) -> Message:
    """COMMAND_LONG; parameters that are left out are zero."""
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    return mavlink.MAVLink_command_long_message(to.system, to.component, number, 0, *padded)


def switch_mode(to: Sender, autopilot: Autopilot, mode: str) -> Message:
    """Change to a mode."""
    number = autopilot.modes[mode]
    main, sub = (number >> 16 & 0xFF, number >> 24) if autopilot.kind == "px4" else (number, 0)
    return command_long(to, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, main, sub)


def arm_command(to: Sender, *, on: bool) -> Message:
    """Arm or disarm, never by force: the second parameter, which would override all checks, is zero."""
    return command_long(to, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(on), 0)


def interval_requests(to: Sender, position_message: str, hz: float) -> list[Message]:
    """Requests for position and attitude at ``hz``, and for status messages at `STATUS_HZ`."""
    rates = {position_message: hz, "ATTITUDE": hz, "SYS_STATUS": STATUS_HZ, "EXTENDED_SYS_STATE": STATUS_HZ}
    return [
        command_long(to, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"), round(1e6 / rate))
        for name, rate in rates.items()
    ]


def stream_requests(to: Sender, hz: float) -> list[Message]:
    """Requests by REQUEST_DATA_STREAM, for an autopilot without message intervals."""
    rates = dict.fromkeys((mavlink.MAV_DATA_STREAM_POSITION, mavlink.MAV_DATA_STREAM_EXTRA1), max(1, round(hz)))
    rates[mavlink.MAV_DATA_STREAM_EXTENDED_STATUS] = round(STATUS_HZ)
    request = mavlink.MAVLink_request_data_stream_message
    return [request(to.system, to.component, stream, rate, 1) for stream, rate in rates.items()]


def setpoint(to: Sender, time_ms: int, linear: Vec3, yaw_rate: float, *, on_ground: bool) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED of a velocity, ENU (on the ground: forward, left, up), and a counter-clockwise yaw rate."""
    frame, velocity = mavlink.MAV_FRAME_LOCAL_NED, world_flipped(linear)
    if on_ground:
        frame, velocity = mavlink.MAV_FRAME_BODY_NED, (linear[0], 0.0, 0.0)
    target = (time_ms & 0xFFFFFFFF, to.system, to.component, frame, VELOCITY_AND_YAW_RATE)
    position, acceleration, yaw = STILL, STILL, 0.0  # ignored
    message = mavlink.MAVLink_set_position_target_local_ned_message
    return message(*target, *position, *velocity, *acceleration, yaw, -yaw_rate)
