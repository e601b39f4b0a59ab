"""Messages to and from firmware, against the published protocols."""

import json
import math
import socket
import struct

import msgspec
import numpy as np
import pytest
from pymavlink.quaternion import QuaternionBase  # type: ignore[import-untyped]

from tests.hardware.firmware.test_flights import scenario
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.runs.api import check
from vcmvsp.cosim.types import Fix, Imu, VehicleState
from vcmvsp.hardware.drivers.mavlink import protocol
from vcmvsp.hardware.drivers.mavlink.protocol import attitude_flipped, attitude_from_euler
from vcmvsp.hardware.firmware import ardupilot, atmosphere, px4


def packet(magic: int, number: int, pulses: list[int], channels: int) -> bytes:
    return struct.pack(f"<HHI{channels}H", magic, 400, number, *pulses, *[0] * (channels - len(pulses)))


@pytest.mark.parametrize(("magic", "channels"), [(18458, 16), (29569, 32)])
def test_servo_outputs_of_both_sizes(magic: int, channels: int) -> None:
    found = ardupilot.outputs_of(packet(magic, 7, [1000, 1500, 2000, 2100], channels))
    assert found == (7, (0.0, 0.5, 1.0, 1.0))


@pytest.mark.parametrize(
    "datagram", [b"", b"\x1aH", packet(18458, 1, [], 32), packet(29569, 1, [], 16), packet(18457, 1, [], 16), bytes(40)]
)
def test_other_datagrams_are_refused(datagram: bytes) -> None:
    assert ardupilot.outputs_of(datagram) is None


def readings(**state: object) -> FlightReadings:
    """Readings of a level vehicle."""
    imu = Imu(acceleration=(0.0, 0.0, 9.81), angular_velocity=(0.1, 0.2, 0.3))
    return FlightReadings(now_ns=2_500_000_000, state=VehicleState(position=(1.0, 2.0, 3.0), **state), imu=imu)  # type: ignore[arg-type]


def test_the_line_of_readings_follows_the_interface_readme() -> None:
    line = ardupilot.line_of(readings(velocity=(0.5, 0.25, -0.125), attitude=quaternion_from_yaw(0.5 * math.pi)))
    assert (line[:1], line[-1:], line.count(b"\n")) == (b"\n", b"\n", 2)
    got = json.loads(line)
    assert list(got) == ["timestamp", "imu", "position", "quaternion", "velocity"]
    assert got["timestamp"] == 2.5
    assert got["imu"] == {"gyro": [0.1, -0.2, -0.3], "accel_body": [0.0, -0.0, -9.81]}  # at rest, FRD
    assert got["position"] == [2.0, 1.0, -3.0]
    assert got["velocity"] == [0.25, 0.5, 0.125]
    assert got["quaternion"] == pytest.approx([1.0, 0.0, 0.0, 0.0])  # facing north


@pytest.mark.parametrize("euler", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, -0.4, 0.0), (0.1, 0.2, 3.0), (-1.0, 1.2, -2.0)])
def test_attitudes_are_those_of_pymavlink(euler: tuple[float, float, float]) -> None:
    ours = np.array(attitude_flipped(attitude_from_euler(*euler)))
    reference = np.array(QuaternionBase(list(euler)).q)
    assert ours * np.sign(ours @ reference) == pytest.approx(reference, abs=1e-12)
    assert np.abs(attitude_flipped((*ours.tolist(),))) == pytest.approx(np.abs(attitude_from_euler(*euler)))  # its own inverse


