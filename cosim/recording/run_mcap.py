"""``run.mcap``: the events of a run as messages that viewers draw (`cosim.recording.foxglove`), each under its key.

What Foxglove has no schema for is written as it is. Pictures stay raw: in compressed chunks they are smaller than PNG files,
written five times as fast, and come back as they were. Two things can be told only once an instant is over: which estimates
differ from the truth, and how the scene looks.
"""

from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

from vcmvsp.cosim import types
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import RunInfo
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.recording import foxglove as fg
from vcmvsp.cosim.recording.accumulators import vehicle_of
from vcmvsp.cosim.recording.mcap_writer import McapLog
from vcmvsp.cosim.recording.scene import DrawnWorld, moving_frames, scene, solids
from vcmvsp.cosim.tables.schema import NOT_LOST

CALIBRATION = "calibration"  # under the key of a camera
SOLIDS, SCENE, MOVING = "world/solids", "world/scene", "world/moving"


class DatagramCount(types.Value, frozen=True, kw_only=True):
    """How much programs outside have handed over at an instant."""

    datagrams: int
    bytes: int


class TrafficCount(types.Value, frozen=True, kw_only=True):
    """What became of such datagrams, as far as it is known at an instant."""

    frames: int
    arrivals: int
    lost: int  # receiver by receiver


