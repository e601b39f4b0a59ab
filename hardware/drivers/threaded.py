"""Common part of drivers with a thread: opening, closing, newest sample, notices, and errors of the thread.

Everything shared between thread and caller is behind one lock, which is never held while waiting. `ThreadedDriver` leaves the
communication to its subclass; `QueueDriver` is for libraries that call back, `ReconnectingDriver` for links with a file
descriptor, and restores a lost link.
"""

import contextlib
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import words_of
from vcmvsp.cosim.types import ORIGIN, Vec3, Velocity
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, LinkLost, Notice, Sample, What, checked

NOTICES = 1000  # maximum number without a reader
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0  # between attempts to reconnect, doubled each time
NOT_YET = "no command yet"

V = TypeVar("V")


class ClosedByCaller(Exception):
    """Raised in the thread of a driver when the caller closes it."""


class CommandRepeater(Generic[V]):
    """Schedule of velocities: zero first, then the newest command, repeated at a constant rate, and zero without commands.

    It has no clock and no link: times are arguments, velocities are of any type. ``stopped`` is the reason for zero speed;
    empty: the robot follows the commands.

    Args:
        zero: the velocity of a robot that stands.
        timeout_s: zero speed after this time without a command.
        again_ns: period of repetition.
        least_ns: minimum time between two velocities. A stop does not wait for it and is repeated after it, as the first may be
            lost. 0: the newest command goes at once, and a stop once.
    """

    def __init__(self, zero: V, timeout_s: float, *, again_ns: int, least_ns: int = 0) -> None:
        self.stopped = NOT_YET
        self._zero = self._speeds = zero
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._again_ns, self._least_ns = again_ns, least_ns
        self._given_ns = self._said_ns = 0
        self._zero_first, self._waiting = True, False

    def command(self, speeds: V, now_ns: int) -> None:
        """Set the speeds that are sent until the next command."""
        self.stopped = ""
        self._speeds, self._given_ns, self._waiting = speeds, now_ns, True

    def stop(self, cause: str) -> None:
        """Zero speed at once, before any later command."""
        self.stopped = cause
        self._speeds, self._zero_first, self._waiting = self._zero, True, self._least_ns > 0

    def current(self, now_ns: int) -> V:
        """Velocity to keep now."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        return self._speeds

    def advance(self, now_ns: int) -> V | None:
        """Velocity to send now; None: nothing. Call it until it returns None."""
        speeds = self.current(now_ns)
        if self._zero_first:
            self._zero_first, self._said_ns = False, now_ns
            return self._zero
        if now_ns < self._next_ns:
            return None
        self._waiting, self._said_ns = False, now_ns
        return speeds

    @property
    def due_ns(self) -> int:
        """Time of the next `advance`, if no command comes before."""
        if self._zero_first:
            return 0
        return self._next_ns if self.stopped else min(self._next_ns, self._given_ns + self._timeout_ns)

    @property
    def _next_ns(self) -> int:
        return self._said_ns + (self._least_ns if self._waiting else self._again_ns)


class ThreadedDriver:
    """Caller side of a thread that communicates with a robot; a subclass defines the thread's work (`_work`).

    `write` takes commands of a ground robot; it uses the subclass's `_repeater` while the robot is `_connected`. Deadlines are
    defined by `hardware.drivers.base.Driver`; the deadline of `close` may change while the driver is open.
    """

    _who = "robot"
    _repeater: CommandRepeater[Any]
    _connected = False
    _speeds: Callable[[Velocity], Any] = staticmethod(checked)

    def __init__(self, device: str, *, open_deadline_s: float, close_deadline_s: float) -> None:
        self.device, self.open_deadline_s, self.close_deadline_s = device, open_deadline_s, close_deadline_s
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._notices: deque[Notice] = deque(maxlen=NOTICES)
        self._sample: Sample | None = None  # newest unread sample
        self._failure: DriverError | None = None  # error that ended the thread
        self._closing, self._ready = threading.Event(), threading.Event()

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Connect to the robot, which stands at ``start`` (x m, y m, yaw rad)."""
        if self._thread is not None:
            raise RuntimeError(f"{self.device} is already open")
        self._sample = self._failure = None
        self._closing, self._ready = threading.Event(), threading.Event()
        self._prepare(start)
        self._thread = threading.Thread(target=self._run, name=f"{self._who} at {self.device}", daemon=True)
        self._thread.start()
        self._ready.wait(self.open_deadline_s)
        if self._failure is not None or not self._ready.is_set():
            failure = self._failure or self._hangs()
            self.close()
            raise failure

    def read(self) -> Sample | None:
        """Newest unread sample."""
        with self._lock:
            self._check()
            sample, self._sample = self._sample, None
            if sample is not None:
                self._was_read()
        return sample

    def write(self, velocity: Velocity) -> None:
        """Command a forward speed and a yaw rate; ignored while the robot is lost."""
        speeds = self._speeds(velocity)
        with self._lock:
            self._check()
            if self._connected:
                self._repeater.command(speeds, time.monotonic_ns())
        self._wake()

    def stop(self, cause: str) -> None:
        """Zero speed at once; never raises."""
        with self._lock:
            if self._thread is None or not self._hold(cause):
                self._notices.append(Notice(time_ns=time.monotonic_ns(), what="stopped", cause=cause))
        self._wake()

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        with self._lock:
            notices = list(self._notices)
            self._notices.clear()
        return notices

    def close(self) -> None:
        """Stop and release the robot."""
        thread = self._thread
        if thread is None:
            return
        self._closing.set()
        self._wake()
        thread.join(self.close_deadline_s)
        with self._lock:
            # A thread that is alive hangs in the operating system, and ends with the process.
            if self._thread is thread and not thread.is_alive():
                self._release()
                self._thread = None

    # Hooks of a subclass; "lock held": called with the lock held.

    def _prepare(self, start: Vec3) -> None:
        """Prepare the start of the thread."""
        raise NotImplementedError

    def _hangs(self) -> DriverError:
        """Error of a thread that is not ready in time."""
        return HandshakeError(self.device, "the connection hangs", "check the network")

    def _check(self) -> None:
        """Raise the error for which the robot cannot be driven, if there is one (lock held)."""
        if self._thread is None:
            raise RuntimeError(f"{self.device} is not open")
        if self._failure is not None:
            raise self._failure

    def _was_read(self) -> None:
        """Note that a sample was read (lock held)."""

    def _hold(self, cause: str) -> bool:
        """Let the thread send zero speed next (lock held); whether another part reports that stop."""
        self._repeater.stop(cause)
        return False

    def _wake(self) -> None:
        """Wake the thread, if there is one."""
        raise NotImplementedError

    def _release(self) -> None:
        """Release the resources of the thread, which has ended (lock held)."""

    def _work(self) -> None:
        """Work of the thread; it sets `_ready` as soon as the robot can be driven."""
        raise NotImplementedError

    def _give_up(self) -> None:
        """Leave the robot in a safe state after the error `_failure`, which ends the thread."""

    def _say_goodbye(self) -> None:
        """Leave the robot in a safe state; waiting does not raise `ClosedByCaller` once `_leaving` is set."""

    def _hang_up(self) -> None:
        """Release the port, if it is open, with last messages."""

    def _run(self) -> None:
        try:
            self._work()
        except ClosedByCaller:
            if not self._ready.is_set():
                self._failure = HandshakeError(self.device, "the driver was closed while connecting", "connect again")
            self._say_goodbye()
        except DriverError as error:
            self._failure = error
            self._give_up()
        except Exception as error:  # any error: for the caller, and the robot must stop
            self._failure = DriverError(self.device, f"the driver failed ({words_of(error)})", "report this error")
        finally:
            try:
                self._hang_up()
            finally:
                self._ready.set()

    def _due_command(self) -> tuple[Any, int]:
        """Velocity to send now, None: nothing; and the time of the next one. A stop is reported."""
        with self._lock:
            before = self._repeater.stopped
            speeds = self._repeater.advance(time.monotonic_ns())
            stopped, due_ns = self._repeater.stopped, self._repeater.due_ns
        if stopped != before:
            self._notice("stopped", stopped)
        return speeds, due_ns

    def _notice(self, what: What, cause: str) -> None:
        with self._lock:
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))


