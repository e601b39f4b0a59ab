"""Wire format: message bytes against ROS 2; keys, tokens and attachments against sources."""

import json
import random
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.ros2.protocol import (
    ODOMETRY,
    TWIST,
    TWIST_STAMPED,
    Endpoint,
    OdometryMessage,
    Origin,
    RmwZenoh,
    Ros2Dds,
    Twist,
    decode_odometry,
    decode_twist,
    encode_odometry,
    encode_twist,
    gid_of,
    origin_of,
    topic_of,
    type_hash,
)

# Random content and its bytes by rclpy.serialization.serialize_message of ROS 2 Jazzy (rclpy 7.1.6 on Fast DDS). Padding
# bytes, undefined in rclpy, are zero here.
GOLDEN = json.loads((Path(__file__).parent / "test_ros2_golden.json").read_text())
TWIST_HASH = (
    "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"  # share/geometry_msgs/msg/Twist.json, Jazzy
)

finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.tuples(finite, finite, finite)
stamps = st.integers(0, 2**31 * 10**9 - 1)
names = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)


def odometry_of(golden: dict[str, Any]) -> OdometryMessage:
    pose, twist = [0.0] * 36, [0.0] * 36
    pose[0], pose[35] = golden["pose_covariance"]
    twist[7] = golden["twist_covariance"]
    position, linear, angular = (tuple(golden[key]) for key in ("position", "linear", "angular"))
    texts = golden["frame"], golden["child_frame"]
    attitude = tuple(golden["attitude"])
    return OdometryMessage(position, attitude, linear, angular, golden["stamp_ns"], *texts, tuple(pose), tuple(twist))


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda each: each["type"])
def test_bytes_are_those_of_ros_2(golden: dict[str, Any]) -> None:
    data = bytes.fromhex(golden["hex"])
    if golden["type"] == ODOMETRY:
        odometry = odometry_of(golden)
        assert encode_odometry(odometry) == data
        received = decode_odometry(data)
        assert received.attitude == pytest.approx(odometry.attitude, abs=1e-15)  # normalised again
        assert received._replace(attitude=odometry.attitude) == odometry
    else:
        stamped = golden["type"] == TWIST_STAMPED
        linear, angular = tuple(golden["linear"]), tuple(golden["angular"])
        twist = Twist(linear, angular, golden.get("stamp_ns", 0), golden.get("frame", ""))
        assert encode_twist(twist, stamped=stamped) == data
        assert decode_twist(data, stamped=stamped) == twist


def test_a_twist_is_six_doubles_behind_a_header() -> None:
    data = encode_twist(Twist((0.2, 0.0, 0.0), (0.0, 0.0, 0.1)), stamped=False)
    assert data == b"\0\1\0\0" + struct.pack("<6d", 0.2, 0, 0, 0, 0, 0.1)
    big = b"\0\0\0\0" + struct.pack(">6d", 0.2, 0, 0, 0, 0, 0.1)
    assert decode_twist(big, stamped=False) == decode_twist(data, stamped=False)


def test_hashes_are_those_of_ros_2() -> None:
    assert type_hash(TWIST) == TWIST_HASH
    assert type_hash(TWIST_STAMPED) == "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
    assert type_hash(ODOMETRY) == "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"


