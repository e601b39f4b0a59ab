"""Betaflight in the loop: packets against its sources, a stand-in, and its own program if installed."""

import math
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.hardware.firmware import test_flights
from tests.hardware.firmware.test_flights import track
from tests.support.paths import ROOT
from tests.support.requirements import installed_apart
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.runs.api import check
from vcmvsp.cosim.types import Imu, Incident, VehicleState, Waypoint
from vcmvsp.hardware.drivers.mavlink.protocol import attitude_from_euler
from vcmvsp.hardware.firmware import betaflight, private_network

PROGRAM = ROOT / "tests" / "support" / "hardware" / "scripted_betaflight.py"
IN_PRIVATE = f"import sys; sys.path.insert(0, {str(Path(private_network.__file__).parent)!r}); import private_network"
STAND_IN = f"{sys.executable} {PROGRAM}"


def scenario(count: int = 1, duration_s: float = 2.0, command: str = STAND_IN, **more: Any) -> dict[str, Any]:
    table = test_flights.scenario("betaflight", [0] * count, duration_s, command=command, **more)
    for vehicle in table["vehicle"]:
        del vehicle["heading"]
    return table


@pytest.fixture(scope="module")
def networks_allowed() -> None:
    """Skips on machines without network namespaces."""
    trial = f"{IN_PRIVATE}\nprivate_network.enter()"
    if subprocess.run([sys.executable, "-c", trial], check=False, capture_output=True).returncode:
        pytest.skip("this machine does not allow network namespaces")


def outputs(pulses: list[float], count: int = 4) -> bytes:
    return struct.pack("<H2x16f", count, *pulses, *[0.0] * (16 - len(pulses)))


def test_motors_are_put_in_the_order_of_the_run() -> None:
    # Betaflight's mixer QUADX: back right, front right, back left, front left
    found = betaflight.outputs_of(outputs([1100.0, 1200.0, 1300.0, 2100.0]))
    assert found == pytest.approx((0.2, 0.3, 1.0, 0.1))  # front right, back left, front left, back right


@pytest.mark.parametrize("datagram", [b"", bytes(16), outputs([1000.0] * 8, count=8), outputs([math.nan] * 4), bytes(144)])
def test_outputs_of_other_vehicles_and_protocols_are_refused(datagram: bytes) -> None:
    assert betaflight.outputs_of(datagram) is None


def test_the_state_is_in_the_frames_of_the_firmware() -> None:
    attitude = attitude_from_euler(0.1, 0.2, 0.5 * math.pi)  # roll right, nose up, to the east
    state = VehicleState(position=(1.0, 2.0, 3.0), velocity=(4.0, 5.0, 6.0), attitude=attitude)
    imu = Imu(acceleration=(0.0, 0.0, 9.81), angular_velocity=(0.1, 0.2, 0.3))
    packet = betaflight.state_packet(FlightReadings(now_ns=2_500_000_000, state=state, imu=imu), (47.0, 8.0, 490.0), 95000.0)
    values = struct.unpack("<18d", packet)
    assert values[:7] == pytest.approx((2.5, 0.1, -0.2, -0.3, 0.0, 0.0, -9.81))  # sitl.c negates the last two rates, and forces
    w, x, y, z = values[7:11]
    assert math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) == pytest.approx(0.1)
    assert math.asin(2 * (x * z - w * y)) == pytest.approx(-0.2)  # imu.c: pitch, nose down
    assert math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(0.5 * math.pi)  # heading, clockwise
    assert values[11:] == pytest.approx((4.0, 5.0, 6.0, 8.0, 47.0, 490.0, 95000.0))  # longitude before latitude


