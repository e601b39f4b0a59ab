"""Telemetry of an emulated autopilot: heartbeats, and messages at requested rates. It has no clock."""

import math
from typing import NamedTuple

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.types import Vec3, VehicleState
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.protocol import Autopilot, Message, euler_from_attitude, mavlink, world_flipped

TICK_NS = 5_000_000  # time step of the emulation
TELEMETRY_HZ, STATUS_HZ = 50.0, 1.0
SITE = (47.397742, 8.545594, 488.0)  # latitude, longitude (deg), height (m): where PX4's simulators begin
BATTERY_V = 15.8

_NUMBERS = {"px4": mavlink.MAV_AUTOPILOT_PX4, "ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA}
_FAST, _SLOW = ("LOCAL_POSITION_NED", "ATTITUDE"), ("SYS_STATUS", "EXTENDED_SYS_STATE")
_BY_ITSELF = {**dict.fromkeys(_FAST, TELEMETRY_HZ), **dict.fromkeys(_SLOW, STATUS_HZ)}
_STREAMS = {
    mavlink.MAV_DATA_STREAM_POSITION: ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    mavlink.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE",),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: _SLOW,
}


class TelemetryState(NamedTuple):
    """Content of telemetry."""

    mode: str
    armed: bool
    landed: bool
    state: VehicleState  # in the world
    blind: bool  # no position estimate


class Telemetry:
    """Messages at their rates; PX4 starts by itself, ArduPilot on request.

    ``origin`` is that of the vehicle's local frame in the world, m, which is at `SITE` on the earth.
    """

    def __init__(self, autopilot: Autopilot, vehicle_type: int, origin: Vec3, heartbeat_s: float) -> None:
        self._autopilot, self._type, self._origin = autopilot, vehicle_type, origin
        self._plane = TangentPlane(*SITE)
        hertz = _BY_ITSELF if autopilot.kind == "px4" else {}
        self._period_ns = {name: round(SECOND_NS / hz) for name, hz in hertz.items()}
        self._next_ns = dict.fromkeys(self._period_ns, 0)
        self._heartbeat_ns = max(TICK_NS, round(heartbeat_s * SECOND_NS))
        self._beat_ns = 0

    @property
    def due_ns(self) -> int:
        """Time of the next message."""
        return min([self._beat_ns, *self._next_ns.values()])

    def messages(self, now_ns: int, now: TelemetryState) -> list[Message]:
        """Messages that are due at a tick."""
        output = []
        if now_ns >= self._beat_ns:
            self._beat_ns += self._heartbeat_ns
            output.append(self._heartbeat(now))
        for name, period_ns in self._period_ns.items():
            if now_ns >= self._next_ns[name]:
                self._next_ns[name] = max(self._next_ns[name] + period_ns, now_ns + TICK_NS)
                output.append(self._told(name, now_ns, now))
        return output

    def ask(self, number: int, microseconds: float, now_ns: int) -> bool:
        """SET_MESSAGE_INTERVAL for the message of this number; whether it is supported."""
        kind = mavlink.mavlink_map.get(number)
        if kind is None or kind.msgname not in (*_BY_ITSELF, "GLOBAL_POSITION_INT") or not math.isfinite(microseconds):
            return False
        self._tell_every(kind.msgname, round(1000.0 * microseconds), now_ns)
        return True

    def ask_stream(self, stream: int, hz: int, now_ns: int) -> None:
        """REQUEST_DATA_STREAM; 0 Hz ends it."""
        for name in _STREAMS.get(stream, ()):
            self._tell_every(name, SECOND_NS // hz if hz else -1, now_ns)

    def _tell_every(self, name: str, period_ns: int, now_ns: int) -> None:
        if period_ns > 0:
            self._period_ns[name] = max(TICK_NS, period_ns)
            self._next_ns.setdefault(name, now_ns)
        else:
            self._period_ns.pop(name, None)
            self._next_ns.pop(name, None)

    def _heartbeat(self, now: TelemetryState) -> Message:
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if now.armed else 0)
        status = mavlink.MAV_STATE_ACTIVE if now.armed else mavlink.MAV_STATE_STANDBY
        number = self._autopilot.modes[now.mode]
        return mavlink.MAVLink_heartbeat_message(self._type, _NUMBERS[self._autopilot.kind], flags, number, status, 3)

    def _told(self, name: str, now_ns: int, now: TelemetryState) -> Message:
        boot_ms, state = now_ns // 1_000_000, now.state
        here: Vec3 = tuple(a - b for a, b in zip(state.position, self._origin, strict=True))  # type: ignore[assignment]
        north, east, down = world_flipped(here) if not now.blind else (math.nan,) * 3
        velocity = world_flipped(state.velocity)
        match name:
            case "LOCAL_POSITION_NED":
                return mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, down, *velocity)
            case "ATTITUDE":
                rates = protocol.body_flipped(state.angular_velocity)
                return mavlink.MAVLink_attitude_message(boot_ms, *euler_from_attitude(state.attitude), *rates)
            case "GLOBAL_POSITION_INT":
                latitude, longitude, height = self._plane.geodetic(*here)
                cm = [round(100.0 * each) for each in velocity]
                heading = round(100.0 * math.degrees(euler_from_attitude(state.attitude)[2])) % 36_000
                above = round(1e3 * state.position[2])
                place = (round(1e7 * latitude), round(1e7 * longitude), round(1e3 * height), above)
                return mavlink.MAVLink_global_position_int_message(boot_ms, *place, *cm, heading)
            case "SYS_STATUS":
                return mavlink.MAVLink_sys_status_message(0, 0, 0, 100, round(1e3 * BATTERY_V), -1, -1, 0, 0, 0, 0, 0, 0)
            case _:
                landed = mavlink.MAV_LANDED_STATE_ON_GROUND if now.landed else mavlink.MAV_LANDED_STATE_IN_AIR
                return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, landed)


def version() -> Message:
    """AUTOPILOT_VERSION: capabilities."""
    capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    none = (0,) * 8
    return mavlink.MAVLink_autopilot_version_message(capabilities, 0, 0, 0, 0, none, none, none, 0, 0, 0)
