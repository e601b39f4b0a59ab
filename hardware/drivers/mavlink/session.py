"""Session with a vehicle: telemetry, modes, arming, set-points, and command authority.

It has no clock and no link: messages and times are arguments and results. Requests and acknowledgements prove nothing: mode and
arming come from the vehicle's heartbeats.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Odometry, Value, Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.base import Sample, What, finite
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.link import Chunks, Peer
from vcmvsp.hardware.drivers.mavlink.protocol import (
    PERIOD_NS,
    STILL,
    Message,
    MessageReader,
    body_flipped,
    mavlink,
    world_flipped,
)
from vcmvsp.hardware.drivers.threaded import CommandRepeater

ATTITUDE_NS = 500_000_000  # older attitudes are useless
MS = 1_000_000  # ns


class MavlinkSampler:
    """Converts telemetry to samples, over reconnections.

    Odometry begins at ``start`` in the run (x m, y m, yaw rad); ``origin`` (m, world) is the origin of the autopilot's local
    frame, or of ``plane`` if positions are global.
    """

    def __init__(self, start: Vec3, origin: Vec3, plane: TangentPlane | None) -> None:
        self.position_message = "LOCAL_POSITION_NED" if plane is None else "GLOBAL_POSITION_INT"
        self.battery_v: float | None = None
        self.state: VehicleState | None = None  # the newest
        self._start, self._origin, self._plane = start, origin, plane
        self._number = self._link = 0
        self._clock = ForeignClock()
        self._attitude: Message | None = None
        self._attitude_ns = 0
        self._base: Vec3 | None = None  # pose at the first sample

    def connect(self) -> None:
        """Note that a connection begins."""
        self._link += 1
        self._attitude, self.state = None, None
        self._clock = ForeignClock()  # stamps count from power-up, which may be recent

    def attitude(self, message: Message, now_ns: int) -> None:
        """Process an ATTITUDE message."""
        fields = (message.roll, message.pitch, message.yaw, message.rollspeed, message.pitchspeed, message.yawspeed)
        if all(map(math.isfinite, fields)):
            self._attitude, self._attitude_ns = message, now_ns

    def position(self, message: Message, now_ns: int) -> Sample | None:
        """Take a position; a sample, if it completes a state."""
        if self._attitude is None or now_ns - self._attitude_ns > ATTITUDE_NS:
            return None
        place = _local(message) if self._plane is None else _global(message, self._plane)
        if place is None:
            return None
        (x, y, z), velocity = place
        turn = self._attitude
        self.state = state = VehicleState(
            position=(self._origin[0] + x, self._origin[1] + y, self._origin[2] + z),
            velocity=velocity,
            attitude=protocol.attitude_from_euler(turn.roll, turn.pitch, turn.yaw),
            angular_velocity=body_flipped((turn.rollspeed, turn.pitchspeed, turn.yawspeed)),
        )
        self._number += 1
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=now_ns,
            measured_ns=self._clock.local_time_ns(message.time_boot_ms * MS, now_ns),
            odometry=self._odometry(state),
            state=state,
            battery_v=self.battery_v,
        )

    def status(self, message: Message) -> None:
        """Process a SYS_STATUS message."""
        self.battery_v = None if message.voltage_battery in (0, 0xFFFF) else 1e-3 * message.voltage_battery

    def _odometry(self, state: VehicleState) -> Odometry:
        """Motion since the first sample, from the start pose."""
        pose = (state.position[0], state.position[1], state.yaw)
        base = self._base = self._base or pose
        dx, dy = rotate2(pose[0] - base[0], pose[1] - base[1], self._start[2] - base[2])
        odometry_pose = (self._start[0] + dx, self._start[1] + dy, self._start[2] + wrap(pose[2] - base[2]))
        forward, _ = rotate2(state.velocity[0], state.velocity[1], -pose[2])
        return Odometry(pose=odometry_pose, v=forward, w=state.angular_velocity[2])


def _local(message: Message) -> tuple[Vec3, Vec3] | None:
    position, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
    finite = all(map(math.isfinite, position + velocity))
    return (world_flipped(position), world_flipped(velocity)) if finite else None


def _global(message: Message, plane: TangentPlane) -> tuple[Vec3, Vec3] | None:
    """Position in 1e-7 degrees and mm above sea level, velocity in cm/s. Latitude and longitude 0 mean no position."""
    latitude, longitude = 1e-7 * message.lat, 1e-7 * message.lon
    if (message.lat == 0 and message.lon == 0) or not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    velocity = (1e-2 * message.vx, 1e-2 * message.vy, 1e-2 * message.vz)
    return plane.enu(latitude, longitude, 1e-3 * message.alt), world_flipped(velocity)


ASK_NS = 500_000_000  # between repeated requests
CLIMB = 0.7  # m/s, of a take-off
NEAR = 0.9  # share of its height that ends a take-off
STANDS = 0.05  # m/s
TEXT = 50  # characters of a STATUSTEXT; a longer text comes in pieces
REPEAT_NS = 10_000_000_000  # before a text is reported again

_RESULTS = {
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    mavlink.MAV_RESULT_DENIED: "refused",
    mavlink.MAV_RESULT_UNSUPPORTED: "not known",
    mavlink.MAV_RESULT_FAILED: "failed",
}


class SessionOptions(Value, frozen=True, kw_only=True):
    """Requests at the start, and the command time-out."""

    telemetry_hz: float
    timeout_s: float
    switch_mode: bool = False
    arm: bool = False
    takeoff_m: float | None = None


class _Step(NamedTuple):
    what: str
    done: Callable[[], bool]
    ask: Callable[[], list[Message]]


class MavlinkSession:
    """Sends requests and set-points, and monitors the vehicle."""

    def __init__(self, peer: Peer, orders: SessionOptions, sampler: MavlinkSampler, now_ns: int) -> None:
        self.in_command = False  # the vehicle is in the mode that follows set-points
        self.interrupted = ""  # why preparation must end: the mode was changed, or the vehicle was stopped; empty: it continues
        self.news: list[tuple[What, str]] = []  # events for notices; the reader empties it
        self._peer, self._orders, self._sampler = peer, orders, sampler
        self._repeater = CommandRepeater((STILL, 0.0), orders.timeout_s, again_ns=PERIOD_NS, least_ns=PERIOD_NS)
        self._boot_ns = self._now_ns = now_ns
        self._mode, self._armed, self._terminated = "", False, False
        self._landed = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._leaving = self._has_armed = False
        self._climb_to: float | None = None  # m, z in the world
        self._reader, self._refusal, self._texts = MessageReader(), "", StatusTexts()
        self._old_streams = False
        self._steps = deque(self._opening())
        self._request_ns: int | None = None
        self._beat_ns = now_ns  # time of the next heartbeat
        self._watch(peer.heartbeat)

    @property
    def ready(self) -> bool:
        """Whether all requests are fulfilled; after `leave`: whether the vehicle may be left."""
        return not self._steps

    @property
    def waits_for(self) -> str:
        """Request that is not fulfilled, with the vehicle's answer."""
        last = self._texts.last
        notes = ", ".join(each for each in (self._refusal, last and f'it says "{last}"') if each)
        request = self._steps[0].what if self._steps else "nothing"
        return f"{request} ({notes})" if notes else request

    @property
    def stopped(self) -> str:
        """Why the vehicle does not follow commands; empty: it does."""
        if not self.in_command:
            return f"it is in {self._mode or 'no mode that is known'}: it follows commands in {self._peer.autopilot.follows}"
        return self._repeater.stopped if self._armed else "it is not armed"

    def command(self, velocity: Velocity, now_ns: int) -> None:
        """Set the velocity; ignored in other modes, while disarmed, and during a take-off."""
        finite(velocity)
        if self.in_command and self._armed and self.ready and not self._leaving:
            self._repeater.command((velocity.linear, velocity.yaw_rate), now_ns)

    def stop(self, cause: str) -> None:
        """Zero speed with the next message."""
        self._repeater.stop(cause)
        self._climb_to = None
        if self._steps and self._orders.switch_mode and not self._leaving:  # otherwise no request can move it
            self.interrupted = cause

    def leave(self) -> None:
        """Zero speed, and a mode that holds the position; a vehicle on the ground that this driver armed is disarmed.

        Nothing is disarmed in the air, and a vehicle under another command is left unchanged.
        """
        self._leaving, self._climb_to, self._request_ns = True, None, None
        self._repeater.stop("the driver is being closed")
        self._steps = deque()
        if self.in_command:
            holds = deque(self._peer.autopilot.holds)

            def hold() -> list[Message]:
                holds.rotate(-1)
                return [protocol.switch_mode(self._peer.sender, self._peer.autopilot, holds[-1])]

            self._steps.append(_Step("it to hold its place", lambda: not self.in_command, hold))
            if self._has_armed:
                disarm = protocol.arm_command(self._peer.sender, on=False)
                self._steps.append(_Step("it to disarm", lambda: not (self._armed and self._stands), lambda: [disarm]))

    def farewell(self) -> list[Message]:
        """Last messages of the session."""
        self._climb_to = None
        return self._points(STILL, 0.0)

    def advance(self, now_ns: int) -> list[Message]:
        """Messages to send at this time."""
        self._now_ns = now_ns
        output: list[Message] = []
        if now_ns >= self._beat_ns:
            self._beat_ns = now_ns + SECOND_NS
            output.append(protocol.heartbeat())
        before = self._repeater.stopped
        if (speeds := self._repeater.advance(now_ns)) is not None:
            output += self._points(*speeds)
        if self._repeater.stopped != before:
            self.news.append(("stopped", self._repeater.stopped))
        while self._steps and self._steps[0].done():
            self._steps.popleft()
            self._request_ns, self._refusal = None, ""
        if self._steps and (self._request_ns is None or now_ns >= self._request_ns + ASK_NS):
            output += self._steps[0].ask()
            self._request_ns = now_ns
        return output

    @property
    def due_ns(self) -> int:
        """Time of the next `advance`."""
        due_ns = min(self._beat_ns, self._repeater.due_ns)
        if not self._steps:
            return due_ns
        return 0 if self._request_ns is None else min(due_ns, self._request_ns + ASK_NS)

    def decode(self, chunks: Chunks) -> list[Message]:
        """Messages of the vehicle in received bytes, for `receive`."""
        messages = []
        for _, data in chunks:
            messages += [each for each in self._reader.feed(data) if protocol.sender_of(each) == self._peer.sender]
        return messages

    def receive(self, message: Message, now_ns: int) -> Sample | None:
        """Process a message of the vehicle; a sample, if it completes one."""
        self._now_ns = now_ns
        kind = message.get_type()
        if kind == self._sampler.position_message:
            sample = self._sampler.position(message, now_ns)
            flags = {"motors": self._armed, "emergency_stop": self._terminated, "stopped": self.stopped}
            return sample and msgspec.structs.replace(sample, **flags)
        match kind:
            case "ATTITUDE":
                self._sampler.attitude(message, now_ns)
            case "HEARTBEAT":
                self._watch(message)
            case "SYS_STATUS":
                self._sampler.status(message)
            case "EXTENDED_SYS_STATE":
                self._landed = message.landed_state
            case "COMMAND_ACK":
                self._acknowledged(message)
            case "STATUSTEXT":
                if text := self._texts.hear(message, now_ns):
                    self.news.append(("warned", f'the autopilot says "{text}"'))
        return None

    def _opening(self) -> list[_Step]:
        orders, autopilot, sampler = self._orders, self._peer.autopilot, self._sampler
        position = f"its position ({sampler.position_message} and ATTITUDE)"
        steps = [_Step(position, lambda: sampler.state is not None and bool(self._mode), self._telemetry)]
        if orders.switch_mode:
            switch = protocol.switch_mode(self._peer.sender, autopilot, autopilot.follows)
            led_ns = self._boot_ns + seconds_to_ns(autopilot.lead_s)
            steps.append(_Step("set-points to have come for a while", lambda: self._now_ns >= led_ns, list))
            steps.append(_Step(f"it to switch to {autopilot.follows}", lambda: self.in_command, lambda: [switch]))
        if orders.arm:
            steps.append(_Step("it to arm", lambda: self._armed, self._ask_to_arm))
        if orders.takeoff_m is not None:
            steps.append(_Step(f"it to reach {orders.takeoff_m:g} m", self._high, self._rise))
        return steps

    def _ask_to_arm(self) -> list[Message]:
        self._has_armed = True
        return [protocol.arm_command(self._peer.sender, on=True)]

    def _telemetry(self) -> list[Message]:
        """Request telemetry; with REQUEST_DATA_STREAM too, if message intervals had no effect."""
        to, hz = self._peer.sender, self._orders.telemetry_hz
        requests = protocol.interval_requests(to, self._sampler.position_message, hz)
        if self._old_streams:
            requests += protocol.stream_requests(to, hz)
        self._old_streams = True
        return requests

    def _rise(self) -> list[Message]:
        """PX4 climbs by set-points, without a global position; ArduPilot needs a command to leave the ground."""
        state, height = self._sampler.state, self._orders.takeoff_m
        assert state is not None  # noqa: S101  its position is the first step
        assert height is not None  # noqa: S101  there is this step
        if self._climb_to is None:
            self._climb_to = state.position[2] + NEAR * height
        if self._peer.autopilot.kind == "px4":
            return []
        return [protocol.command_long(self._peer.sender, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height)]

    def _high(self) -> bool:
        state = self._sampler.state
        if self._climb_to is None or state is None or state.position[2] < self._climb_to:
            return False
        self._climb_to = None
        return True

    @property
    def _stands(self) -> bool:
        state = self._sampler.state
        still = state is not None and max(map(abs, state.velocity)) < STANDS
        return still and (self._peer.on_ground or self._landed == mavlink.MAV_LANDED_STATE_ON_GROUND)

    def _watch(self, beat: Message) -> None:
        autopilot = self._peer.autopilot
        self._mode = autopilot.mode(beat.custom_mode)
        self._terminated = beat.system_status == mavlink.MAV_STATE_FLIGHT_TERMINATION
        armed = bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if self._armed and not armed:
            self._halt("it has disarmed")
        self._armed = armed
        follows = self._mode == autopilot.follows
        if follows and not self.in_command:
            self._repeater.stop(f"it has just been switched to {self._mode}")  # old commands do not count
            self.news.append(("connected", f"it is in {self._mode}: it follows commands"))
        elif self.in_command and not follows:
            self._halt(f"its pilot or the autopilot switched it to {self._mode}: the driver releases control")
        self.in_command = follows

    def _halt(self, cause: str) -> None:
        self.stop(cause)
        if not self._leaving:
            self.news.append(("stopped", cause))

    def _acknowledged(self, message: Message) -> None:
        if message.result in _RESULTS:
            command = mavlink.enums["MAV_CMD"].get(message.command)
            name = command.name.removeprefix("MAV_CMD_") if command else f"command {message.command}"
            self._refusal = f"{name}: {_RESULTS[message.result]}"

    def _points(self, linear: Vec3, yaw_rate: float) -> list[Message]:
        """Set-point; none while ArduPilot takes off, as any would end that."""
        if self._climb_to is not None and self.in_command:
            if self._peer.autopilot.kind == "ardupilot":
                return []
            linear, yaw_rate = (0.0, 0.0, CLIMB), 0.0
        boot_ms = (self._now_ns - self._boot_ns) // MS
        return [protocol.setpoint(self._peer.sender, boot_ms, linear, yaw_rate, on_ground=self._peer.on_ground)]


class StatusTexts:
    """Error messages (STATUSTEXT) of one vehicle, joined from chunks. The ``last`` one is not repeated for a while."""

    def __init__(self) -> None:
        self.last = ""
        self._last_ns = -REPEAT_NS
        self._piece: dict[int, str] = {}  # start of a text, by its number

    def hear(self, message: Message, now_ns: int) -> str:
        """Text to report now; empty: the text continues, is no error, or was reported recently."""
        text = self._piece.pop(message.id, "") + message.text if message.id and message.chunk_seq else message.text
        if message.id and len(message.text) == TEXT:
            self._piece = {message.id: text}
            return ""
        if message.severity > mavlink.MAV_SEVERITY_ERROR or not text.strip():
            return ""
        text = "".join(map(_shown, text.strip()))
        if text == self.last and now_ns - self._last_ns < REPEAT_NS:
            return ""
        self.last, self._last_ns = text, now_ns
        return text


def _shown(letter: str) -> str:
    return letter if letter.isprintable() else "?"
