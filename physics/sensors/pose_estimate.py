"""What a vehicle takes for its own state, by its pose source."""

from typing import Protocol

import msgspec

from vcmvsp.cosim.frames import Quaternion, quaternion_from_yaw, yaw_of
from vcmvsp.cosim.types import Fix, Odometry, VehicleState
from vcmvsp.physics.engine.interface import Motion


class Fused(Protocol):
    """A pose that was made of odometry and positions."""

    @property
    def x(self) -> float:
        """World, m."""

    @property
    def y(self) -> float:
        """World, m."""

    @property
    def heading(self) -> float:
        """Rad; meaningless unless known."""

    @property
    def heading_known(self) -> bool:
        """Whether the vehicle has moved far enough to tell it."""


class Fuser(Protocol):
    """Makes one pose of odometry and positions: the same on a real robot and on a simulated one."""

    def odometry(self, time_ns: int, distance_m: float, turn_rad: float) -> object:
        """The vehicle has gone and turned so much since the last call; the first call only marks the time."""

    def fix(self, time_ns: int, x: float, y: float, sigma_m: float) -> object:
        """The vehicle was there at that time, give or take ``sigma_m``, which is positive, in x and in y."""

    def estimate(self, now_ns: int) -> Fused | None:
        """The pose at a time; None while nothing is known."""


def state_of(motion: Motion, row: int) -> VehicleState:
    """The state of one vehicle."""
    position, velocity, attitude, spin = (tuple(each[row].tolist()) for each in motion[:4])
    return VehicleState(position=position, velocity=velocity, attitude=attitude, angular_velocity=spin)


def estimate(
    pose_source: str, truth: VehicleState, odometry: Odometry | None, fix: Fix | None, fused: Fused | None = None
) -> VehicleState:
    """What a vehicle takes for its own state.

    The pose comes from its pose source; speeds come from its wheels, unless it is told the truth. Without wheels, all that is
    not in a fix is the truth. Until the first fix, and as long as a fused pose has no heading, odometry stands in.
    """
    if pose_source == "truth" or (odometry is None and fix is None):
        return truth
    if odometry is None:
        assert fix is not None  # noqa: S101  # else it is the truth
        return msgspec.structs.replace(truth, position=fix.position, attitude=_turned_to(fix.yaw, truth.attitude))
    (x, y, yaw), z = odometry.pose, 0.0
    if pose_source == "fusion" and fused is not None:
        x, y, yaw = fused.x, fused.y, fused.heading if fused.heading_known else yaw
    elif pose_source == "positioning" and fix is not None:
        (x, y, z), yaw = fix.position, yaw if fix.yaw is None else fix.yaw
    w, _, _, s = attitude = quaternion_from_yaw(yaw)
    velocity = (odometry.v * (w * w - s * s), odometry.v * 2.0 * w * s, 0.0)
    return VehicleState(position=(x, y, z), velocity=velocity, attitude=attitude, angular_velocity=(0.0, 0.0, odometry.w))


def _turned_to(yaw: float | None, attitude: Quaternion) -> Quaternion:
    """The attitude, turned about the vertical so that it has this yaw, rad; None: as it is."""
    if yaw is None:
        return attitude
    c, _, _, s = quaternion_from_yaw(yaw - yaw_of(attitude))
    w, x, y, z = attitude
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
