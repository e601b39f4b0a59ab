"""ArcosDriver on pseudo-terminals and TCP connections, against the emulated robot in real time."""

import os
import pty
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.cosim.run_processes import reserve_port
from tests.support.hardware import driver_runs
from tests.support.hardware.driver_runs import drive, error_of, eventually
from tests.support.paths import ROOT
from vcmvsp.cosim.types import ORIGIN, Vec3, Velocity
from vcmvsp.hardware.drivers.arcos.driver import ArcosDriver
from vcmvsp.hardware.drivers.arcos.protocol import Command, command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.drivers.base import Driver, DriverError, HandshakeError, LinkLost, Notice, PortError
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import ArcosServer, serve_pty, serve_tcp

pytestmark = [pytest.mark.processes, pytest.mark.sockets, pytest.mark.usefixtures("steady")]
IMPATIENT = msgspec.structs.replace(ROBOTS["amigo"], watchdog_s=0.8)  # longer than the driver's command timeout


def connected(port: str, start: Vec3 = ORIGIN, **options: Any) -> AbstractContextManager[ArcosDriver]:
    return driver_runs.open_driver(ArcosDriver(port, **options), start)


def heard(served: ArcosServer) -> list[tuple[int, int | bytes | None]]:
    with served.lock:
        return [(number, argument) for _, number, argument in served.device.heard]


def stands(served: ArcosServer) -> bool:
    with served.lock:
        return served.device.commanded() == (0.0, 0.0)


def what(driver: Driver) -> list[str]:
    return [each.what for each in driver.notices()]


def test_a_drive_on_a_terminal_and_a_gentle_end() -> None:
    with serve_pty(Device(ROBOTS["amigo"], name="rosa")) as served:
        with connected(served.url, robot="amigo") as driver:
            assert isinstance(driver, Driver)
            samples = drive(driver, 1.6, v=0.2)
            assert [each.cause for each in driver.notices()] == ["rosa, AmigoBot"]
        eventually(lambda: not served.device.is_open)
        assert heard(served)[-2:] == [(Command.ENABLE, 0), (Command.CLOSE, 1)]
        with served.lock:
            moving = max(time_ns for time_ns, number, value in served.device.heard if (number, value) == (Command.VEL, 200))
            off = next(time_ns for time_ns, number, value in served.device.heard if (number, value) == (Command.ENABLE, 0))
        assert off - moving > 250_000_000  # brakes to a standstill first, from 0.2 m/s at 0.75 m/s2
    x, y, yaw = samples[-1].odometry.pose
    assert 0.15 <= x <= 0.34
    assert (y, yaw) == (0.0, 0.0)
    assert samples[-1].odometry.v == pytest.approx(0.2, abs=0.001)
    count = samples[-1].number - samples[0].number
    seconds = (samples[-1].measured_ns - samples[0].measured_ns) / 1e9
    assert count / seconds == pytest.approx(10.0, rel=0.1)
    assert all(each.motors and not each.stopped for each in samples[2:])
    assert {number for each in samples for number, _ in each.sonar} == set(range(8))


def test_a_disabled_watchdog_is_warned_of() -> None:
    with (
        serve_pty(Device(msgspec.structs.replace(ROBOTS["amigo"], watchdog_s=0.0))) as served,
        connected(served.url, max_speed=1.5) as driver,
    ):
        off, fast = [each.cause for each in driver.notices() if each.what == "warned"]
        assert "watchdog is off" in off
        assert "max_speed = 1.5 m/s" in fast


def test_both_wheels_in_one_command_over_tcp_from_a_start_pose() -> None:
    with serve_tcp(Device(ROBOTS["p2dx"])) as served, connected(served.url, start=(5.0, 6.0, 1.5), mode="vel2") as driver:
        samples = drive(driver, 1.2, v=0.2, w=0.25)
        assert samples[-1].odometry.v == pytest.approx(0.2, abs=0.01)
        assert samples[-1].odometry.w == pytest.approx(0.25, abs=0.06)  # one step of 20 mm/s on one side
        assert samples[-1].odometry.pose[2] > 1.6
        assert samples[-1].odometry.pose[1] > 6.1
        numbers = [number for number, _ in heard(served)]
        assert Command.VEL2 in numbers
        assert Command.VEL not in numbers[numbers.index(Command.VEL2) :]


