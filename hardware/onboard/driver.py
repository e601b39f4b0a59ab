"""The driver of robots that have a computer of their own, on which ``vcmvsp robot`` drives them, over Eclipse Zenoh.

It listens, and the robot dials in, so that only the run's machine needs a known address and an open port. One thread says
what `Orders` want and takes what comes; all that it shares with the caller is behind one lock, which nobody holds while
waiting. Beyond this machine both ends show certificates, and who has none for this vehicle may greet, and no more.
"""

import contextlib
import math
import queue
import re
import secrets
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cosim.clock import SECOND_NS, seconds_to_ns
from cosim.codec import encode
from cosim.errors import ScenarioError, UsageError
from cosim.text import plain
from cosim.transport import security
from cosim.types import NonNegative, Positive, Vec3, Velocity
from hardware.driver import (
    COMMAND_TIMEOUT_S,
    ORIGIN,
    CommandTimeout,
    DriverError,
    HandshakeError,
    LinkLost,
    Notice,
    PortError,
    Sample,
)
from hardware.onboard import wire
from hardware.onboard.admission import Admission
from hardware.onboard.door import Door, Gone, Heard, Knock, News, Peer
from hardware.onboard.orders import Orders
from hardware.onboard.track import Track
from hardware.onboard.wire import SAY_S, Down, Failure, Hello, Welcome

if TYPE_CHECKING:
    from cosim.certificates import Keys

START_S = 5.0  # for the session
GRACE_S = 2.0  # for a robot, beyond what its driver says of itself
INVITE_S = 2.0  # before it is said that the robot is waited for
FAREWELL_S = 0.5  # for a robot to hear that it is not needed, after a failure
LONGEST_CLOSE_S = 30.0  # whatever it says
NOTICES = 1000  # kept for somebody who asks
WAITING, AT_THE_DOOR = 256, 16  # how many messages may wait for the thread, with greetings among them; more are left out
_FAILURES = {"driver": DriverError, "port": PortError, "handshake": HandshakeError, "lost": LinkLost}
_ADVICE = "look at the program 'vcmvsp robot' on the robot's computer, and at the network"


