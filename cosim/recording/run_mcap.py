"""Writes ``run.mcap``: the events of a run as messages for viewers (`cosim.recording.foxglove`), each under its key.

Values without a Foxglove schema are written unchanged. Pictures stay raw: in compressed chunks they are smaller than PNG files,
five times as fast to write, and lossless. Two messages wait for the end of an instant: estimates that differ from the true
state, and the scene.
"""

from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

from vcmvsp.cosim import types
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import RunInfo, vehicle_of
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.recording import foxglove as fg
from vcmvsp.cosim.recording.mcap_writer import McapLog, MessageSink
from vcmvsp.cosim.recording.scene import DrawnWorld, moving_frames, scene, solids
from vcmvsp.cosim.tables.schema import NOT_LOST

CALIBRATION = "calibration"  # under the key of a camera
SOLIDS, SCENE, MOVING = "world/solids", "world/scene", "world/moving"


class DatagramCount(types.Value, frozen=True, kw_only=True):
    """Datagrams and bytes from external programs at an instant."""

    datagrams: int
    bytes: int


class TrafficCount(types.Value, frozen=True, kw_only=True):
    """Frames of datagrams from external programs with a known outcome at an instant: frames, arrivals, losses."""

    frames: int
    arrivals: int
    lost: int  # counted per receiver


class Viewer:
    """Writes the messages of one run to a stream, which the caller closes.

    `putters` maps types to their functions, `write` takes all others: key, time (ns) and value; times never decrease.
    """

    def __init__(
        self,
        stream: BinaryIO,
        run: RunInfo,
        radius_m: Mapping[str, float],
        world: DrawnWorld | None = None,
        sink: MessageSink | None = None,
    ) -> None:
        about = {"scenario": run.scenario, "seed": str(run.seed), "vehicles": " ".join(run.vehicles)}
        self._log = McapLog(stream, about, sink=sink)
        self.write = self._log.write  # writes a value unchanged
        self._vehicles, self._radius_m = run.vehicles, radius_m
        self._targets = () if world is None else world.targets
        self._moving = world if world is not None and (world.moving or world.movables) else None
        self._calibrated: set[str] = set()  # keys of cameras
        self._places: dict[str, types.Follows] = {}  # slots of followers
        self._scene_is_due, self._scene_ns = True, 0
        self._pushed: types.Pushed | None = None
        self._estimates: list[tuple[str, types.VehicleState]] = []  # of the current instant
        self._split: tuple[types.States | None, dict[str, types.VehicleState]] = None, {}  # the last states split by vehicle
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
        """Write the true states of all vehicles at a recorded instant."""
        now, transforms, write = fg.Time.of(time_ns), [], self.write
        for name, state in self._each(states).items():
            (x, y, z), (qw, qx, qy, qz) = state.position, state.attitude
            transforms.append(fg.FrameTransform(now, "world", name, fg.Vector3(x, y, z), fg.Quaternion(qx, qy, qz, qw)))
            write(f"{name}/state", time_ns, state)
        write("/tf", time_ns, fg.FrameTransforms(transforms))
        if self._moving is not None:
            write(MOVING, time_ns, moving_frames(self._moving, self._pushed, time_ns))

    def say(self, level: str, text: str, time_ns: int) -> None:
        """Write a log line."""
        self.write("log", time_ns, fg.Log(fg.Time.of(time_ns), fg.LEVELS[level], text))

    def end_instant(self, time_ns: int, latest: tuple[int, types.States] | None, *, is_cut: bool = False) -> None:
        """End an instant: write the estimates that differ from the true states, and the scene if it is due.

        Args:
            time_ns: the instant.
            latest: time (ns) and values of the newest states.
            is_cut: the run ended within this instant, so the scene may lack slots.
        """
        if self._estimates:
            true = self._each(latest[1]) if latest is not None and latest[0] == time_ns else {}
            for key, estimate in self._estimates:
                if true.get(vehicle_of(key)) != estimate:
                    self.write(key, time_ns, estimate)
            self._estimates.clear()
        if is_cut:
            return
        if self._scene_is_due or (self._targets and time_ns - self._scene_ns >= SECOND_NS):  # once, however often it changed
            update = scene(self._vehicles, self._radius_m, self._places, time_ns, self._targets)
            self.write(SCENE, time_ns, update)
            self._scene_is_due, self._scene_ns = False, time_ns

    def finish(self) -> None:
        """Write the end of the file."""
        self._log.finish()

    def _each(self, states: types.States) -> dict[str, types.VehicleState]:
        """The states as one value per vehicle; cached, because most instants need them twice."""
        if states is not self._split[0]:
            columns = (states.position, states.velocity, states.attitude, states.angular_velocity)
            rows = zip(states.names, *(zip(*column.T.tolist(), strict=True) for column in columns), strict=True)
            self._split = (
                states,
                {name: types.VehicleState(position=p, velocity=v, attitude=q, angular_velocity=w) for name, p, v, q, w in rows},
            )
        return self._split[1]

    def _put_datagrams(self, key: str, time_ns: int, datagrams: types.Datagrams) -> None:
        """Write only their number and bytes: the table of frames contains each."""
        self.write(key, time_ns, DatagramCount(datagrams=len(datagrams.number), bytes=int(datagrams.size_bytes.sum())))

    def _put_traffic(self, key: str, time_ns: int, traffic: types.Traffic) -> None:
        lost = sum(each not in NOT_LOST for report in traffic.reports for each in report.outcome)
        self.write(key, time_ns, TrafficCount(frames=len(traffic.reports), arrivals=len(traffic.number), lost=lost))

    def _put_pushed(self, key: str, time_ns: int, pushed: types.Pushed) -> None:
        self._pushed = pushed  # written with the states

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

    def _put_shown(self, key: str, time_ns: int, value: types.ProbabilityMap | types.Sightings | types.Mosaic) -> None:
        number = self._vehicles.index(vehicle_of(key))
        for topic, message in fg.messages_of(key, value, time_ns, number):
            self.write(topic, time_ns, message)
