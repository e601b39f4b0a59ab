"""Driver of Pioneer and AmigoBot robots, real or emulated, on a serial port or over TCP.

One thread uses the link: it connects, receives, sends the newest command, and reconnects. Everything shared with the caller is
behind one lock, which is never held while waiting.
"""

import contextlib
import time
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.types import NonNegative, Positive, Vec3, Velocity
from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.command_schedule import Mode, speeds
from vcmvsp.hardware.drivers.arcos.config_packet import warnings
from vcmvsp.hardware.drivers.arcos.handshake import ZERO_SPEED, Handshake, Settings
from vcmvsp.hardware.drivers.arcos.packet import PacketReader, command
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.drivers.arcos.samples import ArcosSampler
from vcmvsp.hardware.drivers.arcos.sip import Sip, decode, is_sip
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, LinkLost, checked
from vcmvsp.hardware.drivers.byte_link import OPEN_S, ByteLink, open_line
from vcmvsp.hardware.drivers.command_repeater import CommandRepeater
from vcmvsp.hardware.drivers.threaded import ReconnectingDriver

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

    # What the caller does.

    def write(self, velocity: Velocity) -> None:
        """Command a speed; ignored while a lost robot is looked for."""
        v, w = checked(velocity)
        with self._lock:
            self._check()
            if self._repeater is not None:
                self._repeater.command((v, w), time.monotonic_ns())
        self._wake()

    def _prepare(self, start: Vec3) -> None:
        super()._prepare(start)
        self._sampler = ArcosSampler(start)
        self._line: ByteLink | None = None
        self._repeater: CommandRepeater[tuple[float, float]] | None = None  # None: not connected
        self._motors = True

    def _was_read(self) -> None:
        self._sampler.taken()

    def _hold(self, cause: str) -> bool:
        if self._repeater is not None:
            self._repeater.stop(cause)
        return False

    # What the thread does.

    def _connect(self, within_s: float) -> None:
        """Open the link, and run the handshake."""
        deadline_ns = time.monotonic_ns() + seconds_to_ns(within_s)
        self._line = line = open_line(self.device, self._baud)
        remaining_s = max(0.0, (deadline_ns - time.monotonic_ns()) / SECOND_NS)
        baud = 0 if "://" in self.device else self._baud
        handshake = Handshake(device=self.device, kind=self._kind, settings=self._settings, baud=baud, give_up_s=remaining_s)
        line.write(handshake.start(time.monotonic_ns()))
        while not handshake.done:
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
        name = handshake.name or "a robot without a name"
        self._notice("connected", f"{name}, {self.robot.name}")
        if handshake.config is not None:
            for each in warnings(handshake.config, self.robot, self._settings.max_speed, self._settings.max_yaw_rate):
                self._notice("warned", each)
        self._reader = handshake.reader
        self._ready.set()

    def _converse(self) -> None:
        """Receive and send until the link is lost or the caller closes the driver."""
        line = self._line
        assert line is not None  # noqa: S101  it is connected
        silence_ns = seconds_to_ns(self._silence_s)
        last_packet_ns = time.monotonic_ns()
        while True:
            due_ns = self._send(line)
            if self._wait(line.fileno(), min(due_ns, last_packet_ns + silence_ns)):
                if self._take(self._reader.feed(line.read())):
                    last_packet_ns = time.monotonic_ns()
            elif time.monotonic_ns() >= last_packet_ns + silence_ns:
                happened = f"nothing was heard for {self._silence_s:g} s"
                raise LinkLost(self.device, happened, "look at the robot's battery, its cable and its radio")

    def _send(self, line: ByteLink) -> int:
        """Send the command that is due; time of the next one."""
        with self._lock:
            repeater, robot = self._repeater, self.robot
            assert repeater is not None and robot is not None  # noqa: PT018, S101  it is connected
            before = repeater.stopped
            command = repeater.advance(time.monotonic_ns())
            due_ns, stopped = repeater.due_ns, repeater.stopped
        if stopped != before:
            self._notice("stopped", stopped)
        if command is not None:
            line.write(speeds(robot, *command, self._mode))
        return due_ns

    def _take(self, packets: list[bytes]) -> bool:
        """Make samples of information packets; whether there was one."""
        sips = _sips(packets)
        for sip in sips:
            with self._lock:
                assert self._repeater is not None  # noqa: S101  it is connected
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
            moving = self._repeater is not None
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
            self._repeater = None
        if line is None:
            return
        if not self._closing.is_set():
            with contextlib.suppress(LinkLost):
                line.write(ZERO_SPEED + command(Command.CLOSE, 1))
        line.close()


def _sips(packets: list[bytes]) -> list[Sip]:
    """Valid information packets among the packets."""
    sips = []
    for data in packets:
        if is_sip(data):
            try:
                sips.append(decode(data))
            except ValueError:
                continue  # cut off by the robot
    return sips
