"""The Crazyflie Real Time Protocol (CRTP), the aircraft's side: one packet in, packets out, without sockets and clocks.

A packet is a byte with port (4 bits) and channel (2 bits), and up to 30 bytes (Bitcraze, "CRTP - Communication with the
Crazyflie"; protocol version 10). Integers and floats are little-endian.

====  ===================  =====================================================================
port  name                 here
====  ===================  =====================================================================
0     console              a greeting
2     parameters           table of contents, read, write
3     commander            a thrust of 0 stops; other attitudes are refused
4     memory               one, for trajectories: read, write
5     log                  table of contents, blocks
6     localisation         external poses are taken and ignored, emergency stop
7     generic commander    stop, velocity, hover, position, full state; end of set-points
8     high-level commander take-off, landing, go to, trajectories, stop
13    platform             protocol and firmware version
15    link                 echo, source
====  ===================  =====================================================================
"""

import math
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from errno import EIO, ENOENT, ENOEXEC
from typing import Literal, NamedTuple

from vcmvsp.cosim.frames import Quaternion, yaw_of
from vcmvsp.cosim.types import ORIGIN, Vec3, VehicleState
from vcmvsp.hardware.stacks.trajectories import Piece, compressed, uncompressed

VERSION = 10
NULL = b"\xff"  # asks whether a Crazyflie is there
MOST_BLOCKS, MOST_VARIABLES = 16, 128  # of the log, as in the firmware
GREETING = b"Crazyflie simulated by VCMVSP\n"
LOG_TYPES = {1: "B", 2: "H", 3: "I", 4: "b", 5: "h", 6: "i", 7: "f", 8: "e"}
PARAMETER_TYPES = {0: "b", 1: "h", 2: "i", 6: "f", 8: "B", 9: "H", 10: "I"}
MEMORY_TYPE, MEMORY_BYTES = 0x12, 4096  # for trajectories, as in the firmware
MOST_COPIED = 24  # bytes that an answer has room for
LONGEST_S = 1e5  # of a piece
MOST_TRAJECTORIES = 10  # NUM_TRAJECTORY_DEFINITIONS of the firmware
IN_MEMORY, UNCOMPRESSED, COMPRESSED = 1, 0, 1  # place and types of trajectories
READ_ONLY = 0x40
_U8, _U16, _FLOAT = 8, 9, 6

PARAMETERS: Mapping[str, tuple[int, float]] = {  # type and value at the start
    "commander.enHighLevel": (_U8, 1),
    "stabilizer.estimator": (_U8, 2),  # Kalman
    "stabilizer.controller": (_U8, 1),  # PID
    "kalman.resetEstimation": (_U8, 0),
    "kalman.initialX": (_FLOAT, 0.0),
    "kalman.initialY": (_FLOAT, 0.0),
    "kalman.initialZ": (_FLOAT, 0.0),
    "kalman.initialYaw": (_FLOAT, 0.0),
    "locSrv.extPosStdDev": (_FLOAT, 0.01),
    "locSrv.extQuatStdDev": (_FLOAT, 0.0045),
    "flightmode.stabModeRoll": (_U8, 1),
    "flightmode.stabModePitch": (_U8, 1),
    "flightmode.stabModeYaw": (_U8, 0),
    "hlCommander.vtoff": (_FLOAT, 0.5),
    "hlCommander.vland": (_FLOAT, 0.5),
    "ring.effect": (_U8, 0),
    "led.bitmask": (_U8, 0),
    "deck.bcFlow2": (_U8 | READ_ONLY, 1),
    "deck.bcLighthouse4": (_U8 | READ_ONLY, 0),
    "firmware.modified": (_U8 | READ_ONLY, 0),
    "firmware.revision0": (10 | READ_ONLY, 0),
    "firmware.revision1": (_U16 | READ_ONLY, 0),
}
VARIANCE_M2 = 1e-6  # of the estimated position: scripts wait until it is small
FULL_V = 4.1  # battery
CAN_FLY = 0x1 | 0x2 | 0x8  # supervisor.info: can be armed, is armed, can fly


class SetPoint(NamedTuple):
    """A set-point of the commander, in the world unless ``body``; None: not given."""

    velocity: Vec3 = ORIGIN  # m/s
    position: tuple[float | None, float | None, float | None] = (None, None, None)  # m
    yaw: float | None = None  # rad
    yaw_rate: float = 0.0  # rad/s
    body: bool = False  # whether the velocity turns with the yaw


class Manoeuvre(NamedTuple):
    """A command of the high-level commander."""

    kind: Literal["takeoff", "land", "go_to"]
    goal: Vec3  # m; of take-off and landing only the height counts
    yaw: float | None  # rad; None: the present one
    duration_s: float
    relative: bool = False
    linear: bool = False


