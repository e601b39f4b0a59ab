"""What a recording says in JSON, as the values that it was made from (the inverse of `cosim.recording.foxglove.messages`).

A number that JSON cannot say is null there, and NaN here; of a beam without return it is infinity, which it stood for. What a
message has no place for is not to be had any more, such as the depth of a picture.
"""

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording.foxglove.agent_displays import CompressedImage, Grid, ImageAnnotations
from vcmvsp.cosim.recording.foxglove.messages import LEVELS, CameraCalibration, LaserScan, Log, RawImage, Time
from vcmvsp.cosim.types import (
    Fix,
    Follows,
    Halted,
    Image,
    Mosaic,
    Presence,
    ProbabilityMap,
    RealStatus,
    Scan,
    Sightings,
    States,
    frozen,
)
from vcmvsp.cosim.util.documents import json_reader
from vcmvsp.cosim.view.messages import LinkStatus, LogLine

_WORDS = {number: word for word, number in LEVELS.items()}
_Numbers = tuple[float | None, ...]


class State(msgspec.Struct):
    """A `VehicleState`, whatever its numbers."""

    position: _Numbers
    velocity: _Numbers
    attitude: _Numbers
    angular_velocity: _Numbers


class _Numbers4(msgspec.Struct):
    """A `Vector3` or a `Quaternion`, likewise."""

    x: float | None
    y: float | None
    z: float | None
    w: float | None = None


class _Pose(msgspec.Struct):
    position: _Numbers4
    orientation: _Numbers4


class _Fix(msgspec.Struct):
    """A `PoseInFrame`, likewise."""

    timestamp: Time
    pose: _Pose
    sigma_m: float | None
    sigma_rad: float | None


class _Transform(msgspec.Struct):
    """A `FrameTransform`, likewise."""

    child_frame_id: str
    translation: _Numbers4
    rotation: _Numbers4


class _Frames(msgspec.Struct):
    transforms: list[_Transform]


class _Note(msgspec.Struct):
    values: dict[str, Any]


class _Frame(msgspec.Struct):
    """What is shown of a `FrameReport`."""

    sender: str
    sent_ns: int
    receivers: tuple[str, ...]
    rssi_dbm: list[float | None]
    received_ns: list[int]
    outcome: tuple[str, ...]


_read_sweep = json_reader(LaserScan)
_read_picture = json_reader(RawImage)
_read_calibration = json_reader(CameraCalibration)
_read_jpeg = json_reader(CompressedImage)
_read_sightings = json_reader(ImageAnnotations)
_read_grid = json_reader(Grid)
_read_fix = json_reader(_Fix)
_read_frames = json_reader(_Frames)
_read_note = json_reader(_Note)
_read_frame = json_reader(_Frame)
_read_log = json_reader(Log)
state_of = json_reader(State)
follows_of = json_reader(Follows)
presence_of = json_reader(Presence)
real_of = json_reader(RealStatus)
halted_of = json_reader(Halted)


def states_of(names: tuple[str, ...], rows: Sequence[State]) -> States:
    """The true states of one instant, a row for each vehicle."""
    columns = ("position", "velocity", "attitude", "angular_velocity")
    return States(names=names, **{name: frozen([getattr(row, name) for row in rows], np.float64) for name in columns})


def note_of(data: bytes) -> dict[str, Any]:
    """What an agent noted."""
    return {name: _number(value) if value is None else value for name, value in _read_note(data).values.items()}


def fix_of(data: bytes) -> Fix:
    """A position; one whose heading is exactly east, and sure, told none."""
    said = _read_fix(data)
    at, turn = said.pose.position, said.pose.orientation
    yaw, sigma_rad = yaw_of((_number(turn.w), _number(turn.x), _number(turn.y), _number(turn.z))), _number(said.sigma_rad)
    return Fix(
        time_ns=_ns(said.timestamp),
        position=(_number(at.x), _number(at.y), _number(at.z)),
        yaw=yaw if yaw or sigma_rad else None,
        sigma_m=_number(said.sigma_m),
        sigma_rad=sigma_rad,
    )


def frames_of(data: bytes) -> dict[str, tuple[float, float, float, float]]:
    """Where obstacles are: x, y, z m, and yaw rad, by name."""
    found = {}
    for each in _read_frames(data).transforms:
        at, turn = each.translation, each.rotation
        yaw = yaw_of((_number(turn.w), _number(turn.x), _number(turn.y), _number(turn.z)))
        found[each.child_frame_id.removeprefix("obstacle/")] = _number(at.x), _number(at.y), _number(at.z), yaw
    return found


def scan_of(data: bytes) -> Scan:
    """A sweep."""
    said = _read_sweep(data)
    ranges = np.array(said.ranges, np.float32)
    ranges[np.isnan(ranges)] = np.inf
    step = (said.end_angle - said.start_angle) / max(1, len(ranges) - 1)
    range_m = math.inf if said.range_max is None else said.range_max
    return Scan(
        ranges=frozen(ranges), angle_min=said.start_angle, angle_step=step, range_max=range_m, time_ns=_ns(said.timestamp)
    )


def image_of(data: bytes, calibration: bytes | None) -> Image:
    """A picture, and the focal length of its camera, where it was told."""
    said = _read_picture(data)
    focal_px = 0.0 if calibration is None else _read_calibration(calibration).K[0]
    return Image(pixels=said.pixels, time_ns=_ns(said.timestamp), focal_px=focal_px)


def sightings_of(data: bytes, picture: bytes | None) -> Sightings:
    """What was recognised, and the picture that it was recognised in, where it was kept."""
    said = _read_sightings(data)
    jpeg = b"" if picture is None else _read_jpeg(picture).data
    sizes = {"width": said.width, "height": said.height}
    return Sightings(sensor=said.sensor, time_ns=said.time_ns, found=said.found, jpeg=jpeg, **sizes)


def map_of(data: bytes) -> ProbabilityMap:
    """What a vehicle knows of the area."""
    grid = _read_grid(data)
    cells = grid.cells
    return ProbabilityMap(**_place(grid), probability=frozen(cells[..., 0]), seen=frozen(cells[..., 1] != 0))


def mosaic_of(data: bytes) -> Mosaic:
    """The ground as a vehicle has seen it."""
    grid = _read_grid(data)
    return Mosaic(**_place(grid), pixels=frozen(grid.cells[..., :3]))


def link_of(data: bytes) -> LinkStatus:
    """What became of a frame."""
    said = _read_frame(data)
    return LinkStatus(
        sender=said.sender,
        sent_ns=said.sent_ns,
        receivers=said.receivers,
        rssi_dbm=frozen(said.rssi_dbm, np.float64),
        received=frozen(np.array(said.received_ns) >= 0, np.bool_),
        outcome=said.outcome,
    )


def line_of(data: bytes, time_ns: int) -> LogLine:
    """A line of the log."""
    said = _read_log(data)
    return LogLine(time_ns=time_ns, level=_WORDS[said.level], text=said.message)


def _number(said: float | None) -> float:
    return math.nan if said is None else said


def _ns(time: Time) -> int:
    return time.sec * 1_000_000_000 + time.nsec


def _place(grid: Grid) -> dict[str, float]:
    return {"left": grid.pose.position.x, "bottom": grid.pose.position.y, "cell_m": grid.cell_size.x}
