"""Values exchanged between federates: frozen, SI units, ENU world, quaternions (w, x, y, z).

Small fixed vectors are tuples; scans, pictures and batches are read-only NumPy arrays. This module has data types only, no code
that acts on them or encodes them.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import DTypeLike, NDArray

from vcmvsp.cosim.frames import Quaternion, yaw_of

Vec3 = tuple[float, float, float]
ORIGIN: Vec3 = (0.0, 0.0, 0.0)
Array = NDArray[Any]

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Decibels = Annotated[float, msgspec.Meta(ge=-400, le=400)]  # dB, dBm or dBi
Spread = Annotated[float, msgspec.Meta(ge=0, le=100)]  # dB
Count = Annotated[int, msgspec.Meta(ge=0)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Period = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]  # s
Rate = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]  # Hz
OnLost = Literal["stop", "hold", "remove"]
FileName = Annotated[str, msgspec.Meta(extra={"file": True})]
"""Name of a file; in a scenario relative to its folder. Fields of type ``pathlib.Path`` are file names, too."""
Name = Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z0-9_-]+\Z")]


class Value(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Base of all values: immutable and encodable (see `cosim.util.codec`)."""


def frozen(array: object, dtype: DTypeLike | None = None) -> Array:
    """A C-contiguous, read-only array of this content: a copy, unless it is one already."""
    if (
        isinstance(array, np.ndarray)
        and not array.flags.writeable
        and array.flags.c_contiguous
        and dtype in (None, array.dtype)
    ):
        return array
    result: Array = np.array(array, dtype, order="C")
    result.flags.writeable = False
    return result


class VehicleState(Value, frozen=True, kw_only=True, tag="state"):
    """State of a rigid body at one instant."""

    position: Vec3  # m, world
    velocity: Vec3 = (0.0, 0.0, 0.0)  # m/s, world
    attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)  # w, x, y, z; world_from_body; unit norm
    angular_velocity: Vec3 = (0.0, 0.0, 0.0)  # rad/s, body

    @property
    def yaw(self) -> float:
        """Direction of the body x axis seen from above, rad, counter-clockwise from east."""
        return yaw_of(self.attitude)


class States(Value, frozen=True, kw_only=True, tag="states"):
    """The true states of all vehicles at one instant, a row per vehicle (for the radio and the recording only)."""

    names: tuple[str, ...]
    position: Array  # (n, 3) m, world
    velocity: Array  # (n, 3) m/s, world
    attitude: Array  # (n, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (n, 3) rad/s, body


class Velocity(Value, frozen=True, kw_only=True, tag="velocity"):
    """A command to move with a velocity until the next command.

    ``linear`` is in the body frame for ground robots (x forward; they cannot follow y and z) and in the world frame for
    vehicles that fly.
    """

    linear: Vec3 = (0.0, 0.0, 0.0)  # m/s
    yaw_rate: float = 0.0  # rad/s


class Waypoint(Value, frozen=True, kw_only=True, tag="waypoint"):
    """A command to a flying vehicle: go to a position and stay there until the next command."""

    position: Vec3  # m, world
    yaw: float | None = None  # rad; None: keep the present yaw
    speed: float | None = None  # m/s; None: the autopilot's maximum


class Contact(Value, frozen=True, kw_only=True, tag="contact"):
    """Start of a contact of a vehicle with another vehicle, a movable or moving obstacle or (``other`` is None) the world."""

    vehicle: str
    other: str | None


class Pushed(Value, frozen=True, kw_only=True, tag="pushed"):
    """Poses of all movable obstacles."""

    names: tuple[str, ...]
    position: Array  # (n, 3) m, world, of the centres
    attitude: Array  # (n, 4) w, x, y, z; world_from_body


class Presence(Value, frozen=True, kw_only=True, tag="presence"):
    """Presence of a vehicle's agent: lost (the vehicle holds its command), removed, or back."""

    state: Literal["lost", "removed", "back"]
    since_ns: int  # first tick without an answer, or first answered tick again
    why: str = ""
    late: int = 0  # back: number of answers that came too late


class RealStatus(Value, frozen=True, kw_only=True, tag="real"):
    """Status of a real vehicle and its link at an instant of the run."""

    link: int  # number of the connection; greater than 1 after a loss
    age_s: float | None  # age of the newest report of the driver; None: none yet
    fix_age_s: float | None = None  # age of the newest accepted position
    sigma_m: float | None = None  # standard deviation of the estimated position, along its worse axis
    prediction_m: float | None = None  # error of dead reckoning since the last instant
    gated: int = 0  # number of rejected positions
    sent: Velocity | None = None  # last command to the robot
    causes: tuple[str, ...] = ()  # reasons for a difference from the agent's command
    battery_v: float | None = None
    bumpers: int = 0  # a bit for each pressed segment
    late_s: float = 0.0  # largest lag of the station's control step since the last instant


