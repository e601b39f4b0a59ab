"""Stations in processes of their own, with a simulated robot and with an emulated one on a pseudo-terminal."""

import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.hardware.driver_runs import eventually
from tests.support.hardware.stations import BENCH, mission, ready_station
from tests.support.netsim.gateway_context import free_ports
from tests.support.paths import ROOT
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.arcos.protocol import Command
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import ArcosServer, serve_pty
from vcmvsp.hardware.station.messages import PartSpec, StationMission, StationReport
from vcmvsp.hardware.stations import Station

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

PATIENT = msgspec.structs.replace(ROBOTS["amigo"], watchdog_s=60.0)  # the robot's own watchdog must not stop it


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Isolates stations from others, and removes the files of killed ones."""
    with tempfile.TemporaryDirectory(prefix="vcmvsp-", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


def arcos(served: ArcosServer) -> PartSpec:
    return PartSpec(group="driver", kind="arcos", params={"port": served.url, "accel": 2.0, "decel": 2.0})


def drives(report: StationReport) -> bool:
    return report.odometry is not None and report.odometry.v > 0.1


def speeds_of(served: ArcosServer) -> list[tuple[int, Any]]:
    """Speed commands so far, with their times on the robot's clock."""
    with served.lock:
        return [(ns, value) for ns, number, value in served.device.heard if number == Command.VEL]


def zero_ns(served: ArcosServer, after_ns: int) -> int | None:
    """First time of a zero speed command after ``after_ns``, or None."""
    return next((ns for ns, value in speeds_of(served) if ns >= after_ns and not value), None)


def driven_ns(served: ArcosServer) -> int:
    """Time of the last non-zero speed command."""
    return max((ns for ns, value in speeds_of(served) if value), default=0)


def test_a_robot_drives_and_reports_its_state() -> None:
    def is_there(report: StationReport) -> bool:
        return report.odometry is not None and report.odometry.pose[0] > 0.3 and report.odometry.v > 0.39 and not report.causes

    with ready_station(mission()) as run:
        report = run.until(is_there, v=0.4)
        assert report.state.position[0] == pytest.approx(report.odometry.pose[0], abs=0.25)
        assert report.state.velocity[0] == pytest.approx(0.4, abs=0.05)
        assert report.sent.linear[0] == pytest.approx(0.4)
        assert report.causes == ()
        assert report.order > 0
        numbers = [each.number for each in run.reports]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        speeds = [each.sent.linear[0] for each in run.reports if each.sent is not None]
        assert max(speeds) <= 0.4
        run.station.leave()
        last = run.station.close()
    assert last[-1].failed == ""
    assert run.notices == [("connected", "a robot in software")]
    run.reports += last
    assert run.notices[1:] == [("stopped", "the run is over")]


def test_a_station_with_slow_turns_still_receives_orders(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\n"
        "from vcmvsp.hardware.drivers.bench_robot import Bench\n"
        "class Slow(Bench):\n"
        "    def read(self):\n"
        "        time.sleep(0.05)\n"
        "        return super().read()\n"
    )
    station_mission = mission(PartSpec(group="driver", kind="slow.py:Slow", params=BENCH.params))
    with ready_station(msgspec.structs.replace(station_mission, folder=str(tmp_path))) as run:
        report = run.until(drives, v=0.4)
        assert report.late_s > 0.0


def test_positions_of_a_tag_are_fused() -> None:
    port = free_ports(1)
    tag = PartSpec(
        group="localisation",
        kind="vcmvsp.hardware.localisation.ubisense:Ubisense",
        params={"listen": f"udp://127.0.0.1:{port}"},
    )
    station_mission = msgspec.structs.replace(
        mission(), localisation=tag, fusion={"start_sigma_m": 0.5, "noise": {"turn": 0.02}}
    )
    with ready_station(station_mission) as run, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine:

        def hears(report: StationReport) -> bool:
            datagram = struct.pack(">HHQIffffQ", 0xE298, 0x026B, 7, 1, 0.2, 0.1, 0.0, 0.01, time.time_ns())
            engine.sendto(datagram, ("127.0.0.1", port))
            there = report.state is not None and report.state.position[1] > 0.05
            return bool(report.fixes) and there and not report.causes

        report = run.until(hears, v=0.0)
        assert report.fixes[0].position[:2] == pytest.approx((0.2, 0.1))


