"""Session with a connected robot: orders to it, samples and notices from it, until it is lost or must leave.

All but `write` and `stop` runs in the driver's thread; admission and the final loss of a robot belong to the driver.
"""

import math
import queue
import threading
import time

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.transport import key_names
from vcmvsp.cosim.types import Vec3, Velocity
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, LinkLost, PortError
from vcmvsp.hardware.drivers.command_repeater import NOT_YET
from vcmvsp.hardware.drivers.threaded import NOTICES, ThreadedDriver
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import SAY_S, Failure, RobotHello, RobotOrder
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, News, Peer, RobotGreeting, RobotListener, RobotMessage
from vcmvsp.hardware.remote_robot.run_side.samples import RemoteSampler

GRACE_S = 2.0  # for a robot, beyond its driver's own deadlines
LONGEST_CLOSE_S = 30.0  # upper bound
FAREWELL_S = 0.5  # for a robot to receive the end, after a failure
WAITING, AT_THE_DOOR = 256, 16  # limits of waiting messages: in all, and for requests; others are dropped
_FAILURES = {"driver": DriverError, "port": PortError, "handshake": HandshakeError, "lost": LinkLost}
_ADVICE = "look at the program 'vcmvsp robot' on the robot's computer, and at the network"


class RobotSession(ThreadedDriver):
    """A driver that exchanges messages with a robot through its `RobotListener`; a subclass opens it and admits robots.

    Args:
        device: for messages.
        vehicle: for messages.
        open_deadline_s: for the robot to connect and to be ready.
        reconnect_s: waiting time for a lost robot; 0: its loss is an error at once.
        command_timeout_s: without a command, the robot is stopped.
    """

    _listener: RobotListener

    def __init__(
        self, device: str, *, vehicle: str, open_deadline_s: float, reconnect_s: float, command_timeout_s: float
    ) -> None:
        close_deadline_s = GRACE_S  # the robot says more when it comes
        super().__init__(device, open_deadline_s=open_deadline_s, close_deadline_s=close_deadline_s)
        self._vehicle, self._reconnect_s, self._timeout_s = vehicle, reconnect_s, command_timeout_s

    # What the caller does.

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

    # What the thread does.

    def _hand_over(self, news: News) -> None:
        """Called by Zenoh. Dropped messages are replaced by later ones; silence shows a dropped end of a link."""
        knocks = isinstance(news, RobotGreeting)
        if isinstance(news, LinkEnded) or self._news.qsize() < (AT_THE_DOOR if knocks else WAITING):
            self._news.put(news)

    def _follow(self, peer: Peer, hello: RobotHello) -> None:
        """Start exchanging messages with this robot."""
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
        """Process a status of the robot."""
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
            self._fail(self._failed_aboard(status.failure))
        elif status.state == "open" and not self._connected and not self._command_state.held:
            self._connect(message.arrived_ns)

    def _fail(self, error: DriverError) -> None:
        """Handle a failure of the robot's own driver, which may find a lost robot again."""
        may_come_back = self._ready.is_set() and self._reconnect_s
        if not may_come_back or not (isinstance(error, LinkLost) or self._lost is not None):
            raise error
        self._let_go(f"{error.device}: {error.happened}")

    def _connect(self, now_ns: int) -> None:
        """The robot is ready."""
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
        """Let the robot close its own driver."""
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
        """Whether the robot has closed its driver."""
        try:
            status = messages.ups.decode(message.data)
        except ValueError:
            return False
        with self._lock:
            self._notices.extend(self._sampler.notices(status, message.arrived_ns))
        return status.state == "closed" and (status.left or status.failure is not None)

    def _failed_aboard(self, failure: Failure) -> DriverError:
        """Error of the robot's own driver."""
        device = f"{plain(failure.device)} aboard {self._vehicle}"
        return _FAILURES[failure.kind](device, plain(failure.happened), plain(failure.advice))

    def _warn_once(self, cause: str) -> None:
        cause = plain(cause)
        if cause not in self._warned and len(self._warned) < NOTICES:
            self._warned.add(cause)
            self._notice("warned", cause)


class CommandState:
    """Command for a robot: the newest velocity until its time-out, otherwise to stand; each connection starts with standing.

    It has no clock and no link: times are arguments.

    Args:
        timeout_s: zero speed after this time without a command.

    Attributes:
        stopped: reason for zero speed; empty: the robot follows the commands.
        held: the robot has not confirmed yet that it stands.
    """

    def __init__(self, timeout_s: float) -> None:
        self.stopped, self.held = NOT_YET, True
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._velocity = Velocity()
        self._given_ns = self._stands_from = 0

    def connect(self, number: int) -> None:
        """A robot connected: it must stand until it confirms a message of at least this number."""
        self.stopped, self.held, self._stands_from = NOT_YET, True, number

    def acknowledge(self, number: int) -> None:
        """The robot has obeyed this message."""
        if number >= self._stands_from:
            self.held = False

    def command(self, velocity: Velocity, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped, self._velocity, self._given_ns = "", velocity, now_ns

    def stop(self, cause: str) -> None:
        """Stand, before any later command."""
        self.stopped = cause

    def at(self, now_ns: int) -> Velocity | None:
        """Velocity to send now; None: stand."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        return None if self.stopped or self.held else self._velocity
