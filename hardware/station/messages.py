"""What a run and the station of a real vehicle say to each other: a mission at first, then orders there and reports back.

All times are of the monotonic clock of whoever gives them, in ns, unless a comment says otherwise. Station and run are on one
machine, or else the link between them translates the station's times.
"""

from typing import Any, Literal

from vcmvsp.cosim.types import Array, Fix, Odometry, Value, Vec3, VehicleState, Velocity
from vcmvsp.cosim.util.codec import Decoder
from vcmvsp.hardware.drivers.base import Notice

OPERATOR_STOP = "operator's stop"
"""Among the causes of a report: ``vcmvsp stop`` was called, and counts until the station ends."""


class PartSpec(Value, frozen=True, kw_only=True):
    """Something that the station builds: a driver, or what tells where the robot is."""

    group: Literal["driver", "localisation"]
    kind: str  # short name, module:Class or file.py:Class
    params: dict[str, Any]  # of its constructor, checked by whoever wrote the mission


class Safety(Value, frozen=True, kw_only=True):
    """Limits, fence, distances and time-outs; lengths in m, times in s. None: nobody looks at it."""

    max_speed: float  # m/s
    max_yaw_rate: float  # rad/s
    accel: float  # m/s2
    decel: float  # m/s2, that the robot is sure to reach when it brakes
    yaw_accel: float  # rad/s2
    yaw_decel: float  # rad/s2
    max_climb: float = 1.0  # m/s, up and down, of what flies
    radius_m: float  # of a circle around the body, about the point that its pose tells
    fence: tuple[tuple[float, float], ...] | None = None  # corners x, y, world; none may be left
    floor_m: float | None = None  # of what flies: the least height
    ceiling_m: float | None = None  # and the greatest
    fence_margin_m: float = 0.0
    separation_m: float = 0.5  # between bodies
    reaction_s: float = 0.2  # from a command to when the next one acts, with all delays of pose and link
    jump_m: float = 1.0  # a jump of the position beyond this is not believed: the robot stands until the station ends
    operator_s: float | None = None  # how long the operator (``vcmvsp operator``) may be silent
    command_s: float | None = 0.5
    positioning_s: float | None = 1.0
    federation_s: float | None = 0.5


class StationMission(Value, frozen=True, kw_only=True):
    """The first thing that a station is told."""

    run: str  # of the run, for those who look for its stations
    vehicle: str
    folder: str  # of the scenario: where a file.py:Class is
    driver: PartSpec
    localisation: PartSpec | None
    fusion: dict[str, Any]  # parameters of `cosim.estimation.fusion.Fusion`
    start: Vec3  # x m, y m, yaw rad
    height_m: float  # above the ground: z of a robot that only moves on it
    flies: bool
    safety: Safety
    rate_hz: float = 50.0


class StationOrder(Value, frozen=True, kw_only=True):
    """What the run wants now. The newest counts; it is said again at least every 0.1 s, so that silence means something."""

    number: int  # counts from 1
    sent_ns: int
    command: Velocity | None = None  # None: there was none yet
    command_ns: int | None = None  # when it was given
    command_age_ns: int | None = None  # by the run's time, which its own lateness does not count in; None: by its clock
    others: Array | None = None  # (n, 7): x y z m, vx vy vz m/s, radius m of every other vehicle
    stop: str = ""  # why the robot must stop now; it stays so until the station ends
    leave: bool = False  # stop the robot, close everything, and end


class StationReport(Value, frozen=True, kw_only=True):
    """How things stand at the station, at every turn."""

    number: int  # counts from 1
    time_ns: int
    order: int = 0  # the newest that was heard
    state: VehicleState | None = None  # at ``time_ns``, in the world; None: not known
    covariance: Array | None = None  # (3, 3) of x, y, yaw: m^2, m rad, rad^2
    odometry: Odometry | None = None  # newest
    sample: int = 0  # number of the newest sample of the driver; 0: none
    measured_ns: int = 0  # when it was measured, as far as that is known
    link: int = 0
    fixes: tuple[Fix, ...] = ()  # new since the last report, ``time_ns`` of each on the station's clock
    gated: int = 0  # fixes that did not fit, so far
    fix_age_s: float | None = None  # of the newest that counted
    sonar: tuple[tuple[int, float], ...] = ()  # number, range m: new since the last report
    battery_v: float | None = None
    bumpers: int = 0
    sent: Velocity | None = None  # to the robot
    causes: tuple[str, ...] = ()  # why that is not what was wanted, now (`hardware.safety.Cause`, or words)
    notices: tuple[Notice, ...] = ()  # new since the last report: connected, lost, stopped
    late_s: float = 0.0  # how late this turn began
    failed: str = ""  # why the station ends: the last report
    advice: str = ""  # what to do about it


missions: Decoder[StationMission] = Decoder(StationMission)
orders: Decoder[StationOrder] = Decoder(StationOrder)
reports: Decoder[StationReport] = Decoder(StationReport)
