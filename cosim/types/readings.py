"""What sensors say, at once or when somebody looks."""

from collections.abc import Callable
from typing import Any

from vcmvsp.cosim.types.quantities import Array, Value, Vec3


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
