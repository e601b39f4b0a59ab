"""Emulated vehicle with an autopilot as a state machine: bytes and times in, bytes out. No clock, thread or port.

It has the behaviour that a driver relies on and must survive: refused modes (PX4: OFFBOARD before set-points have come for a
second), a pilot who switches (`pilot_switches`), arming and its refusal, the end of OFFBOARD without set-points, telemetry on
request.
"""

import math
from collections import deque
from typing import Literal

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.frames import quaternion_from_yaw, rotate2
from vcmvsp.cosim.types import Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.protocol import STILL, Autopilot, Message, euler_from_attitude, mavlink, world_flipped

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


class Telemetry:
    """Messages at their rates: PX4's by themselves, ArduPilot's on request. ``origin`` (m, world) is at `SITE` on the earth."""

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

    def messages(self, now_ns: int, now: "Vehicle") -> list[Message]:
        """Messages that are due at a tick."""
        output = []
        if now_ns >= self._beat_ns:
            self._beat_ns += self._heartbeat_ns
            output.append(self._heartbeat(now))
        for name, period_ns in self._period_ns.items():
            if now_ns >= self._next_ns[name]:
                self._next_ns[name] = max(self._next_ns[name] + period_ns, now_ns + TICK_NS)
                output.append(self._telemetry_message(name, now_ns, now))
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

    def _heartbeat(self, now: "Vehicle") -> Message:
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if now.armed else 0)
        status = mavlink.MAV_STATE_ACTIVE if now.armed else mavlink.MAV_STATE_STANDBY
        number = self._autopilot.modes[now.mode]
        return mavlink.MAVLink_heartbeat_message(self._type, _NUMBERS[self._autopilot.kind], flags, number, status, 3)

    def _telemetry_message(self, name: str, now_ns: int, now: "Vehicle") -> Message:
        boot_ms, state = now_ns // 1_000_000, now.state
        position: Vec3 = tuple(a - b for a, b in zip(state.position, self._origin, strict=True))  # type: ignore[assignment]
        north, east, down = world_flipped(position) if not now.blind else (math.nan,) * 3
        velocity = world_flipped(state.velocity)
        match name:
            case "LOCAL_POSITION_NED":
                return mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, down, *velocity)
            case "ATTITUDE":
                rates = protocol.body_flipped(state.angular_velocity)
                return mavlink.MAVLink_attitude_message(boot_ms, *euler_from_attitude(state.attitude), *rates)
            case "GLOBAL_POSITION_INT":
                latitude, longitude, height = self._plane.geodetic(*position)
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


LAG_S = 0.3  # of a velocity controller
YAW_LAG_S = 0.15
SPEED_MPS, CLIMB_MPS, YAW_RATE = 5.0, 2.0, 1.5  # limits
ACCEL_MPS2 = 4.0
GRAVITY = 9.80665  # m/s2


class VehicleMotion:
    """Motion without forces: a quadrotor tilts as its acceleration needs, a rover moves along its heading."""

    def __init__(self, start: VehicleState, *, on_ground: bool) -> None:
        self._position, self._yaw = start.position, start.yaw
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._yaw_rate = 0.0
        self._on_ground = on_ground

    def step(self, command: Velocity, dt: float) -> VehicleState:
        """Advance by ``dt`` seconds, on or above the ground, z = 0."""
        goal = self._in_world(command.linear)
        change = [(to - v) * min(1.0, dt / LAG_S) for to, v in zip(goal, self._velocity, strict=True)]
        size = math.hypot(*change)
        scale = min(1.0, ACCEL_MPS2 * dt / size) if size else 0.0
        ax, ay, az = (each * scale / dt for each in change)
        vx, vy, vz = (v + each * scale for v, each in zip(self._velocity, change, strict=True))
        rate = max(-YAW_RATE, min(YAW_RATE, command.yaw_rate))
        self._yaw_rate += (rate - self._yaw_rate) * min(1.0, dt / YAW_LAG_S)
        self._yaw += self._yaw_rate * dt
        x, y, z = self._position
        z += vz * dt
        if z <= 0.0:
            z, vz = 0.0, max(0.0, vz)
            if not self._on_ground:  # it stands
                vx = vy = ax = ay = 0.0
        self._position, self._velocity = (x + vx * dt, y + vy * dt, z), (vx, vy, vz)
        attitude = quaternion_from_yaw(self._yaw)
        if not self._on_ground:
            forward, leftward = rotate2(ax, ay, -self._yaw)
            lean = math.atan2(forward, GRAVITY + az)  # its z axis is along the thrust: acceleration minus gravity
            roll = -math.atan2(leftward * math.cos(lean), GRAVITY + az)
            attitude = protocol.attitude_from_euler(roll, -lean, 0.5 * math.pi - self._yaw)
        return VehicleState(
            position=self._position,
            velocity=self._velocity,
            attitude=attitude,
            angular_velocity=(0.0, 0.0, self._yaw_rate),
        )

    def _in_world(self, linear: Vec3) -> Vec3:
        """Velocity goal within the limits, in the world."""
        if self._on_ground:
            linear = (*rotate2(linear[0], 0.0, self._yaw), 0.0)
        x, y, z = linear
        speed = math.hypot(x, y)
        scale = min(1.0, SPEED_MPS / speed) if speed else 0.0
        return x * scale, y * scale, max(-CLIMB_MPS, min(CLIMB_MPS, z))


