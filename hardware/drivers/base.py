"""What a run asks of the driver of a robot: newest samples out, velocities in, and never a long wait.

**Threads.** A driver that talks to something outside has one thread of its own, which alone touches the line. It hands over
the newest sample; the caller leaves the newest command. So `read`, `write` and `stop` never wait for the robot, and a robot
that hangs cannot hold up a run. Only `open` and `close` wait, each no longer than the deadline that the driver names.

**Layers that stop a robot.** The driver stops it when no command was given for `COMMAND_TIMEOUT_S`, also while the caller
hangs. Whoever gives the commands watches for the operator; the robot watches for the driver.

::

    FederateError
    `-- DriverError             a robot cannot be driven any more, or not at all
        |-- PortError           its port cannot be opened: it is not there, in use, or may not be used
        |-- HandshakeError      something is there, but not the robot that was meant
        `-- LinkLost            it was there, and went silent or was unplugged
"""

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

    def __init__(self, device: str, happened: str, advice: str) -> None:
        self.device, self.happened, self.advice = device, happened, advice
        super().__init__(f"robot at {device}", f"{happened}; {advice}")


class PortError(DriverError):
    """The port cannot be opened."""


class HandshakeError(DriverError):
    """The port is open, but what is there is not the robot that was meant, or cannot be understood."""


class LinkLost(DriverError):
    """A robot that was connected went silent or was unplugged."""


class Sample(Value, frozen=True, kw_only=True):
    """What a robot said last. Times are of this machine's monotonic clock."""

    number: int  # counts what was heard since `open`; a gap means that newer ones took the place of others
    link: int  # 1 for the first connection, 2 after the first reconnection, ...: odometry misses what was moved in between
    arrived_ns: int
    measured_ns: int  # estimated
    odometry: Odometry  # from the start pose that `open` was given
    state: VehicleState | None = None  # in the world, of a robot that knows it by itself: an autopilot, motion capture
    wheels: tuple[float, float] | None = None  # m/s, left and right, of a robot that tells them
    sonar: tuple[tuple[int, float], ...] = ()  # (number, range in m): the newest of each that is new since the last `read`
    battery_v: float | None = None
    motors: bool = True  # they are enabled
    stalled: tuple[bool, bool] = (False, False)  # left and right wheel
    bumpers: int = 0  # a bit for each segment that is pressed: front from bit 0, rear from bit 8
    emergency_stop: bool = False  # somebody pressed the button on the robot
    stopped: str = ""  # why the driver holds it at zero speed; empty: it follows the commands


class Notice(Value, frozen=True, kw_only=True):
    """Something that a recording should tell: a connection, a loss, a stop or something odd, with its cause."""

    time_ns: int  # of this machine's monotonic clock
    what: What
    cause: str


@runtime_checkable
class Driver(Protocol):
    """A robot that takes velocities: forward speed and yaw rate on the ground, all three axes of the world in the air.

    Constructing one does nothing yet: it is done to check a scenario, too. A class that drives nothing that flies says
    ``ground_only = True``.
    """

    device: str  # for messages
    open_deadline_s: float  # `open` takes no longer than about this
    close_deadline_s: float  # nor does `close`

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Connect, with the robot standing at ``start`` (x m, y m, yaw rad), and have it at zero speed with motors enabled."""

    def read(self) -> Sample | None:
        """The newest sample, or None if there was none since the last call; raises what ended the connection."""

    def write(self, velocity: Velocity) -> None:
        """Move like this until the next command, or until `COMMAND_TIMEOUT_S` have passed.

        Robots on the ground look at ``linear[0]`` and ``yaw_rate`` alone.
        """

    def stop(self, cause: str) -> None:
        """Zero speed at once, ahead of all else; the next `write` moves the robot again."""

    def notices(self) -> list[Notice]:
        """What happened since the last call, oldest first; it can still be asked after `close`."""

    def close(self) -> None:
        """Zero speed, motors off, port free. May be called twice, and after a failure."""


def checked(velocity: Velocity) -> tuple[float, float]:
    """Forward speed, m/s, and yaw rate, rad/s, of a command that a ground robot can follow: NaN and infinity are refused."""
    v, w = velocity.linear[0], velocity.yaw_rate
    if not (abs(v) < float("inf") and abs(w) < float("inf")):  # false for NaN too
        raise ValueError(f"a robot cannot follow v = {v} m/s, w = {w} rad/s: both must be finite")
    return v, w
