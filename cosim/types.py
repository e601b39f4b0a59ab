"""The values that travel between federates: frozen, SI units, ENU world, quaternions (w, x, y, z).

Small fixed vectors are tuples; scans, pictures and batches are read-only NumPy arrays. Values alone: whatever acts on them, or
reads and writes them, is elsewhere.
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
"""The name of a file; in a scenario relative to its folder. ``pathlib.Path`` is one, too."""
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
    """A rigid body at one instant."""

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
    """A command: move like this until the next command.

    ``linear`` is in the body frame for ground robots (x forward; they cannot follow y and z) and in the world frame for
    vehicles that fly.
    """

    linear: Vec3 = (0.0, 0.0, 0.0)  # m/s
    yaw_rate: float = 0.0  # rad/s


class Waypoint(Value, frozen=True, kw_only=True, tag="waypoint"):
    """A command to a vehicle that flies: go there and stay, until the next command."""

    position: Vec3  # m, world
    yaw: float | None = None  # rad; None: keep the present one
    speed: float | None = None  # m/s; None: as fast as its autopilot goes


class Contact(Value, frozen=True, kw_only=True, tag="contact"):
    """A vehicle began to touch another vehicle, a movable or moving obstacle or, where ``other`` is None, the world."""

    vehicle: str
    other: str | None


class Pushed(Value, frozen=True, kw_only=True, tag="pushed"):
    """Where obstacles are that can be pushed; those that nobody has touched, too."""

    names: tuple[str, ...]
    position: Array  # (n, 3) m, world, of their centres
    attitude: Array  # (n, 4) w, x, y, z; world_from_body


class Presence(Value, frozen=True, kw_only=True, tag="presence"):
    """What became of a vehicle's agent: it was lost and its vehicle holds, was lost for good, or is back."""

    state: Literal["lost", "removed", "back"]
    since_ns: int  # its first tick without an answer, or its first with one again
    why: str = ""
    late: int = 0  # back: answers that came too late to count


class RealStatus(Value, frozen=True, kw_only=True, tag="real"):
    """How a real vehicle and the run that it is part of stand, at an instant of the run."""

    link: int  # which connection since the start: greater than 1 after one was lost
    age_s: float | None  # of the newest that its driver told; None: nothing yet
    fix_age_s: float | None = None  # of the newest position that counted
    sigma_m: float | None = None  # standard deviation of the estimated position, along its worse axis
    prediction_m: float | None = None  # how far off dead reckoning since the last instant was
    gated: int = 0  # positions that did not fit, so far
    sent: Velocity | None = None  # what the robot was told last
    causes: tuple[str, ...] = ()  # why that is not what its agent wanted
    battery_v: float | None = None
    bumpers: int = 0  # a bit for each segment that is pressed
    late_s: float = 0.0  # how late a turn of its station began, at most, since the last instant


class Incident(Value, frozen=True, kw_only=True, tag="incident"):
    """Something that befell a real vehicle."""

    what: Literal["connected", "lost", "stopped", "warned"]
    cause: str
    happened_ns: int  # in the run's time; may lie before 0


class Odometry(Value, frozen=True, kw_only=True, tag="odometry"):
    """What the wheels say: the pose integrated from the start pose, and the present speeds."""

    pose: Vec3  # x m, y m, yaw rad; world, drifting
    v: float  # m/s, forward
    w: float  # rad/s


class Fix(Value, frozen=True, kw_only=True, tag="fix"):
    """One answer of a positioning system."""

    time_ns: int  # when it was measured
    position: Vec3  # m, world
    yaw: float | None = None  # rad; None: it tells no heading
    sigma_m: float  # standard deviation of x and y
    sigma_rad: float = 0.0  # standard deviation of the yaw
    sigma_z_m: float | None = None  # standard deviation of z; None: as x and y


class Imu(Value, frozen=True, kw_only=True, tag="imu"):
    """Inertial readings in the body frame."""

    acceleration: Vec3  # m/s2, specific force
    angular_velocity: Vec3  # rad/s
    time_ns: int = 0  # when it was measured


class Scan(Value, frozen=True, kw_only=True, tag="scan"):
    """One sweep of a range scanner; beam i points at ``angle_min + i * angle_step`` from the body x axis."""

    ranges: Array  # (n,) float32 m; inf: no return; -inf: nearer than it can measure
    angle_min: float  # rad
    angle_step: float  # rad
    range_max: float  # m
    time_ns: int = 0  # when it was measured


class Image(Value, frozen=True, kw_only=True, tag="image"):
    """One camera picture; the camera looks along its z axis, x is to the right of the picture, y down."""

    pixels: Array  # (height, width, 3) uint8, RGB
    time_ns: int = 0  # when it was taken
    focal_px: float = 0.0  # focal length; the principal point is the middle of the picture
    depth_m: Array | None = None  # (height, width) float32, along the optical axis; inf: nothing