class Flight(NamedTuple):
    """Start of an uploaded trajectory."""

    pieces: tuple[Piece, ...]
    time_scale: float
    relative: bool = False  # to the present place
    relative_yaw: bool = False  # to the present yaw as well
    reversed: bool = False


class Stop(NamedTuple):
    """Rotors off."""


class Release(NamedTuple):
    """No more set-points: the high-level commander takes over."""


Order = SetPoint | Manoeuvre | Flight | Stop | Release


class _Refused(Exception):
    pass


class Crazyflie:
    """Answers of one aircraft to packets; ``order`` receives the orders in them."""

    def __init__(self, order: Callable[[Order], None]) -> None:
        self.refused: Counter[str] = Counter()  # packets that were not followed, by cause
        self._order = order
        self._names, self._log_names = [*PARAMETERS], [*LOG]
        self._values = {name: value for name, (_, value) in PARAMETERS.items()}
        self._blocks: dict[int, _Block] = {}
        self._uploaded = bytearray(MEMORY_BYTES)
        self._trajectories: dict[int, tuple[int, int, int]] = {}  # type, offset and number of pieces
        self._ports: dict[int, Callable[[int, bytes], list[bytes]]] = {
            2: self._parameters,
            3: self._attitude,
            4: self._memory,
            5: self._log,
            6: self._localisation,
            7: self._generic,
            8: self._high_level,
            13: _platform,
            15: _link,
        }

    def take(self, packet: bytes) -> list[bytes]:
        """The packets that answer one."""
        if packet == NULL:
            return [NULL]
        if not 1 <= len(packet) <= 31:
            self.refused["length"] += 1
            return []
        port, channel = packet[0] >> 4, packet[0] & 3
        try:
            answers = self._ports[port](channel, packet[1:])
        except KeyError:
            self.refused[f"port {port}"] += 1
            return []
        except (struct.error, IndexError):
            self.refused["content"] += 1
            return []
        except _Refused as refused:
            self.refused[str(refused)] += 1
            return []
        if port == 15 and channel:
            return answers
        return [packet[:1] + each for each in answers]

    def logged(self, now_ms: int, state: VehicleState) -> list[bytes]:
        """Packets of the log that are due; one for each block at most."""
        due = [each for each in self._blocks.values() if each.period_ms and now_ms >= each.due_ms]
        if not due:
            return []
        values, packets = log_values(state), []
        for block in due:
            block.due_ms = max(block.due_ms + block.period_ms, now_ms - block.period_ms)
            content = b"".join(_packed(LOG_TYPES[kind], values[name]) for name, kind in block.variables)
            packets.append(bytes([0x52, block.number]) + now_ms.to_bytes(4, "little")[:3] + content)
        return packets

    def _parameters(self, channel: int, data: bytes) -> list[bytes]:
        if channel == 0:
            return _contents(data, self._names, [kind for kind, _ in PARAMETERS.values()])
        if channel == 3:
            return [data[:3] + bytes([ENOENT])]
        (number,) = struct.unpack_from("<H", data)
        if number >= len(self._names):
            return [data[:2] + bytes([ENOENT])]
        name = self._names[number]
        kind = PARAMETERS[name][0]
        if channel == 1:
            return [data[:2] + b"\0" + _packed(PARAMETER_TYPES[kind & 15], self._values[name])]
        if kind & READ_ONLY:
            raise _Refused("write of a read-only parameter")
        (self._values[name],) = _finite(struct.unpack("<" + PARAMETER_TYPES[kind], data[2:]))
        return [data]

    def _memory(self, channel: int, data: bytes) -> list[bytes]:
        if channel == 0:
            details = struct.pack("<BBIQ", 0, MEMORY_TYPE, MEMORY_BYTES, 0) if data[1:2] == b"\0" else data[1:2]
            return {1: [b"\x01\x01"], 2: [b"\x02" + details]}.get(data[0], [])
        number, at = struct.unpack_from("<BI", data)
        size = data[5] if channel == 1 else len(data) - 5
        if number or at + size > MEMORY_BYTES or size > MOST_COPIED:
            return [data[:5] + bytes([ENOENT if number else EIO])]
        if channel == 1:
            return [data[:5] + b"\0" + self._uploaded[at : at + size]]
        self._uploaded[at : at + size] = data[5:]
        return [data[:5] + b"\0"]

    def _log(self, channel: int, data: bytes) -> list[bytes]:
        if channel == 0:
            return _contents(data, self._log_names, [*LOG.values()])
        if channel != 1:
            raise _Refused("channel of the log")
        command = data[0]
        if command == 5:
            self._blocks.clear()
            return [b"\x05\0\0"]
        return [bytes([command, data[1], self._configured(command, data[1], data[2:])])]

    def _configured(self, command: int, number: int, rest: bytes) -> int:
        """Change a block of the log; returns the error number."""
        if command in (6, 7):
            block = self._blocks.get(number, _Block(number)) if command == 7 else _Block(number)
            added = [*struct.iter_unpack("<BH", rest[: len(rest) // 3 * 3])]  # cflib begins an entry that has no room
            if any(each >= len(self._log_names) or kind & 15 not in LOG_TYPES for kind, each in added):
                return ENOENT
            block.variables += [(self._log_names[each], kind & 15) for kind, each in added]
            size = sum(struct.calcsize(LOG_TYPES[kind]) for _, kind in block.variables)
            if size > 26 or (number not in self._blocks and len(self._blocks) == MOST_BLOCKS):
                return 7 if size > 26 else 12  # E2BIG, ENOMEM
            self._blocks[number] = block
            return 0
        if number not in self._blocks:
            return ENOENT
        if command == 2:
            del self._blocks[number]
        elif command in (3, 4):
            self._blocks[number].period_ms = 10 * rest[0] if command == 3 else 0
            self._blocks[number].due_ms = 0
        else:
            return ENOEXEC
        return 0

    def _attitude(self, channel: int, data: bytes) -> list[bytes]:
        _, _, _, thrust = struct.unpack("<fffH", data)
        if thrust:
            raise _Refused("attitude set-point: only velocities and positions are followed")
        self._order(Stop())
        return []

    def _localisation(self, channel: int, data: bytes) -> list[bytes]:
        if channel == 1 and data[0] == 3:
            self._order(Stop())
        return []

    def _generic(self, channel: int, data: bytes) -> list[bytes]:
        if channel == 1:
            self._order(Release())
            return []
        kind, numbers = data[0], data[1:]
        if kind == 0:
            self._order(Stop())
        elif kind in (1, 8):
            x, y, z, rate = _finite(struct.unpack("<ffff", numbers))
            self._order(SetPoint(velocity=(x, y, z), yaw_rate=_turn(kind, 1, rate)))
        elif kind in (5, 10):
            x, y, rate, height = _finite(struct.unpack("<ffff", numbers))
            self._order(SetPoint((x, y, 0.0), (None, None, height), yaw_rate=_turn(kind, 5, rate), body=True))
        elif kind == 7:
            x, y, z, yaw = _finite(struct.unpack("<ffff", numbers))
            self._order(SetPoint(position=(x, y, z), yaw=math.radians(yaw)))
        elif kind == 6:
            x, y, z, vx, vy, vz, _, _, _, packed, _, _, rate = struct.unpack("<hhhhhhhhhIhhh", numbers)
            velocity, place = (vx / 1e3, vy / 1e3, vz / 1e3), (x / 1e3, y / 1e3, z / 1e3)
            turn = math.radians(rate / 1e3)
            self._order(SetPoint(velocity, place, yaw=yaw_of(_uncompressed(packed)), yaw_rate=turn))
        else:
            raise _Refused(f"set-point of type {kind}")
        return []

    def _high_level(self, channel: int, data: bytes) -> list[bytes]:
        command = data[0]
        if command == 3:
            self._order(Stop())
        elif command in (7, 8):
            _, height, yaw, keep, duration = struct.unpack("<Bff?f", data[1:])
            height, yaw, duration = _finite((height, yaw, duration))
            kind: Literal["takeoff", "land"] = "takeoff" if command == 7 else "land"
            self._order(Manoeuvre(kind, (0.0, 0.0, height), None if keep else yaw, duration))
        elif command == 12:
            _, relative, linear, *numbers = struct.unpack("<B??fffff", data[1:])
            x, y, z, yaw, duration = _finite(numbers)
            self._order(Manoeuvre("go_to", (x, y, z), yaw, duration, relative, linear))
        elif command == 6:
            number, place, form, offset, count = struct.unpack("<BBBIB", data[1:])
            if number >= MOST_TRAJECTORIES or place != IN_MEMORY or form not in (UNCOMPRESSED, COMPRESSED):
                raise _Refused("trajectory of an unknown place, type or number")
            self._trajectories[number] = form, offset, count
        elif command == 13:
            _, relative, relative_yaw, backwards, number, time_scale = struct.unpack("<B???Bf", data[1:])
            pieces = self._pieces(number, time_scale, plain=not backwards)
            self._order(Flight(pieces, time_scale, relative, relative and relative_yaw, backwards))
        elif command != 0:
            raise _Refused(f"command {command} of the high-level commander")
        return []

    def _pieces(self, number: int, time_scale: float, *, plain: bool) -> tuple[Piece, ...]:
        """Pieces of a trajectory that can be flown."""
        if number not in self._trajectories:
            raise _Refused("start of a trajectory that is not defined")
        form, offset, count = self._trajectories[number]
        if form == COMPRESSED and not (plain and time_scale == 1.0):
            raise _Refused("compressed trajectory, reversed or at another speed")  # as in the firmware
        pieces = uncompressed(self._uploaded, offset, count) if form == UNCOMPRESSED else compressed(self._uploaded, offset)
        _finite([time_scale, *(each for piece in pieces for axis in piece.axes for each in axis)])
        if not pieces or not time_scale > 0.0 or not all(0.0 < piece.duration_s < LONGEST_S for piece in pieces):
            raise _Refused("trajectory without a possible duration")
        return pieces


class _Block:
    def __init__(self, number: int) -> None:
        self.number, self.variables = number, list[tuple[str, int]]()
        self.period_ms = self.due_ms = 0


def log_values(state: VehicleState) -> dict[str, float]:
    """The logged variables by name: SI units, angles in degrees, the pitch with the sign of the firmware (nose up)."""
    w, x, y, z = state.attitude
    roll = math.degrees(math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    pitch = -math.degrees(math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)))
    yaw = math.degrees(state.yaw)
    place = dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*state.position, *state.velocity), strict=True))
    angles = {"roll": roll, "pitch": pitch, "yaw": yaw}
    estimate = place | angles | {"qx": x, "qy": y, "qz": z, "qw": w}
    values = {f"stateEstimate.{name}": value for name, value in estimate.items()}
    values |= {f"stabilizer.{name}": value for name, value in angles.items()}
    values |= {f"gyro.{axis}": math.degrees(rate) for axis, rate in zip("xyz", state.angular_velocity, strict=True)}
    values |= {f"kalman.varP{axis}": VARIANCE_M2 for axis in "XYZ"}
    return values | {"pm.vbat": FULL_V, "pm.state": 0, "sys.canfly": 1, "supervisor.info": CAN_FLY, "radio.rssi": 40}


