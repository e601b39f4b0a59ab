"""MavlinkDriver over UDP and TCP sockets, against the emulated vehicle in real time."""

import itertools
import math
import socket
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any

import pytest

from tests.support import requirements
from tests.support.cosim.run_processes import reserve_port
from tests.support.hardware import driver_runs
from tests.support.hardware.driver_runs import eventually, fly, newest, rest
from tests.support.netsim.gateway_context import free_ports
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import ORIGIN, Vec3, Velocity
from vcmvsp.hardware.drivers.base import Driver, HandshakeError, LinkLost, PortError
from vcmvsp.hardware.drivers.mavlink import link as mavlink_link
from vcmvsp.hardware.drivers.mavlink.driver import MavlinkDriver
from vcmvsp.hardware.drivers.mavlink.link import SOURCES, open_link
from vcmvsp.hardware.drivers.mavlink.protocol import mavlink
from vcmvsp.hardware.emulators.device_server import UdpPort
from vcmvsp.hardware.emulators.mavlink.server import MavlinkServer, serve
from vcmvsp.hardware.emulators.mavlink.vehicle import SITE, Vehicle
from vcmvsp.hardware.stations import READY_S

pytestmark = [pytest.mark.sockets, pytest.mark.usefixtures("steady")]
FLYING = (0.0, 0.0, 10.0, 0.0)
QUICK: dict[str, Any] = {"heartbeat_s": 0.1}  # for short waiting times
GUIDED: dict[str, Any] = {"autopilot": "ardupilot", "mode": "GUIDED", "armed": True, **QUICK}


def connected(address: str, start: Vec3 = ORIGIN, **options: Any) -> AbstractContextManager[MavlinkDriver]:
    return driver_runs.open_driver(MavlinkDriver(address=address, **{"system_id": 1, **options}), start)


def commands(served: MavlinkServer, number: int) -> list[Any]:
    with served.lock:
        messages = [each for _, each in served.vehicle.heard]
    return [each for each in messages if each.get_type() == "COMMAND_LONG" and each.command == number]