def test_an_unreadable_order_stops_the_robot_and_ends_the_station() -> None:
    with serve_pty(Device(PATIENT)) as served, ready_station(mission(arcos(served))) as run:
        run.until(drives, v=0.2)
        assert run.station._link.send(b"\x81\xa3bad")
        with pytest.raises(DriverError, match="an invalid order"):
            run.until(lambda _: False, v=None)
        eventually(lambda: not served.device.is_open)
        assert served.device.motion.target_speeds(0.0) == (0.0, 0.0)
    assert run.reports[-1].failed


def test_an_unplugged_robot_is_named() -> None:
    with serve_pty(Device(PATIENT)) as served, ready_station(mission(arcos(served), vehicle="car7")) as run:
        run.until(drives, v=0.2)
        served.close()
        with pytest.raises(DriverError, match=f"the robot of car7: {served.url}: .*unplugged"):
            run.until(lambda _: False, v=0.2)


@pytest.fixture
def hanging(tmp_path: Path) -> Callable[..., StationMission]:
    """A mission with a custom driver that hangs in the method ``where``."""
    (tmp_path / "hanging.py").write_text(
        "import time\n"
        "class Hanging:\n"
        "    device, close_deadline_s = 'nowhere', 0.1\n"
        "    def __init__(self, *, where: str, open_s: float): self.where, self.open_deadline_s = where, open_s\n"
        "    def write(self, velocity): ...\n"
        "    def __getattr__(self, name):\n"
        "        return lambda *_: time.sleep(1000) if name == self.where else [] if name == 'notices' else None\n"
    )

    def told(where: str, open_s: float = 0.1) -> StationMission:
        driver = PartSpec(group="driver", kind="hanging.py:Hanging", params={"where": where, "open_s": open_s})
        return msgspec.structs.replace(mission(driver, vehicle="car2"), folder=str(tmp_path))

    return told


def test_a_hanging_driver_times_out(hanging: Callable[..., StationMission]) -> None:
    with ExitStack() as stack:
        opening, leaving, turning = (Station.start(hanging(where)) for where in ("open", "open", "read"))
        for each in (opening, leaving, turning):
            stack.callback(each.close)
        last = leaving.close()  # a close while the driver still opens ends the station
        assert last[-1].failed == ""
        with pytest.raises(DriverError, match=r"nowhere: the driver hangs: opening it took longer than 2\.1 s"):
            opening.wait_ready()
        with pytest.raises(DriverError, match=r"car2: the driver hangs: a turn of its station took longer than 3 s"):
            turning.wait_ready()


def test_a_station_not_ready_in_time_is_ended(hanging: Callable[..., StationMission]) -> None:
    stuck = Station.start(hanging("open", open_s=60.0))
    os.kill(stuck.pid, signal.SIGSTOP)
    with pytest.raises(DriverError, match="did not connect to the robot in time"):
        stuck.wait_ready(time.monotonic() + 0.3)
    assert stuck.close()[-1].failed


def test_a_port_in_use_and_a_missing_one() -> None:
    with ExitStack() as stack:
        nowhere = Station.start(mission(PartSpec(group="driver", kind="arcos", params={"port": "/dev/ttyNONE"})))
        wrong = Station.start(mission(PartSpec(group="driver", kind="arcos", params={"prot": "x"})))
        served = stack.enter_context(serve_pty(Device(PATIENT)))
        stack.enter_context(ready_station(mission(arcos(served))))
        second = Station.start(mission(arcos(served), vehicle="car2"))
        for each in (nowhere, wrong, second):
            stack.callback(each.close)
        with pytest.raises(DriverError, match=f"the robot of car2: {served.url}: it is in use; close the other program"):
            second.wait_ready()
        with pytest.raises(DriverError, match="/dev/ttyNONE: there is no such port"):
            nowhere.wait_ready()
        with pytest.raises(DriverError, match=r"driver\.prot: .*correct the scenario"):
            wrong.wait_ready()