class Measured(Value, frozen=True, kw_only=True, tag="measured"):
    """Numbers by name, of any other sensor: a bumper's segments (0 or 1), ranges to neighbours (m), ..."""

    time_ns: int
    values: dict[str, float]


class Looks(Value, frozen=True, kw_only=True, tag="looks"):
    """What a detector says of the cells around it: square cells of the plane, of which (0, 0) has a corner in the origin."""

    time_ns: int  # when it looked
    cell_m: float
    cells: Array  # (n, 2) int32: column, row; cell (i, j) is i * cell_m <= x < (i + 1) * cell_m, likewise j and y
    hits: Array  # (n,) bool: "there is a target"


Reading = Odometry | Fix | Imu | Scan | Image | Measured | Looks


class Later:
    """A reading that is worked out when somebody first looks at it, and then kept; it depends on nothing that comes after it.

    It takes the place of the reading inside a process; what leaves the process, or is recorded, is the reading.
    """

    __slots__ = ("_reading", "_work")

    def __init__(self, work: Callable[[], Reading]) -> None:
        self._work: Callable[[], Reading] | None = work
        self._reading: Reading | None = None

    def get(self) -> Reading:
        """The reading."""
        if self._work is not None:
            self._reading = self._work()  # where that fails, it fails again at the next look
            self._work = None
        assert self._reading is not None  # noqa: S101
        return self._reading


class Readings(dict[str, Any]):
    """Readings by the names of sensors; what is worked out on demand, is when it is looked at."""

    def __getitem__(self, name: str) -> Reading:
        reading = super().__getitem__(name)
        return reading.get() if isinstance(reading, Later) else reading

    def get(self, name: str, default: object = None) -> Any:
        """The reading, or the default."""
        return self[name] if name in self else default  # noqa: SIM401  this is that method

    def values(self) -> list[Reading]:  # type: ignore[override]  # a list serves
        """All readings."""
        return [self[name] for name in self]

    def items(self) -> list[tuple[str, Reading]]:  # type: ignore[override]
        """All names and readings."""
        return [(name, self[name]) for name in self]


class Message(Value, frozen=True, kw_only=True, tag="message"):
    """What an agent hands to its radio. The body crosses the air as MessagePack; ``size_bytes`` sets the air time."""

    sender: str
    body: dict[str, Any] | bytes
    size_bytes: int
    to: str | None = None  # None: broadcast
    priority: int = 0  # one of a higher priority overtakes those that wait in its sender's queue, where the mac has one


class Reception(Value, frozen=True, kw_only=True, tag="reception"):
    """A message as it arrived."""

    message: Message
    rssi_dbm: float
    sent_ns: int
    received_ns: int


class FrameReport(Value, frozen=True, kw_only=True, tag="frame"):
    """What became of one frame at every receiver it was meant for; the rows of ``radio.parquet``."""

    frame: int  # unique in the run, in the order in which frames entered the channel
    sender: str
    sent_ns: int
    size_bytes: int
    receivers: tuple[str, ...]
    distance_m: Array  # (n,) float64
    rssi_dbm: Array  # (n,) float64
    received_ns: Array  # (n,) int64; -1: lost
    outcome: tuple[str, ...]  # "received" or the cause of the loss, per receiver
    air_time_ns: int = 0  # one transmission; 0: it was never sent
    queue_ns: int = 0  # waited behind the sender's earlier frames
    access_ns: int = 0  # waited for the air, earlier attempts included
    copy_ns: Array | None = None  # (n,) int64, when a second copy arrives; -1: none does
    # The link budget, (n,) each; None where the channel has no such layer.
    snr_db: Array | None = None  # over noise alone
    sinr_db: Array | None = None  # over noise and interference, the least while it was on the air
    path_loss_db: Array | None = None
    walls: Array | None = None  # int64, how many are crossed
    wall_materials: tuple[str, ...] | None = None  # e.g. "2 brick, 1 wood"
    wall_loss_db: Array | None = None
    shadowing_db: Array | None = None
    fading_db: Array | None = None  # a gain


class Datagrams(Value, frozen=True, kw_only=True, tag="datagrams"):
    """What programs outside have handed to the radios of their vehicles, in the order in which it came."""

    number: Array  # (n,) int64, unique in the run
    sender: Array  # (n,) int32, rows of the run's vehicles
    to: Array  # (n,) int32, the only one meant; -1: broadcast
    size_bytes: Array  # (n,) int64, payload
    sent_ns: Array  # (n,) int64, when it came, a little before or after now; decreases for no sender
    payloads: tuple[bytes, ...] = ()  # where agents are to hear it; else it never leaves whoever carries it


