"""The driver of Pioneer and AmigoBot robots, real or emulated, on a serial port or over TCP.

One thread owns the line: it connects, reads, sends what `Steering` says, and connects again. All that it shares with the
caller is behind one lock, which nobody holds while waiting.
"""

import contextlib
import os
import select
import threading
import time
from collections import deque
from typing import Annotated, Literal

import msgspec

from cosim.clock import SECOND_NS, seconds_to_ns
from cosim.types import NonNegative, Positive, Vec3, Velocity
from hardware.arcos.commands import Command
from hardware.arcos.handshake import ZERO_SPEED, Handshake, Settings
from hardware.arcos.packet import Reader, command
from hardware.arcos.robots import Robot
from hardware.arcos.sip import Sip, decode, is_sip
from hardware.arcos.steering import Mode, Steering
from hardware.arcos.track import Track
from hardware.driver import (
    COMMAND_TIMEOUT_S,
    ORIGIN,
    CommandTimeout,
    DriverError,
    HandshakeError,
    LinkLost,
    Notice,
    Sample,
    checked,
)
from hardware.line import OPEN_S, Line, open_line

BRAKING_S = 2.0  # from 1 m/s at 0.5 m/s2: the motors are switched off when it stands, or after this
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0  # before one attempt to connect again and the next: doubled each time
NOTICES = 1000  # kept for somebody who asks

Baud = Annotated[int, msgspec.Meta(ge=1200, le=921_600)]
Kind = Literal["", "p2dx", "amigo", "amigo-sh"]


class _Closing(Exception):
    """The caller wants the thread to end."""