@pytest.mark.parametrize("cause", ["left the field", "no command for 0.5 s"])
def test_stop_timeout_and_stop_button_stop_it_with_a_notice(cause: str) -> None:
    with serve_pty(Device(ROBOTS["amigo"])) as served, connected(served.url) as driver:
        eventually(lambda: drive(driver, 0.4, v=0.2) and not stands(served))
        if cause == "left the field":
            driver.stop(cause)
        eventually(lambda: stands(served))
        eventually(lambda: (sample := driver.read()) is not None and sample.stopped == cause)
        assert [(each.what, each.cause) for each in driver.notices()][1:] == [("stopped", cause)]
        with served.lock:
            served.device.estop_pressed = True
        eventually(lambda: (sample := driver.read()) is not None and sample.emergency_stop and not sample.motors)
        batches: list[list[Notice]] = []
        eventually(lambda: (new := driver.notices()) and not batches.append(new))  # type: ignore[func-returns-value]
        assert [each.cause for each in batches[0]] == ["the robot has switched its motors off: its stop button is pressed"]


def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    """Unplugged in motion, stopped by its watchdog, session still open: the robot must not move again."""
    link = tmp_path / "robot"
    first = serve_pty(Device(ROBOTS["amigo"]), link=link)
    with connected(str(link), reconnect_s=20.0) as driver:
        before = drive(driver, 1.0, v=0.2)[-1]
        first.close()
        eventually(lambda: "lost" in what(driver))
        driver.read()  # does not raise
        driver.write(Velocity(linear=(0.2, 0.0, 0.0)))  # dropped

        robot = Device(ROBOTS["amigo"], old_session=True)
        robot.receive(command(Command.VEL, 200) + command(Command.RVEL, 20), 0)
        robot.watchdog_stopped = True
        with serve_pty(robot, link=link) as again:
            eventually(lambda: "connected" in what(driver))
            eventually(lambda: driver.read() is not None)
            assert heard(again)[2:5] == [(Command.VEL, 0), (Command.RVEL, 0), (Command.PULSE, None)]  # after the commands above
            assert all(value == 0 for number, value in heard(again)[2:] if number in (Command.VEL, Command.RVEL))
            assert stands(again)
            with again.lock:
                assert robot.odometry == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
            sample = drive(driver, 0.6, v=0.2)[-1]
            assert sample.link == 2
            assert sample.odometry.pose[0] > before.odometry.pose[0]


@pytest.mark.parametrize("serve", [serve_pty, serve_tcp])
def test_unplugged_for_good(serve: Callable[[Device], ArcosServer]) -> None:
    served = serve(Device(ROBOTS["amigo"]))
    with connected(served.url) as driver:
        drive(driver, 0.3, v=0.1)
        served.close()
        eventually(lambda: isinstance(error_of(driver), LinkLost))
        assert str(error_of(driver)).startswith(f"robot at {served.url}: ")
        with pytest.raises(LinkLost):
            driver.write(Velocity())
        driver.stop("too late")  # does not raise
        assert what(driver) == ["connected", "lost", "stopped"]


def test_not_back_in_time() -> None:
    served = serve_tcp(Device(ROBOTS["amigo"]))
    with connected(served.url, reconnect_s=0.7) as driver:
        served.close()
        with pytest.raises(LinkLost, match=r"connection, and the link did not return within 0.7 s \(nothing listens"):
            drive(driver, 10.0)


def test_a_silent_robot() -> None:
    with serve_pty(Device(ROBOTS["amigo"])) as served, connected(served.url, silence_s=0.5) as driver:
        drive(driver, 0.3)
        with served.lock, pytest.raises(LinkLost, match=r"no packet was received for 0\.5 s; check the robot's battery"):
            drive(driver, 10.0)  # the lock blocks the emulated robot


