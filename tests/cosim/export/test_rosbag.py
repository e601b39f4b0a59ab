"""An exported bag, read by independent readers, has the content of the recording."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from tests.support.cosim import export_runs
from tests.support.cosim.export_runs import rerun, topic_messages
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.export.formats import export
from vcmvsp.cosim.export.rosbag import write_bag
from vcmvsp.cosim.frames import product
from vcmvsp.cosim.recording import recorded_run
from vcmvsp.cosim.recording.ros_messages import nanoseconds as ns
from vcmvsp.cosim.recording.ros_messages import pinhole, ros_name
from vcmvsp.cosim.types import Image
from vcmvsp.cosim.util import limits

pytestmark = pytest.mark.processes

RUNS = ("lab-patrol", "recon-team", "a crossing cart", "a tag and late sensors")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    return {name: export(export_runs.run_of(name), rosbag2=folder / ros_name(name)[1:])[0] for name in RUNS}


def read(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Times, ns, and messages by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([bag]) as reader:
        for connection, time_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((time_ns, reader.deserialize(data, connection.msgtype)))
    return found


def test_poses_and_transforms_are_true_and_twists_in_body_axes(bags: dict[str, Path]) -> None:
    bag = read(bags["lab-patrol"])
    expected = topic_messages("lab-patrol", "ugv2/state")
    assert [time_ns for time_ns, _ in bag["/ugv2/state"]] == [time_ns for time_ns, _ in expected]
    for number, (time_ns, state) in enumerate(expected):
        odometry, transforms = bag["/ugv2/state"][number][1], bag["/tf"][number][1].transforms
        assert (ns(odometry.header.stamp), odometry.header.frame_id, odometry.child_frame_id) == (time_ns, "world", "ugv2")
        at, turn, linear = odometry.pose.pose.position, odometry.pose.pose.orientation, odometry.twist.twist.linear
        assert [at.x, at.y, at.z] == state["position"]
        assert [turn.w, turn.x, turn.y, turn.z] == state["attitude"]
        w, x, y, z = state["attitude"]
        _, *back = product(product((w, x, y, z), (0.0, linear.x, linear.y, linear.z)), (w, -x, -y, -z))
        assert back == pytest.approx(state["velocity"], abs=1e-12)
        (own_transform,) = [each for each in transforms if each.child_frame_id == "ugv2"]
        assert [getattr(own_transform.transform.translation, axis) for axis in "xyz"] == state["position"]
    assert [ns(clock.clock) for _, clock in bag["/clock"]] == [time_ns for time_ns, _ in expected]
    ((first, path),) = bag["/ugv2/state/path"]
    assert (first, len(path.poses)) == (0, len(expected))


def test_readings_arrive_as_they_were_recorded(bags: dict[str, Path]) -> None:
    bag = read(bags["lab-patrol"])
    (time_ns, scan), (_, original) = bag["/ugv1/scan"][3], topic_messages("lab-patrol", "ugv1/scan")[3]
    ranges = [np.inf if each is None else each for each in original["ranges"]]
    np.testing.assert_array_equal(scan.ranges, np.array(ranges, np.float32))
    assert (ns(scan.header.stamp), scan.header.frame_id) == (time_ns, "ugv1")
    assert scan.angle_min == np.float32(original["start_angle"])
    assert scan.angle_min + (len(ranges) - 1) * scan.angle_increment == pytest.approx(original["end_angle"])
    assert np.isfinite(scan.range_max)
    assert scan.range_max >= np.max(scan.ranges[np.isfinite(scan.ranges)])
    for (_, command), (_, original) in zip(bag["/ugv1/command"], topic_messages("lab-patrol", "ugv1/command"), strict=True):
        assert (command.twist.linear.x, command.twist.angular.z) == (original["linear"][0], original["yaw_rate"])
    for topic in ("ugv3/bumper", "radio/frame", "ugv3/send"):
        messages = [(time_ns, json.loads(message.data)) for time_ns, message in bag[f"/{topic}"]]
        assert messages == topic_messages("lab-patrol", topic)
    ((_, line),) = bag["/rosout"]
    assert (line.level, line.msg) == (20, "the run is complete")


def test_pictures_are_the_same_pixels_and_come_with_their_cameras(bags: dict[str, Path]) -> None:
    bag = read(bags["recon-team"])
    pictures = recorded_run.Source(export_runs.run_of("recon-team"), lambda _: None)
    values = recorded_run.Values()
    expected = [values.of(original) for original in pictures if original.topic == "uav2/camera"]
    assert len(expected) > 1
    images, infos = bag["/uav2/camera/image_raw"], bag["/uav2/camera/camera_info"]
    for (_, image), (_, info), original in zip(images, infos, expected, strict=True):
        np.testing.assert_array_equal(image.data.reshape(image.height, image.width, 3), original.pixels)
        assert (image.encoding, image.header) == ("rgb8", info.header)
        assert (info.width, info.height) == (image.width, image.height)
        assert info.k[0] == info.k[4] > 100.0
    assert bytes(bag["/uav1/sightings/picture/compressed"][0][1].data[:3]) == b"\xff\xd8\xff"
    (_, grid), (_, original) = bag["/uav1/map"][0], topic_messages("recon-team", "uav1/map")[0]
    assert (grid.info.width, len(grid.data)) == (original["column_count"], grid.info.width * grid.info.height)
    assert 0 <= grid.data.min() <= grid.data.max() <= 100


def test_the_principal_point_is_the_centre_of_the_picture() -> None:
    """The centre of the first pixel is (0, 0), as in the calibration of a recording."""
    info: Any = pinhole(Image(pixels=np.zeros((3, 5, 3), np.uint8), focal_px=80.0, time_ns=4), "camera")
    assert info.k.tolist() == [80.0, 0.0, 2.0, 0.0, 80.0, 1.0, 0.0, 0.0, 1.0]
    assert info.p.reshape(3, 4)[:, 2].tolist() == [2.0, 1.0, 1.0]
    assert (info.header.frame_id, info.width, info.height, ns(info.header.stamp)) == ("camera", 5, 3, 4)


def test_readings_are_stamped_with_their_time_of_measurement(bags: dict[str, Path]) -> None:
    bag = read(bags["a tag and late sensors"])
    for topic in ("/car/scan", "/car/path", "/car/camera/image_raw", "/car/camera/camera_info"):
        assert len(bag[topic]) > 5
        late = {time_ns - ns(message.header.stamp) for time_ns, message in bag[topic] if ns(message.header.stamp) > 50_000_000}
        assert late == {50_000_000}, topic
    assert len(bag["/car/state/path"]) == 1  # its type differs from that of the sensor of this name


def test_an_unknown_heading_has_a_large_variance(bags: dict[str, Path]) -> None:
    bag = read(bags["a tag and late sensors"])
    for _, fix in bag["/car/fix"]:
        assert fix.pose.covariance[[0, 7]] == pytest.approx(0.15**2)
        assert fix.pose.covariance[35] > 3.0


def test_the_scene_has_walls_bodies_and_obstacles(bags: dict[str, Path]) -> None:
    bag = read(bags["a crossing cart"])
    ((_, solids),) = bag["/world/solids"]
    wall, cart, name = solids.markers
    assert (wall.type, len(wall.points), wall.header.frame_id) == (11, 3 * 12, "world")
    assert (cart.type, cart.header.frame_id, cart.frame_locked) == (1, "obstacle/cart", True)
    assert (name.type, name.text) == (9, "cart")
    before, *drawn = bag["/world/scene"][-1][1].markers
    assert before.action == 3  # DELETEALL: removes a place that the vehicle has given up
    bodies = Counter(marker.ns for marker in drawn)
    assert bodies == {"car-1": 3, "car-2": 3, "car-2/place": 2}
    frames = {each.child_frame_id for _, message in bag["/tf"] for each in message.transforms}
    assert frames == {"car-1", "car-2", "obstacle/cart"}
    assert {"/car_1/state", "/car_2/command"} < set(bag)  # ROS names have no hyphens


@pytest.mark.parametrize("name", RUNS)
def test_other_readers_agree(bags: dict[str, Path], name: str) -> None:
    path = bags[name] / f"{bags[name].name}.mcap"
    topics = read(bags[name])
    read_counts: Counter[str] = Counter()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            time_ns, expected = topics[channel.topic][read_counts[channel.topic]]
            read_counts[channel.topic] += 1
            assert message.log_time == time_ns
            if channel.topic.endswith("/state"):
                assert decoded.pose.pose.position.x == expected.pose.pose.position.x
    assert read_counts == {topic: len(listed) for topic, listed in topics.items()}


def test_rerun_understands_pictures_cameras_maps_and_transforms(bags: dict[str, Path], tmp_path: Path) -> None:
    path, converted = bags["recon-team"] / "recon_team.mcap", tmp_path / "run.rrd"
    rows = [line for line in rerun("mcap", "check", "--full", str(path)).splitlines() if line.startswith(("warn", "err"))]
    assert rows == []
    rerun("mcap", "convert", str(path), "-o", str(converted))
    found = rerun("rrd", "stats", str(converted))
    known = ("Image:buffer", "Pinhole:image_from_camera", "GridMap:data", "Transform3D:translation", "TextLog:text")
    assert [each for each in (*known, "EncodedImage:blob") if each not in found] == []


def test_names_equal_in_ros_are_refused(tmp_path: Path) -> None:
    assert (ros_name("car-1/state"), ros_name("/tf"), ros_name("2nd/scan")) == ("/car_1/state", "/tf", "/_2nd/scan")
    twins = recorded_run.Source(export_runs.run_of("a crossing cart"), lambda _: None)
    twins.vehicles = ("car-1", "car_1")  # names that differ only in a hyphen
    with pytest.raises(UsageError, match=r"car-1/state/path and car_1/state/path would both become .* /car_1/state/path"):
        write_bag(twins, tmp_path / "bag")


def test_a_bag_of_too_many_topics_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TOPICS", 3)
    with pytest.raises(UsageError, match="--rosbag2: topics: 4 exceeds the limit of 3"):
        write_bag(recorded_run.Source(export_runs.run_of("a crossing cart"), lambda _: None), tmp_path / "bag")