class ArcosDriver:
    """A robot that speaks ARCOS, P2OS, AmigOS or AmigoSH (`hardware.driver.Driver`).

    Speeds are rounded to 1 mm/s and 1 deg/s by the protocol (``vel2``: each wheel to 20 mm/s), and limited to what the robot
    ever does; limits for the sake of safety belong elsewhere.

    Args:
        port: ``/dev/ttyUSB0``, the path of a pseudo-terminal, or ``socket://host:8101``.
        robot: the kind that it must be; empty: any that is known.
        baud: of a serial port.
        mode: ``vel``: commands VEL and RVEL; ``vel2``: both wheels in one.
        connect_s: for the handshake.
        silence_s: without an information packet, the robot counts as lost.
        reconnect_s: for so long a robot that was lost is looked for; 0: losing it is an error at once.
        command_timeout_s: without a command, the robot is stopped.
        max_speed: m/s, told to the robot, which enforces it, as are the following; None: as it is set.
        accel: m/s2.
        decel: m/s2.
        max_yaw_rate: rad/s.
        yaw_accel: rad/s2.
    """

    ground_only = True

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
        self.device = port
        self.open_deadline_s = OPEN_S + connect_s + 1.0
        self.close_deadline_s = OPEN_S + BRAKING_S + 1.0
        self.robot: Robot | None = None  # once it is connected
        self._kind, self._baud, self._mode = robot, baud, mode
        self._connect_s, self._silence_s, self._reconnect_s = connect_s, silence_s, reconnect_s
        self._timeout_s = command_timeout_s
        self._settings = Settings(max_speed=max_speed, accel=accel, decel=decel, max_yaw_rate=max_yaw_rate, yaw_accel=yaw_accel)
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._notices: deque[Notice] = deque(maxlen=NOTICES)

    # What the caller does.

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Connect; raises what is wrong."""
        if self._thread is not None:
            raise RuntimeError(f"{self.device} is open already")
        self._track = Track(start)
        self._line: Line | None = None
        self._steering: Steering | None = None  # None: not connected
        self._sample: Sample | None = None
        self._failure: DriverError | None = None
        self._closing, self._ready = threading.Event(), threading.Event()
        self._leaving = False
        self._motors = True
        self._woken, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"robot at {self.device}", daemon=True)
        self._thread.start()
        self._ready.wait(self.open_deadline_s)
        if self._failure is not None or not self._ready.is_set():
            failure = self._failure or LinkLost(self.device, "the port hangs", "unplug it and plug it in again")
            self.close()
            raise failure

    def read(self) -> Sample | None:
        """The newest sample that was not read yet."""
        with self._lock:
            self._check()
            sample, self._sample = self._sample, None
            if sample is not None:
                self._track.taken()
        return sample

    def write(self, velocity: Velocity) -> None:
        """Command a speed; while the robot is looked for after a loss, commands are dropped."""
        v, w = checked(velocity)
        with self._lock:
            self._check()
            if self._steering is not None:
                self._steering.command((v, w), time.monotonic_ns())
        self._wake()

    def stop(self, cause: str) -> None:
        """Zero speed at once; never raises."""
        with self._lock:
            if self._steering is not None:
                self._steering.stop(cause)
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what="stopped", cause=cause))
        self._wake()

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        with self._lock:
            notices = list(self._notices)
            self._notices.clear()
        return notices

    def close(self) -> None:
        """Bring the robot to a stand, switch its motors off, end the session."""
        thread = self._thread
        if thread is None:
            return
        self._closing.set()
        self._wake()
        thread.join(self.close_deadline_s)
        with self._lock:
            # One that is alive hangs in the operating system, and will end with the process.
            if self._thread is thread and not thread.is_alive():
                os.close(self._waker)
                os.close(self._woken)
                self._thread = None

    def _check(self) -> None:
        if self._thread is None:
            raise RuntimeError(f"{self.device} is not open")
        if self._failure is not None:
            raise self._failure

    def _wake(self) -> None:
        with self._lock:
            if self._thread is not None:
                os.write(self._waker, b"\0")

    # What the thread does.

    def _run(self) -> None:
        try:
            reader = self._connect(time.monotonic_ns() + seconds_to_ns(self._connect_s))
            while True:
                try:
                    self._converse(reader)
                except LinkLost as lost:
                    self._let_go(lost)
                    reader = self._look_for(lost)
        except _Closing:
            if not self._ready.is_set():
                self._failure = HandshakeError(self.device, "it was closed while it was being connected", "open it again")
            self._say_goodbye()
        except DriverError as error:
            self._failure = error
        except Exception as error:  # whatever it is: the caller must be told, and the robot stopped
            self._failure = DriverError(self.device, f"the driver failed ({type(error).__name__}: {error})", "report this")
        finally:
            self._hang_up()
            self._ready.set()

    def _connect(self, deadline_ns: int) -> Reader:
        """Open the line and shake hands, until the deadline."""
        self._line = open_line(self.device, self._baud)
        left_s = max(0.0, (deadline_ns - time.monotonic_ns()) / SECOND_NS)
        baud = 0 if "://" in self.device else self._baud
        handshake = Handshake(device=self.device, kind=self._kind, settings=self._settings, baud=baud, give_up_s=left_s)
        self._line.write(handshake.start(time.monotonic_ns()))
        while not handshake.done:
            if self._wait(handshake.due_ns):
                answer = handshake.receive(self._line.read(), time.monotonic_ns())
            else:
                answer = handshake.advance(time.monotonic_ns())
            if answer:
                self._line.write(answer)
        assert handshake.robot is not None  # noqa: S101  it is done
        with self._lock:
            self.robot = handshake.robot
            self._track.connect(self.robot)
            self._steering = Steering(self.robot, self._mode, self._timeout_s)
        name = handshake.name or "a robot without a name"
        self._notice("connected", f"{name}, {self.robot.name}")
        self._ready.set()
        return handshake.reader

    def _converse(self, reader: Reader) -> None:
        """Read and send until the link is lost or the caller closes it."""
        assert self._line is not None  # noqa: S101  it is connected
        silence_ns = seconds_to_ns(self._silence_s)
        heard_ns = time.monotonic_ns()
        while True:
            due_ns = self._send(self._line)
            if self._wait(min(due_ns, heard_ns + silence_ns)):
                if self._take(reader.feed(self._line.read())):
                    heard_ns = time.monotonic_ns()
            elif time.monotonic_ns() >= heard_ns + silence_ns:
                happened = f"nothing was heard for {self._silence_s:g} s"
                raise LinkLost(self.device, happened, "look at the robot's battery, its cable and its radio")

    def _send(self, line: Line) -> int:
        """Send what is due; when the next is."""
        with self._lock:
            steering = self._steering
            assert steering is not None  # noqa: S101  it is connected
            before = steering.stopped
            data = steering.packets(time.monotonic_ns())
            due_ns, stopped = steering.due_ns, steering.stopped
        if stopped != before:
            self._notice("stopped", stopped)
        if data:
            line.write(data)
        return due_ns

    def _take(self, packets: list[bytes]) -> bool:
        """Make samples of information packets; whether there was one."""
        sips = _sips(packets)
        for sip in sips:
            with self._lock:
                assert self._steering is not None  # noqa: S101  it is connected
                sample = self._sample = self._track.add(sip, time.monotonic_ns(), self._steering.stopped)
            if self._motors and not sample.motors:
                button = ": its stop button is pressed" if sample.emergency_stop else ""
                self._notice("stopped", f"the robot has switched its motors off{button}")
            self._motors = sample.motors
        return bool(sips)

    def _let_go(self, lost: LinkLost) -> None:
        """Note the loss; a robot that still hears us stops now, any other by its own watchdog."""
        with self._lock:
            self._steering = None
        self._notice("lost", f"{lost.happened}; the robot's watchdog stops it")
        self._hang_up()

    def _look_for(self, lost: LinkLost) -> Reader:
        """Connect again, after longer and longer pauses."""
        deadline_ns = time.monotonic_ns() + seconds_to_ns(self._reconnect_s)
        pause_s, last = FIRST_PAUSE_S, ""
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            self._pause(min(deadline_ns, now_ns + seconds_to_ns(pause_s)))
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            try:
                return self._connect(min(deadline_ns, time.monotonic_ns() + seconds_to_ns(self._connect_s)))
            except DriverError as error:
                last = error.happened
                self._hang_up()
        if not self._reconnect_s:
            raise lost
        happened = f"{lost.happened}, and it was not back within {self._reconnect_s:g} s ({last})"
        raise LinkLost(self.device, happened, lost.advice)

    def _say_goodbye(self) -> None:
        """Zero speed, wait until the robot stands, motors off, end of the session."""
        line, reader = self._line, Reader()
        if line is None:
            return
        self._leaving = True
        until_ns = time.monotonic_ns() + seconds_to_ns(BRAKING_S)
        try:
            line.write(ZERO_SPEED)
            moving = self._steering is not None
            while moving and time.monotonic_ns() < until_ns:
                if self._wait(until_ns):
                    moving = not any(each.left == each.right == 0 for each in _sips(reader.feed(line.read())))
            line.write(ZERO_SPEED + command(Command.ENABLE, 0) + command(Command.CLOSE, 1))
        except LinkLost:
            return  # it has gone by itself

    def _hang_up(self) -> None:
        """Free the port, with zero speed and the end of the session as the last words to whoever still listens."""
        line, self._line = self._line, None
        if line is None:
            return
        if not self._closing.is_set():
            with contextlib.suppress(LinkLost):
                line.write(ZERO_SPEED + command(Command.CLOSE, 1))
        line.close()

    def _wait(self, until_ns: int) -> bool:
        """Wait for bytes, for the caller, or until this time; whether there are bytes."""
        assert self._line is not None  # noqa: S101  only called with a line
        return self._line.fileno() in self._select([self._line.fileno()], until_ns)

    def _pause(self, until_ns: int) -> None:
        while time.monotonic_ns() < until_ns:
            self._select([], until_ns)

    def _select(self, files: list[int], until_ns: int) -> list[int]:
        left_s = max(0.0, (until_ns - time.monotonic_ns()) / SECOND_NS)
        ready, _, _ = select.select([self._woken, *files], [], [], left_s)
        if self._woken in ready:
            os.read(self._woken, 4096)
        if self._closing.is_set() and not self._leaving:
            raise _Closing
        return ready

    def _notice(self, what: Literal["connected", "lost", "stopped"], cause: str) -> None:
        with self._lock:
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))


def _sips(packets: list[bytes]) -> list[Sip]:
    """Those of the packets that are whole information packets; the configuration, for one, is not."""
    sips = []
    for data in packets:
        if is_sip(data):
            try:
                sips.append(decode(data))
            except ValueError:
                continue  # cut off by the robot: a checksum guards the rest
    return sips
