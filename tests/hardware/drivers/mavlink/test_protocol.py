"""MAVLink messages: split, noisy and corrupted streams, search for a vehicle, coordinate frames."""

import math
import random
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vcmvsp.cosim.frames import quaternion_from_yaw, wrap, yaw_of
from vcmvsp.cosim.types import Array, VehicleState, Velocity
from vcmvsp.hardware.drivers.base import HandshakeError
from vcmvsp.hardware.drivers.mavlink.link import LISTEN_S, VehicleSearch
from vcmvsp.hardware.drivers.mavlink.protocol import (
    Encoder,
    Message,
    MessageReader,
    Sender,
    attitude_from_euler,
    body_flipped,
    euler_from_attitude,
    mavlink,
    setpoint,
    world_flipped,
    yaw_flipped,
)
from vcmvsp.hardware.emulators.mavlink.vehicle import GRAVITY, VehicleMotion

SECOND = 1_000_000_000
LATER = SECOND + round(LISTEN_S * SECOND)


def heartbeat(kind: int = mavlink.MAV_TYPE_QUADROTOR, autopilot: int = mavlink.MAV_AUTOPILOT_PX4) -> Message:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 1, 6 << 16, 4, 3)


def encoded(system: int, *messages: Message) -> bytes:
    return Encoder(Sender(system=system, component=1))(*messages)


def found_peer(*datagrams: tuple[str, bytes], system_id: int = 0, kind: str | None = None) -> Any:
    search = VehicleSearch("udpin:0.0.0.0:14540", system_id, kind)  # type: ignore[arg-type]
    search.receive(list(datagrams), SECOND)
    return search.decide(LATER)


def failed(*datagrams: tuple[str, bytes], system_id: int = 0) -> str:
    search = VehicleSearch("udpin:0.0.0.0:14540", system_id, None)
    assert search.receive(list(datagrams), SECOND) is None
    assert search.decide(LATER) is None
    return str(search.failure(10.0))


STREAM = Encoder(Sender(system=7, component=1))(
    *(mavlink.MAVLink_attitude_message(each, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0) for each in range(20))
)


@given(st.lists(st.integers(0, len(STREAM)), max_size=12))
def test_a_stream_may_be_cut_anywhere(cuts: list[int]) -> None:
    reader, times = MessageReader(), []
    for start, end in pairwise([0, *sorted(cuts), len(STREAM)]):
        times += [each.time_boot_ms for each in reader.feed(STREAM[start:end])]
    assert times == list(range(20))


@given(st.binary(max_size=300), st.integers(0, 19))
def test_noise_costs_no_message_behind_it(noise: bytes, number: int) -> None:
    reader = MessageReader()
    times = [each.time_boot_ms for each in reader.feed(noise + STREAM + bytes(300)) if each.get_type() == "ATTITUDE"]
    assert times[-20:] == list(range(20))


def test_a_flipped_bit_costs_one_message() -> None:
    draws = random.Random(5)
    for _ in range(200):
        data = bytearray(STREAM)
        data[draws.randrange(len(data))] ^= 1 << draws.randrange(8)
        times = [each.time_boot_ms for each in MessageReader().feed(bytes(data) + bytes(300))]
        assert len(times) == 19


def test_mavlink_1_is_understood() -> None:
    mav = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
    (message,) = MessageReader().feed(heartbeat().pack(mav, force_mavlink1=True))
    assert (message.get_type(), message.get_srcSystem()) == ("HEARTBEAT", 3)


def test_unknown_messages_and_features_are_ignored() -> None:
    unknown = bytes((0xFD, 1, 0, 0, 0, 1, 1, 0xFF, 0xFF, 0xFE, 9, 1, 2))
    feature = bytearray(encoded(1, heartbeat()))
    feature[2] |= 0x80
    assert [each.get_type() for each in MessageReader().feed(unknown + feature + encoded(1, heartbeat()))] == ["HEARTBEAT"]


def test_the_only_vehicle_is_found_beside_a_ground_station_and_a_camera() -> None:
    station = heartbeat(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID)
    camera = heartbeat(mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID)
    peer = found_peer(("a", encoded(255, station)), ("b", b"noise" + encoded(4, camera, heartbeat())))
    assert (peer.sender.system, peer.source, peer.autopilot.name, peer.on_ground) == (4, "b", "PX4", False)


def test_a_named_vehicle_is_found_among_others_at_once() -> None:
    search = VehicleSearch("x", 2, None)
    peer: Any = search.receive([("", encoded(1, heartbeat()) + encoded(2, heartbeat()))], SECOND)
    assert peer.sender.system == 2