@given(vectors, vectors, vectors, stamps, names, names)
def test_odometry_round_trip(position: Any, linear: Any, angular: Any, stamp_ns: int, frame: str, child_frame: str) -> None:
    odometry = OdometryMessage(position, (0.6, 0.0, 0.0, 0.8), linear, angular, stamp_ns, frame, child_frame)
    assert decode_odometry(encode_odometry(odometry)) == odometry


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_values_are_refused(bad: float) -> None:
    good = OdometryMessage((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="pose is not finite"):
        decode_odometry(encode_odometry(good._replace(position=(0.0, bad, 0.0))))
    with pytest.raises(ValueError, match="velocity is not finite"):
        decode_odometry(encode_odometry(good._replace(angular=(0.0, 0.0, bad))))
    with pytest.raises(ValueError, match="velocity is not finite"):
        decode_twist(encode_twist(Twist((bad, 0.0, 0.0), (0.0, 0.0, 0.0)), stamped=False), stamped=False)
    unknown = good._replace(pose_covariance=(bad,) * 36)
    assert decode_odometry(encode_odometry(unknown)).position == good.position


def test_an_invalid_quaternion_is_refused() -> None:
    for attitude in (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.5):
        with pytest.raises(ValueError, match="not a rotation"):
            decode_odometry(encode_odometry(OdometryMessage((0.0, 0.0, 0.0), attitude)))


def test_garbage_is_a_value_error_and_nothing_else() -> None:
    draw, good = random.Random(1), bytes.fromhex(GOLDEN[-1]["hex"])
    refused = 0
    for _ in range(5000):
        data = bytearray(good if draw.random() < 0.8 else draw.randbytes(800))
        for _ in range(draw.randint(1, 8)):
            data[draw.randrange(len(data))] = draw.randrange(256)
        if draw.random() < 0.5:
            del data[draw.randrange(len(data)) :]
        try:
            decode_odometry(bytes(data))
        except ValueError:
            refused += 1
    assert refused > 2500
    for length in range(len(good) - 8):
        with pytest.raises(ValueError, match="not a valid nav_msgs"):
            decode_odometry(good[:length])


def test_keys_of_rmw_zenoh() -> None:
    keys = RmwZenoh(0, "me")
    key = f"0/cmd_vel/geometry_msgs::msg::dds_::Twist_/{TWIST_HASH}"
    assert keys.publishes("cmd_vel", TWIST) == key
    assert keys.type_of(key) == TWIST
    assert keys.type_of("0/cmd_vel/*/*") is None  # a put may use wildcards
    assert RmwZenoh(7, "me", "humble").publishes("a/b", TWIST) == "7/a/b/geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported"


def test_tokens_of_rmw_zenoh() -> None:
    """Format: docs/design.md of rmw_zenoh."""
    ends = (Endpoint("MP", "robot1/cmd_vel", TWIST), Endpoint("MS", "odom", ODOMETRY))
    keys = RmwZenoh(2, "me")
    publisher, subscriber, node = keys.tokens("a1b2", ends)
    qos = "::,10:,:,:,,"
    assert publisher == (f"@ros2_lv/2/a1b2/0/1/MP/%/%/me/%robot1%cmd_vel/geometry_msgs::msg::dds_::Twist_/{TWIST_HASH}/{qos}")
    assert node == "@ros2_lv/2/a1b2/0/0/NN/%/%/me"
    assert (keys.endpoint(publisher), keys.endpoint(subscriber)) == ends
    assert keys.endpoint(node) is None


def test_keys_and_tokens_of_the_bridge() -> None:
    """Format: liveliness_mgt.rs of zenoh-plugin-ros2dds."""
    keys = Ros2Dds()
    assert keys.publishes("robot1/cmd_vel", TWIST) == keys.subscription_key("robot1/cmd_vel") == "robot1/cmd_vel"
    end = Endpoint("MP", "robot1/cmd_vel", TWIST)
    token, plugin = keys.tokens("a1b2", (end,))
    assert token == "@/a1b2/@ros2_lv/MP/robot1§cmd_vel/geometry_msgs§msg§Twist/:1::0,10"
    assert plugin == "@/a1b2/@ros2_lv"
    assert keys.endpoint(token) == end
    assert keys.attachment(Origin(1, 2, bytes(16))) is None


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_attachments_both_old_and_new(number: int, time_ns: int, gid: bytes) -> None:
    origin = Origin(number, time_ns, gid)
    new = RmwZenoh(0, "me").attachment(origin)
    assert new == number.to_bytes(8, "little", signed=True) + time_ns.to_bytes(8, "little") + b"\x10" + gid
    assert origin_of(new) == origin
    old = b"\x0fsequence_number" + new[:8] + b"\x10source_timestamp" + new[8:16] + b"\x0asource_gid" + new[16:]
    assert len(old) == 77
    assert origin_of(old) == origin


@given(st.binary(max_size=90))
def test_other_attachments_are_ignored(data: bytes) -> None:
    assert len(data) == 33 or origin_of(data) is None
    assert origin_of(bytes(33)) is None
    assert origin_of(bytes(77)) is None


def test_ids_of_senders_are_16_distinct_bytes() -> None:
    assert len(gid_of("a")) == 16
    assert gid_of("a") != gid_of("b")


def test_names_of_topics() -> None:
    assert topic_of("", "cmd_vel") == topic_of("robot1", "/cmd_vel") == "cmd_vel"
    assert topic_of("/fleet/robot1/", "a/b") == "fleet/robot1/a/b"
    for namespace, topic in ("", "a/*"), ("", ""), ("", "a b"), ("1", "a"), ("a#", "b"), ("", "a/"), ("", "//a"):
        with pytest.raises(ValueError, match="such as"):
            topic_of(namespace, topic)