def test_a_killed_station_is_reported() -> None:
    with ready_station(mission()) as run:
        run.until(drives, v=0.4)
        os.kill(run.station.pid, signal.SIGKILL)
        with pytest.raises(DriverError, match="was killed by SIGKILL; the robot's own watchdog"):
            run.until(lambda _: False, v=0.4)


def test_a_terminated_station_stops_its_robot() -> None:
    with serve_pty(Device(PATIENT)) as served, ready_station(mission(arcos(served))) as run:
        run.until(drives, v=0.2)
        os.kill(run.station.pid, signal.SIGINT)  # a station ignores SIGINT
        run.until(drives, v=0.2)
        os.kill(run.station.pid, signal.SIGTERM)
        with pytest.raises(DriverError, match="SIGTERM"):
            run.until(lambda _: False, v=0.2)
        eventually(lambda: not served.device.is_open)


def test_a_hanging_station_blocks_nothing() -> None:
    with ready_station(mission()) as run:
        run.until(drives, v=0.4)
        os.kill(run.station.pid, signal.SIGSTOP)
        for _ in range(2000):  # more than the link's capacity
            run.order(0.4)
        assert run.station.close(time.monotonic() + 0.5)[-1].failed == "its station did not end in time and was killed"


RUN = """
import sys, time
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.stations import Station
from vcmvsp.hardware.station.messages import StationOrder, missions

station = Station.start(missions.decode(bytes.fromhex(sys.argv[1])))
station.wait_ready()
print(station.pid, flush=True)
for number in range(1, 10**6):
    now_ns = time.monotonic_ns()
    station.order(StationOrder(number=number, sent_ns=now_ns, command=Velocity(linear=(0.2, 0.0, 0.0)), command_ns=now_ns))
    station.reports()
    time.sleep(0.05)
"""


@pytest.fixture
def robot() -> Iterator[ArcosServer]:
    with serve_pty(Device(PATIENT)) as served:
        yield served


def is_driving(served: ArcosServer) -> bool:
    with served.lock:
        return served.device.commanded()[0] > 0.15


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@contextmanager
def another_run(robot: ArcosServer, **limits: Any) -> Iterator["subprocess.Popen[str]"]:
    """A run in a process of its own that drives the robot; it is killed at the end, and its station ends."""
    command = [sys.executable, "-c", RUN, encode(mission(arcos(robot), **limits)).hex()]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, start_new_session=True)
    try:
        assert run.stdout is not None
        assert select.select([run.stdout], [], [], 30.0)[0]
        station = int(run.stdout.readline())
        eventually(lambda: is_driving(robot))
        yield run
    finally:
        run.kill()
        run.communicate(timeout=10)
    eventually(lambda: not lives(station))


def test_when_the_run_is_killed_the_robot_stops_and_the_port_is_free(robot: ArcosServer) -> None:
    with another_run(robot):
        killed_ns = robot.now_ns
    told_ns = zero_ns(robot, killed_ns)
    assert told_ns is not None
    assert told_ns - killed_ns < 5_000_000_000  # some ms without load
    eventually(lambda: not robot.device.is_open)
    with ready_station(mission(arcos(robot))) as again:  # the port is free again
        again.until(drives, v=0.2)


def test_when_the_run_is_frozen_the_robot_stops_until_it_is_back(robot: ArcosServer) -> None:
    with another_run(robot, federation_s=1.5) as run:
        frozen_ns = robot.now_ns
        run.send_signal(signal.SIGSTOP)
        eventually(lambda: driven_ns(robot) > frozen_ns + 500_000_000)
        eventually(lambda: zero_ns(robot, driven_ns(robot)) is not None)
        told_ns = zero_ns(robot, driven_ns(robot))
        assert told_ns is not None
        assert told_ns - frozen_ns < 8_000_000_000  # 1.5 s plus one turn without load
        run.send_signal(signal.SIGCONT)
        eventually(lambda: is_driving(robot))  # the run continues to send orders
