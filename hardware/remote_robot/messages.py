"""Messages between the driver in a run and the program on a robot.

Each side sends its state every `SAY_S`, and at once when it changes: lost messages are replaced by the next. Times are of the
sender's monotonic clock, ns. Each side returns the newest time that it received, so that the driver gets the offset of the
robot's clock, and the robot the maximum age of a velocity, for any clocks.
"""

from typing import Literal

from vcmvsp.cosim.types import Value, Vec3, Velocity
from vcmvsp.cosim.util.codec import Decoder
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, DriverError, HandshakeError, LinkLost, Notice, PortError, Sample
from vcmvsp.hardware.drivers.threaded import NOT_YET

PROTOCOL = 1
SAY_S = 0.05
DEADMAN_S = COMMAND_TIMEOUT_S
"""Aboard: without a velocity for so long, or with one that may be older, the robot is stopped."""

NOTICES_AT_ONCE = 20  # in one message; more wait for the acknowledgement of these

FailureKind = Literal["port", "handshake", "lost", "driver"]
FAILURES: dict[FailureKind, type[DriverError]]
FAILURES = {"port": PortError, "handshake": HandshakeError, "lost": LinkLost, "driver": DriverError}
"""Errors of drivers by their kinds; the last is any other."""


class RobotHello(Value, frozen=True, kw_only=True):
    """Request of a program on a robot to be driven."""

    protocol: int
    vehicle: str
    robot: str  # random number of this program, unchanged after a broken link
    session: str  # id of its Zenoh session
    device: str  # of its driver, for messages
    open_s: float = 0.0  # maximum time of its driver to open
    close_s: float = 0.0  # maximum time of its driver to close


class RobotWelcome(Value, frozen=True, kw_only=True):
    """Answer to a `RobotHello`."""

    refused: str = ""  # reason of a rejection; empty: accepted
    final: bool = False  # a repeated request will be rejected, too
    run: str = ""  # name of this opening of the driver
    start: Vec3 = (0.0, 0.0, 0.0)  # pose of the robot: x m, y m, yaw rad


class RobotOrder(Value, frozen=True, kw_only=True):
    """Message to the robot."""

    number: int  # counts from 1
    sent_ns: int
    yours_ns: int = 0  # `RobotStatus.said_ns` of the newest status; 0: none
    noticed: int = 0  # notices received so far
    velocity: Velocity | None = None  # None: stand
    stop: str = NOT_YET  # reason to stand
    leave: bool = False  # the run is over


class Failure(Value, frozen=True, kw_only=True):
    """Failure of the robot's own driver."""

    kind: FailureKind
    device: str
    happened: str
    advice: str


class RobotStatus(Value, frozen=True, kw_only=True):
    """Message from the robot."""

    said_ns: int
    heard: int = 0  # number of the newest `RobotOrder` that took effect
    yours_ns: int = 0  # its ``sent_ns``
    heard_ns: int = 0  # its arrival
    state: Literal["closed", "opening", "open"] = "closed"  # of the robot's own driver
    opened: int = 0  # number of openings
    sample: Sample | None = None  # new sample
    notices: tuple[Notice, ...] = ()  # notices without acknowledgement
    noticed: int = 0  # number of earlier notices
    failure: Failure | None = None
    left: bool = False  # the run is over, and the driver is closed


hellos: Decoder[RobotHello] = Decoder(RobotHello)
welcomes: Decoder[RobotWelcome] = Decoder(RobotWelcome)
downs: Decoder[RobotOrder] = Decoder(RobotOrder)
ups: Decoder[RobotStatus] = Decoder(RobotStatus)
