"""Decodes recorded messages to the original values (the inverse of `cosim.recording.foxglove`).

Data without a field in the message, such as the depth of a picture, are lost.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording.foxglove import (
    CameraCalibration,
    FrameTransforms,
    Grid,
    ImageAnnotations,
    LaserScan,
    PoseInFrame,
    RawImage,
)
from vcmvsp.cosim.recording.recorded_run import Noted
from vcmvsp.cosim.types import (
    Fix,
    Follows,
    FrameReport,
    Halted,
    Image,
    Presence,
    Scan,
    frozen,
)
from vcmvsp.cosim.view.messages import LinkStatus, Pose

ALSO: Mapping[str, Any] = {
    **{f"vcmvsp.{kind.__name__}": kind for kind in (Follows, Halted, Presence)},
    "foxglove.ImageAnnotations": ImageAnnotations,
}
"""Types of the schemas that exports do not decode."""


def image_of(message: RawImage, calibration: CameraCalibration | None) -> Image:
    """A picture, with the focal length of its camera if recorded."""
    return Image(pixels=message.pixels, time_ns=message.timestamp.ns, focal_px=0.0 if calibration is None else calibration.K[0])


def _numbers_of(message: Noted) -> dict[str, Any]:
    """Values of a note, with null (a number that JSON cannot express) as NaN."""
    unknown = {name: math.nan for name, value in message.values.items() if value is None}
    return {**message.values, **unknown}


def _fix_of(message: PoseInFrame) -> Fix:
    at = message.pose.position
    sigma = {"sigma_m": message.sigma_m, "sigma_rad": message.sigma_rad}
    return Fix(time_ns=message.timestamp.ns, position=(at.x, at.y, at.z), yaw=message.yaw, **sigma)


def _poses_of(message: FrameTransforms) -> dict[str, Pose]:
    poses = {}
    for each in message.transforms:
        at, turn = each.translation, each.rotation
        pose = (at.x, at.y, at.z, yaw_of((turn.w, turn.x, turn.y, turn.z)))
        poses[each.child_frame_id.removeprefix("obstacle/")] = pose
    return poses


def _scan_of(message: LaserScan) -> Scan:
    """A sweep; null becomes infinity, for a beam without return."""
    ranges = np.array(message.ranges, np.float32)
    ranges[np.isnan(ranges)] = np.inf
    return Scan(
        ranges=frozen(ranges),
        angle_min=message.start_angle,
        angle_step=(message.end_angle - message.start_angle) / max(1, len(ranges) - 1),
        range_max=math.inf if message.range_max is None else message.range_max,
        time_ns=message.timestamp.ns,
    )


SHOWN_AS: Mapping[type, Callable[[Any], Any]] = {
    Noted: _numbers_of,
    PoseInFrame: _fix_of,
    FrameTransforms: _poses_of,
    LaserScan: _scan_of,
    Grid: lambda grid: grid.content,
    FrameReport: LinkStatus.of,
}
"""Decoders for messages to the page, by type; other messages are used unchanged."""