class ZenohDriver:
    """A robot whose own computer runs ``vcmvsp robot`` (`hardware.driver.Driver`).

    Args:
        listen: where the robot dials in, such as ``tls/0.0.0.0:7448``; each vehicle has a port of its own.
        keys: folder of the authority ('vcmvsp keys init'), relative to the scenario's; a must beyond this machine.
        insecure: do without certificates where everybody is trusted.
        open_deadline_s: for the robot to dial in and to stand ready.
        silence_s: without a word from the robot, it counts as lost.
        reconnect_s: for so long a robot that was lost is waited for; 0: losing it is an error at once.
        command_timeout_s: without a command, the robot is stopped.
        vehicle: whose robot is to come; given by the run.
        folder: of the scenario; given by the run.
    """

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
            raise ScenarioError(f"must have letters, digits, _ and - only, not {vehicle!r}", key="vehicle")
        try:
            _check(listen, keys, insecure=insecure)
        except UsageError as error:
            raise ScenarioError(str(error), key="listen") from None
        self.device = f"{listen} ({vehicle})" if vehicle else listen
        self.open_deadline_s = START_S + open_deadline_s
        self.close_deadline_s = GRACE_S  # the robot says more when it comes
        self._listen, self._vehicle, self._secure = listen, vehicle, bool(keys)
        self._admission = Admission(vehicle, Path(folder, keys) if keys else None)
        self._open_s, self._silence_s, self._reconnect_s = open_deadline_s, silence_s, reconnect_s
        self._silence_ns, self._timeout_s = seconds_to_ns(silence_s), command_timeout_s
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._notices: deque[Notice] = deque(maxlen=NOTICES)

    # What the caller does.

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Wait for the robot, until it stands ready; raises who is missing, and what would start it."""
        if self._thread is not None:
            raise RuntimeError(f"{self.device} is open already")
        if not self._vehicle:
            raise HandshakeError(self.device, "it was not told whose robot is to come", "give it a vehicle")
        self._news: queue.SimpleQueue[News | None] = queue.SimpleQueue()
        self._track, self._orders = Track(start), Orders(self._timeout_s)
        self._run_name = secrets.token_hex(8)
        self._peer: Peer | None = None  # who is followed
        self._hello: Hello | None = None  # of that, or of the one before
        self._connected = False  # it stands ready
        self._lost: LinkLost | None = None
        self._lost_ns = self._heard_ns = self._yours_ns = 0
        self._number = 0
        self._invited = False  # somebody was told that it waits
        self._refused = ""  # why a robot was sent away last
        self._warned = set[str]()
        self._sample: Sample | None = None
        self._failure: DriverError | None = None
        self._closing, self._ready, self._woken = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"robot at {self.device}", daemon=True)
        self._thread.start()
        self._ready.wait(self.open_deadline_s)
        if self._failure is not None or not self._ready.is_set():
            failure = self._failure or HandshakeError(self.device, "the connection hangs", "look at the network")
            self.close()
            raise failure

    @property
    def invitation(self) -> str:
        """The command line that starts the robot's program."""
        keys = f"--keys {self._vehicle}.keys" if self._secure else "--insecure"
        where = re.sub(r"/(0\.0\.0\.0|\[::\]):", "/HOST:", self._listen)
        return f"vcmvsp robot --vehicle {self._vehicle} --driver KIND:ADDRESS --connect {where} {keys}"

    def read(self) -> Sample | None:
        """The newest sample that was not read yet."""
        with self._lock:
            self._check()
            sample, self._sample = self._sample, None
            if sample is not None:
                self._track.taken()
        return sample

    def write(self, velocity: Velocity) -> None:
        """Command a velocity; while the robot is lost, commands are dropped."""
        if not all(map(math.isfinite, (*velocity.linear, velocity.yaw_rate))):
            raise ValueError(f"a robot cannot follow {velocity.linear} m/s, {velocity.yaw_rate} rad/s: all must be finite")
        with self._lock:
            self._check()
            if self._connected:
                self._orders.command(velocity, time.monotonic_ns())
        self._wake()

    def stop(self, cause: str) -> None:
        """Zero speed at once; never raises."""
        with self._lock:
            if self._thread is None or not self._connected:  # else the robot tells of it
                self._notices.append(Notice(time_ns=time.monotonic_ns(), what="stopped", cause=cause))
            if self._thread is None:
                return
            self._orders.stop(cause)
        self._wake()

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        with self._lock:
            notices = list(self._notices)
            self._notices.clear()
        return notices

    def close(self) -> None:
        """Have the robot stop and its driver closed, then leave."""
        thread = self._thread
        if thread is None:
            return
        self._closing.set()
        self._wake()
        thread.join(self.close_deadline_s)
        if not thread.is_alive():  # one that is hangs in the network, and will end with the process
            self._thread = None

    def _check(self) -> None:
        if self._thread is None:
            raise RuntimeError(f"{self.device} is not open")
        if self._failure is not None:
            raise self._failure

    def _wake(self) -> None:
        if self._thread is not None and not self._woken.is_set():
            self._woken.set()
            self._news.put(None)

    # What the thread does.

    def _run(self) -> None:
        try:
            with contextlib.closing(Door(self._listen, self._authority(), self._vehicle, self._hand_over)) as door:
                self._door = door
                try:
                    self._converse(time.monotonic_ns() + seconds_to_ns(self._open_s))
                except DriverError as error:
                    self._failure = error
                    self._ready.set()
                self._say_goodbye()
        except DriverError as error:
            self._failure = error
        except Exception as error:  # whatever it is: the caller must be told
            self._failure = DriverError(self.device, f"the driver failed ({type(error).__name__}: {error})", "report this")
        finally:
            self._ready.set()

    def _authority(self) -> "Keys | None":
        try:
            keys = self._admission.keys()
            if keys is not None and (warning := keys.check()):
                self._notice("warned", warning)
        except UsageError as error:
            raise PortError(self.device, str(error), "name the folder of the authority, keys = 'DIR'") from None
        return keys

    def _hand_over(self, news: News) -> None:
        """Called by Zenoh. What is left out of news is said again, but for a link's end, which silence shows, too."""
        knocks = isinstance(news, Knock)
        if isinstance(news, Gone) or self._news.qsize() < (AT_THE_DOOR if knocks else WAITING):
            self._news.put(news)

    def _converse(self, open_until_ns: int) -> None:
        """Take what comes and say what is due until the caller closes it."""
        due_ns = 0
        while not self._closing.is_set():
            now_ns = time.monotonic_ns()
            if now_ns >= due_ns:
                self._say()
                due_ns = now_ns + seconds_to_ns(SAY_S)
            self._watch(now_ns, open_until_ns)
            try:
                news = self._news.get(timeout=max(0.0, (due_ns - now_ns) / SECOND_NS))
            except queue.Empty:
                continue
            if news is None:
                self._woken.clear()
                due_ns = 0
            else:
                self._take(news)
        if not self._ready.is_set():
            raise HandshakeError(self.device, "it was closed while its robot was waited for", "open it again")

    def _take(self, news: News) -> None:
        if isinstance(news, Knock):
            self._greeted(news)
        elif news.peer == self._peer:
            if isinstance(news, Gone):
                self._let_go("the robot's program has ended, or its link broke")
            else:
                self._heard(news)

    def _watch(self, now_ns: int, open_until_ns: int) -> None:
        """Note silence, and what did not come in time."""
        if self._peer is not None and now_ns >= self._heard_ns + self._silence_ns:
            self._let_go(f"nothing was heard for {self._silence_s:g} s")
        if not self._ready.is_set():
            if now_ns >= open_until_ns:
                raise self._nobody()
            if self._peer is None and not self._invited and now_ns >= open_until_ns - seconds_to_ns(self._open_s - INVITE_S):
                self._invited = True
                sys.stderr.write(f"waiting for the robot of {self._vehicle} at {self._listen}; there: {self.invitation}\n")
                sys.stderr.flush()
        elif self._lost is not None and now_ns >= self._lost_ns + seconds_to_ns(self._reconnect_s):
            raise self._gone_for_good(self._lost)

    # Greetings

    def _greeted(self, knock: Knock) -> None:
        """Let a robot in, or say why not."""
        try:
            hello = wire.hellos.decode(knock.said)
            peer = Peer(knock.name, hello.session)
            security.robot_key(peer.name, self._vehicle, peer.session, "up")
        except ValueError:
            knock.answer(Welcome(refused="that was no greeting of a robot of this version", final=True))
            return
        final = self._admission.refusal(knock.name, hello)
        if refused := final or self._waits(knock.name, hello):
            self._refused = refused
            self._warn_once(f"a robot was sent away: {refused}")
            knock.answer(Welcome(refused=refused, final=bool(final)))
            return
        if self._peer is not None and self._peer != peer:
            self._let_go("the robot has dialled anew")
        if self._peer is None:
            self._admit(peer, hello)
        knock.answer(Welcome(run=self._run_name, start=self._track.pose))

    def _waits(self, name: str, hello: Hello) -> str:
        """Why a robot that may come is not driven now; empty: it is."""
        known = self._hello
        if self._closing.is_set():
            return "the run is over"
        if self._peer is not None and known is not None and (self._peer.name, known.robot) != (name, hello.robot):
            return f"another program drives {self._vehicle} already"
        return ""

    def _admit(self, peer: Peer, hello: Hello) -> None:
        """Begin to follow it."""
        self._door.follow(peer)
        same = self._hello is not None and self._hello.robot == hello.robot
        with self._lock:
            self._track.connect(anew=not same)
            self._orders.connect(self._number + 1)
        self._peer, self._hello = peer, hello
        self._yours_ns, self._heard_ns = 0, time.monotonic_ns()
        longest_s = max(0.0, min(hello.close_s, LONGEST_CLOSE_S))  # also of what is no number
        self.close_deadline_s = 2 * GRACE_S + longest_s

    # Talking

    def _say(self, *, leave: bool = False) -> None:
        if self._peer is None:
            return
        self._number += 1
        now_ns = time.monotonic_ns()
        with self._lock:
            before = self._orders.stopped
            velocity, stopped = self._orders.at(now_ns), self._orders.stopped
            noticed = self._track.noticed
        if stopped != before:
            self._notice("stopped", stopped)
        down = Down(
            number=self._number,
            sent_ns=now_ns,
            yours_ns=self._yours_ns,
            noticed=noticed,
            velocity=velocity,
            stop="" if velocity else stopped or wire.NOT_YET,
            leave=leave,
        )
        self._door.say(encode(down))

    def _heard(self, heard: Heard) -> None:
        """Take what the robot says."""
        try:
            up = wire.ups.decode(heard.data)
        except ValueError as error:
            self._warn_once(f"a message of the robot is left out: {error}")
            return
        self._heard_ns, self._yours_ns = heard.arrived_ns, up.said_ns
        with self._lock:
            self._track.hear(up, heard.arrived_ns)
            self._orders.heard(up.heard)
            sample = self._track.sample(up, heard.arrived_ns, self._orders.stopped)
            self._sample = sample or self._sample
            self._notices.extend(self._track.notices(up, heard.arrived_ns))
        if up.failure is not None and not self._closing.is_set():
            self._fail(self._failed_aboard(up.failure))
        elif up.state == "open" and not self._connected and not self._orders.held:
            self._connect(heard.arrived_ns)

    def _fail(self, error: DriverError) -> None:
        """The robot's own driver has failed; one that had lost its robot may find it again."""
        may_come_back = self._ready.is_set() and self._reconnect_s
        if not may_come_back or not (isinstance(error, LinkLost) or self._lost is not None):
            raise error
        self._let_go(f"{error.device}: {error.happened}")

    def _connect(self, now_ns: int) -> None:
        """The robot stands, ready to be driven."""
        clock = self._track.clock.best(now_ns)
        if clock is None or self._hello is None or self._peer is None:
            return
        with self._lock:
            self._connected, self._lost = True, None
        who = "" if self._peer.name == security.OPEN else f", certificate of '{self._peer.name}'"
        about = f"{plain(self._hello.device)} aboard{who}; its clock is known to {clock.error_ns / 1e6:.1f} ms"
        self._notice("connected", about)
        self._ready.set()

    def _let_go(self, happened: str) -> None:
        """Note that the robot is away; its own program stops it."""
        was, self._peer = self._connected, None
        self._door.leave()
        with self._lock:
            self._connected = False
            self._orders.stop(happened)
        if was:
            self._lost, self._lost_ns = LinkLost(self.device, happened, _ADVICE), time.monotonic_ns()
            self._notice("lost", f"{happened}; its own computer stops it")

    def _say_goodbye(self) -> None:
        """Have the robot's own driver closed."""
        patience_s = self.close_deadline_s - GRACE_S if self._failure is None else FAREWELL_S
        until_ns = time.monotonic_ns() + seconds_to_ns(patience_s)
        due_ns = 0
        while self._peer is not None and (now_ns := time.monotonic_ns()) < until_ns:
            if now_ns >= due_ns:
                with self._lock:
                    self._orders.stop("the run is over")
                self._say(leave=True)
                due_ns = now_ns + seconds_to_ns(SAY_S)
            try:
                news = self._news.get(timeout=max(0.0, (min(due_ns, until_ns) - now_ns) / SECOND_NS))
            except queue.Empty:
                continue
            if isinstance(news, Gone) and news.peer == self._peer:
                return
            if isinstance(news, Heard) and news.peer == self._peer and self._has_closed(news):
                return

    def _has_closed(self, heard: Heard) -> bool:
        """Whether the robot says that its driver is closed, now that it was told that the run is over."""
        try:
            up = wire.ups.decode(heard.data)
        except ValueError:
            return False
        with self._lock:
            self._notices.extend(self._track.notices(up, heard.arrived_ns))
        return up.state == "closed" and (up.left or up.failure is not None)

    # What is said of it

    def _nobody(self) -> HandshakeError:
        """Why no robot stands ready."""
        within = f"within {self._open_s:g} s"
        if self._peer is not None and self._hello is not None:
            happened = f"the robot has come, but its own driver ({plain(self._hello.device)}) is not open {within}"
            return HandshakeError(
                self.device, happened, f"look at the robot; it may take {self._hello.open_s:g} s: open_deadline_s"
            )
        sent_away = f"; one was sent away: {self._refused}" if self._refused else ""
        happened = f"the robot of {self._vehicle} did not come {within}{sent_away}"
        return HandshakeError(self.device, happened, f"start on its own computer: {self.invitation}")

    def _gone_for_good(self, lost: LinkLost) -> LinkLost:
        if not self._reconnect_s:
            return lost
        return LinkLost(self.device, f"{lost.happened}, and it was not back within {self._reconnect_s:g} s", lost.advice)

    def _failed_aboard(self, failure: Failure) -> DriverError:
        """What the robot's own driver has said."""
        device = f"{plain(failure.device)} aboard {self._vehicle}"
        return _FAILURES[failure.kind](device, plain(failure.happened), plain(failure.advice))

    def _warn_once(self, cause: str) -> None:
        cause = plain(cause)
        if cause not in self._warned and len(self._warned) < NOTICES:
            self._warned.add(cause)
            self._notice("warned", cause)

    def _notice(self, what: Literal["connected", "lost", "stopped", "warned"], cause: str) -> None:
        with self._lock:
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))


def _check(listen: str, keys: str, *, insecure: bool) -> None:
    """Raise `UsageError` if it may not listen there so; the keys themselves are read when it is opened."""
    if keys and insecure:
        raise UsageError("keys and insecure exclude one another: leave one of them out")
    security.endpoint_rules(listen, keys or None, insecure=insecure, side="driver")
