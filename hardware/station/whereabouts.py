"""Where a robot is at any instant, from what its driver and its positioning system said last.

Between two samples a robot is taken to go on as it did, for `COAST_S` at most; then to stand.
"""

import math
from typing import Protocol

import msgspec

from cosim.clock import SECOND_NS
from cosim.frames import Quaternion, arc, quaternion_from_yaw
from cosim.types import Array, Fix, Odometry, Vec3, VehicleState
from hardware.driver import Sample
from hardware.station.wire import Mission

COAST_S = 0.5
STILL: Vec3 = (0.0, 0.0, 0.0)


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """The state at an instant."""

    state: VehicleState
    covariance: Array | None = None  # (3, 3) of x, y, yaw
    seen_ns: int | None = None  # when that was measured on which it rests; None: not yet
    fix_age_s: float | None = None


class Whereabouts(Protocol):
    """Takes samples and fixes in the order in which they come; their times must not lie in the future.

    Attributes:
        gated: fixes that did not fit.
        jumps: times that the estimate was given up for what the fixes said.
    """

    gated: int
    jumps: int

    def sample(self, sample: Sample, now_ns: int) -> None:
        """What the driver read."""

    def fix(self, fix: Fix) -> None:
        """What the positioning system said."""

    def at(self, now_ns: int) -> Estimate | None:
        """The state now; None: not known."""


def whereabouts(mission: Mission) -> Whereabouts:
    """As a mission asks: fused where something tells positions to a robot on the ground, else as the driver says."""
    if mission.localisation is not None and not mission.flies:
        from hardware.station.fused import Fused  # half a second of SciPy, which no other robot needs

        return Fused(mission.fusion, mission.start, mission.height_m)
    return Told(mission.height_m, flies=mission.flies)


class Told:
    """As the driver says: the state that the robot knows, else odometry; which does not tell where something is that flies."""

    def __init__(self, height_m: float, *, flies: bool) -> None:
        self.gated = self.jumps = 0
        self._height_m, self._flies = height_m, flies
        self._last: Sample | None = None

    def sample(self, sample: Sample, now_ns: int) -> None:
        """The newest counts."""
        self._last = sample

    def fix(self, fix: Fix) -> None:
        """The robot knows where it is."""

    def at(self, now_ns: int) -> Estimate | None:
        """Extrapolated to now."""
        last = self._last
        if last is None or (last.state is None and self._flies):
            return None
        seen_ns = min(last.measured_ns, now_ns)
        age_s = (now_ns - seen_ns) / SECOND_NS
        state = _carried_on(last.odometry, age_s, self._height_m) if last.state is None else _gone_on(last.state, age_s)
        return Estimate(state=state, seen_ns=seen_ns)


def _carried_on(odometry: Odometry, age_s: float, height_m: float) -> VehicleState:
    """Odometry, so many seconds later."""
    v, w = (odometry.v, odometry.w) if age_s <= COAST_S else (0.0, 0.0)
    return planar(arc(odometry.pose, odometry.v, odometry.w, min(age_s, COAST_S)), v, w, height_m)


def planar(pose: Vec3, v: float, w: float, height_m: float) -> VehicleState:
    """The state of a robot on the ground."""
    x, y, yaw = pose
    return VehicleState(
        position=(x, y, height_m),
        velocity=(v * math.cos(yaw), v * math.sin(yaw), 0.0),
        attitude=quaternion_from_yaw(yaw),
        angular_velocity=(0.0, 0.0, w),
    )


def _gone_on(state: VehicleState, age_s: float) -> VehicleState:
    """A state, so many seconds later: along its velocity, turned about the vertical."""
    moved_s = min(age_s, COAST_S)
    (x, y, z), (vx, vy, vz) = state.position, state.velocity
    turned = quaternion_from_yaw(state.angular_velocity[2] * moved_s)
    goes_on = age_s <= COAST_S
    return VehicleState(
        position=(x + vx * moved_s, y + vy * moved_s, z + vz * moved_s),
        velocity=state.velocity if goes_on else STILL,
        attitude=_after(turned, state.attitude),
        angular_velocity=state.angular_velocity if goes_on else STILL,
    )


def _after(turned: Quaternion, attitude: Quaternion) -> Quaternion:
    """The attitude, turned about the vertical: the product of quaternions whose first has no x and y."""
    c, _, _, s = turned
    w, x, y, z = attitude
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
