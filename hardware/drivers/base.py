"""Protocol of a robot's driver: newest samples out, velocities in, no long waits.

**Threads.** A driver of an external device has one thread, which alone uses the link. It provides the newest sample; the
caller provides the newest command. So `read`, `write` and `stop` never wait for the robot, and a robot that hangs cannot
block a run. Only `open` and `close` wait, no longer than the driver's deadlines.

**Layers that stop a robot.** The driver stops it without a command for `COMMAND_TIMEOUT_S`, also while the caller hangs. The
caller monitors the operator; the robot monitors the driver.

::

    FederateError
    `-- DriverError             a robot cannot be driven any more, or not at all
        |-- PortError           its port cannot be opened: missing, in use, or without permission
        |-- HandshakeError      another device than the configured robot answers
        `-- LinkLost            a connected robot is silent or was unplugged
"""

import contextlib
import math
import signal
from collections.abc import Callable, Iterator
from math import isfinite
from types import FrameType
from typing import Annotated, Literal, Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.types import ORIGIN, Odometry, Value, Vec3, VehicleState, Velocity

COMMAND_TIMEOUT_S = 0.5  # five periods of 10 Hz: short beside the 2 s of a robot's own watchdog

What = Literal["connected", "lost", "stopped", "warned"]
"""Kinds of notices."""

CommandTimeout = Annotated[float, msgspec.Meta(gt=0, le=2)]
"""How long a driver may go on without a command, s: no longer than a robot's own watchdog does."""


class DriverError(FederateError):
    """A robot cannot be driven: which device, what happened, what to do."""

    _subject = "robot at"

    def __init__(self, device: str, happened: str, advice: str) -> None:
        self.device, self.happened, self.advice = device, happened, advice
        super().__init__(f"{self._subject} {device}", f"{happened}; {advice}")


class PortError(DriverError):
    """The port cannot be opened."""


class HandshakeError(DriverError):
    """The port is open, but its device is not the configured robot, or sends invalid data."""


class LinkLost(DriverError):
    """A connected robot is silent or was unplugged."""


class Sample(Value, frozen=True, kw_only=True):
    """Newest data of a robot. Times are of this machine's monotonic clock."""

    number: int  # counts since `open`; a gap means that newer samples replaced others
    link: int  # number of connections so far; odometry misses motion between two of them
    arrived_ns: int
    measured_ns: int  # estimated
    odometry: Odometry  # from the start pose of `open`
    state: VehicleState | None = None  # in the world, if the robot reports it: an autopilot, motion capture
    wheels: tuple[float, float] | None = None  # m/s, left and right, if the robot reports them
    sonar: tuple[tuple[int, float], ...] = ()  # (number, range in m): newest reading of each sonar since the last `read`
    battery_v: float | None = None
    motors: bool = True  # motors are enabled
    stalled: tuple[bool, bool] = (False, False)  # left and right wheel
    bumpers: int = 0  # a bit for each segment that is pressed: front from bit 0, rear from bit 8
    emergency_stop: bool = False  # the button on the robot is pressed
    stopped: str = ""  # reason for zero speed by the driver; empty: the robot follows the commands


class Notice(Value, frozen=True, kw_only=True):
    """An event for the recording: a connection, a loss, a stop or a warning, with its cause."""

    time_ns: int  # of this machine's monotonic clock
    what: What
    cause: str


@runtime_checkable
class Driver(Protocol):
    """A robot that takes velocities: forward speed and yaw rate on the ground, all three axes of the world in the air.

    The constructor must not connect: it is also called to check a scenario. A class only for ground robots has
    ``ground_only = True``.
    """

    device: str  # for messages
    open_deadline_s: float  # maximum time of `open`, approximately
    close_deadline_s: float  # maximum time of `close`, approximately

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Connect to the robot, which stands at ``start`` (x m, y m, yaw rad), at zero speed with motors enabled."""

    def read(self) -> Sample | None:
        """Newest sample; None if there is none since the last call. Raises the error that ended the connection."""

    def write(self, velocity: Velocity) -> None:
        """Set the velocity for at most `COMMAND_TIMEOUT_S`; ground robots use ``linear[0]`` and ``yaw_rate`` only."""

    def stop(self, cause: str) -> None:
        """Zero speed at once, before any other command; the next `write` moves the robot again."""

    def notices(self) -> list[Notice]:
        """Events since the last call, oldest first; valid also after `close`."""

    def close(self) -> None:
        """Zero speed, motors off, port free. May be called twice, and after a failure."""


def finite(velocity: Velocity) -> Velocity:
    """The command itself; `ValueError` for NaN and infinity."""
    if not all(map(isfinite, (*velocity.linear, velocity.yaw_rate))):
        raise ValueError(f"the command {velocity.linear} m/s, {velocity.yaw_rate} rad/s must be finite")
    return velocity


def checked(velocity: Velocity) -> tuple[float, float]:
    """Forward speed, m/s, and yaw rate, rad/s, of a command for a ground robot; `ValueError` for NaN and infinity."""
    v, w = velocity.linear[0], velocity.yaw_rate
    if not (isfinite(v) and isfinite(w)):
        raise ValueError(f"the command v = {v} m/s, w = {w} rad/s must be finite")
    return v, w


TICK_S = 0.2


def nothing() -> str:
    """No reason to abort."""
    return ""


@contextlib.contextmanager
def within(seconds: float, device: str, doing: str, abort_reason: Callable[[], str] = nothing) -> Iterator[Callable[[], None]]:
    """Raise a `DriverError` inside the block if it takes longer, or as soon as ``abort_reason`` returns a text.

    It works in the main thread, by its alarm clock, which also interrupts sleep. It counts ticks instead of time, so that a
    process that was frozen does not time out. The yielded function restarts the time.
    """
    ticks = most = math.ceil(seconds / TICK_S)

    def begin_anew() -> None:
        nonlocal ticks
        ticks = most

    def tick(_number: int, _frame: FrameType | None) -> None:
        nonlocal ticks
        ticks -= 1
        if reason := abort_reason():
            raise DriverError(device, reason, f"it was {doing}")
        if ticks <= 0:
            happened = f"the driver hangs: {doing} took longer than {seconds:g} s"
            raise DriverError(device, happened, "unplug the device and plug it in again; check its driver")

    before = signal.signal(signal.SIGALRM, tick)
    signal.setitimer(signal.ITIMER_REAL, TICK_S, TICK_S)
    try:
        yield begin_anew
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