class Viewer:
    """Writes the file of one run into a stream, which stays its owner's to close.

    An event of a type that `putters` has goes there, any other to `write`: key, time (ns) and value; times never decrease.
    """

    def __init__(self, stream: BinaryIO, run: RunInfo, radius_m: Mapping[str, float], world: DrawnWorld | None = None) -> None:
        about = {"scenario": run.scenario, "seed": str(run.seed), "vehicles": " ".join(run.vehicles)}
        self._log = McapLog(stream, about)
        self.write = self._log.write  # a value as it is
        self._vehicles, self._radius_m = run.vehicles, radius_m
        self._targets = () if world is None else world.targets
        self._moving = world if world is not None and (world.moving or world.movables) else None
        self._calibrated: set[str] = set()  # keys of cameras
        self._places: dict[str, types.Follows] = {}  # that followers mean to keep
        self._scene_is_due, self._scene_ns = True, 0
        self._pushed: types.Pushed | None = None
        self._estimates: list[tuple[str, types.VehicleState]] = []  # of the present instant
        self._told: tuple[types.States | None, dict[str, types.VehicleState]] = None, {}  # those asked for last, by vehicle
        self.putters: dict[type, Callable[[str, int, Any], None]] = {
            types.VehicleState: lambda key, _, estimate: self._estimates.append((key, estimate)),  # the truth may come later
            types.Datagrams: self._put_datagrams,
            types.Traffic: self._put_traffic,
            types.Fix: self._put_fix,
            types.Follows: self._put_follows,
            types.Image: self._put_image,
            types.Scan: lambda key, time_ns, scan: self.write(
                key, time_ns, fg.LaserScan.of(scan, vehicle_of(key), scan.time_ns or time_ns)
            ),
            types.Pushed: self._put_pushed,
            **dict.fromkeys((types.ProbabilityMap, types.Sightings, types.Mosaic), self._put_shown),
        }
        standing = None if world is None else solids(world)
        if standing is not None:
            self.write(SOLIDS, 0, standing)

    def put_states(self, time_ns: int, states: types.States) -> None:
        """Where all vehicles truly are, at an instant that is recorded."""
        now, transforms, write = fg.Time.of(time_ns), [], self.write
        for name, state in self._each(states).items():
            (x, y, z), (qw, qx, qy, qz) = state.position, state.attitude
            transforms.append(fg.FrameTransform(now, "world", name, fg.Vector3(x, y, z), fg.Quaternion(qx, qy, qz, qw)))
            write(f"{name}/state", time_ns, state)
        write("/tf", time_ns, fg.FrameTransforms(transforms))
        if self._moving is not None:
            write(MOVING, time_ns, moving_frames(self._moving, self._pushed, time_ns))

    def say(self, level: str, text: str, time_ns: int) -> None:
        """A line of the log."""
        self.write("log", time_ns, fg.Log(fg.Time.of(time_ns), fg.LEVELS[level], text))

    def end_instant(self, time_ns: int, latest: tuple[int, types.States] | None, *, is_cut: bool = False) -> None:
        """An instant is over: write the estimates that differ from its truth, and the scene if it is due.

        Args:
            time_ns: the instant.
            latest: when states were last told (ns), and these.
            is_cut: the run has ended within it: of the scene, not all places are known.
        """
        if self._estimates:
            true = self._each(latest[1]) if latest is not None and latest[0] == time_ns else {}
            for key, estimate in self._estimates:
                if true.get(vehicle_of(key)) != estimate:
                    self.write(key, time_ns, estimate)
            self._estimates.clear()
        if is_cut:
            return
        if self._scene_is_due or (self._targets and time_ns - self._scene_ns >= SECOND_NS):  # once, whoever changed it
            drawn = scene(self._vehicles, self._radius_m, self._places, time_ns, self._targets)
            self.write(SCENE, time_ns, drawn)
            self._scene_is_due, self._scene_ns = False, time_ns

    def finish(self) -> None:
        """Write the end of the file."""
        self._log.finish()

    def _each(self, states: types.States) -> dict[str, types.VehicleState]:
        """The state of each vehicle by itself; worked out once, as it is asked for twice at most instants."""
        if states is not self._told[0]:
            columns = (states.position, states.velocity, states.attitude, states.angular_velocity)
            rows = zip(states.names, *(zip(*column.T.tolist(), strict=True) for column in columns), strict=True)
            self._told = (
                states,
                {name: types.VehicleState(position=p, velocity=v, attitude=q, angular_velocity=w) for name, p, v, q, w in rows},
            )
        return self._told[1]

    def _put_datagrams(self, key: str, time_ns: int, datagrams: types.Datagrams) -> None:
        """Only how many there were: each is in the table of frames."""
        self.write(key, time_ns, DatagramCount(datagrams=len(datagrams.number), bytes=int(datagrams.size_bytes.sum())))

    def _put_traffic(self, key: str, time_ns: int, traffic: types.Traffic) -> None:
        lost = sum(each not in NOT_LOST for report in traffic.reports for each in report.outcome)
        self.write(key, time_ns, TrafficCount(frames=len(traffic.reports), arrivals=len(traffic.number), lost=lost))

    def _put_pushed(self, key: str, time_ns: int, pushed: types.Pushed) -> None:
        self._pushed = pushed  # it is written with the states

    def _put_follows(self, key: str, time_ns: int, follows: types.Follows) -> None:
        self._places[vehicle_of(key)] = follows
        self._scene_is_due = True
        self.write(key, time_ns, follows)

    def _put_fix(self, key: str, time_ns: int, fix: types.Fix) -> None:
        qw, qx, qy, qz = quaternion_from_yaw(fix.yaw or 0.0)
        pose = fg.Pose(fg.Vector3(*fix.position), fg.Quaternion(qx, qy, qz, qw))
        at = fg.Time.of(fix.time_ns)
        self.write(key, time_ns, fg.PoseInFrame(at, "world", pose, fix.sigma_m, fix.sigma_rad))

    def _put_image(self, key: str, time_ns: int, image: types.Image) -> None:
        vehicle = vehicle_of(key)
        if image.focal_px > 0.0 and key not in self._calibrated:
            self._calibrated.add(key)
            self.write(f"{key}/{CALIBRATION}", time_ns, fg.CameraCalibration.of(image, vehicle, time_ns))
        self.write(key, time_ns, fg.RawImage.of(image, vehicle, image.time_ns or time_ns))

    def _put_shown(self, key: str, time_ns: int, shown: types.ProbabilityMap | types.Sightings | types.Mosaic) -> None:
        number = self._vehicles.index(vehicle_of(key))
        for topic, message in fg.messages_of(key, shown, time_ns, number):
            self.write(topic, time_ns, message)