@pytest.mark.parametrize(
    ("change", "words"),
    [({"mavlink": "udpin:127.0.0.1:14540"}, "no commands over MAVLink"), ({"command": ""}, "its port 9001 is that of uav0")],
)
def test_bad_input_is_one_error(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        check(scenario(2, **change))


@pytest.mark.processes
@pytest.mark.sockets
@pytest.mark.usefixtures("networks_allowed")
def test_several_share_port_numbers_and_an_ended_one_falls() -> None:
    table = scenario(3, duration_s=2.5)
    table["vehicle"][1]["firmware"] |= {"command": f"{STAND_IN} --stop 1.5", "on_lost": "fall"}
    notes: list[tuple[str, Incident]] = []

    def keep(event: Any) -> None:
        if event.key.endswith("/incident"):
            notes.append((event.key, event.value))

    vcmvsp.run(table, observe=keep)
    assert sorted(key for key, each in notes if each.what == "connected") == [f"uav{k}/incident" for k in range(3)]
    ((key, lost),) = [(key, each) for key, each in notes if each.what == "lost"]
    assert key == "uav1/incident"
    assert "ended with exit code 1, last line: told to stop; its rotors stop" in lost.cause


@pytest.mark.processes
@pytest.mark.sockets
@pytest.mark.usefixtures("networks_allowed")
def test_a_missing_program_is_an_error() -> None:
    with pytest.raises(FederateError, match="no-such-firmware cannot be started"):
        vcmvsp.run(scenario(command="no-such-firmware"))


CONFIGURATION = ("aux 0 0 0 1700 2100 0 0", "aux 1 1 1 1700 2100 0 0", "set acc_calibration = 0,0,0,1", "save")


@pytest.fixture(scope="module")
def configured(networks_allowed: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Command line of Betaflight's own program with a configuration: AUX 1 arms, AUX 2 switches to mode ANGLE."""
    built = Path(installed_apart("betaflight").__file__).parent / "firmware" / "obj"
    program, folder = next(built.glob("betaflight_*_SITL")), tmp_path_factory.mktemp("betaflight")
    talk = f"""import socket, subprocess, time
{IN_PRIVATE}
private_network.enter()
firmware = subprocess.Popen([{str(program)!r}], stdout=subprocess.DEVNULL)
while True:
    try:
        link = socket.create_connection(("127.0.0.1", 5761))
        break
    except OSError:
        time.sleep(0.1)
link.settimeout(10.0)
time.sleep(0.5)
for line in ("#", *{CONFIGURATION!r}):
    link.sendall(line.encode() + (b"" if line == "#" else b"\\n"))
    output = b""
    while not output.rstrip().endswith((b"#", b"Rebooting")):
        output += link.recv(4096)
time.sleep(0.5)
firmware.kill()"""
    subprocess.run([sys.executable, "-c", talk], cwd=folder, check=True, timeout=30)
    yield f"sh -c 'cp {folder}/eeprom.bin . && exec {program} > log'"
    shutil.rmtree(folder)


class Flight(vcmvsp.Agent):
    """Hovers, flies 2 m ahead, lands."""

    period = 0.1

    def __init__(self, x: float) -> None:
        self.x = x

    def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> vcmvsp.Velocity | Waypoint:
        if obs.time_s < 11.0:
            return vcmvsp.Velocity()
        if obs.time_s < 17.0:
            return Waypoint(position=(self.x, 2.0, 2.5))
        return vcmvsp.Velocity(linear=(0.0, 0.0, -0.7))


@pytest.mark.processes
@pytest.mark.sockets
def test_three_of_betaflights_own_program_arm_hover_and_land(configured: str) -> None:
    table = scenario(3, duration_s=24.0, command=configured)
    table["vehicle"] = [{**each, "agent": {}} for each in table["vehicle"]]
    begun_s = time.monotonic()
    result = vcmvsp.run(table, agents={f"uav{k}": Flight(3.0 * k) for k in range(3)})
    assert time.monotonic() - begun_s >= 23.0  # the firmware follows the wall clock
    for k in range(3):
        at = track(result, f"uav{k}")
        assert at(11.0) == pytest.approx([3.0 * k, 0.0, 2.2], abs=0.35)
        assert at(17.0) == pytest.approx([3.0 * k, 2.0, 2.5], abs=0.2)
        assert at(24.0)[2] == pytest.approx(0.04, abs=0.03)
