"""Driver of robots that run ``vcmvsp robot`` on their own computer, over Eclipse Zenoh, and admission of robots.

The driver listens and the robot connects, so that only the run's machine needs a known address and an open port. One thread
sends `CommandState` and receives; everything shared with the caller is behind one lock, which is never held while waiting.
Beyond this machine both ends need certificates; without one for this vehicle a robot can only send its request.
"""

import contextlib
import queue
import re
import secrets
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.transport import access_control, endpoints, key_names
from vcmvsp.cosim.types import NonNegative, Positive, Vec3
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import (
    COMMAND_TIMEOUT_S,
    CommandTimeout,
    DriverError,
    HandshakeError,
    LinkLost,
    PortError,
    finite,
)
from vcmvsp.hardware.drivers.threaded import NOT_YET, NOTICES, QueueDriver
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import FAILURES, SAY_S, RobotHello, RobotOrder, RobotWelcome
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, News, Peer, RobotGreeting, RobotListener, RobotMessage
from vcmvsp.hardware.remote_robot.run_side.session import CommandState, RemoteSampler

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys


RELOAD_S = 1.0  # certificates are read at most once in this time


class Admission:
    """Admits robots of one vehicle; without the folder of an authority any robot may come."""

    def __init__(self, vehicle: str, folder: Path | None) -> None:
        self._vehicle, self._folder = vehicle, folder
        self._current: tuple[float, Keys] | None = None  # time of reading, and the certificates

    def keys(self) -> "Keys | None":
        """Certificates, at most `RELOAD_S` old: one may be revoked meanwhile. `UsageError`: they cannot be read."""
        if self._folder is None:
            return None
        from vcmvsp.cosim.security import certificates

        now = time.monotonic()
        if self._current is None or now > self._current[0] + RELOAD_S:
            self._current = now, certificates.load(self._folder)
        return self._current[1]

    def refusal(self, name: str, hello: RobotHello) -> str:
        """Reason to reject a robot of the machine ``name`` permanently; empty: admitted."""
        if hello.protocol != messages.PROTOCOL:
            versions = f"this run speaks protocol {messages.PROTOCOL}, the robot {hello.protocol}"
            return f"{versions}: use the same vcmvsp version"
        vehicle = plain(hello.vehicle)
        try:
            keys = self.keys()
        except UsageError as error:
            return f"the run cannot read its certificates ({error})"
        if keys is not None and (denied := access_control.admission(keys, name, [vehicle])):
            return denied
        if hello.vehicle != self._vehicle:
            return f"this port belongs to {self._vehicle}, not to {vehicle}"
        return ""


START_S = 5.0  # for the session
GRACE_S = 2.0  # for a robot, beyond its driver's own deadlines
LONGEST_CLOSE_S = 30.0  # upper bound
FAREWELL_S = 0.5  # for a robot to receive the end, after a failure
WAITING, AT_THE_DOOR = 256, 16  # limits of waiting messages: in all, and for requests; others are dropped
_ADVICE = "check the program 'vcmvsp robot' on the robot's computer, and the network"
INVITE_S = 2.0  # before a message to the user


