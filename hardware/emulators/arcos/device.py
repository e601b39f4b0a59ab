"""Emulated ARCOS robot as a state machine: bytes and times in, bytes out. It has no clock, no thread, no port.

It has the behaviour that clients rely on and must survive: an old session that continues to send, lost bytes, a watchdog that
stops the robot after 2 s **and lets it resume its last speed at the next command of any kind**. Where the manuals are silent,
it is the more demanding choice for a client: a speed that came while the motors were off is stored and applies once they are
on; only STOP, ESTOP, ENABLE 0 and CLOSE clear it.

It moves on its own (`Wheels`), or, with ``start=None``, the caller reads `commanded` and calls `moved`.
"""

import math
from collections import deque
from collections.abc import Sequence

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import arc, rotate2, wrap
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.hardware.drivers.arcos import protocol
from vcmvsp.hardware.drivers.arcos.protocol import SYNC0, SYNC1, SYNC2, Command, Config, PacketReader, Sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot

_ARRIVED_M = 1e-3  # MOVE ends this near to its goal; the firmware's own margin is not published


class SetPoints:
    """Set points of forward speed and yaw rate, from motion commands.

    A forward command (VEL, MOVE) and a turning one (RVEL, ROTATE, HEAD, DHEAD) hold side by side; VEL2, STOP and
    ESTOP replace both.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.accel, self.decel, self.yaw_accel, self.yaw_decel = robot.accel, robot.decel, robot.yaw_accel, robot.yaw_accel
        self.max_speed, self.max_yaw_rate = robot.speed, robot.yaw_rate
        self.emergency = False  # ESTOP: stop without deceleration
        self.stop()

    def stop(self) -> None:
        """Forget all commands for motion."""
        self._v = self._w = 0.0
        self._left_m: float | None = None  # remaining distance of MOVE
        self.heading: float | None = None  # rad, goal of HEAD or DHEAD

    def take(self, number: int, value: int, heading: float) -> None:
        """Take a motion command, its argument in the unit of the protocol, at the robot's own heading (rad)."""
        match number:
            case Command.VEL:
                self._v, self._left_m = value * 1e-3, None
            case Command.MOVE:
                self._v, self._left_m = 0.0, value * 1e-3
            case Command.RVEL | Command.ROTATE:
                self._w, self.heading = math.radians(value), None
            case Command.HEAD:
                self.heading = wrap(math.radians(value))
            case Command.DHEAD:
                self.heading = wrap(heading + math.radians(value))
            case Command.VEL2:
                self._wheels(value)
            case Command.STOP | Command.ESTOP:
                self.stop()
            case _:
                self._limit(number, value)
                return
        self.emergency = number == Command.ESTOP

    def _wheels(self, value: int) -> None:
        low, high = (value & 0xFFFF).to_bytes(2, "little")
        right_wheel, left_wheel = ((byte ^ 0x80) - 0x80 for byte in (low, high))
        mm = self.robot.vel2_divisor
        self.stop()
        self._v = 0.5e-3 * mm * (right_wheel + left_wheel)
        self._w = 0.5 * mm * (right_wheel - left_wheel) * self.robot.diff_factor

    def _limit(self, number: int, value: int) -> None:
        match number:
            case Command.SETV:
                self.max_speed = min(abs(value) * 1e-3, self.robot.max_speed)
            case Command.SETRV:
                self.max_yaw_rate = min(math.radians(abs(value)), self.robot.max_yaw_rate)
            case Command.SETA if value > 0:
                self.accel = value * 1e-3
            case Command.SETA if value < 0:
                self.decel = -value * 1e-3
            case Command.SETRA if value > 0:
                self.yaw_accel = math.radians(value)
            case Command.SETRA if value < 0:
                self.yaw_decel = math.radians(-value)

    def travelled(self, forward_m: float) -> None:
        """Count the distance travelled, for MOVE."""
        if self._left_m is not None:
            self._left_m -= forward_m
            if abs(self._left_m) <= _ARRIVED_M:
                self._left_m = None

    def target_speeds(self, heading: float) -> tuple[float, float]:
        """Forward speed (m/s) and yaw rate (rad/s) within the limits; towards a goal, as fast as it can still brake."""
        v, w = self._v, self._w
        if self._left_m is not None:
            v = math.copysign(math.sqrt(2.0 * self.decel * abs(self._left_m)), self._left_m)
        if self.heading is not None:
            error = wrap(self.heading - heading)
            w = math.copysign(math.sqrt(2.0 * self.yaw_decel * abs(error)), error)
        return max(-self.max_speed, min(self.max_speed, v)), max(-self.max_yaw_rate, min(self.max_yaw_rate, w))


