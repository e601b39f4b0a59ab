"""What a vehicle takes for its own state, by its pose source."""

import msgspec

from cosim.frames import Quaternion, quaternion_from_yaw, yaw_of
from cosim.types import Fix, Odometry, VehicleState
from physics.engine import Motion


def state_of(motion: Motion, row: int) -> VehicleState:
    """The state of one vehicle."""
    position, velocity, attitude, spin = (tuple(each[row].tolist()) for each in motion[:4])
    return VehicleState(position=position, velocity=velocity, attitude=attitude, angular_velocity=spin)


def estimate(pose_source: str, truth: VehicleState, odometry: Odometry | None, fix: Fix | None) -> VehicleState:
    """What a vehicle takes for its own state.

    The pose comes from its pose source; speeds come from its wheels, unless it is told the truth. Without wheels, all that is
    not in a fix is the truth.
    """
    if pose_source == "truth" or (odometry is None and fix is None):
        return truth
    if odometry is None:
        assert fix is not None  # noqa: S101  # else it is the truth
        return msgspec.structs.replace(truth, position=fix.position, attitude=_turned_to(fix.yaw, truth.attitude))
    if pose_source == "odometry" or fix is None:
        (x, y, yaw), z = odometry.pose, 0.0
    else:
        (x, y, z), yaw = fix.position, odometry.pose[2] if fix.yaw is None else fix.yaw
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