class ZenohDriver(QueueDriver):
    """A robot with ``vcmvsp robot`` on its own computer (`hardware.drivers.base.Driver`).

    Args:
        listen: endpoint for the robot, such as ``tls/0.0.0.0:7448``; each vehicle has a port of its own.
        keys: folder of the authority ('vcmvsp keys init'), relative to the scenario's; required beyond this machine.
        insecure: allow connections without certificates.
        open_deadline_s: for the robot to connect and to be ready.
        silence_s: without a message from the robot, it counts as lost.
        reconnect_s: waiting time for a lost robot; 0: its loss is an error at once.
        command_timeout_s: without a command, the robot is stopped.
        vehicle: vehicle of the robot; given by the run.
        folder: of the scenario; given by the run.
    """

    _repeater: CommandState
    _speeds = staticmethod(finite)

    def __init__(
        self,
        *,
        listen: str,
        keys: str = "",
        insecure: bool = False,
        open_deadline_s: Positive = 45.0,
        silence_s: Positive = 1.0,
        reconnect_s: NonNegative = 0.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
        vehicle: str = "",
        folder: str = "",
    ) -> None:
        if vehicle and not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):
            raise ScenarioError(f"must have only letters, digits, _ and -, not {vehicle!r}", key="vehicle")
        try:
            if keys and insecure:
                raise UsageError("keys and insecure exclude one another: leave one of them out")
            listen = endpoints.endpoint_rules(listen, keys or None, insecure=insecure, side="driver")
        except UsageError as error:
            raise ScenarioError(str(error), key="listen") from None
        device = f"{listen} ({vehicle})" if vehicle else listen
        # the robot reports its own deadline of closing on connection
        super().__init__(device, open_deadline_s=START_S + open_deadline_s, close_deadline_s=GRACE_S)
        self._vehicle, self._reconnect_s, self._timeout_s = vehicle, reconnect_s, command_timeout_s
        self._listen, self._secure = listen, bool(keys)
        self._admission = Admission(vehicle, Path(folder, keys) if keys else None)
        self._open_s, self._silence_s, self._silence_ns = open_deadline_s, silence_s, seconds_to_ns(silence_s)

    @property
    def invitation(self) -> str:
        """Command line that starts the robot's program."""
        keys = f"--keys {self._vehicle}.keys" if self._secure else "--insecure"
        with contextlib.suppress(UsageError):  # reported on opening
            if (certified := self._admission.keys()) is not None:
                keys = f"--keys {certified.file_of(self._vehicle)}"
        where = re.sub(r"/(0\.0\.0\.0|\[::\]):", "/HOST:", self._listen)
        return f"vcmvsp robot --vehicle {self._vehicle} --driver KIND:ADDRESS --connect {where} {keys}"

    def _prepare(self, start: Vec3) -> None:
        if not self._vehicle:
            raise HandshakeError(self.device, "the driver has no vehicle", "set its vehicle")
        self._news: queue.SimpleQueue[News | None] = queue.SimpleQueue()
        self._woken = threading.Event()
        self._sampler, self._repeater = RemoteSampler(start), CommandState(self._timeout_s)
        self._peer: Peer | None = None  # followed robot
        self._hello: RobotHello | None = None  # of the followed robot, or of the previous one
        self._connected = False  # the robot is ready
        self._lost: LinkLost | None = None
        self._lost_ns = self._heard_ns = self._yours_ns = 0
        self._number = 0
        self._warned = set[str]()
        self._run_name = secrets.token_hex(8)
        self._invited = False  # the user was informed
        self._refused = ""  # reason of the last rejection

    def _was_read(self) -> None:
        self._sampler.clear_sonar()

    def _hold(self, cause: str) -> bool:
        super()._hold(cause)
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
            self._repeater.connect(self._number + 1)
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
            before = self._repeater.stopped
            velocity, stopped = self._repeater.at(now_ns), self._repeater.stopped
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

    def _on_message(self, message: RobotMessage) -> None:
        try:
            status = messages.ups.decode(message.data)
        except ValueError as error:
            self._warn_once(f"a message of the robot is ignored: {error}")
            return
        self._heard_ns, self._yours_ns = message.arrived_ns, status.said_ns
        with self._lock:
            self._sampler.hear(status, message.arrived_ns)
            self._repeater.acknowledge(status.heard)
            sample = self._sampler.sample(status, message.arrived_ns, self._repeater.stopped)
            self._sample = sample or self._sample
            self._notices.extend(self._sampler.notices(status, message.arrived_ns))
        if status.failure is not None and not self._closing.is_set():
            failure = status.failure
            device = f"{plain(failure.device)} aboard {self._vehicle}"
            self._fail(FAILURES[failure.kind](device, plain(failure.happened), plain(failure.advice)))
        elif status.state == "open" and not self._connected and not self._repeater.held:
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
        certificate = "" if self._peer.name == key_names.OPEN else f", certificate of '{self._peer.name}'"
        about = f"{plain(self._hello.device)} aboard{certificate}; its clock is known to {clock.error_ns / 1e6:.1f} ms"
        self._notice("connected", about)
        self._ready.set()

    def _let_go(self, happened: str) -> None:
        """Record the loss of the robot; its own program stops it."""
        was, self._peer = self._connected, None
        self._listener.leave()
        with self._lock:
            self._connected = False
            self._repeater.stop(happened)
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
                    self._repeater.stop("the run is over")
                self._say(leave=True)
                due_ns = now_ns + seconds_to_ns(SAY_S)
            news = self._next_news(min(due_ns, until_ns))
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

    def _work(self) -> None:
        with contextlib.closing(RobotListener(self._listen, self._authority(), self._vehicle, self._hand_over)) as listener:
            self._listener = listener
            try:
                self._converse(time.monotonic_ns() + seconds_to_ns(self._open_s))
            except DriverError as error:
                self._failure = error
                self._ready.set()
            self._say_goodbye()

    def _authority(self) -> "Keys | None":
        try:
            keys = self._admission.keys()
            if keys is not None and (warning := keys.check()):
                self._notice("warned", warning)
        except UsageError as error:
            raise PortError(self.device, str(error), "set the folder of the authority, keys = 'DIR'") from None
        return keys

    def _converse(self, open_until_ns: int) -> None:
        due_ns = 0
        while not self._closing.is_set():
            now_ns = time.monotonic_ns()
            if now_ns >= due_ns:
                self._say()
                due_ns = now_ns + seconds_to_ns(SAY_S)
            self._watch(now_ns, open_until_ns)
            news = self._next_news(due_ns)
            if news is None:  # the caller has news, or it is time to send
                self._woken.clear()
                due_ns = 0
            elif isinstance(news, RobotGreeting):
                self._greeted(news)
            elif isinstance(news, LinkEnded) and news.peer == self._peer:
                self._let_go("the robot's program has ended, or its link is lost")
            elif isinstance(news, RobotMessage) and news.peer == self._peer:
                self._on_message(news)
        if not self._ready.is_set():
            raise HandshakeError(self.device, "the driver was closed while waiting for the robot", "connect again")

    def _watch(self, now_ns: int, open_until_ns: int) -> None:
        if self._peer is not None and now_ns >= self._heard_ns + self._silence_ns:
            self._let_go(f"no message was received for {self._silence_s:g} s")
        if not self._ready.is_set():
            if now_ns >= open_until_ns:
                raise self._nobody()
            if self._peer is None and not self._invited and now_ns >= open_until_ns - seconds_to_ns(self._open_s - INVITE_S):
                self._invited = True
                sys.stderr.write(f"waiting for the robot of {self._vehicle} at {self._listen}; there: {self.invitation}\n")
                sys.stderr.flush()
        elif self._lost is not None and now_ns >= self._lost_ns + seconds_to_ns(self._reconnect_s):
            lost, back = self._lost, f"and the robot did not return within {self._reconnect_s:g} s"
            raise LinkLost(self.device, f"{lost.happened}, {back}", lost.advice) if self._reconnect_s else lost

    def _greeted(self, greeting: RobotGreeting) -> None:
        try:
            hello = messages.hellos.decode(greeting.payload)
            peer = Peer(greeting.name, hello.session)
            key_names.robot_key(peer.name, self._vehicle, peer.session, "up")
        except ValueError:
            greeting.answer(RobotWelcome(refused="not a greeting of a robot of this version", final=True))
            return
        final = self._admission.refusal(greeting.name, hello)
        if refused := final or self._waits(greeting.name, hello):
            self._refused = refused
            self._warn_once(f"a robot was rejected: {refused}")
            greeting.answer(RobotWelcome(refused=refused, final=bool(final)))
            return
        if self._peer is not None and self._peer != peer:
            self._let_go("the robot has connected again")
        if self._peer is None:
            self._follow(peer, hello)
        greeting.answer(RobotWelcome(run=self._run_name, start=self._sampler.pose))

    def _waits(self, name: str, hello: RobotHello) -> str:
        """Reason not to accept an admitted robot now; empty: accept it."""
        if self._closing.is_set():
            return "the run is over"
        if self._peer is not None and self._hello is not None and (self._peer.name, self._hello.robot) != (name, hello.robot):
            return f"another program already drives {self._vehicle}"
        return ""

    def _nobody(self) -> HandshakeError:
        within = f"within {self._open_s:g} s"
        if self._peer is not None and self._hello is not None:
            happened = f"the robot has connected, but its own driver ({plain(self._hello.device)}) did not open {within}"
            advice = f"check the robot; its driver may need {self._hello.open_s:g} s: raise open_deadline_s"
            return HandshakeError(self.device, happened, advice)
        refusal = f"; a robot was rejected: {self._refused}" if self._refused else ""
        happened = f"the robot of {self._vehicle} did not connect {within}{refusal}"
        return HandshakeError(self.device, happened, f"start on its own computer: {self.invitation}")
