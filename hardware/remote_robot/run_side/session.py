"""Session with a connected robot: orders to it, samples and notices from it, until it is lost or must leave.

All but `write` and `stop` runs in the driver's thread; admission and the final loss of a robot belong to the driver.
"""

import math
import queue
import threading
import time
from typing import Any

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.estimation.clock_offset import EchoClock
from vcmvsp.cosim.transport import key_names
from vcmvsp.cosim.types import Vec3, Velocity
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import DriverError, LinkLost, Notice, Sample
from vcmvsp.hardware.drivers.threaded import NOT_YET, NOTICES, CommandRepeater, ThreadedDriver
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import FAILURES, SAY_S, RobotHello, RobotOrder, RobotStatus
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, News, Peer, RobotGreeting, RobotListener, RobotMessage

WINDOW = 50  # number of exchanges in the window: some two seconds
MOST_READINGS = 64  # of sonar, in a sample
MOST_MISSED = 1_000_000  # samples between two received ones


class RemoteSampler:
    """Converts messages of a robot to samples and notices, from its start pose (x m, y m, yaw rad).

    ``pose`` is the newest pose of odometry, where a robot starts that is opened again.
    """

    def __init__(self, start: Vec3) -> None:
        self.clock = EchoClock(window=WINDOW)
        self.pose, self.link = start, 0
        self.noticed = 0  # notices of this robot so far
        self._number = 0
        self._last: tuple[int, int, int] | None = None  # openings, link and number of the robot's newest sample
        self._measured_ns = 0
        self._sonar: dict[int, float] = {}

    def connect(self, *, anew: bool) -> None:
        """A robot connected; ``anew``: another robot or clock than before."""
        self.link += 1
        self._last = None
        if anew:
            self.clock = EchoClock(window=WINDOW)
            self.noticed = 0

    def hear(self, status: RobotStatus, arrived_ns: int) -> None:
        """Use the times of a message."""
        if status.heard:
            self.clock.add(status.yours_ns, status.heard_ns, status.said_ns, arrived_ns)

    def sample(self, status: RobotStatus, arrived_ns: int, stopped: str) -> Sample | None:
        """Sample of a message; None: it has none, an old one, one that is not finite, or the clock is unknown."""
        theirs, clock = status.sample, self.clock.best(arrived_ns)
        if theirs is None or clock is None or not _finite(msgspec.to_builtins(theirs)):
            return None
        key = (status.opened, theirs.link, theirs.number)
        if self._last is not None and self._last[0] == status.opened and theirs.number <= self._last[2]:
            return None
        if self._last is not None and self._last[:2] != key[:2]:
            self.link += 1
        goes_on = self._last is not None and self._last[0] == status.opened
        self._number += min(theirs.number - self._last[2], MOST_MISSED) if self._last is not None and goes_on else 1
        self._last = key
        came_ns = min(theirs.arrived_ns + clock.offset_ns, arrived_ns)
        self._measured_ns = max(self._measured_ns, min(theirs.measured_ns + clock.offset_ns, came_ns))
        self.pose = theirs.odometry.pose
        self._sonar |= dict(theirs.sonar[:MOST_READINGS])
        return msgspec.structs.replace(
            theirs,
            number=self._number,
            link=self.link,
            arrived_ns=max(came_ns, self._measured_ns),
            measured_ns=self._measured_ns,
            sonar=tuple(self._sonar.items())[-MOST_READINGS:],
            stopped=stopped or plain(theirs.stopped),
        )

    def taken(self) -> None:
        """The newest sample was read: its sonar readings are not repeated."""
        self._sonar.clear()

    def notices(self, status: RobotStatus, arrived_ns: int) -> list[Notice]:
        """New notices of a message."""
        new = status.notices[max(0, self.noticed - status.noticed) :]
        self.noticed = max(self.noticed, status.noticed + len(status.notices))
        clock = self.clock.best(arrived_ns)

        def here(notice: Notice) -> Notice:
            time_ns = arrived_ns if clock is None else max(0, min(notice.time_ns + clock.offset_ns, arrived_ns))
            return msgspec.structs.replace(notice, time_ns=time_ns, cause=plain(notice.cause))

        return [here(each) for each in new]