class QueueDriver(ThreadedDriver):
    """A driver with a thread that waits for callbacks of a library and for the caller, both in a queue; None wakes it."""

    _news: queue.SimpleQueue[Any]

    def _wake(self) -> None:
        if self._thread is not None:
            self._news.put(None)

    def _next_news(self, until_ns: int) -> Any:
        """Next news before this time; None: there is none, or the caller wakes the thread."""
        try:
            return self._news.get(timeout=max(0.0, (until_ns - time.monotonic_ns()) / SECOND_NS))
        except queue.Empty:
            return None


class ReconnectingDriver(ThreadedDriver):
    """A driver with a thread that waits for bytes and for the caller, and reconnects to a lost robot.

    ``connect_s`` is the time to find the robot and to prepare it; without a message for ``silence_s`` it counts as lost, and is
    looked for during ``reconnect_s`` (0: its loss is an error at once).
    """

    _meanwhile = ""  # what stops a lost robot

    def __init__(self, device: str, *, connect_s: float, silence_s: float, reconnect_s: float, **deadlines: float) -> None:
        super().__init__(device, **deadlines)
        self._connect_s, self._silence_s, self._reconnect_s = connect_s, silence_s, reconnect_s

    # Hooks of a subclass

    def _connect(self, within_s: float) -> None:
        """Open the link and prepare the robot, then set `_ready`, which stays set for a reconnection."""
        raise NotImplementedError

    def _converse(self) -> None:
        """Receive and send until the link is lost (`LinkLost`) or the caller closes the driver."""
        raise NotImplementedError

    def _prepare(self, start: Vec3) -> None:
        self._leaving = False
        self._woken, self._waker = os.pipe()
        os.set_blocking(self._waker, False)  # a full pipe wakes, too: the caller never waits for a thread that hangs

    def _hangs(self) -> DriverError:
        return LinkLost(self.device, "the port hangs", "unplug the device and plug it in again")

    def _wake(self) -> None:
        with self._lock:
            if self._thread is not None:
                with contextlib.suppress(BlockingIOError):
                    os.write(self._waker, b"\0")

    def _release(self) -> None:
        os.close(self._waker)
        os.close(self._woken)

    def _work(self) -> None:
        self._connect(self._connect_s)
        while True:
            try:
                self._converse()
            except LinkLost as lost:
                self._notice("lost", f"{lost.happened}; {self._meanwhile}")
                self._hang_up()  # a robot that still receives stops now
                self._look_for(lost)

    def _look_for(self, lost: LinkLost) -> None:
        """Reconnect, with growing pauses."""
        deadline_ns = time.monotonic_ns() + seconds_to_ns(self._reconnect_s)
        pause_s, last = FIRST_PAUSE_S, ""
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            until_ns = min(deadline_ns, now_ns + seconds_to_ns(pause_s))
            while time.monotonic_ns() < until_ns:
                self._select([], until_ns)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            remaining_s = (deadline_ns - time.monotonic_ns()) / SECOND_NS
            try:
                return self._connect(max(0.0, min(self._connect_s, remaining_s)))
            except DriverError as error:
                last = error.happened
                self._hang_up()
        if not self._reconnect_s:
            raise lost
        happened = f"{lost.happened}, and the link did not return within {self._reconnect_s:g} s ({last})"
        raise LinkLost(self.device, happened, lost.advice)

    def _wait(self, descriptor: int, until_ns: int) -> bool:
        """Wait for bytes, for the caller, or until this time; whether there are bytes."""
        return descriptor in self._select([descriptor], until_ns)

    def _select(self, files: list[int], until_ns: int) -> list[int]:
        remaining_s = max(0.0, (until_ns - time.monotonic_ns()) / SECOND_NS)
        ready = readable([self._woken, *files], remaining_s)
        if self._woken in ready:
            os.read(self._woken, 4096)
        if self._closing.is_set() and not self._leaving:
            raise ClosedByCaller
        return ready