# Types of the variables, in the order of the table of contents: floats but for a few.
_INTEGERS = {"pm.state": 4, "sys.canfly": 1, "supervisor.info": 2, "radio.rssi": 1}
LOG: Mapping[str, int] = dict.fromkeys(log_values(VehicleState(position=ORIGIN)), 7) | _INTEGERS


def _contents(data: bytes, names: list[str], kinds: list[int]) -> list[bytes]:
    """Answer to a request of a table of contents: its size and checksum, or one entry."""
    if data[0] == 3:
        checksum = zlib.crc32(repr([*zip(names, kinds, strict=True)]).encode())
        return [b"\x03" + struct.pack("<HI", len(names), checksum)]
    if data[0] != 2:
        raise _Refused("table of contents of an older protocol")
    (number,) = struct.unpack_from("<H", data, 1)
    if number >= len(names):
        return [data[:3]]
    group, _, name = names[number].partition(".")
    return [data[:3] + bytes([kinds[number]]) + f"{group}\0{name}\0".encode()]


def _platform(channel: int, data: bytes) -> list[bytes]:
    if channel == 1:
        return [b"\0" + bytes([VERSION]) if data[0] == 0 else b"\x01vcmvsp\0"]
    return [data]  # of arming and the like


def _link(channel: int, data: bytes) -> list[bytes]:
    return {0: [data], 1: [b"\xf1Bitcraze Crazyflie\0"]}.get(channel, [])