class Incident(Value, frozen=True, kw_only=True, tag="incident"):
    """An incident of a real vehicle, or of the firmware of a simulated one."""

    what: Literal["connected", "lost", "stopped", "warned"]
    cause: str
    happened_ns: int  # simulated time; may be negative


class Odometry(Value, frozen=True, kw_only=True, tag="odometry"):
    """Wheel odometry: the pose integrated from the start pose, and the present speeds."""

    pose: Vec3  # x m, y m, yaw rad; world, drifting
    v: float  # m/s, forward
    w: float  # rad/s


class Fix(Value, frozen=True, kw_only=True, tag="fix"):
    """A measurement of a positioning system."""

    time_ns: int  # time of the measurement
    position: Vec3  # m, world
    yaw: float | None = None  # rad; None: no heading
    sigma_m: float  # standard deviation of x and y
    sigma_rad: float = 0.0  # standard deviation of the yaw
    sigma_z_m: float | None = None  # standard deviation of z; None: as x and y


class Imu(Value, frozen=True, kw_only=True, tag="imu"):
    """Inertial readings in the body frame."""

    acceleration: Vec3  # m/s2, specific force
    angular_velocity: Vec3  # rad/s
    time_ns: int = 0  # time of the measurement


class Scan(Value, frozen=True, kw_only=True, tag="scan"):
    """Sweep of a range scanner; beam i points at ``angle_min + i * angle_step`` from the body x axis."""

    ranges: Array  # (n,) float32 m; inf: no return; -inf: below the minimum range
    angle_min: float  # rad
    angle_step: float  # rad
    range_max: float  # m
    time_ns: int = 0  # time of the measurement


class Image(Value, frozen=True, kw_only=True, tag="image"):
    """Camera picture; the camera looks along its z axis, x is to the right of the picture, y down."""

    pixels: Array  # (height, width, 3) uint8, RGB
    time_ns: int = 0  # time of the exposure
    focal_px: float = 0.0  # focal length; the principal point is the centre of the picture
    depth_m: Array | None = None  # (height, width) float32, along the optical axis; inf: no surface


class Measured(Value, frozen=True, kw_only=True, tag="measured"):
    """Named numbers of any other sensor: a bumper's segments (0 or 1), ranges to neighbours (m), ..."""

    time_ns: int  # time of the measurement
    values: dict[str, float]  # by name, with the unit in the name


class Looks(Value, frozen=True, kw_only=True, tag="looks"):
    """Detections in the cells around a detector: square cells of the plane; cell (0, 0) has a corner in the origin."""

    time_ns: int  # time of the measurement
    cell_m: float
    cells: Array  # (n, 2) int32: column, row; cell (i, j) is i * cell_m <= x < (i + 1) * cell_m, and y with j
    hits: Array  # (n,) bool: target detected


Reading = Odometry | Fix | Imu | Scan | Image | Measured | Looks


class Later:
    """A reading that is computed when it is first read, and then kept; it is independent of later events.

    It stands for the reading inside a process; values that leave the process or are recorded are plain readings.
    """

    __slots__ = ("_reading", "_work")

    def __init__(self, work: Callable[[], Reading]) -> None:
        self._work: Callable[[], Reading] | None = work
        self._reading: Reading | None = None

    def get(self) -> Reading:
        """The reading, computed on the first call."""
        if self._work is not None:
            self._reading = self._work()  # a failed computation fails again at the next call
            self._work = None
        assert self._reading is not None  # noqa: S101
        return self._reading


class Readings(dict[str, Any]):
    """Readings by sensor name; readings on demand are computed when they are read."""

    def __getitem__(self, name: str) -> Reading:
        reading = super().__getitem__(name)
        return reading.get() if isinstance(reading, Later) else reading

    def get(self, name: str, default: object = None) -> Any:
        """The reading of a sensor, or the default."""
        return self[name] if name in self else default  # noqa: SIM401  this is that method

    def values(self) -> list[Reading]:  # type: ignore[override]  # a list serves
        """All readings."""
        return [self[name] for name in self]

    def items(self) -> list[tuple[str, Reading]]:  # type: ignore[override]
        """All names and readings."""
        return [(name, self[name]) for name in self]


