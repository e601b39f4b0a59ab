"""Driver of Pioneer and AmigoBot robots, real or emulated, on a serial port or over TCP, and samples of their packets."""

import contextlib
import time
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import NonNegative, Odometry, Positive, Vec3
from vcmvsp.hardware.drivers.arcos import protocol
from vcmvsp.hardware.drivers.arcos.handshake import ZERO_SPEED, Handshake, Settings
from vcmvsp.hardware.drivers.arcos.protocol import COUNT_BITS, Command, Mode, PacketReader, Sip, command, decode_sip, is_sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, LinkLost, Sample
from vcmvsp.hardware.drivers.byte_link import OPEN_S, ByteLink, open_line
from vcmvsp.hardware.drivers.threaded import CommandRepeater, ReconnectingDriver

HEADING_COUNTS = 4096  # a turn
EMERGENCY_STOP = 1 << 5  # bit of the flags in ARCOS
AGE_NS = 50_000_000  # half a packet period: packets have no time, and their data is up to one period old
DRIFT = 0.01  # relative error of the robot's period
LEAP_S = 1.0  # longest step of the pose: greatest speed times (time since the last packet + this)


class ArcosSampler:
    """Converts packets to samples, from the start pose, over reconnections; ``leaps``: impossible steps, left out."""

    def __init__(self, start: Vec3) -> None:
        self.leaps = 0
        self._pose = start
        self._number = self._link = 0
        self._last: Sip | None = None
        self._turned = 0.0  # rotation from the robot's own frame to that of the pose
        self._arrived_ns = self._clock_ns = 0
        self._sonar: dict[int, float] = {}

    def connect(self, robot: Robot) -> None:
        """Note that a connection begins: the next packet is the new base."""
        self._robot, self._last = robot, None
        self._link += 1

    def add(self, sip: Sip, now_ns: int, stopped: str) -> Sample:
        """Sample of a packet that arrived now."""
        robot = self._robot
        self._clock_ns = self._sent_ns(now_ns)
        self._move(sip, now_ns)
        self._last, self._arrived_ns = sip, now_ns
        self._number += 1
        left, right = (1e-3 * robot.vel_factor * each for each in (sip.left, sip.right))
        # 0.1 deg/s if the packet has it, else from the wheels
        w = 1.7453292519943296e-3 * sip.rotation if sip.rotation is not None else (right - left) / robot.track_m
        for number, counts in sip.sonars:
            self._sonar[number] = 1e-3 * robot.range_factor * counts
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=now_ns,
            measured_ns=self._clock_ns - AGE_NS,
            odometry=Odometry(pose=self._pose, v=0.5 * (left + right), w=w),
            wheels=(left, right),
            sonar=tuple(sorted(self._sonar.items())),
            battery_v=0.1 * (sip.battery if sip.battery_x10 is None else sip.battery_x10),
            motors=sip.motors_on,
            stalled=sip.stalled,
            bumpers=sip.stall & 0xFEFE,
            emergency_stop=bool(sip.flags & EMERGENCY_STOP),
            stopped=stopped,
        )

    def clear_sonar(self) -> None:
        """Note that the newest sample was read: its sonar readings are not repeated."""
        self._sonar = {}

    def _move(self, sip: Sip, now_ns: int) -> None:
        last, robot = self._last, self._robot
        x, y, yaw = self._pose
        if last is None:
            self._turned = yaw - robot.angle_factor * sip.heading
            return
        dx, dy = (1e-3 * robot.dist_factor * _difference(*both, 1 << COUNT_BITS) for both in ((sip.x, last.x), (sip.y, last.y)))
        farthest = robot.max_speed * (1e-9 * (now_ns - self._arrived_ns) + LEAP_S)
        if dx * dx + dy * dy > farthest * farthest:
            self.leaps += 1
            self._turned = yaw - robot.angle_factor * sip.heading
            return
        dx, dy = rotate2(dx, dy, self._turned)
        self._pose = (x + dx, y + dy, yaw + robot.angle_factor * _difference(sip.heading, last.heading, HEADING_COUNTS))

    def _sent_ns(self, now_ns: int) -> int:
        """Time of sending, by the minimum delay: packets leave once a period, some arrive late, none early."""
        period = seconds_to_ns(self._robot.period_s)
        if self._last is None:
            return now_ns
        periods = max(1, round((now_ns - self._clock_ns) / period))
        return min(now_ns, self._clock_ns + round(periods * period * (1.0 + DRIFT)))  # at most half a period before now