class Traffic(Value, frozen=True, kw_only=True, tag="traffic"):
    """What became of datagrams."""

    reports: tuple[FrameReport, ...]  # of all frames that were sent for them
    carries: Array  # (len(reports),) int64, the number of the datagram in each
    number: Array  # (m,) int64, of datagrams that arrive where they are meant to
    receiver: Array  # (m,) int32, there
    arrival_ns: Array  # (m,) int64, when; may be earlier than now, if whoever carries it was late
    frame: Array  # (m,) int64, that brought it: with routing the last of several
    settled: Array  # (k,) int64, numbers of those of which nothing is to come any more


class Routed(Value, frozen=True, kw_only=True, tag="routed"):
    """What became of a message that others may have passed on, once nothing of it is under way or the run has ended."""

    origin: str
    number: int  # among those of its origin
    to: str | None  # None: broadcast
    sent_ns: int
    size_bytes: int  # payload
    frame_bytes: int  # of each frame: that, and what routing adds
    frames: tuple[int, ...]  # that were sent for it, in their order; none: there was no route
    receivers: tuple[str, ...]  # whom it reached, relays included, in the order of time
    hops: tuple[int, ...]  # on the way to each of them
    via: tuple[str, ...]  # from whom each of them had it
    received_ns: tuple[int, ...]
    update: bool = False  # of routes: no message, but what vehicles tell each other
    under_way: bool = False  # when the run ended: it may have reached more


class Follows(Value, frozen=True, kw_only=True, tag="follows"):
    """The place that a follower means to keep: what the formation error is measured against.

    ``slot`` is where its centre belongs in the leader's frame, (x forward, y left). The error compares the follower's
    handle, ``handle_m`` ahead of its centre, with the point ``slot + (handle_m, 0)`` of the leader's frame.
    """

    leader: str | None  # None: it follows nobody any more
    slot: tuple[float, float] = (0.0, 0.0)  # m
    handle_m: float = 0.0  # m


class Note(Value, frozen=True, kw_only=True, tag="note"):
    """Numbers and words that an agent wants recorded (`Agent.note`)."""

    values: dict[str, float | str | bool]


class ProbabilityMap(Value, frozen=True, kw_only=True, tag="map"):
    """What a vehicle knows of an area that is searched, and what of it it has seen itself; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    probability: Array  # (rows, columns) uint8, of a target in the cell, in 255ths
    seen: Array  # (rows, columns) bool: looked at by this vehicle


class Sighting(Value, frozen=True, kw_only=True):
    """A target that was recognised in a picture."""

    target: str
    place: tuple[float, float]  # m, world, on the ground
    centre_px: tuple[float, float]  # column, row; the middle of the first pixel is (0, 0)
    angle: float  # rad, counter-clockwise in the picture
    side_px: float
    score: float  # 0 to 1


class Sightings(Value, frozen=True, kw_only=True, tag="sightings"):
    """What was recognised in one picture of a camera."""

    sensor: str
    time_ns: int  # when the picture was taken
    width: int  # px
    height: int
    found: tuple[Sighting, ...]
    jpeg: bytes = b""  # the picture itself; empty: not kept


class Mosaic(Value, frozen=True, kw_only=True, tag="mosaic"):
    """The ground as far as a vehicle has seen it, from above; row 0 is the south edge."""

    left: float  # m, world
    bottom: float  # m, world
    cell_m: float
    pixels: Array  # (rows, columns, 3) uint8, RGB; black: not seen


class Outage(Value, frozen=True, kw_only=True, tag="outage"):
    """The operator has all frames from and to these vehicles lost."""

    vehicles: tuple[str, ...]
    until_ns: int


class Changed(Value, frozen=True, kw_only=True, tag="changed"):
    """The operator has given a key of the scenario another value."""

    key: str
    value: float


class Moved(Value, frozen=True, kw_only=True, tag="moved"):
    """The operator has put an obstacle somewhere else, where it rests."""

    obstacle: str
    position: tuple[float, float]  # m, world
    yaw: float  # rad


class Halted(Value, frozen=True, kw_only=True, tag="halted"):
    """The operator has vehicles stand still, whatever their agents command, or lets them go on."""

    vehicles: tuple[str, ...]
    halted: bool


VehicleValue = VehicleState | States | Presence | RealStatus | Incident | Contact | Pushed
AgentValue = Velocity | Waypoint | Follows | Note | ProbabilityMap | Sightings | Mosaic
RadioValue = Message | Reception | FrameReport | Datagrams | Traffic | Routed
OperatorValue = Outage | Changed | Moved | Halted
AnyValue = VehicleValue | Reading | AgentValue | RadioValue | OperatorValue