class Message(Value, frozen=True, kw_only=True, tag="message"):
    """Message that an agent gives to its radio. The body is sent as MessagePack; ``size_bytes`` sets the air time."""

    sender: str  # name of a vehicle
    body: dict[str, Any] | bytes  # a mapping from agents, bytes from programs
    size_bytes: int  # payload
    to: str | None = None  # None: broadcast
    priority: int = 0  # a message of higher priority overtakes others in its sender's queue, if the mac supports it
    radio: str | msgspec.UnsetType = msgspec.UNSET  # name of the radio; unset: the only one, or the first


class Reception(Value, frozen=True, kw_only=True, tag="reception"):
    """A message at a receiver."""

    message: Message
    rssi_dbm: float  # received power
    sent_ns: int  # time at which the sender gave it to its radio
    received_ns: int  # time of arrival; the agent sees it at its next tick

    @property
    def radio(self) -> str | None:
        """Name of the radio that received it; None: the only one."""
        return self.message.radio or None


class Receptions(Value, frozen=True, kw_only=True, tag="receptions"):
    """m receptions of k messages, in the order in which the channel decided them."""

    names: tuple[str, ...]  # all vehicles, by row
    messages: tuple[Message, ...]  # (k,)
    sent_ns: Array  # (k,) int64
    message: Array  # (m,) int64, index into ``messages``
    receiver: Array  # (m,) int64, row of the vehicle
    arrival_ns: Array  # (m,) int64
    rssi_dbm: Array  # (m,) float64


class Heard(Value, frozen=True, kw_only=True, tag="heard"):
    """The messages that an agent gets at a tick, in order of arrival (for the recording only)."""

    receptions: tuple[Reception, ...]


class FrameReport(Value, frozen=True, kw_only=True, tag="frame"):
    """Outcome of one frame at each of its receivers; the rows of ``radio.parquet``."""

    frame: int  # unique in the run, in the order in which frames entered the channel
    sender: str
    sent_ns: int
    size_bytes: int
    receivers: tuple[str, ...]
    distance_m: Array  # (n,) float64
    rssi_dbm: Array  # (n,) float64
    received_ns: Array  # (n,) int64; -1: lost
    outcome: tuple[str, ...]  # "received" or the cause of the loss, per receiver
    air_time_ns: int = 0  # of one transmission; 0: it was never sent
    queue_ns: int = 0  # wait behind the sender's earlier frames
    access_ns: int = 0  # medium access delay, earlier attempts included
    copy_ns: Array | None = None  # (n,) int64, arrival of a second copy; -1: none
    # Link budget, (n,) each; None where the channel has no such layer.
    snr_db: Array | None = None  # over noise only
    sinr_db: Array | None = None  # over noise and interference, the minimum over the frame
    path_loss_db: Array | None = None
    walls: Array | None = None  # int64, number of walls crossed
    wall_materials: tuple[str, ...] | None = None  # e.g. "2 brick, 1 wood"
    wall_loss_db: Array | None = None
    shadowing_db: Array | None = None
    fading_db: Array | None = None  # as a gain
    radio: str | msgspec.UnsetType = msgspec.UNSET  # name of its radio; unset: the run has only one
    # Of the paths of the wave, (n,) each; unset: the channel does not know them.
    path_delay_ns: Array | msgspec.UnsetType = msgspec.UNSET  # float64, travel time of the first path
    delay_spread_ns: Array | msgspec.UnsetType = msgspec.UNSET  # float64, standard deviation over the paths, by power


class Datagrams(Value, frozen=True, kw_only=True, tag="datagrams"):
    """Datagrams that external programs have given to the radios of their vehicles, in the order of arrival."""

    number: Array  # (n,) int64, unique in the run
    sender: Array  # (n,) int32, rows of the run's vehicles
    to: Array  # (n,) int32, the only receiver; -1: broadcast
    size_bytes: Array  # (n,) int64, payload
    sent_ns: Array  # (n,) int64, arrival from the program, a little before or after now; decreases for no sender
    payloads: tuple[bytes, ...] = ()  # only if agents receive them; otherwise the gateway keeps them
    radio: str | msgspec.UnsetType = msgspec.UNSET  # name of the radio; unset: the only one, or the first


