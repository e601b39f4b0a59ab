"""What the driver in a run and the program aboard a robot say to each other.

Either says all that counts every `SAY_S`, and at once when something is new: what gets lost is said again. Times are of the
monotonic clock of whoever gives them, ns. Each repeats the newest time that it was told, so that the driver learns the
offset of the robot's clock, and the robot how old a velocity can be at most, whatever the clocks say.
"""

from typing import Literal

from vcmvsp.cosim.types import Value, Vec3, Velocity
from vcmvsp.cosim.util.codec import Decoder
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, Notice, Sample
from vcmvsp.hardware.drivers.command_repeater import NOT_YET

PROTOCOL = 1
SAY_S = 0.05
DEADMAN_S = COMMAND_TIMEOUT_S
"""Aboard: without a velocity for so long, or with one that may be older, the robot is stopped."""

NOTICES_AT_ONCE = 20  # in one message; more wait until these have been heard


class RobotHello(Value, frozen=True, kw_only=True):
    """The program aboard a robot asks to be driven."""

    protocol: int
    vehicle: str
    robot: str  # a number of this program's own, the same after the link has broken
    session: str  # id of its Zenoh session
    device: str  # of its driver, for messages
    open_s: float = 0.0  # how long its driver may take to open
    close_s: float = 0.0  # ... and to close


class RobotWelcome(Value, frozen=True, kw_only=True):
    """The answer."""

    refused: str = ""  # why it is not driven
    final: bool = False  # to ask again will not help
    run: str = ""  # a name of this opening of the driver
    start: Vec3 = (0.0, 0.0, 0.0)  # where it stands: x m, y m, yaw rad


class RobotOrder(Value, frozen=True, kw_only=True):
    """To the robot."""

    number: int  # counts from 1
    sent_ns: int
    yours_ns: int = 0  # `RobotStatus.said_ns` of the newest that was heard; 0: none
    noticed: int = 0  # notices that were heard so far
    velocity: Velocity | None = None  # None: stand
    stop: str = NOT_YET  # why it stands
    leave: bool = False  # the run is over


class Failure(Value, frozen=True, kw_only=True):
    """Why the robot's own driver cannot go on."""

    kind: Literal["driver", "port", "handshake", "lost"]
    device: str
    happened: str
    advice: str


class RobotStatus(Value, frozen=True, kw_only=True):
    """From the robot."""

    said_ns: int
    heard: int = 0  # number of the newest `RobotOrder` that was acted upon
    yours_ns: int = 0  # its ``sent_ns``
    heard_ns: int = 0  # when it came
    state: Literal["closed", "opening", "open"] = "closed"  # of the robot's own driver
    opened: int = 0  # how often it was opened
    sample: Sample | None = None  # if there is a new one
    notices: tuple[Notice, ...] = ()  # those that were not heard yet
    noticed: int = 0  # how many came before these
    failure: Failure | None = None
    left: bool = False  # it was told that the run is over, and has closed its driver


hellos: Decoder[RobotHello] = Decoder(RobotHello)
welcomes: Decoder[RobotWelcome] = Decoder(RobotWelcome)
downs: Decoder[RobotOrder] = Decoder(RobotOrder)
ups: Decoder[RobotStatus] = Decoder(RobotStatus)