def points(served: MavlinkServer) -> list[Any]:
    with served.lock:
        return [each for _, each in served.vehicle.heard if each.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


def notice(driver: Driver, kind: str, word: str) -> Callable[[], bool]:
    """Predicate: a notice of this kind with this word has been read."""
    causes: list[str] = []

    def told() -> bool:
        causes.extend(each.cause for each in driver.notices() if each.what == kind)
        return any(word in each for each in causes)

    return told


def test_px4_is_switched_armed_lifted_flown_east_and_left_holding() -> None:
    port = free_ports(1)
    with MavlinkServer(Vehicle(start=(3.0, 4.0, 0.0, 0.5 * math.pi), **QUICK), UdpPort(("127.0.0.1", port))) as served:
        options: dict[str, Any] = {"switch_mode": True, "arm": True, "takeoff_m": 0.4, "connect_s": 15.0}
        with connected(f"udpin:127.0.0.1:{port}", start=(0.0, 0.0, 0.0), **options) as driver:
            assert isinstance(driver, Driver)
            first = newest(driver)
            assert first.state.position[2] > 0.3
            began, t0 = first.state.position, first.measured_ns
            samples = fly(driver, 1.2, 1.0, 0.0, 0.0)
            last = samples[-1]
            seconds = 1e-9 * (last.measured_ns - t0)
            assert last.state.position[0] - began[0] == pytest.approx(seconds, abs=0.3 + 0.2 * seconds)  # lag of 0.3 s
            assert last.state.position[1] == pytest.approx(4.0, abs=0.05)
            assert last.state.velocity[0] == pytest.approx(1.0, abs=0.1)
            assert last.state.yaw == pytest.approx(0.5 * math.pi, abs=0.01)
            assert last.motors
            assert last.stopped == ""
            assert last.battery_v == pytest.approx(15.8)
            # Odometry begins at the pose passed to `open`, and faces east where the vehicle faces north.
            x, y, _ = last.odometry.pose
            assert y < -0.4
            assert abs(x) < 0.05
            assert [each.number for each in samples] == sorted({each.number for each in samples})
        with served.lock:
            assert served.vehicle.mode == "HOLD"
            assert served.vehicle.armed  # never disarmed in the air
    arming = commands(served, mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
    assert {(each.param1, each.param2) for each in arming} == {(1.0, 0.0)}  # never by force


def test_nothing_is_armed_or_switched_without_an_option() -> None:
    with MavlinkServer(Vehicle(**QUICK), UdpPort()) as served, connected(served.url) as driver:
        samples = fly(driver, 0.5, 1.0, 0.0, 1.0)
        eventually(lambda: points(served))
        assert samples[-1].stopped == "it is in POSITION: it follows commands in OFFBOARD"
        assert not samples[-1].motors
        assert not commands(served, mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
        assert not commands(served, mavlink.MAV_CMD_DO_SET_MODE)
        assert served.vehicle.state.position == (0.0, 0.0, 0.0)
        assert {(each.vx, each.vy, each.vz) for each in points(served)} == {(0.0, 0.0, 0.0)}


def test_a_driver_opens_within_the_stations_timeout() -> None:
    with pytest.raises(ScenarioError, match="<= 15"):
        call(MavlinkDriver, {"address": "udpin:0.0.0.0:1", "connect_s": 15.1}, key="driver")
    longest = call(
        MavlinkDriver,
        {"address": "udpin:0.0.0.0:1", "connect_s": 15.0, "switch_mode": True, "arm": True, "takeoff_m": 9.0},
        key="driver",
    )
    assert longest.open_deadline_s < READY_S - 5.0
    with pytest.raises(ScenarioError, match="<= 2"):
        call(MavlinkDriver, {"address": "udpin:0.0.0.0:1", "command_timeout_s": 2.1}, key="driver")


@pytest.mark.parametrize("to", ["127.0.0.1", "::1"])
def test_an_emulated_vehicle_sends_to_any_machine(to: str) -> None:
    """Not possible with a socket bound to loopback."""
    with socket.socket(socket.AF_INET6 if ":" in to else socket.AF_INET, socket.SOCK_DGRAM) as ear:
        try:
            ear.bind((to, 0))
        except OSError:
            requirements.not_allowed("IPv6")
        ear.settimeout(20.0)
        with MavlinkServer(Vehicle(**QUICK), UdpPort((to, ear.getsockname()[1]))) as served:
            _, (source, *_) = ear.recvfrom(4096)
            assert source == to
            assert served._port._socket.getsockname()[0] in ("0.0.0.0", "::")  # type: ignore[union-attr]


@pytest.mark.parametrize("options", [{"arm": True}, {"switch_mode": True, "takeoff_m": 1.0}, {"system_id": 245}])
def test_parameters_that_do_not_fit(options: dict[str, Any]) -> None:
    with pytest.raises(ScenarioError, match=r"needs|differ"):
        MavlinkDriver(address="udpin:127.0.0.1:14540", **options)


def test_refused_arming_has_a_reason() -> None:
    with MavlinkServer(Vehicle(autopilot="ardupilot", can_arm=False, **QUICK), UdpPort()) as served:
        driver = MavlinkDriver(address=served.url, system_id=1, switch_mode=True, arm=True, connect_s=1.0)
        with pytest.raises(HandshakeError, match=r"waited for it to arm \(COMPONENT_ARM_DISARM: temporarily") as caught:
            driver.open()
        assert "Arming denied: no position estimate, no valid heading and no battery to speak of" in str(caught.value)
        eventually(lambda: served.vehicle.mode == "BRAKE")
        assert not served.vehicle.armed


def test_the_pilot_takes_over_and_gives_back() -> None:
    with MavlinkServer(Vehicle(start=FLYING, **GUIDED), UdpPort()) as served, connected(served.url) as driver:
        eventually(lambda: newest(driver).stopped != "it is not armed")
        eventually(lambda: fly(driver, 0.3, 1.0, 0.0, 0.0)[-1].stopped == "")
        with served.lock:
            served.vehicle.pilot_switches("LOITER")
        eventually(lambda: "LOITER" in fly(driver, 0.1, 1.0, 0.0, 0.0)[-1].stopped)
        eventually(notice(driver, "stopped", "switched it to LOITER"))
        fly(driver, 0.5, 1.0, 0.0, 0.0)
        assert served.vehicle.mode == "LOITER"  # the driver did not switch it back
        assert not commands(served, mavlink.MAV_CMD_DO_SET_MODE)
        with served.lock:
            served.vehicle.pilot_switches("GUIDED")
        eventually(lambda: fly(driver, 0.1, 0.0, 1.0, 0.0)[-1].stopped == "")
        eventually(lambda: fly(driver, 0.1, 0.0, 1.0, 0.0)[-1].state.velocity[1] > 0.8)
        with served.lock:
            served.vehicle.pilot_switches("LOITER")
        eventually(lambda: "LOITER" in newest(driver).stopped)
    assert served.vehicle.mode == "LOITER"  # left to the pilot at the end


def test_stop_is_immediate_and_missing_commands_stop_too() -> None:
    with serve(Vehicle(start=FLYING, **GUIDED), "tcp://:0") as served, connected(served.url) as driver:
        eventually(lambda: newest(driver).stopped != "it is not armed")
        fly(driver, 0.6, 0.0, 1.0, 0.0, yaw_rate=0.3)
        driver.stop("somebody shouted")
        eventually(lambda: served.vehicle.commanded() == Velocity())
        eventually(lambda: newest(driver).stopped == "somebody shouted")  # the previous stop may still be unread
        fly(driver, 0.2, 0.0, 1.0, 0.0)
        eventually(lambda: newest(driver).stopped == "no command for 0.5 s")
        eventually(lambda: served.vehicle.commanded() == Velocity())
        with pytest.raises(ValueError, match="finite"):
            driver.write(Velocity(linear=(math.nan, 0.0, 0.0)))
    assert served.vehicle.mode == "BRAKE"
    assert served.vehicle.armed


def test_a_returning_vehicle_gets_zero_first() -> None:
    with (
        MavlinkServer(Vehicle(start=FLYING, **GUIDED), UdpPort()) as served,
        connected(served.url, silence_s=0.5, reconnect_s=30.0) as driver,
    ):
        fly(driver, 0.3, 1.0, 0.0, 0.0)
        served.mute = True
        notices: list[str] = []

        def lost() -> bool:
            notices.extend(f"{each.what} {each.cause}" for each in driver.notices())
            return any("lost no message was received for 0.5 s" in each for each in notices)

        eventually(lost)
        with served.lock:
            served.vehicle.heard.clear()
        served.mute = False
        eventually(lambda: (sample := driver.read()) is not None and sample.link == 2)
        eventually(lambda: points(served))
        assert {(each.vx, each.vy, each.vz) for each in points(served)} == {(0.0, 0.0, 0.0)}
        eventually(lambda: fly(driver, 0.1, 1.0, 0.0, 0.0)[-1].stopped == "")


def test_only_the_lost_vehicle_is_found_again_neither_switched_nor_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although no system_id was given, another vehicle sends, and the caller requests stops all the time."""
    monkeypatch.setattr(mavlink_link, "LISTEN_S", 0.5)  # five heartbeats
    port = free_ports(1)
    where = ("127.0.0.1", port)
    options: dict[str, Any] = {"system_id": 0, "switch_mode": True, "arm": True, "silence_s": 0.5, "reconnect_s": 60.0}
    with (
        MavlinkServer(Vehicle(autopilot="ardupilot", **QUICK), UdpPort(where)) as one,
        connected(f"udpin:127.0.0.1:{port}", **options) as driver,
        MavlinkServer(Vehicle(system_id=2, start=FLYING, **GUIDED), UdpPort(where)) as two,
    ):
        one.mute = True
        eventually(lambda: any(each.what == "lost" for each in driver.notices()))
        with one.lock:
            one.vehicle.pilot_switches("LOITER")
            one.vehicle.armed = False
            one.vehicle.heard.clear()
        driver.write(Velocity(linear=(1.0, 0.0, 0.0)))
        rest(0.6)
        one.mute = False

        def back() -> bool:
            driver.stop("the link is lost")
            return (sample := driver.read()) is not None and sample.link == 2

        eventually(back)
        assert driver.peer is not None
        assert driver.peer.sender.system == 1
        fly(driver, 0.55, 1.0, 0.0, 0.0)  # longer than the interval of repeated requests
        assert (one.vehicle.mode, one.vehicle.armed) == ("LOITER", False)
        assert not commands(one, mavlink.MAV_CMD_DO_SET_MODE)
        assert not commands(one, mavlink.MAV_CMD_COMPONENT_ARM_DISARM)
        with two.lock:
            assert not any(each.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for _, each in two.vehicle.heard)


def test_a_non_finite_position_is_no_sample() -> None:
    with MavlinkServer(Vehicle(start=FLYING, **GUIDED), UdpPort()) as served, connected(served.url, silence_s=0.5) as driver:
        eventually(lambda: newest(driver).motors)
        with served.lock:
            served.vehicle.blind = True

        def flies() -> bool:
            driver.write(Velocity(linear=(1.0, 0.0, 0.0)))
            sample = driver.read()
            assert sample is None or all(map(math.isfinite, sample.state.position))  # type: ignore[union-attr]
            return False

        with pytest.raises(LinkLost, match=r"no position was received for 0.5 s; check its GPS"):
            eventually(flies)
        eventually(lambda: points(served)[-1].vy == 0.0)  # the last command
        assert [vy for vy, _ in itertools.groupby(each.vy for each in points(served))][-2:] == [1.0, 0.0]


def test_garbage_and_other_senders_have_no_effect() -> None:
    port = free_ports(1)
    noise = bytes(range(256)) * 4
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        MavlinkServer(Vehicle(start=FLYING, **GUIDED), UdpPort(("127.0.0.1", port))),
    ):
        stranger.connect(("127.0.0.1", port))
        with connected(f"udpin:127.0.0.1:{port}") as driver:
            false = mavlink.MAVLink_local_position_ned_message(1, 999.0, 999.0, 999.0, 0.0, 0.0, 0.0)
            forged = false.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
            for _ in range(30):
                stranger.send(noise)
                stranger.send(forged)
                for sample in fly(driver, 0.01, 1.0, 0.0, 0.0):
                    assert abs(sample.state.position[0]) < 10.0
            eventually(lambda: fly(driver, 0.1, 1.0, 0.0, 0.0)[-1].state.velocity[0] > 0.5)


def test_a_vehicle_is_answered_whose_address_other_senders_have_displaced() -> None:
    port = free_ports(1)
    link = open_link(f"udpin:127.0.0.1:{port}", 57_600)
    with ExitStack() as stack:
        stack.callback(link.close)
        vehicle, *others = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(SOURCES + 2))
        for sender in (vehicle, *others):
            sender.connect(("127.0.0.1", port))
            sender.send(b"here")
        sources = [source for source, _ in link.read()]
        link.answer(sources[0])
        vehicle.send(b"here again")
        assert link.read() == [(sources[0], b"here again")]
        link.write(b"set-point")
        vehicle.settimeout(20.0)
        assert vehicle.recv(100) == b"set-point"


def test_wrong_ids_and_addresses(stack: ExitStack) -> None:
    nobody = stack.enter_context(reserve_port())
    with MavlinkServer(Vehicle(system_id=3, **QUICK), UdpPort()) as served:
        with pytest.raises(HandshakeError, match=r"system 1 was not received within 0.8 s, only system 3"):
            MavlinkDriver(address=served.url, system_id=1, connect_s=0.8).open()
        with pytest.raises(HandshakeError, match=r"no byte was received within 0.2 s; let the autopilot"):
            MavlinkDriver(address=f"udpin:127.0.0.1:{free_ports(1)}", connect_s=0.2).open()
    for address, message in {
        "udp:1.2.3.4:5": "not an address; write udpin",
        "udpin:127.0.0.1:99999": "invalid port 99999",
        f"tcp:127.0.0.1:{nobody}": "nothing listens",
        "/dev/no-such-port": "there is no such port",
    }.items():
        with pytest.raises(PortError, match=message):
            MavlinkDriver(address=address).open()


def test_a_rover_takes_forward_speed_and_sends_global_positions() -> None:
    rover = Vehicle(kind="rover", start=(5.0, 6.0, 0.0, 0.5 * math.pi), old=True, **GUIDED)
    with serve(rover, "tcp://:0") as served:
        options: dict[str, Any] = {
            "geodetic_origin": SITE,
            "origin": (100.0, 200.0, 0.0),
            "connect_s": 15.0,
            "telemetry_hz": 20.0,
        }
        with connected(served.url, **options) as driver:
            first = newest(driver)
            assert first.state.position == pytest.approx((105.0, 206.0, 0.0), abs=0.05)
            eventually(lambda: newest(driver).motors)
            eventually(lambda: fly(driver, 0.1, 0.8, 0.0, 0.0)[-1].odometry.v > 0.75)
            last = fly(driver, 0.3, 0.8, 0.0, 0.0)[-1]
            assert last.state.velocity[1] == pytest.approx(0.8, abs=0.15)  # it faces north
            assert last.odometry.v == pytest.approx(0.8, abs=0.1)
            eventually(lambda: fly(driver, 0.1, 0.0, 0.0, 0.0, yaw_rate=0.5)[-1].odometry.w > 0.45)
            turning = fly(driver, 0.3, 0.0, 0.0, 0.0, yaw_rate=0.5)[-1]
            assert turning.odometry.w == pytest.approx(0.5, abs=0.08)
            with pytest.raises(RuntimeError, match="already open"):
                driver.open()
    assert served.vehicle.mode == "HOLD"


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_all_interfaces_need_an_option(host: str) -> None:
    with pytest.raises(PortError, match=r"admits anyone .* add insecure = true"):
        open_link(f"udpin:{host}:14540", 57_600)