def _difference(new: int, old: int, modulus: int) -> int:
    return (new - old + modulus // 2) % modulus - modulus // 2


STILL = (0.0, 0.0)  # m/s, rad/s
RESEND_NS = 200_000_000  # commands are not acknowledged; the robot stops after 2 s without one
BRAKING_S = 2.0  # from 1 m/s at 0.5 m/s2: motors are switched off when the robot stands, or after this time

Baud = Annotated[int, msgspec.Meta(ge=1200, le=921_600)]
Kind = Literal["", "p2dx", "amigo", "amigo-sh"]


class ArcosDriver(ReconnectingDriver):
    """A robot with ARCOS, P2OS, AmigOS or AmigoSH (`hardware.drivers.base.Driver`).

    The protocol rounds speeds to 1 mm/s and 1 deg/s (``vel2``: each wheel to 20 mm/s); the driver limits them to the greatest
    speeds of the robot. Safety limits belong elsewhere.

    Args:
        port: ``/dev/ttyUSB0``, the path of a pseudo-terminal, or ``socket://host:8101``.
        robot: required kind; empty: any known kind.
        baud: of a serial port.
        mode: ``vel``: commands VEL and RVEL; ``vel2``: both wheels in one.
        connect_s: for the handshake.
        silence_s: without an information packet, the robot counts as lost.
        reconnect_s: time to look for a lost robot; 0: its loss is an error at once.
        command_timeout_s: without a command, the robot is stopped.
        max_speed: m/s, limit enforced by the robot, like the following; None: the robot's setting.
        accel: m/s2.
        decel: m/s2.
        max_yaw_rate: rad/s.
        yaw_accel: rad/s2.
    """

    ground_only = True
    _meanwhile = "the robot's watchdog stops it"

    def __init__(
        self,
        port: str,
        *,
        robot: Kind = "",
        baud: Baud = 9600,
        mode: Mode = "vel",
        connect_s: Positive = 10.0,
        silence_s: Positive = 2.0,
        reconnect_s: NonNegative = 0.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
        max_speed: Positive | None = None,
        accel: Positive | None = None,
        decel: Positive | None = None,
        max_yaw_rate: Positive | None = None,
        yaw_accel: Positive | None = None,
    ) -> None:
        super().__init__(
            port,
            open_deadline_s=OPEN_S + connect_s + 1.0,
            close_deadline_s=OPEN_S + BRAKING_S + 1.0,
            connect_s=connect_s,
            silence_s=silence_s,
            reconnect_s=reconnect_s,
        )
        self.robot: Robot | None = None  # once it is connected
        self._kind, self._baud, self._mode = robot, baud, mode
        self._timeout_s = command_timeout_s
        self._settings = Settings(max_speed=max_speed, accel=accel, decel=decel, max_yaw_rate=max_yaw_rate, yaw_accel=yaw_accel)

    def _prepare(self, start: Vec3) -> None:
        super()._prepare(start)
        self._sampler = ArcosSampler(start)
        self._line: ByteLink | None = None
        self._repeater = CommandRepeater(STILL, self._timeout_s, again_ns=RESEND_NS)  # until it is connected
        self._motors = True

    def _was_read(self) -> None:
        self._sampler.clear_sonar()

    def _connect(self, within_s: float) -> None:
        deadline_ns = time.monotonic_ns() + seconds_to_ns(within_s)
        self._line = line = open_line(self.device, self._baud)
        remaining_s = max(0.0, (deadline_ns - time.monotonic_ns()) / SECOND_NS)
        baud = 0 if "://" in self.device else self._baud
        handshake = Handshake(device=self.device, kind=self._kind, settings=self._settings, baud=baud, give_up_s=remaining_s)
        line.write(handshake.start(time.monotonic_ns()))
        while not handshake.is_done:
            if self._wait(line.fileno(), handshake.due_ns):
                answer = handshake.receive(line.read(), time.monotonic_ns())
            else:
                answer = handshake.advance(time.monotonic_ns())
            if answer:
                line.write(answer)
        assert handshake.robot is not None  # noqa: S101  it is done
        with self._lock:
            self.robot = handshake.robot
            self._sampler.connect(self.robot)
            cycle_ns = seconds_to_ns(self.robot.period_s)
            self._repeater = CommandRepeater(STILL, self._timeout_s, again_ns=RESEND_NS, least_ns=cycle_ns)
            self._connected = True
        name = handshake.name or "a robot without a name"
        self._notice("connected", f"{name}, {self.robot.name}")
        if handshake.config is not None:
            for each in protocol.setting_warnings(
                handshake.config, self.robot, self._settings.max_speed, self._settings.max_yaw_rate
            ):
                self._notice("warned", each)
        self._reader = handshake.reader
        self._ready.set()

    def _converse(self) -> None:
        line, robot = self._line, self.robot
        assert line is not None and robot is not None  # noqa: PT018, S101  it is connected
        silence_ns = seconds_to_ns(self._silence_s)
        last_packet_ns = time.monotonic_ns()
        while True:
            command, due_ns = self._due_command()
            if command is not None:
                v, w = command
                line.write(protocol.speeds(robot, v, w, self._mode))
            if self._wait(line.fileno(), min(due_ns, last_packet_ns + silence_ns)):
                if self._take(self._reader.feed(line.read())):
                    last_packet_ns = time.monotonic_ns()
            elif time.monotonic_ns() >= last_packet_ns + silence_ns:
                happened = f"no packet was received for {self._silence_s:g} s"
                raise LinkLost(self.device, happened, "check the robot's battery, cable and radio")

    def _take(self, packets: list[bytes]) -> bool:
        sips = _sips(packets)
        for sip in sips:
            with self._lock:
                sample = self._sample = self._sampler.add(sip, time.monotonic_ns(), self._repeater.stopped)
            if self._motors and not sample.motors:
                button = ": its stop button is pressed" if sample.emergency_stop else ""
                self._notice("stopped", f"the robot has switched its motors off{button}")
            self._motors = sample.motors
        return bool(sips)

    def _say_goodbye(self) -> None:
        """Zero speed, wait until the robot stands, motors off, end of the session."""
        line, reader = self._line, PacketReader()
        if line is None:
            return
        self._leaving = True
        until_ns = time.monotonic_ns() + seconds_to_ns(BRAKING_S)
        try:
            line.write(ZERO_SPEED)
            moving = self._connected
            while moving and time.monotonic_ns() < until_ns:
                if self._wait(line.fileno(), until_ns):
                    moving = not any(each.left == each.right == 0 for each in _sips(reader.feed(line.read())))
            line.write(ZERO_SPEED + command(Command.ENABLE, 0) + command(Command.CLOSE, 1))
        except LinkLost:
            return  # the link is lost already

    def _hang_up(self) -> None:
        """Release the port, with zero speed and the end of the session as last messages."""
        line, self._line = self._line, None
        with self._lock:
            self._connected = False
        if line is None:
            return
        if not self._closing.is_set():
            with contextlib.suppress(LinkLost):
                line.write(ZERO_SPEED + command(Command.CLOSE, 1))
        line.close()


def _sips(packets: list[bytes]) -> list[Sip]:
    sips = []
    for data in packets:
        if is_sip(data):
            try:
                sips.append(decode_sip(data))
            except ValueError:
                continue  # cut off by the robot
    return sips