def _finite(value: Any) -> bool:
    if isinstance(value, dict | list | tuple):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


GRACE_S = 2.0  # for a robot, beyond its driver's own deadlines
LONGEST_CLOSE_S = 30.0  # upper bound
FAREWELL_S = 0.5  # for a robot to receive the end, after a failure
WAITING, AT_THE_DOOR = 256, 16  # limits of waiting messages: in all, and for requests; others are dropped
_ADVICE = "look at the program 'vcmvsp robot' on the robot's computer, and at the network"


class RobotSession(ThreadedDriver):
    """A driver that exchanges messages with a robot through its `RobotListener`; a subclass opens it and admits robots."""

    _listener: RobotListener

    def __init__(
        self, device: str, *, vehicle: str, open_deadline_s: float, reconnect_s: float, command_timeout_s: float
    ) -> None:
        # the robot says more of its closing when it comes
        super().__init__(device, open_deadline_s=open_deadline_s, close_deadline_s=GRACE_S)
        self._vehicle, self._reconnect_s, self._timeout_s = vehicle, reconnect_s, command_timeout_s

    def write(self, velocity: Velocity) -> None:
        """Command a velocity; ignored while the robot is lost."""
        if not all(map(math.isfinite, (*velocity.linear, velocity.yaw_rate))):
            raise ValueError(f"a robot cannot follow {velocity.linear} m/s, {velocity.yaw_rate} rad/s: all must be finite")
        with self._lock:
            self._check()
            if self._connected:
                self._command_state.command(velocity, time.monotonic_ns())
        self._wake()

    def _prepare(self, start: Vec3) -> None:
        self._news: queue.SimpleQueue[News | None] = queue.SimpleQueue()
        self._woken = threading.Event()
        self._sampler, self._command_state = RemoteSampler(start), CommandState(self._timeout_s)
        self._peer: Peer | None = None  # followed robot
        self._hello: RobotHello | None = None  # of the followed robot, or of the previous one
        self._connected = False  # the robot is ready
        self._lost: LinkLost | None = None
        self._lost_ns = self._heard_ns = self._yours_ns = 0
        self._number = 0
        self._warned = set[str]()

    def _was_read(self) -> None:
        self._sampler.taken()

    def _hold(self, cause: str) -> bool:
        self._command_state.stop(cause)
        return self._connected  # the robot reports it

    def _wake(self) -> None:
        if self._thread is not None and not self._woken.is_set():
            self._woken.set()
            self._news.put(None)

    def _hand_over(self, news: News) -> None:
        """Called by Zenoh. Dropped messages are replaced by later ones; silence shows a dropped end of a link."""
        most = AT_THE_DOOR if isinstance(news, RobotGreeting) else WAITING
        if isinstance(news, LinkEnded) or self._news.qsize() < most:
            self._news.put(news)

    def _follow(self, peer: Peer, hello: RobotHello) -> None:
        self._listener.follow(peer)
        same = self._hello is not None and self._hello.robot == hello.robot
        with self._lock:
            self._sampler.connect(anew=not same)
            self._command_state.connect(self._number + 1)
        self._peer, self._hello = peer, hello
        self._yours_ns, self._heard_ns = 0, time.monotonic_ns()
        longest_s = max(0.0, min(hello.close_s, LONGEST_CLOSE_S))  # also for NaN
        self.close_deadline_s = 2 * GRACE_S + longest_s

    def _say(self, *, leave: bool = False) -> None:
        if self._peer is None:
            return
        self._number += 1
        now_ns = time.monotonic_ns()
        with self._lock:
            before = self._command_state.stopped
            velocity, stopped = self._command_state.at(now_ns), self._command_state.stopped
            noticed = self._sampler.noticed
        if stopped != before:
            self._notice("stopped", stopped)
        order = RobotOrder(
            number=self._number,
            sent_ns=now_ns,
            yours_ns=self._yours_ns,
            noticed=noticed,
            velocity=velocity,
            stop="" if velocity else stopped or NOT_YET,
            leave=leave,
        )
        self._listener.say(encode(order))

    def _heard(self, message: RobotMessage) -> None:
        try:
            status = messages.ups.decode(message.data)
        except ValueError as error:
            self._warn_once(f"a message of the robot is left out: {error}")
            return
        self._heard_ns, self._yours_ns = message.arrived_ns, status.said_ns
        with self._lock:
            self._sampler.hear(status, message.arrived_ns)
            self._command_state.acknowledge(status.heard)
            sample = self._sampler.sample(status, message.arrived_ns, self._command_state.stopped)
            self._sample = sample or self._sample
            self._notices.extend(self._sampler.notices(status, message.arrived_ns))
        if status.failure is not None and not self._closing.is_set():
            failure = status.failure
            device = f"{plain(failure.device)} aboard {self._vehicle}"
            self._fail(FAILURES[failure.kind](device, plain(failure.happened), plain(failure.advice)))
        elif status.state == "open" and not self._connected and not self._command_state.held:
            self._connect(message.arrived_ns)

    def _fail(self, error: DriverError) -> None:
        """Handle a failure of the robot's own driver, which may find a lost robot again."""
        may_come_back = self._ready.is_set() and self._reconnect_s
        if not may_come_back or not (isinstance(error, LinkLost) or self._lost is not None):
            raise error
        self._let_go(f"{error.device}: {error.happened}")

    def _connect(self, now_ns: int) -> None:
        clock = self._sampler.clock.best(now_ns)
        if clock is None or self._hello is None or self._peer is None:
            return
        with self._lock:
            self._connected, self._lost = True, None
        who = "" if self._peer.name == key_names.OPEN else f", certificate of '{self._peer.name}'"
        about = f"{plain(self._hello.device)} aboard{who}; its clock is known to {clock.error_ns / 1e6:.1f} ms"
        self._notice("connected", about)
        self._ready.set()

    def _let_go(self, happened: str) -> None:
        """Record the loss of the robot; its own program stops it."""
        was, self._peer = self._connected, None
        self._listener.leave()
        with self._lock:
            self._connected = False
            self._command_state.stop(happened)
        if was:
            self._lost, self._lost_ns = LinkLost(self.device, happened, _ADVICE), time.monotonic_ns()
            self._notice("lost", f"{happened}; its own computer stops it")

    def _say_goodbye(self) -> None:
        patience_s = self.close_deadline_s - GRACE_S if self._failure is None else FAREWELL_S
        until_ns = time.monotonic_ns() + seconds_to_ns(patience_s)
        due_ns = 0
        while self._peer is not None and (now_ns := time.monotonic_ns()) < until_ns:
            if now_ns >= due_ns:
                with self._lock:
                    self._command_state.stop("the run is over")
                self._say(leave=True)
                due_ns = now_ns + seconds_to_ns(SAY_S)
            try:
                news = self._news.get(timeout=max(0.0, (min(due_ns, until_ns) - now_ns) / SECOND_NS))
            except queue.Empty:
                continue
            if isinstance(news, LinkEnded) and news.peer == self._peer:
                return
            if isinstance(news, RobotMessage) and news.peer == self._peer and self._has_closed(news):
                return

    def _has_closed(self, message: RobotMessage) -> bool:
        try:
            status = messages.ups.decode(message.data)
        except ValueError:
            return False
        with self._lock:
            self._notices.extend(self._sampler.notices(status, message.arrived_ns))
        return status.state == "closed" and (status.left or status.failure is not None)

    def _warn_once(self, cause: str) -> None:
        cause = plain(cause)
        if cause not in self._warned and len(self._warned) < NOTICES:
            self._warned.add(cause)
            self._notice("warned", cause)


class CommandState(CommandRepeater[Velocity]):
    """Command for a robot; each connection starts with standing. ``held``: it has not confirmed yet that it stands."""

    held, _stands_from = True, 0

    def __init__(self, timeout_s: float) -> None:
        super().__init__(Velocity(), timeout_s, again_ns=0)

    def connect(self, number: int) -> None:
        """A robot connected: it must stand until it confirms a message of at least this number."""
        self.stop(NOT_YET)
        self.held, self._stands_from = True, number

    def acknowledge(self, number: int) -> None:
        """The robot has obeyed this message."""
        self.held = self.held and number < self._stands_from

    def at(self, now_ns: int) -> Velocity | None:
        """Velocity to send now; None: stand."""
        velocity = self.current(now_ns)
        return None if self.stopped or self.held else velocity