class Wheels:
    """A robot without mass: its speeds follow the set points within accelerations, its path is made of arcs."""

    def __init__(self, pose: Vec3) -> None:
        self.pose, self.v, self.w = pose, 0.0, 0.0

    def step(self, target: tuple[float, float], motion: SetPoints, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        if motion.emergency:
            self.v = self.w = 0.0
        else:
            self.v = _towards(self.v, target[0], motion.accel * dt, motion.decel * dt)
            self.w = _towards(self.w, target[1], motion.yaw_accel * dt, motion.yaw_decel * dt)
        self.pose = arc(self.pose, self.v, self.w, dt)


def _towards(now: float, goal: float, up: float, down: float) -> float:
    """A speed nearer to its goal: by at most ``down`` while it falls, else by at most ``up``; it pauses at zero."""
    if now * goal < 0.0:
        goal = 0.0
    most = up if abs(goal) > abs(now) else down
    return now + max(-most, min(most, goal - now))


TICK_NS = 5_000_000  # time step of the emulation
GAP_NS = 200_000_000  # silence that ends a packet; 200 bytes take that long at 9600 baud
PINGS = 8  # sonars of an array, which take turns

_SYNCED, _OPEN = 3, 4  # stages of a session: 0 to 2 is the SYNC that is awaited


class Device:
    """A Pioneer or AmigoBot. Times are nanoseconds of a monotonic clock; earlier times than before count as now."""

    def __init__(
        self,
        robot: Robot,
        *,
        name: str = "emulated",
        start: Vec3 | None = ORIGIN,
        ping_ms: int = 40,
        old_session: bool = False,
    ) -> None:
        """``ping_ms``: from ping to ping within an array of 8 sonars; ``old_session``: a former client has never closed."""
        if ping_ms <= 0 or ping_ms * 1_000_000 % TICK_NS:
            raise ValueError(f"ping_ms must be a positive multiple of {TICK_NS // 1_000_000} ms, not {ping_ms}")
        self.robot, self.name = robot, name
        self.motion, self.reader = SetPoints(robot), PacketReader()
        self.heard: deque[tuple[int, int, int | bytes | None]] = deque(maxlen=1000)  # commands: time ns, number, argument
        self.commands = self.packets = 0  # counts
        self.baud, self.battery_v = robot.baud, 12.6  # rate set by HOSTBAUD
        self.watchdog_stopped = False  # any command lets it resume
        self.estop_pressed = False  # the red button of larger robots, bit 5 of the flags: motors off, even if enabled
        self._wheels = Wheels(start) if start is not None else None
        self.pose: Vec3 | None = start  # in the frame of its start or of `moved`; None: not set yet
        self._origin = start or ORIGIN
        self._v = self._w = 0.0
        self._stall = 0
        self._ranges: tuple[float, ...] = (robot.sonar_max_m,) * len(robot.sonars)
        self._pinged: dict[int, float] = {}
        self._ping_ns, self._period_ns = ping_ms * 1_000_000, seconds_to_ns(robot.period_s)
        self._watchdog_ns = seconds_to_ns(robot.watchdog_s)
        self.now_ns = self._heard_ns = self._bytes_ns = 0  # the first: of its last tick
        self._stage = 0
        self._enabled = False
        self._sonar_on = True
        self._open_ns = self._sips = 0
        if old_session:
            self._open()
            self._enabled = True

    def receive(self, chunk: bytes, now_ns: int) -> bytes:
        """Process bytes of the client; bytes that the robot sends until then and at once."""
        output = self.advance(now_ns)
        self._bytes_ns = max(now_ns, self.now_ns)
        return output + self._obey(self.reader.feed(chunk), self._bytes_ns)

    def advance(self, now_ns: int) -> bytes:
        """Bytes that the robot sends until this time."""
        output = bytearray()
        while self.now_ns + TICK_NS <= now_ns:
            self.now_ns = (self.now_ns // TICK_NS + 1) * TICK_NS
            output += self._tick()
        return bytes(output)

    @property
    def due_ns(self) -> int | None:
        """Time at which `advance` will have bytes to send; None: not before bytes arrive."""
        due = [self._next_sip_ns] if self._stage == _OPEN else []
        if self.reader.waiting:
            due.append(self._bytes_ns + GAP_NS)
        return -(-min(due) // TICK_NS) * TICK_NS if due else None

    @property
    def is_open(self) -> bool:
        """Whether a session is open: packets are sent."""
        return self._stage == _OPEN

    @property
    def motors_on(self) -> bool:
        """Whether the motors are enabled."""
        return self._enabled and not self.estop_pressed

    def commanded(self) -> tuple[float, float]:
        """Forward speed (m/s) and yaw rate (rad/s) to reach within `SetPoints.accel` etc., at once in an emergency."""
        if not self.motors_on or self.watchdog_stopped:
            return 0.0, 0.0
        return self.motion.target_speeds(self.odometry[2])

    def moved(self, pose: Vec3, v: float, w: float, ranges: Sequence[float] | None = None, stall: int = 0) -> None:
        """Set the present motion of the wheels: pose (x m, y m, yaw rad, in any fixed frame), speeds (m/s, rad/s).

        The first pose is the origin of odometry. ``ranges``: present range of each sonar, m, infinite: no echo, None:
        unchanged; ``stall``: the word of stalled wheels and bumpers, see `Sip`.
        """
        if self.pose is None:
            self._origin = self.pose = pose
        x, y, yaw = self.pose
        between = 0.5 * (yaw + pose[2])
        self.motion.travelled((pose[0] - x) * math.cos(between) + (pose[1] - y) * math.sin(between))
        self.pose, self._v, self._w, self._stall = pose, v, w, stall
        if ranges is not None:
            if len(ranges) != len(self.robot.sonars):
                raise ValueError(f"{self.robot.name} has {len(self.robot.sonars)} sonars, not {len(ranges)}")
            self._ranges = tuple(ranges)

    @property
    def odometry(self) -> Vec3:
        """Vec3 since the start or the last SETO: x m, y m, yaw rad."""
        x, y, yaw = self.pose or self._origin
        x0, y0, yaw0 = self._origin
        return *rotate2(x - x0, y - y0, -yaw0), wrap(yaw - yaw0)

    def _tick(self) -> bytes:
        now, output = self.now_ns, b""
        if self.reader.waiting and now - self._bytes_ns >= GAP_NS:
            output += self._obey(self.reader.give_up(), now)
        if self._watchdog_ns and self.is_open and now - self._heard_ns >= self._watchdog_ns:
            self.watchdog_stopped = True
        if self._wheels is not None:
            self._wheels.step(self.commanded(), self.motion, TICK_NS / SECOND_NS)
            self.moved(self._wheels.pose, self._wheels.v, self._wheels.w, stall=self._stall)
        if self._sonar_on and now % self._ping_ns == 0:
            turn = now // self._ping_ns % PINGS
            self._pinged |= {each: self._ranges[each] for each in range(turn, len(self._ranges), PINGS)}
        if self.is_open and now >= self._next_sip_ns:
            self._sips += 1
            self.packets += 1
            output += protocol.frame(protocol.encode_sip(self._sip()))
        return output

    @property
    def _next_sip_ns(self) -> int:
        return self._open_ns + (self._sips + 1) * self._period_ns

    def _sip(self) -> Sip:
        robot = self.robot
        x, y, yaw = self.odometry
        turning = self._w / robot.diff_factor  # mm/s, half the difference of the wheels
        heading = round(yaw / robot.angle_factor)
        goal = self.motion.heading
        setpoint = heading if goal is None else round(goal / robot.angle_factor)
        sonars = []
        for number, metres in sorted(self._pinged.items()):
            sonars.append((number, round(1e3 * max(0.0, min(metres, robot.sonar_max_m)) / robot.range_factor)))
        self._pinged = {}
        array_flags = 0x1E if self._sonar_on else 0
        return Sip(
            kind=protocol.MOVING if self._v or self._w else protocol.STOPPED,
            x=round(1e3 * x / robot.dist_factor),
            y=round(1e3 * y / robot.dist_factor),
            heading=heading,
            left=_int16((1e3 * self._v - turning) / robot.vel_factor),
            right=_int16((1e3 * self._v + turning) / robot.vel_factor),
            battery=round(10 * self.battery_v),
            stall=self._stall,
            setpoint=setpoint,
            flags=self.motors_on | array_flags | self.estop_pressed << 5,
            sonars=tuple(sonars),
            battery_x10=round(10 * self.battery_v),
            charge_state=0,
            rotation=_int16(10 * math.degrees(self._w)),
        )

    def _obey(self, packets: list[bytes], now_ns: int) -> bytes:
        output = b""
        for data in packets:
            try:
                number, argument = protocol.parse_command(data)
            except ValueError:
                continue  # valid checksum, invalid content: a robot does not answer
            self.heard.append((now_ns, number, argument))
            self.commands += 1
            output += self._serve(number, argument, now_ns) if self.is_open else self._shake_hands(number, now_ns)
        return output

    def _shake_hands(self, number: int, now_ns: int) -> bytes:
        """Before a session: echo SYNC0, 1, 2, then wait for OPEN.

        A SYNC out of order is answered like SYNC0: clients then restart.
        """
        if self._stage == _SYNCED and number == Command.OPEN:
            self._heard_ns = now_ns
            self._open()
            return b""
        if number == SYNC2 and self._stage >= SYNC2:
            self._stage = _SYNCED
            names = (self.name, "Pioneer", self.robot.kind)
            return protocol.frame(bytes((SYNC2,)) + b"".join(each.encode("latin-1") + b"\0" for each in names))
        if number in (SYNC0, SYNC1, SYNC2):
            answer = SYNC1 if number == SYNC1 and self._stage >= SYNC1 else SYNC0
            self._stage = answer + 1
            return protocol.frame(bytes((answer,)))
        return b""

    def _open(self) -> None:
        self._stage, self._open_ns, self._sips = _OPEN, self.now_ns, 0
        self.watchdog_stopped = False

    def _serve(self, number: int, argument: int | bytes | None, now_ns: int) -> bytes:
        """In a session: any command restarts the watchdog and ends its stop."""
        self._heard_ns = now_ns
        self.watchdog_stopped = False
        value = _int16(argument) if isinstance(argument, int) else 0
        match number:
            case Command.CLOSE:
                self._close()
            case Command.ENABLE:
                self._enable(bool(value))
            case Command.SETO:
                self._origin = self.pose or self._origin
            case Command.SONAR:
                self._sonar_on = bool(value & 1)
                self._pinged.clear()
            case Command.HOSTBAUD if 0 <= value < len(protocol.BAUDS):
                self.baud = protocol.BAUDS[value]
            case Command.CONFIG:
                return protocol.frame(protocol.encode_config(self._config()))
            case _:
                self.motion.take(number, value, self.odometry[2])
        return b""

    def _enable(self, on: bool) -> None:
        self._enabled = on
        if not on:
            self.motion.stop()

    def _close(self) -> None:
        """End of a session: the robot stops, and its settings are reset."""
        self._stage, self.baud = 0, self.robot.baud
        self._enable(False)
        self.motion = SetPoints(self.robot)

    def _config(self) -> Config:
        robot, motion = self.robot, self.motion
        return Config(
            subclass=robot.kind,
            serial_number="0",
            top_yaw_rate=round(math.degrees(robot.max_yaw_rate)),
            top_speed=round(1e3 * robot.max_speed),
            name=self.name,
            sip_cycle=self._period_ns // 1_000_000,
            host_baud=protocol.BAUDS.index(robot.baud),
            front_sonar=1,
            rear_sonar=1,
            watchdog=round(1e3 * robot.watchdog_s),
            max_yaw_rate=round(math.degrees(motion.max_yaw_rate)),
            max_speed=round(1e3 * motion.max_speed),
            yaw_accel=round(math.degrees(motion.yaw_accel)),
            yaw_decel=round(math.degrees(motion.yaw_decel)),
            accel=round(1e3 * motion.accel),
            decel=round(1e3 * motion.decel),
            sonar_cycle=self._ping_ns // 1_000_000,
            version="1.0",
        )


def _int16(value: float) -> int:
    """The nearest integer, wrapped into 16 bits with sign as the controller's arithmetic does."""
    return (round(value) + 0x8000) % 0x10000 - 0x8000