def _packed(kind: str, value: float) -> bytes:
    if kind in "fe":
        return struct.pack("<" + kind, value)
    size = struct.calcsize(kind)
    return (int(value) & (1 << 8 * size) - 1).to_bytes(size, "little")


def _finite(numbers: "tuple[float, ...] | list[float]") -> "tuple[float, ...] | list[float]":
    if not all(map(math.isfinite, numbers)):
        raise _Refused("not finite")
    return numbers


def _turn(kind: int, legacy: int, rate_deg: float) -> float:
    """Yaw rate (rad/s, counter-clockwise); older types of set-points count it clockwise."""
    return math.radians(-rate_deg if kind == legacy else rate_deg)


def _uncompressed(packed: int) -> Quaternion:
    """Quaternion of 32 bits: index of the largest component, then sign and 9 bits of the others (quatcompress.h)."""
    largest, rest, others = packed >> 30, packed, dict[int, float]()
    for place in reversed([each for each in range(4) if each != packed >> 30]):
        magnitude = math.sqrt(0.5) * (rest & 511) / 511
        others[place] = -magnitude if rest >> 9 & 1 else magnitude
        rest >>= 10
    others[largest] = math.sqrt(max(0.0, 1.0 - sum(each * each for each in others.values())))
    return others[3], others[0], others[1], others[2]