class Traffic(Value, frozen=True, kw_only=True, tag="traffic"):
    """Outcome of datagrams."""

    reports: tuple[FrameReport, ...]  # of all frames with these datagrams
    carries: Array  # (len(reports),) int64, number of the datagram in each frame
    number: Array  # (m,) int64, of delivered datagrams
    receiver: Array  # (m,) int32, receiver of each
    arrival_ns: Array  # (m,) int64, time of delivery; may be earlier than now if the gateway was late
    frame: Array  # (m,) int64, the frame that delivered it: with routing the last of several
    settled: Array  # (k,) int64, numbers of datagrams without further deliveries


class Routed(Value, frozen=True, kw_only=True, tag="routed"):
    """Outcome of a message that others may have relayed, when none of its frames is under way or the run has ended."""

    origin: str
    number: int  # sequence number at its origin
    to: str | None  # None: broadcast
    sent_ns: int
    size_bytes: int  # payload
    frame_bytes: int  # size of each frame, routing header included
    frames: tuple[int, ...]  # its frames in order of sending; none: there was no route
    receivers: tuple[str, ...]  # vehicles that received it, relays included, in order of time
    hops: tuple[int, ...]  # hops to each receiver
    via: tuple[str, ...]  # last hop of each receiver
    received_ns: tuple[int, ...]
    update: bool = False  # a routing update instead of a message
    under_way: bool = False  # at the end of the run: further receivers are possible


class Follows(Value, frozen=True, kw_only=True, tag="follows"):
    """Slot that a follower keeps: the reference of the formation error.

    ``slot`` is the place of its centre in the leader's frame, (x forward, y left). The error compares the follower's
    handle, ``handle_m`` ahead of its centre, with the point ``slot + (handle_m, 0)`` of the leader's frame.
    """

    leader: str | None  # None: it stops following
    slot: tuple[float, float] = (0.0, 0.0)  # m
    handle_m: float = 0.0  # m


class Note(Value, frozen=True, kw_only=True, tag="note"):
    """Numbers and words that an agent records (`Agent.note`)."""

    values: dict[str, float | str | bool]


class ProbabilityMap(Value, frozen=True, kw_only=True, tag="map"):
    """A vehicle's map of a searched area, and the cells that it has seen itself; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    probability: Array  # (rows, columns) uint8, probability of a target in the cell, in 255ths
    seen: Array  # (rows, columns) bool: seen by this vehicle


class Sighting(Value, frozen=True, kw_only=True):
    """A target recognised in a picture."""

    target: str
    place: tuple[float, float]  # m, world, on the ground
    centre_px: tuple[float, float]  # column, row; the centre of the first pixel is (0, 0)
    angle: float  # rad, counter-clockwise in the picture
    side_px: float
    score: float  # 0 to 1


class Sightings(Value, frozen=True, kw_only=True, tag="sightings"):
    """Targets recognised in one picture of a camera."""

    sensor: str
    time_ns: int  # time of the exposure
    width: int  # px
    height: int
    found: tuple[Sighting, ...]
    jpeg: bytes = b""  # the picture itself; empty: not kept


class Mosaic(Value, frozen=True, kw_only=True, tag="mosaic"):
    """Mosaic of the ground that a vehicle has seen, from above; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    pixels: Array  # (rows, columns, 3) uint8, RGB; black: not seen


class Outage(Value, frozen=True, kw_only=True, tag="outage"):
    """Operator's command to lose all frames from and to these vehicles."""

    vehicles: tuple[str, ...]
    until_ns: int


class Changed(Value, frozen=True, kw_only=True, tag="changed"):
    """Operator's change of a scenario key."""

    key: str
    value: float


class Moved(Value, frozen=True, kw_only=True, tag="moved"):
    """Operator's command to move an obstacle, which then rests."""

    obstacle: str
    position: tuple[float, float]  # m, world
    yaw: float  # rad


class Halted(Value, frozen=True, kw_only=True, tag="halted"):
    """Operator's command to stop vehicles, regardless of their agents' commands, or to release them."""

    vehicles: tuple[str, ...]
    halted: bool


VehicleValue = VehicleState | States | Presence | RealStatus | Incident | Contact | Pushed
AgentValue = Velocity | Waypoint | Follows | Note | ProbabilityMap | Sightings | Mosaic
RadioValue = Message | Reception | Receptions | Heard | FrameReport | Datagrams | Traffic | Routed
OperatorValue = Outage | Changed | Moved | Halted
RECEPTIONS = "radio/receptions"
"""Key of `Receptions`."""
AnyValue = VehicleValue | Reading | AgentValue | RadioValue | OperatorValue