@pytest.mark.parametrize(("height_m", "hpa", "celsius"), [(0, 1013.25, 15.0), (500, 954.61, 11.75), (1000, 898.75, 8.5)])
def test_pressure_is_that_of_the_standard_atmosphere(height_m: float, hpa: float, celsius: float) -> None:
    assert atmosphere.pressure_hpa(height_m) == pytest.approx(hpa, abs=0.01)  # ISO 2533:1975, table 5
    assert atmosphere.temperature_c(height_m) == pytest.approx(celsius, abs=0.01)


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        ({"physics": {"kind": "kinematic"}}, "vehicle.uav0.firmware", "needs rotors"),
        ({"physics": {"kind": "bullet"}}, "physics.rate_hz", "at least 200 steps"),
        ({"vehicle": {"kind": "p2dx"}}, "vehicle.uav0.firmware", "flies quadrotors, not a p2dx"),
        ({"vehicle": {"agent": {"kind": "aerial_route"}}}, "vehicle.uav0.firmware.mavlink", "is missing"),
        ({"firmware": {"kind": "inav"}}, "vehicle.uav0.firmware.kind", "ardupilot, betaflight, px4"),
        ({"firmware": {"instance": 60000}}, "vehicle.uav0.firmware.instance", "too large"),
        ({"firmware": {"command": "arducopter {number}"}}, "vehicle.uav0.firmware.command", "{instance}, {vehicle}, {folder}"),
        ({"firmware": {"command": "arducopter 'x"}}, "vehicle.uav0.firmware.command", "No closing quotation"),
        ({"firmware": {"on_lost": "land"}}, "vehicle.uav0.firmware.on_lost", "'stop', 'fall', 'hold'"),
        ({"firmware": {"origin": [91.0, 0.0, 0.0]}}, "vehicle.uav0.firmware.origin", "latitude"),
        ({"firmware": {"timeout_s": 0.0}}, "vehicle.uav0.firmware.timeout_s", "0"),
    ],
)
def test_bad_input_is_one_error(change: dict[str, dict[str, object]], key: str, words: str) -> None:
    table = scenario("ardupilot", [3])
    vehicle = table["vehicle"][0]
    vehicle["firmware"] |= {"command": ""} | change.get("firmware", {})
    vehicle |= change.get("vehicle", {})
    table |= {"physics": change.get("physics", table["physics"])}
    with pytest.raises(ScenarioError) as caught:
        check(table)
    assert caught.value.key == key
    assert words in str(caught.value)


def test_two_vehicles_at_one_port_are_an_error_and_numbers_count_by_kind() -> None:
    with pytest.raises(ScenarioError, match="its port 9032 is that of uav0"):
        check(scenario("ardupilot", [3, 3]))
    table = scenario("px4", [0, 0])
    for vehicle in table["vehicle"]:
        del vehicle["firmware"]["instance"]
    check(table)  # opens and starts nothing


def test_sensor_messages_are_250_hz_at_most_without_loss() -> None:
    """At 1000 steps a second, every fourth step sends a message with the readings of the steps in between."""
    link = px4.Px4(vehicle="uav0", number=0, folder=".")
    here, there = socket.socketpair()
    with here, there:
        link._line, link._encode = here, protocol.Encoder(protocol.Sender(system=1, component=1))
        link.started = True
        here.setblocking(False)
        for step in range(12):
            field = (1.0, 2.0, 3.0) if step == 5 else None
            fix = Fix(time_ns=0, position=(0.0, 0.0, 0.0), sigma_m=1.0) if step == 6 else None
            values = readings()
            link.send(msgspec.structs.replace(values, now_ns=step * 1_000_000, field_ut=field, fix=fix, height_m=2.0))
            assert link.receive() == bool(step % 4)  # a step without a message keeps the last outputs
        messages = protocol.MessageReader().feed(there.recv(65536))
    sensors = [each for each in messages if each.get_type() == "HIL_SENSOR"]
    assert [each.time_usec for each in sensors] == [1000, 5000, 9000]
    assert [each.get_type() for each in messages] == ["HIL_SENSOR", "HIL_SENSOR", "HIL_SENSOR", "HIL_GPS"]
    assert [bool(each.fields_updated & px4.MAG) for each in sensors] == [False, False, True]
    assert all(each.fields_updated & px4.ACCEL and each.fields_updated & px4.BARO for each in sensors)
    assert (sensors[2].xmag, sensors[2].ymag, sensors[2].zmag) == pytest.approx((0.01, -0.02, -0.03))  # gauss, FRD
    assert sensors[0].zacc == pytest.approx(-9.81)
    assert sensors[0].abs_pressure == pytest.approx(atmosphere.pressure_hpa(490.0))
    latitude, longitude, height_m = px4.HOME
    assert (1e-7 * messages[3].lat, 1e-7 * messages[3].lon) == pytest.approx((latitude, longitude), abs=1e-7)
    assert 1e-3 * messages[3].alt == pytest.approx(height_m, abs=1e-3)