def test_calls_never_block() -> None:
    """Even if the robot hangs and reads nothing, until the port is full."""
    with serve_pty(Device(ROBOTS["amigo"])) as served, connected(served.url, silence_s=60.0) as driver, served.lock:
        longest = 0.0
        for _ in range(200):
            begin = time.monotonic()
            driver.write(Velocity(linear=(0.1, 0.0, 0.0)))
            driver.read()
            driver.stop("x")
            longest = max(longest, time.monotonic() - begin)
        assert longest < 1.0  # generous: the machine may be loaded


def refusal(port: str, **options: Any) -> DriverError:
    before = threading.active_count()
    driver = ArcosDriver(port, **options)
    with pytest.raises(DriverError) as error:
        driver.open()
    assert threading.active_count() == before
    assert f"robot at {port}: " in str(error.value)
    assert error.value.exit_code == 3
    return error.value


def test_ports_that_cannot_be_opened(tmp_path: Path) -> None:
    missing = refusal(str(tmp_path / "ttyUSB7"))
    assert isinstance(missing, PortError)
    assert "there is no such port; available ports: " in str(missing)
    plain = tmp_path / "plain"
    plain.write_text("x")
    assert "not a serial port" in refusal(str(plain)).happened
    assert "not a serial port" in refusal(str(tmp_path)).happened
    assert "socket://localhost:8101" in refusal("socket://robot").advice
    assert "socket://localhost:8101" in refusal("socket://robot:x").advice
    assert "unknown kind of port" in refusal("udp://robot:1").happened
    with reserve_port() as nobody:
        for scheme in ("socket", "tcp"):
            assert f"nothing listens on port {nobody} of 127.0.0.1" in refusal(f"{scheme}://127.0.0.1:{nobody}").happened


def test_a_port_without_permission(monkeypatch: pytest.MonkeyPatch) -> None:
    def deny(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("serial.serialposix.os.open", deny)
    error = refusal("/dev/ttyUSB0")
    assert "access is denied; join the group that owns it" in str(error)


def test_a_port_may_not_be_used_twice() -> None:
    with serve_pty(Device(ROBOTS["amigo"])) as served, connected(served.url) as driver:
        error = refusal(served.url)
        assert isinstance(error, PortError)
        assert "it is in use; close the other program" in str(error)
        assert drive(driver, 0.3)
        with pytest.raises(RuntimeError, match="already open"):
            driver.open()


def test_the_wrong_robot() -> None:
    with serve_pty(Device(ROBOTS["p2dx"])) as served:
        error = refusal(served.url, robot="amigo")
        assert isinstance(error, HandshakeError)
        assert "the robot is of kind p2dx (emulated), not amigo" in error.happened
        with connected(served.url, robot="p2dx") as driver:  # the port is free again
            assert driver.robot is ROBOTS["p2dx"]


def test_closing_does_not_wait_for_a_robot_that_does_not_answer() -> None:
    ends = pty.openpty()
    driver = ArcosDriver(os.ttyname(ends[1]), connect_s=60.0)
    with ThreadPoolExecutor(1) as pool:
        opening = pool.submit(driver.open)
        eventually(lambda: driver._thread is not None and driver._line is not None)
        begin = time.monotonic()
        driver.close()
        assert time.monotonic() - begin < driver.close_deadline_s
        with pytest.raises(HandshakeError, match="the driver was closed while connecting"):
            opening.result(5.0)
    for end in ends:
        os.close(end)


def test_a_process_ends_without_close_and_its_robot_stops() -> None:
    code = "import sys; from vcmvsp.hardware.drivers.arcos.driver import ArcosDriver; ArcosDriver(sys.argv[1]).open()"
    with serve_pty(Device(IMPATIENT)) as served:
        subprocess.run([sys.executable, "-c", code, served.url], check=True, timeout=500, cwd=ROOT)
        eventually(lambda: served.device.watchdog_stopped)
