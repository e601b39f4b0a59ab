"""Handshake: from an open link to a robot that stands with its motors on: synchronise, open, enable. Without clock and link.

After a stop by its watchdog a robot resumes its last speed at the next command, and if its last session is still open, the
first message of the handshake is such a command, PULSE. So zero speed comes first at every start of the handshake, and again
before the motors are enabled.

Source of order, waiting times and answers: Pioneer 2 and AmigoBot manuals, "Client connection".
"""

from typing import Literal

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Value
from vcmvsp.hardware.drivers.arcos import protocol
from vcmvsp.hardware.drivers.arcos.protocol import BAUDS, CONFIG_PACKET, SYNC0, SYNC2, Command, Config, command, is_sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS, Robot
from vcmvsp.hardware.drivers.base import HandshakeError

ZERO_SPEED = command(Command.VEL, 0) + command(Command.RVEL, 0)
SYNC_WAIT_NS = 1_000_000_000  # for each echo, as ARIA does
QUIET_NS = 200_000_000  # two packet periods: packets in transit arrive within this time
OPEN_WAIT_NS = 500_000_000  # for the effect of OPEN and of ENABLE
OPEN_TRIES = 6  # before a restart
_OWN = command(Command.VEL, 0)[3:-2]  # never sent by a robot

_Phase = Literal["sync", "quiet", "open", "enable", "done"]


class Settings(Value, frozen=True, kw_only=True):
    """Settings of the robot for the session; None keeps its own value. Units: m, s, rad."""

    max_speed: float | None = None
    accel: float | None = None
    decel: float | None = None
    max_yaw_rate: float | None = None
    yaw_accel: float | None = None

    def commands(self) -> bytes:
        """Commands in mm and degrees, deceleration as a negative acceleration."""
        mm, degrees = 1000.0, 57.29577951308232
        numbers = (
            (Command.SETV, self.max_speed, mm),
            (Command.SETA, self.accel, mm),
            (Command.SETA, self.decel, -mm),
            (Command.SETRV, self.max_yaw_rate, degrees),
            (Command.SETRA, self.yaw_accel, degrees),
            (Command.SETRA, self.yaw_accel, -degrees),
        )
        return b"".join(command(number, round(value * unit)) for number, value, unit in numbers if value is not None)