def test_each_failure_has_its_message() -> None:
    station = heartbeat(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID)
    plane = heartbeat(mavlink.MAV_TYPE_FIXED_WING)
    odd = heartbeat(autopilot=mavlink.MAV_AUTOPILOT_GENERIC)
    assert "no byte was received within 10 s" in failed()
    assert "500 bytes were received within 10 s, but no MAVLink message" in failed(("a", b"hello" * 100))
    assert "no heartbeat was received" in failed(("a", STREAM))
    assert "no vehicle was received within 10 s, only system 255 (gcs)" in failed(("a", encoded(255, station)))
    assert "9 was not received within 10 s, only system 1 (quadrotor)" in failed(("a", encoded(1, heartbeat())), system_id=9)
    with pytest.raises(HandshakeError, match=r"systems 1, 2 and 3 speak here; choose one, e.g. system_id = 1"):
        found_peer(("a", encoded(1, heartbeat()) + encoded(3, heartbeat()) + encoded(2, heartbeat())))
    with pytest.raises(HandshakeError, match="system 1 sends from more than one address"):
        found_peer(("a", encoded(1, heartbeat())), ("b", encoded(1, heartbeat())))
    with pytest.raises(HandshakeError, match="system 1 is of type fixed wing"):
        found_peer(("a", encoded(1, plane)))
    with pytest.raises(HandshakeError, match="neither PX4 nor ArduPilot"):
        found_peer(("a", encoded(1, odd)))
    with pytest.raises(HandshakeError, match='the autopilot "px4", not "ardupilot"'):
        found_peer(("a", encoded(1, heartbeat())), kind="ardupilot")
    assert found_peer(("a", encoded(1, odd)), kind="px4") is not None


ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])

angle = st.floats(-math.pi, math.pi)
tilt = st.floats(-1.5, 1.5)
vector = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


def matrix(q: tuple[float, float, float, float]) -> Array:
    return Rotation.from_quat(q, scalar_first=True).as_matrix()


@given(vector)
def test_vectors_come_back_and_match_the_matrices(v: tuple[float, float, float]) -> None:
    assert world_flipped(world_flipped(v)) == v
    assert body_flipped(body_flipped(v)) == v
    np.testing.assert_array_equal(world_flipped(v), ENU_FROM_NED @ v)
    np.testing.assert_array_equal(body_flipped(v), FRD_FROM_FLU @ v)


@given(angle, tilt, angle)
def test_an_attitude_is_the_product_of_the_matrices(roll: float, pitch: float, yaw: float) -> None:
    ned_from_frd = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    expected = ENU_FROM_NED @ ned_from_frd @ FRD_FROM_FLU
    np.testing.assert_allclose(matrix(attitude_from_euler(roll, pitch, yaw)), expected, atol=1e-12)


@given(angle, tilt, angle)
def test_attitude_round_trip(roll: float, pitch: float, yaw: float) -> None:
    back = euler_from_attitude(attitude_from_euler(roll, pitch, yaw))
    for actual, expected in zip(back, (roll, pitch, yaw), strict=True):
        assert abs(wrap(actual - expected)) < 1e-7


@given(angle)
def test_yaw_is_counter_clockwise_from_east(yaw: float) -> None:
    assert abs(wrap(yaw_flipped(yaw_flipped(yaw)) - yaw)) < 1e-12
    assert abs(wrap(yaw_of(attitude_from_euler(0.0, 0.0, yaw_flipped(yaw))) - yaw)) < 1e-9


@pytest.mark.parametrize(("enu_deg", "ned_deg"), [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (-90.0, 180.0)])
def test_east_is_90_degrees_of_a_compass(enu_deg: float, ned_deg: float) -> None:
    assert abs(wrap(yaw_flipped(math.radians(enu_deg)) - math.radians(ned_deg))) < 1e-12


def test_a_set_point_east_up_and_counter_clockwise() -> None:
    to = Sender(system=1, component=1)
    sent = setpoint(to, 0, (1.0, 2.0, 3.0), 0.5, on_ground=False)
    assert (sent.vx, sent.vy, sent.vz, sent.yaw_rate) == (2.0, 1.0, -3.0, -0.5)
    assert sent.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    ignored = {
        mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE,
    }
    assert sent.type_mask == sum(ignored)
    rover = setpoint(to, 0, (1.0, 2.0, 3.0), 0.5, on_ground=True)
    assert (rover.vx, rover.vy, rover.vz, rover.yaw_rate) == (1.0, 0.0, 0.0, -0.5)
    assert rover.coordinate_frame == mavlink.MAV_FRAME_BODY_NED


@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), angle)
def test_the_emulated_quadrotor_leans_along_its_thrust(linear: tuple[float, float, float], yaw: float) -> None:
    start = VehicleState(position=(0.0, 0.0, 10.0), attitude=quaternion_from_yaw(yaw))
    state = VehicleMotion(start, on_ground=False).step(Velocity(linear=linear), 0.005)
    thrust = np.array(state.velocity) / 0.005 + [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(matrix(state.attitude)[:, 2], thrust / np.linalg.norm(thrust), atol=1e-9)
    assert abs(wrap(euler_from_attitude(state.attitude)[2] - yaw_flipped(yaw))) < 1e-9
