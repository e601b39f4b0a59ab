"""``run.mcap``: the events of a run as messages that viewers draw (`cosim.record.foxglove`), each under its key.

What Foxglove has no schema for is written as it is. Pictures stay raw: in compressed chunks they are smaller than PNG files,
written five times as fast, and come back as they were. Two things can be told only once an instant is over: which estimates
differ from the truth, and how the scene looks.
"""

from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

from cosim.clock import SECOND_NS
from cosim.federate import RunInfo
from cosim.frames import quaternion_from_yaw
from cosim.record import foxglove
from cosim.record.foxglove import FrameTransform, Quaternion, Vector3
from cosim.record.foxglove_shown import messages_of
from cosim.record.mcap import McapLog
from cosim.record.scene import moving_frames, scene, solids
from cosim.types import Fix, Follows, Image, Mosaic, ProbabilityMap, Pushed, Scan, Sightings, VehicleState

CALIBRATION = "calibration"  # under the key of a camera


class Viewer:
    """Writes the file of one run.

    Args:
        stream: open and binary; it stays its owner's to close.
        run: what the federates are told of the run.
        radius_m: radius of each vehicle's body.
        world: what the vehicles move in; None: nothing of it is drawn.
    """

    def __init__(self, stream: BinaryIO, run: RunInfo, radius_m: Mapping[str, float], world: Any = None) -> None:
        about = {"scenario": run.scenario, "seed": str(run.seed), "vehicles": " ".join(run.vehicles)}
        self._log = McapLog(stream, about)
        self.write = self._log.write  # a value as it is: topic, value and time
        self._vehicles, self._radius_m, self._world = run.vehicles, radius_m, world
        self._targets = () if world is None else world.targets
        self._calibrated: set[str] = set()  # keys of cameras
        self._scene_is_due, self._scene_ns = True, 0
        self._pushed: Pushed | None = None
        self._estimates: list[tuple[str, VehicleState]] = []  # of the present instant
        self._putters: dict[type, Callable[[str, Any, int], None]] = {
            Fix: self._put_fix,
            Follows: self._put_follows,
            Image: self._put_image,
            Scan: self._put_scan,
            Pushed: self._put_pushed,
            VehicleState: self._put_estimate,
            **dict.fromkeys((ProbabilityMap, Sightings, Mosaic), self._put_shown),
        }
        standing = None if world is None else solids(world)
        if standing is not None:
            self._log.write("world/solids", standing, 0)

    def put(self, key: str, time_ns: int, value: Any) -> None:
        """An event; times never decrease."""
        self._putters.get(type(value), self._log.write)(key, value, time_ns)

    def put_states(self, truth: Mapping[str, VehicleState], time_ns: int) -> None:
        """Where all vehicles truly are."""
        now, transforms, write = foxglove.Time.of(time_ns), [], self._log.write
        for name, state in truth.items():
            qw, qx, qy, qz = state.attitude
            place, turn = Vector3(*state.position), Quaternion(qx, qy, qz, qw)
            transforms.append(FrameTransform(now, "world", name, place, turn))
            write(f"{name}/state", state, time_ns)
        self._log.write("/tf", foxglove.FrameTransforms(transforms), time_ns)
        if self._world is not None and (self._world.moving or self._world.movables):
            self._log.write("world/moving", moving_frames(self._world, self._pushed, time_ns), time_ns)

    def say(self, level: str, text: str, time_ns: int) -> None:
        """A line of the log."""
        self._log.write("log", foxglove.Log(foxglove.Time.of(time_ns), foxglove.LEVELS[level], text), time_ns)

    def end_instant(
        self, time_ns: int, truth: Callable[[], Mapping[str, VehicleState]], places: Callable[[], Mapping[str, Follows]]
    ) -> None:
        """An instant is over: the true states of it, where they are known, and the places that followers mean to keep."""
        if self._estimates:
            true = truth()
            for key, estimate in self._estimates:
                if true.get(key.partition("/")[0]) != estimate:
                    self._log.write(key, estimate, time_ns)
            self._estimates.clear()
        if self._scene_is_due or (self._targets and time_ns - self._scene_ns >= SECOND_NS):  # once, whoever changed it
            drawn = scene(self._vehicles, self._radius_m, places(), time_ns, self._targets)
            self._log.write("world/scene", drawn, time_ns)
            self._scene_is_due, self._scene_ns = False, time_ns

    def finish(self) -> None:
        """Write the end of the file."""
        self._log.finish()

    def _put_pushed(self, key: str, pushed: Pushed, time_ns: int) -> None:
        self._pushed = pushed  # it is written with the states

    def _put_estimate(self, key: str, estimate: VehicleState, time_ns: int) -> None:
        self._estimates.append((key, estimate))  # the truth of this instant may come later within it

    def _put_follows(self, key: str, follows: Follows, time_ns: int) -> None:
        self._scene_is_due = True
        self._log.write(key, follows, time_ns)

    def _put_fix(self, key: str, fix: Fix, time_ns: int) -> None:
        qw, qx, qy, qz = quaternion_from_yaw(fix.yaw or 0.0)
        pose = foxglove.Pose(Vector3(*fix.position), Quaternion(qx, qy, qz, qw))
        at = foxglove.Time.of(fix.time_ns)
        self._log.write(key, foxglove.PoseInFrame(at, "world", pose, fix.sigma_m, fix.sigma_rad), time_ns)

    def _put_scan(self, key: str, scan: Scan, time_ns: int) -> None:
        self._log.write(key, foxglove.LaserScan.of(scan, key.partition("/")[0], scan.time_ns or time_ns), time_ns)

    def _put_image(self, key: str, image: Image, time_ns: int) -> None:
        vehicle = key.partition("/")[0]
        if image.focal_px > 0.0 and key not in self._calibrated:
            self._calibrated.add(key)
            self._log.write(f"{key}/{CALIBRATION}", foxglove.CameraCalibration.of(image, vehicle, time_ns), time_ns)
        self._log.write(key, foxglove.RawImage.of(image, vehicle, image.time_ns or time_ns), time_ns)

    def _put_shown(self, key: str, shown: ProbabilityMap | Sightings | Mosaic, time_ns: int) -> None:
        number = self._vehicles.index(key.partition("/")[0])
        for topic, message in messages_of(key, shown, time_ns, number):
            self._log.write(topic, message, time_ns)