class Handshake:
    """One attempt to connect. Pass bytes and time, send the returned bytes, until it `is_done` or raises.

    ``kind`` is the required subclass, such as ``amigo``, empty: any known one; ``baud`` is for messages, 0: none.
    """

    def __init__(self, *, device: str, kind: str, settings: Settings, baud: int, give_up_s: float) -> None:
        self.robot: Robot | None = None
        self.name = ""  # name of the robot
        self.config: Config | None = None  # configuration of the robot, if it sends one
        self.due_ns = 0  # time of the next `advance`
        self.reader = protocol.PacketReader()
        self._device, self._kind, self._settings, self._baud, self._give_up_s = device, kind, settings, baud, give_up_s
        self._phase: _Phase = "sync"
        self._sync = SYNC0  # awaits its echo
        self._tries = 0
        self._deadline_ns = 0
        self._bytes = self._packets = 0

    @property
    def is_done(self) -> bool:
        """The robot sends packets, stands at zero speed, and its motors are on."""
        return self._phase == "done"

    def start(self, now_ns: int) -> bytes:
        """The first bytes to send."""
        self._deadline_ns = now_ns + seconds_to_ns(self._give_up_s)
        return self._begin(now_ns)

    def receive(self, chunk: bytes, now_ns: int) -> bytes:
        """Process received bytes; bytes to send."""
        self._bytes += len(chunk)
        return b"".join(self._packet(data, now_ns) for data in self.reader.feed(chunk))

    def advance(self, now_ns: int) -> bytes:
        """Bytes to send at this time; raises `HandshakeError` after the deadline."""
        if self.is_done or now_ns < self.due_ns:
            return b""
        # An apparent long packet may hold back a short answer.
        answer = b"".join(self._packet(data, now_ns) for data in self.reader.give_up())
        if answer or self.is_done:
            return answer
        if now_ns >= self._deadline_ns:
            raise self._error()
        if self._phase in ("sync", "quiet") or self._tries >= OPEN_TRIES:
            return self._begin(now_ns)
        return self._ask(now_ns)

    def _packet(self, data: bytes, now_ns: int) -> bytes:
        self._packets += 1
        if self._phase == "sync":
            return self._synchronise(data, now_ns)
        if self._phase in ("open", "enable") and is_sip(data):
            return self._session(data, now_ns)
        if self._phase == "enable" and data[:1] == bytes((CONFIG_PACKET,)):
            self.config = protocol.decode_config(data)
        return b""  # stragglers

    def _synchronise(self, data: bytes, now_ns: int) -> bytes:
        """Answer to SYNC0, 1 or 2: its echo, a packet of an open session, or something else."""
        if is_sip(data):
            self._pause(now_ns)
            return ZERO_SPEED + command(Command.CLOSE)
        if data == _OWN:
            raise self._looped()
        if not data or data[0] != self._sync:
            self._pause(now_ns)
            return b""
        if self._sync < SYNC2:
            self._sync += 1
            self._wait(now_ns, SYNC_WAIT_NS)
            return command(self._sync)
        self.robot = self._identify(data)
        self._phase, self._tries = "open", 0
        return self._ask(now_ns)

    def _session(self, data: bytes, now_ns: int) -> bytes:
        """An information packet of the new session."""
        try:
            motors_on = protocol.decode_sip(data).motors_on
        except ValueError:
            return b""
        if self._phase == "enable" and motors_on:
            self._phase = "done"
        elif self._phase == "open":
            self._phase, self._tries = "enable", 0
            return self._ask(now_ns)
        return b""

    def _begin(self, now_ns: int) -> bytes:
        self._phase, self._sync = "sync", SYNC0
        self._wait(now_ns, SYNC_WAIT_NS)
        return ZERO_SPEED + command(SYNC0)

    def _pause(self, now_ns: int) -> None:
        self._phase = "quiet"
        self._wait(now_ns, QUIET_NS)

    def _ask(self, now_ns: int) -> bytes:
        """Request information packets or motors, repeatedly: only the packets show the effect."""
        self._tries += 1
        self._wait(now_ns, OPEN_WAIT_NS)
        if self._phase == "open":
            return ZERO_SPEED + command(Command.OPEN, 1)
        return ZERO_SPEED + self._settings.commands() + command(Command.CONFIG, 1) + command(Command.ENABLE, 1)

    def _wait(self, now_ns: int, at_most_ns: int) -> None:
        self.due_ns = min(now_ns + at_most_ns, self._deadline_ns)

    def _identify(self, data: bytes) -> Robot:
        words = data[1:].decode("latin-1").split("\0")
        if len(words) < 3:
            raise self._looped()
        self.name, family, subclass = words[0], words[1], words[2]
        robot = ROBOTS.get(subclass.lower())
        if robot is None:
            happened = f"the robot is {family or 'a robot'} {subclass!r}, whose parameters are unknown"
            raise HandshakeError(self._device, happened, f"supported robots: {', '.join(ROBOTS)}")
        if self._kind and robot.kind != self._kind.lower():
            happened = f"the robot is of kind {robot.kind}{self.name and f' ({self.name})'}, not {self._kind}"
            raise HandshakeError(self._device, happened, f"set robot = {robot.kind!r}, or connect to the other robot")
        return robot

    def _looped(self) -> HandshakeError:
        happened = "the link echoes all bytes"
        return HandshakeError(self._device, happened, "check for a loop-back plug, or a radio modem without its partner")

    def _error(self) -> HandshakeError:
        if not self._bytes:
            happened = f"no byte was received for {self._give_up_s:.2g} s"
            advice = "check that the robot is on, the cable or radio is in its host port, and no other client is connected"
        elif not self._packets:
            happened = f"{self._bytes} bytes were received, but no packet"
            others = ", ".join(str(each) for each in BAUDS if each != self._baud)
            wrong = f"the baud rate may be wrong (it is {self._baud}; try {others}), or " if self._baud else ""
            advice = f"{wrong}the robot does not use ARCOS, P2OS or AmigOS"
        elif self._phase == "enable":
            happened = "its motors stay off"
            advice = "release the stop button, switch the motors on, or charge the battery"
        else:
            happened = f"{self._packets} packets were received, but no connection was made within {self._give_up_s:.2g} s"
            advice = "another client may be connected, or the line is bad: close the other, or switch the robot off and on"
        return HandshakeError(self._device, happened, advice)
