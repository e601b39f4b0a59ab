"""Messages between a run and the station of a real vehicle: one mission, then orders to the station and reports back.

Times are of the sender's monotonic clock, ns, unless a comment says otherwise. Station and run are on one machine, or the
link between them converts the station's times.
"""

from typing import Any, Literal

from vcmvsp.cosim.types import Array, Fix, Odometry, Value, Vec3, VehicleState, Velocity
from vcmvsp.cosim.util.codec import Decoder
from vcmvsp.hardware.drivers.base import Notice
from vcmvsp.hardware.safety.supervisor import Safety

KNOWN_S = 1.0  # extrapolation time of other vehicles
OPERATOR_STOP = "operator's stop"
"""Cause in a report: ``vcmvsp stop`` was called; it lasts until the station ends."""


class PartSpec(Value, frozen=True, kw_only=True):
    """A driver or a localisation that the station builds."""

    group: Literal["driver", "localisation"]
    kind: str  # short name, module:Class or file.py:Class
    params: dict[str, Any]  # of its constructor, checked by the run


class StationMission(Value, frozen=True, kw_only=True):
    """First message to a station."""

    run: str  # name of the run
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
    """Order of the run; the newest counts. It is repeated at least every 0.1 s."""

    number: int  # counts from 1
    sent_ns: int
    command: Velocity | None = None  # None: none yet
    command_ns: int | None = None  # time of the command
    command_age_ns: int | None = None  # in logical time, without lateness of the run; None: unknown
    others: Array | None = None  # (n, 7): x y z m, vx vy vz m/s, radius m of every other vehicle
    stop: str = ""  # reason to stop until the station ends; empty: none
    leave: bool = False  # stop the robot, close everything, and end


class StationReport(Value, frozen=True, kw_only=True):
    """State of the station, once a cycle."""

    number: int  # counts from 1
    time_ns: int
    order: int = 0  # number of the newest order
    state: VehicleState | None = None  # at ``time_ns``, world; None: unknown
    covariance: Array | None = None  # (3, 3) of x, y, yaw: m^2, m rad, rad^2
    odometry: Odometry | None = None  # newest
    sample: int = 0  # number of the newest sample of the driver; 0: none
    measured_ns: int = 0  # time of its measurement, estimated
    link: int = 0
    fixes: tuple[Fix, ...] = ()  # new since the last report, ``time_ns`` of each on the station's clock
    gated: int = 0  # rejected fixes so far
    fix_age_s: float | None = None  # of the newest accepted fix
    sonar: tuple[tuple[int, float], ...] = ()  # number, range m: new since the last report
    battery_v: float | None = None
    bumpers: int = 0
    sent: Velocity | None = None  # to the robot
    causes: tuple[str, ...] = ()  # causes of a difference from the requested command (`hardware.safety.Cause`, or text)
    notices: tuple[Notice, ...] = ()  # new since the last report: connected, lost, stopped
    late_s: float = 0.0  # lateness of this cycle
    failed: str = ""  # reason for the end of the station, in its last report
    advice: str = ""  # remedy


missions: Decoder[StationMission] = Decoder(StationMission)
orders: Decoder[StationOrder] = Decoder(StationOrder)
reports: Decoder[StationReport] = Decoder(StationReport)
