"""Messages out of streams that are cut, mixed with noise and broken; who is found among those who speak."""

import random
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.base import HandshakeError
from vcmvsp.hardware.drivers.mavlink.codec import Encoder, Message, MessageReader, Sender, mavlink
from vcmvsp.hardware.drivers.mavlink.vehicle_search import LISTEN_S, Peer, VehicleSearch

SECOND = 1_000_000_000
LATER = SECOND + round(LISTEN_S * SECOND)


def heartbeat(kind: int = mavlink.MAV_TYPE_QUADROTOR, autopilot: int = mavlink.MAV_AUTOPILOT_PX4) -> Message:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 1, 6 << 16, 4, 3)


def said(system: int, *messages: Message) -> bytes:
    return Encoder(Sender(system=system, component=1))(*messages)


def found(*heard: tuple[str, bytes], system_id: int = 0, kind: str | None = None) -> Peer | None:
    search = VehicleSearch("udpin:0.0.0.0:14540", system_id, kind)  # type: ignore[arg-type]
    search.receive(list(heard), SECOND)
    return search.decide(LATER)


def failed(*heard: tuple[str, bytes], system_id: int = 0) -> str:
    search = VehicleSearch("udpin:0.0.0.0:14540", system_id, None)
    assert search.receive(list(heard), SECOND) is None
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
def test_noise_before_a_message_costs_no_message_behind_it(noise: bytes, number: int) -> None:
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


def test_messages_that_are_not_known_or_of_unknown_features_are_left_out() -> None:
    unknown = bytes((0xFD, 1, 0, 0, 0, 1, 1, 0xFF, 0xFF, 0xFE, 9, 1, 2))
    feature = bytearray(said(1, heartbeat()))
    feature[2] |= 0x80
    assert [each.get_type() for each in MessageReader().feed(unknown + feature + said(1, heartbeat()))] == ["HEARTBEAT"]


def test_the_only_vehicle_is_found_beside_a_ground_station_and_a_camera() -> None:
    station = heartbeat(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID)
    camera = heartbeat(mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID)
    peer = found(("a", said(255, station)), ("b", b"noise" + said(4, camera, heartbeat())))
    assert peer is not None
    assert (peer.sender.system, peer.source, peer.autopilot.name, peer.on_ground) == (4, "b", "PX4", False)


def test_a_vehicle_that_is_named_is_found_among_others_at_once() -> None:
    search = VehicleSearch("x", 2, None)
    peer = search.receive([("", said(1, heartbeat()) + said(2, heartbeat()))], SECOND)
    assert peer is not None
    assert peer.sender.system == 2


def test_each_wrong_thing_has_its_message() -> None:
    station = heartbeat(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID)
    plane = heartbeat(mavlink.MAV_TYPE_FIXED_WING)
    odd = heartbeat(autopilot=mavlink.MAV_AUTOPILOT_GENERIC)
    assert "nothing was heard within 10 s" in failed()
    assert "500 bytes were heard within 10 s, and no MAVLink among them" in failed(("a", b"hello" * 100))
    assert "no heartbeat was heard" in failed(("a", STREAM))
    assert "no vehicle was heard within 10 s, only system 255 (gcs)" in failed(("a", said(255, station)))
    assert "system 9 was not heard within 10 s, only system 1 (quadrotor)" in failed(("a", said(1, heartbeat())), system_id=9)
    with pytest.raises(HandshakeError, match="systems 1, 2 and 3 speak here; say which one is meant: system_id = 1"):
        found(("a", said(1, heartbeat()) + said(3, heartbeat()) + said(2, heartbeat())))
    with pytest.raises(HandshakeError, match="system 1 speaks from more than one place"):
        found(("a", said(1, heartbeat())), ("b", said(1, heartbeat())))
    with pytest.raises(HandshakeError, match="system 1 is of type fixed wing"):
        found(("a", said(1, plane)))
    with pytest.raises(HandshakeError, match="neither PX4 nor ArduPilot"):
        found(("a", said(1, odd)))
    with pytest.raises(HandshakeError, match='its autopilot is "px4", not "ardupilot"'):
        found(("a", said(1, heartbeat())), kind="ardupilot")
    assert found(("a", said(1, odd)), kind="px4") is not None
