"""Recognition of targets in each new picture of a vehicle's camera, and their places on the ground."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from vcmvsp.agents.avoidance.view import check_carried
from vcmvsp.agents.reconnaissance.ground_point import MOUNT, Nadir, Point, Poses, Region, nadir_of
from vcmvsp.agents.reconnaissance.recognition.detector import SMALLEST_PX, Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import FileName, Image, Positive, Sighting, Vec3

STEEPEST = math.cos(math.radians(30.0))  # at a larger tilt, pictures do not show targets from above
RELIABLE = math.cos(math.radians(20.0))  # at a larger tilt, more than a few targets are missed
INSIDE = 0.5  # sides of a target between its middle and the edge of a picture that shows enough of it


class Wanted(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A target to look for."""

    name: str  # for notes and displays
    picture: FileName  # an image file, square: how it looks from above; relative to the scenario's folder
    size_m: Positive = 2.0  # of a side


class Watching(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Targets to look for, and the camera."""

    targets: tuple[Wanted, ...]  # what is looked for
    camera: str = "camera"  # name of a sensor that looks straight down, such as a nadir_camera
    mount: Vec3 = MOUNT  # where its pinhole is, m, body frame
    ground_m: float = 0.0  # height of the ground on which the targets lie, m, world


class GroundDisc(NamedTuple):
    """Disc of ground around a place."""

    place: Point  # m, world
    reach_m: float


@dataclass(frozen=True, eq=False)
class WatchFrame:
    """Targets in one camera picture, with the ground that was examined."""

    time_ns: int  # when it was taken
    nadir: Nadir  # from where, and how
    sightings: tuple[Sighting, ...]  # the surest first
    image: Image
    looked: Region | None  # px: a target with its middle there would have been seen; None: nowhere (tilted too far, ...)
    whole: bool  # whether all of the picture was examined; otherwise only `Watch.region`

    @property
    def footprint(self) -> tuple[Point, ...] | None:
        """Corners of the examined ground, counter-clockwise from ahead on the left; None: none was examined."""
        return None if self.looked is None else self.nadir.footprint(self.looked)


class Watch:
    """Examines each picture of one camera once; ``region`` is the part of the ground to examine next, None: all of it.

    Must be constructed in the constructor of an agent: only then are files of targets found in the scenario's folder.
    `ScenarioError` with ``key``: a picture of a target is unreadable or unsuitable for recognition.
    """

    region: GroundDisc | None = None

    def __init__(self, settings: Watching, *, key: str = "watching") -> None:
        self.settings, self.sensors, self._key = settings, (settings.camera,), key
        self.names = tuple(each.name for each in settings.targets)
        targets = [_loaded(each, f"{key}.targets[{i}]") for i, each in enumerate(settings.targets)]
        try:
            self._detector = Detector(targets)
        except ScenarioError as error:
            raise ScenarioError(error.problem, key=f"{key}.targets") from error
        sizes_m = [each.size_m for each in targets]
        self._smallest_m, self._largest_m = min(sizes_m), max(sizes_m)

    def start(self, info: VehicleInfo) -> None:
        """Check the camera; `ValueError`: the vehicle has none."""
        check_carried(info, self.settings.camera, f"{self._key}.camera")
        self._poses = Poses(info.period_s)
        self._asked_ns: int | None = None
        self._frame: WatchFrame | None = None
        self._taken_ns: int | None = None  # time of the newest picture
        self.region = None

    def look(self, obs: Observation) -> WatchFrame | None:
        """Content of a picture that arrived since the last tick; None: there is none, or its pose is unknown.

        Must be called at least once a tick, to record the poses; further calls of a tick return the same. `TypeError`: the
        sensor is no camera.
        """
        if obs.clock_ns == self._asked_ns:
            return self._frame
        self._asked_ns = obs.clock_ns
        self._poses.add(obs)
        self._frame = self._looked(obs.readings.get(self.settings.camera))
        return self._frame

    def _looked(self, image: Any) -> WatchFrame | None:
        if image is None:
            return None
        if not isinstance(image, Image):
            gives = f"gives a {type(image).__name__}, not pictures"
            raise TypeError(f"{self._key}.camera = {self.settings.camera!r} {gives}; name a camera that looks straight down")
        if self._taken_ns is not None and image.time_ns <= self._taken_ns:
            return None
        self._taken_ns = image.time_ns
        pose = self._poses.at(image.time_ns)
        if pose is None:
            return None
        return self._recognised(image, nadir_of(image, pose, mount=self.settings.mount, ground_m=self.settings.ground_m))

    def _recognised(self, image: Image, nadir: Nadir) -> WatchFrame:
        whole = 0, 0, nadir.width, nadir.height
        part = whole if self.region is None else nadir.region(*self.region)
        if part is None or not (nadir.upright >= STEEPEST and nadir.height_m > 0.0 and image.focal_px > 0.0):
            return WatchFrame(image.time_ns, nadir, (), image, None, self.region is None)
        distance_m = nadir.height_m / nadir.upright  # along the optical axis
        detections = self._detector.detect(image.pixels, distance_m, image.focal_px, None if part == whole else part)
        sightings = tuple(
            Sighting(
                target=detection.target,
                place=place,
                centre_px=detection.centre_px,
                angle=detection.angle,
                side_px=detection.side_px,
                score=min(max(detection.match, 0.0), 1.0),
            )
            for detection in detections
            if (place := nadir.ground_point(detection.centre_px)) is not None
        )
        edge = math.ceil(INSIDE * self._largest_m * image.focal_px / distance_m)
        inner = _common((edge, edge, nadir.width - edge, nadir.height - edge), part)
        large_enough = self._smallest_m * image.focal_px >= SMALLEST_PX * distance_m  # else targets may be missed
        looked = inner if nadir.upright >= RELIABLE and large_enough else None
        return WatchFrame(image.time_ns, nadir, sightings, image, looked, self.region is None)


def _common(a: Region, b: Region) -> Region | None:
    left, top, right, bottom = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    return (left, top, right, bottom) if left < right and top < bottom else None


def _loaded(entry: Wanted, key: str) -> TargetPicture:
    try:
        return TargetPicture.load(entry.name, registry.located(entry.picture), entry.size_m)
    except ScenarioError as error:
        raise ScenarioError(error.problem, key=f"{key}.{error.key}") from error