LEAD_NS = 1_000_000_000  # PX4: duration of set-points before OFFBOARD [PX4 guide, Offboard mode]
GAP_NS = 500_000_000  # ... at more than 2 Hz
LOSS_NS = {"px4": 500_000_000, "ardupilot": 3_000_000_000}  # without set-points (COM_OF_LOSS_T; GUID_TIMEOUT)
TAKEOFF_MPS, LAND_MPS = 1.0, 0.7

_TYPES = {"quadrotor": mavlink.MAV_TYPE_QUADROTOR, "rover": mavlink.MAV_TYPE_GROUND_ROVER}
_NO_VELOCITY, _NO_YAW_RATE = 0b11_1000, 1 << 11  # of a type mask
_OK, _DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_TEMPORARILY_REJECTED
_UNKNOWN = mavlink.MAV_RESULT_UNSUPPORTED


class Vehicle:
    """A quadrotor or a rover. Times are nanoseconds of a monotonic clock; earlier times than before count as now.

    Args:
        autopilot: its modes and its rules for set-points.
        kind: of the vehicle.
        system_id: its number.
        start: x, y, z (m, world) and yaw (rad).
        origin: of its local frame in the world, m; at `SITE` on the earth.
        mode: initial mode; None: POSITION (PX4) or LOITER (ArduPilot).
        armed: whether it starts armed.
        can_arm: False: it refuses to arm, with a text.
        old: it supports REQUEST_DATA_STREAM instead of SET_MESSAGE_INTERVAL.
        heartbeat_s: period of heartbeats; 1 s on real vehicles.
    """

    def __init__(
        self,
        *,
        autopilot: protocol.Kind = "px4",
        kind: Literal["quadrotor", "rover"] = "quadrotor",
        system_id: int = 1,
        start: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        origin: Vec3 = (0.0, 0.0, 0.0),
        mode: str | None = None,
        armed: bool = False,
        can_arm: bool = True,
        old: bool = False,
        heartbeat_s: float = 1.0,
    ) -> None:
        self.type, self.system_id = _TYPES[kind], system_id
        self.autopilot = protocol.autopilot_of(autopilot, self.type)
        self.mode = mode or ("POSITION" if autopilot == "px4" else "LOITER")
        self.armed, self.can_arm, self.old = armed, can_arm, old
        self.heard: deque[tuple[int, Message]] = deque(maxlen=10_000)
        self.blind = False
        x, y, z, yaw = start
        self.state = VehicleState(position=(x, y, z), attitude=quaternion_from_yaw(yaw))
        self.motion = VehicleMotion(self.state, on_ground=kind == "rover")
        self._flies = kind != "rover"
        self._encode = protocol.Encoder(protocol.Sender(system=system_id, component=mavlink.MAV_COMP_ID_AUTOPILOT1))
        self._reader = protocol.MessageReader()
        self._telemetry = Telemetry(self.autopilot, self.type, origin, heartbeat_s)
        self.now_ns = 0  # of the last tick
        self._target, self._target_yaw_rate = STILL, 0.0
        self._setpoint_ns: int | None = None  # time of the last one
        self._since_ns = 0  # start of set-points without a gap
        self._rise_to: float | None = None
        self._texts: list[Message] = []

    def receive(self, chunk: bytes, now_ns: int) -> bytes:
        """Process bytes; bytes that the vehicle sends until then and at once."""
        output = self.advance(now_ns)
        for message in self._reader.feed(chunk):
            self.heard.append((self.now_ns, message))
            output += self._encode(*self._serve(message))
        return output + self._say()

    def advance(self, now_ns: int) -> bytes:
        """Bytes that the vehicle sends until this time."""
        output = b""
        while self.now_ns + TICK_NS <= now_ns:
            self.now_ns += TICK_NS
            self._tick()
            if self.now_ns >= self._telemetry.due_ns:
                output += self._encode(*self._telemetry.messages(self.now_ns, self))
            output += self._say()
        return output

    @property
    def due_ns(self) -> int:
        """Time at which `advance` will have bytes to send."""
        return max(self.now_ns + TICK_NS, -(-self._telemetry.due_ns // TICK_NS) * TICK_NS)

    def pilot_switches(self, mode: str) -> None:
        """Another transmitter or ground station selects a mode."""
        if mode not in self.autopilot.modes:
            raise ValueError(f"{self.autopilot.name} has no mode {mode}; modes: {', '.join(self.autopilot.modes)}")
        self._enter(mode)

    def say(self, text: str, severity: int = mavlink.MAV_SEVERITY_CRITICAL) -> None:
        """Send a text, in chunks of 50 characters."""
        data = text.encode("ascii", "replace")
        if len(data) < 50:
            self._texts.append(mavlink.MAVLink_statustext_message(severity, data))
            return
        for piece, start in enumerate(range(0, len(data) + 1, 50)):  # a full last chunk would not end the text
            self._texts.append(mavlink.MAVLink_statustext_message(severity, data[start : start + 50], 1, piece))

    def commanded(self) -> Velocity:
        """Velocity to reach: in the world; on a rover the forward speed. Zero unless a mode moves the vehicle."""
        if not self.armed:
            return Velocity()
        if self.mode == self.autopilot.follows:
            if self._rise_to is not None:
                return Velocity(linear=(0.0, 0.0, TAKEOFF_MPS))
            return Velocity(linear=self._target, yaw_rate=self._target_yaw_rate)
        if self._flies and self.mode == "LAND":
            return Velocity(linear=(0.0, 0.0, -LAND_MPS))
        if self._flies and self.mode == "TAKEOFF":
            return Velocity(linear=(0.0, 0.0, TAKEOFF_MPS))
        return Velocity()

    @property
    def landed(self) -> bool:
        """Whether it stands on the ground."""
        return not self._flies or self.state.position[2] <= 0.02

    def _tick(self) -> None:
        last = self._setpoint_ns
        if self.mode == self.autopilot.follows and last is not None and self.now_ns - last > LOSS_NS[self.autopilot.kind]:
            self._target, self._target_yaw_rate, self._setpoint_ns = STILL, 0.0, None
            if self.autopilot.kind == "px4":
                self.say("Failsafe: no offboard signal")
                self._enter("HOLD")
        if self._rise_to is not None and self.state.position[2] >= self._rise_to:
            self._rise_to = None
            if self.mode == "TAKEOFF":
                self._enter("HOLD")
        self.state = self.motion.step(self.commanded(), TICK_NS / SECOND_NS)
        if self.mode == "LAND" and self.armed and self.landed:
            self.armed = False

    def _say(self) -> bytes:
        texts, self._texts = self._texts, []
        return self._encode(*texts)

    def _serve(self, message: Message) -> list[Message]:
        """Obey a message; messages for other systems and unknown ones are ignored."""
        if getattr(message, "target_system", self.system_id) not in (0, self.system_id):
            return []
        match message.get_type():
            case "SET_POSITION_TARGET_LOCAL_NED":
                self._follow(message)
            case "COMMAND_LONG":
                result, extra = self._obey(message)
                to = (message.get_srcSystem(), message.get_srcComponent())
                return [mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *to), *extra]
            case "REQUEST_DATA_STREAM":
                rate = message.req_message_rate if message.start_stop else 0
                self._telemetry.ask_stream(message.req_stream_id, rate, self.now_ns)
        return []

    def _follow(self, message: Message) -> None:
        fields = (message.vx, message.vy, message.vz, message.yaw_rate)
        if message.type_mask & _NO_VELOCITY or not all(map(math.isfinite, fields)):
            return
        if self._setpoint_ns is None or self.now_ns - self._setpoint_ns > GAP_NS:
            self._since_ns = self.now_ns
        self._setpoint_ns = self.now_ns
        if self.autopilot.kind == "ardupilot":
            self._rise_to = None  # a set-point ends a take-off
        if message.coordinate_frame == mavlink.MAV_FRAME_BODY_NED:
            self._target = protocol.body_flipped((message.vx, message.vy, message.vz))
        else:
            self._target = protocol.world_flipped((message.vx, message.vy, message.vz))
        self._target_yaw_rate = 0.0 if message.type_mask & _NO_YAW_RATE else -message.yaw_rate

    def _obey(self, message: Message) -> tuple[int, list[Message]]:
        match message.command:
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL if not self.old:
                supported = self._telemetry.ask(_as_integer(message.param1), message.param2, self.now_ns)
                return _OK if supported else _UNKNOWN, []
            case mavlink.MAV_CMD_DO_SET_MODE:
                return self._set_mode(message), []
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                return self._set_armed(_as_integer(message.param1)), []
            case mavlink.MAV_CMD_NAV_TAKEOFF if self._flies:
                return self._take_off(message.param7), []
            case mavlink.MAV_CMD_NAV_LAND if self._flies:
                self._enter("LAND")
                return _OK, []
            case mavlink.MAV_CMD_REQUEST_MESSAGE if message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                return _OK, [version()]
        return _UNKNOWN, []

    def _set_mode(self, message: Message) -> int:
        main, sub = _as_integer(message.param2), max(0, _as_integer(message.param3))
        number = main << 16 | sub << 24 if self.autopilot.kind == "px4" else main
        mode = self.autopilot.mode(number)
        if mode not in self.autopilot.modes:
            return int(mavlink.MAV_RESULT_DENIED)
        last = self._setpoint_ns
        fresh = last is not None and self.now_ns - last <= GAP_NS and last - self._since_ns > LEAD_NS
        if mode == "OFFBOARD" and not fresh:
            return int(_DENIED)
        self._enter(mode)
        return int(_OK)

    def _set_armed(self, number: int) -> int:
        if number not in (0, 1):
            return int(mavlink.MAV_RESULT_DENIED)
        armed = number == 1
        if armed and not self.can_arm:
            self.say("Arming denied: no position estimate, no valid heading and no battery to speak of")
            return int(_DENIED)
        if not armed and not self.landed:  # that would be a crash
            return int(_DENIED)
        self.armed = armed
        return int(_OK)

    def _take_off(self, height: float) -> int:
        """PX4 enters its own mode with a height above the sea; ArduPilot stays in GUIDED with a height above the ground."""
        if not self.armed:
            return int(_DENIED)
        if self.autopilot.kind == "px4":
            above = height - SITE[2] if math.isfinite(height) else 2.5  # MIS_TAKEOFF_ALT
            self._enter("TAKEOFF")
            self._rise_to = max(1.0, above)
            return int(_OK)
        if self.mode != "GUIDED" or not self.landed or not math.isfinite(height):
            return int(mavlink.MAV_RESULT_FAILED)
        self._rise_to = height
        return int(_OK)

    def _enter(self, mode: str) -> None:
        if mode != self.mode:
            self.mode, self._rise_to = mode, None
            if self.autopilot.kind == "ardupilot":  # PX4 follows the last set-point at once
                self._target, self._target_yaw_rate = STILL, 0.0


def _as_integer(number: float) -> int:
    """A command's parameter as an integer; clients leave unused ones at NaN."""
    return int(number) if math.isfinite(number) else -1
