"""Stations as processes of their own: with a robot in software, and with an emulated one on a real pseudo-terminal."""

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
from tests.support.hardware.stations import BENCH, driven, mission
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

PATIENT = msgspec.structs.replace(ROBOTS["amigo"], watchdog_s=60.0)  # it is not the robot's own watchdog that stops it
HERE = ROOT


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Stations listen to nobody else, and those that are killed leave nothing behind."""
    with tempfile.TemporaryDirectory(prefix="vcmvsp-", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


def arcos(served: ArcosServer) -> PartSpec:
    return PartSpec(group="driver", kind="arcos", params={"port": served.url, "accel": 2.0, "decel": 2.0})


def drives(report: StationReport) -> bool:
    return report.odometry is not None and report.odometry.v > 0.1


def zero_ns(served: ArcosServer, after_ns: int) -> int | None:
    """When the robot was first told zero speed after that, on its own clock."""
    with served.lock:
        heard = list(served.device.heard)
    return next((ns for ns, number, value in heard if ns >= after_ns and number == Command.VEL and not value), None)


def driven_ns(served: ArcosServer) -> int:
    """When the robot was last told to drive, on its own clock."""
    with served.lock:
        heard = list(served.device.heard)
    return next((ns for ns, number, value in reversed(heard) if number == Command.VEL and value), 0)


def test_a_robot_drives_and_its_state_is_told() -> None:
    def is_there(report: StationReport) -> bool:
        return report.odometry is not None and report.odometry.pose[0] > 0.3 and report.odometry.v > 0.39 and not report.causes

    with driven(mission()) as run:
        report = run.until(is_there, v=0.4)
        assert report.state is not None
        assert report.state.position[0] == pytest.approx(report.odometry.pose[0], abs=0.25) if report.odometry else False
        assert report.state.velocity[0] == pytest.approx(0.4, abs=0.05)
        assert report.sent is not None
        assert report.sent.linear[0] == pytest.approx(0.4)
        assert report.causes == ()
        assert report.order > 0
        numbers = [each.number for each in run.said]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        speeds = [each.sent.linear[0] for each in run.said if each.sent is not None]
        assert max(speeds) <= 0.4
        run.station.leave()
        last = run.station.close()
    assert last[-1].failed == ""
    assert run.notices == [("connected", "a robot in software")]
    run.said += last
    assert run.notices[1:] == [("stopped", "the run is over")]


def test_a_station_whose_turns_take_too_long_hears_its_run_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\n"
        "from vcmvsp.hardware.drivers.bench_robot import Bench\n"
        "class Slow(Bench):\n"
        "    def read(self):\n"
        "        time.sleep(0.05)\n"
        "        return super().read()\n"
    )
    told = mission(PartSpec(group="driver", kind="slow.py:Slow", params=BENCH.params))
    with driven(msgspec.structs.replace(told, folder=str(tmp_path))) as run:
        report = run.until(drives, v=0.4)
        assert report.late_s > 0.0


def test_positions_of_a_tag_are_fused() -> None:
    port = free_ports(1)
    tag = PartSpec(
        group="localisation",
        kind="vcmvsp.hardware.localisation.ubisense:Ubisense",
        params={"listen": f"udp://127.0.0.1:{port}"},
    )
    told = msgspec.structs.replace(mission(), localisation=tag, fusion={"start_sigma_m": 0.5, "noise": {"turn": 0.02}})
    with driven(told) as run, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine:

        def hears(report: StationReport) -> bool:
            datagram = struct.pack(">HHQIffffQ", 0xE298, 0x026B, 7, 1, 0.2, 0.1, 0.0, 0.01, time.time_ns())
            engine.sendto(datagram, ("127.0.0.1", port))
            there = report.state is not None and report.state.position[1] > 0.05
            return bool(report.fixes) and there and not report.causes

        report = run.until(hears, v=0.0)
        assert report.fixes[0].position[:2] == pytest.approx((0.2, 0.1))
        assert report.fix_age_s is not None


def test_an_order_that_cannot_be_read_stops_the_robot_and_ends_the_station() -> None:
    with serve_pty(Device(PATIENT)) as served, driven(mission(arcos(served))) as run:
        run.until(drives, v=0.2)
        assert run.station._link.send(b"\x81\xa3bad")
        with pytest.raises(DriverError, match="an invalid order"):
            run.until(lambda _: False, v=None)
        eventually(lambda: not served.device.is_open)
        assert served.device.motion.wanted(0.0) == (0.0, 0.0)
    assert run.said[-1].failed


def test_a_robot_that_is_unplugged_is_named() -> None:
    with serve_pty(Device(PATIENT)) as served, driven(mission(arcos(served), vehicle="car7")) as run:
        run.until(drives, v=0.2)
        served.close()
        with pytest.raises(DriverError, match=f"the robot of car7: {served.url}: .*unplugged"):
            run.until(lambda _: False, v=0.2)


@pytest.fixture
def hanging(tmp_path: Path) -> Callable[..., StationMission]:
    """A mission with somebody's own driver, that hangs when it is asked for something."""
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


def test_a_driver_that_hangs_is_given_up(hanging: Callable[..., StationMission]) -> None:
    with ExitStack() as stack:
        opening, leaving, turning = (Station.start(hanging(where)) for where in ("open", "open", "read"))
        for each in (opening, leaving, turning):
            stack.callback(each.close)
        last = leaving.close()  # who hangs while it opens hears that nobody needs it any more
        assert last[-1].failed == ""
        with pytest.raises(DriverError, match=r"nowhere: the driver hangs: opening it took longer than 2\.1 s"):
            opening.wait_ready()
        with pytest.raises(DriverError, match=r"car2: the driver hangs: a turn of its station took longer than 3 s"):
            turning.wait_ready()


def test_a_station_that_does_not_say_that_it_is_ready_is_ended(hanging: Callable[..., StationMission]) -> None:
    stuck = Station.start(hanging("open", open_s=60.0))
    os.kill(stuck.pid, signal.SIGSTOP)
    with pytest.raises(DriverError, match="did not connect to the robot in time"):
        stuck.wait_ready(time.monotonic() + 0.3)
    assert stuck.close()[-1].failed


def test_a_port_that_is_in_use_and_one_that_is_not_there() -> None:
    with ExitStack() as stack:
        nowhere = Station.start(mission(PartSpec(group="driver", kind="arcos", params={"port": "/dev/ttyNONE"})))
        wrong = Station.start(mission(PartSpec(group="driver", kind="arcos", params={"prot": "x"})))
        served = stack.enter_context(serve_pty(Device(PATIENT)))
        stack.enter_context(driven(mission(arcos(served))))
        second = Station.start(mission(arcos(served), vehicle="car2"))
        for each in (nowhere, wrong, second):
            stack.callback(each.close)
        with pytest.raises(DriverError, match=f"the robot of car2: {served.url}: it is in use; close the other program"):
            second.wait_ready()
        with pytest.raises(DriverError, match="/dev/ttyNONE: there is no such port"):
            nowhere.wait_ready()
        with pytest.raises(DriverError, match=r"driver\.prot: .*correct the scenario"):
            wrong.wait_ready()


def test_a_station_that_was_killed_is_said_to_have_been() -> None:
    with driven(mission()) as run:
        run.until(drives, v=0.4)
        os.kill(run.station.pid, signal.SIGKILL)
        with pytest.raises(DriverError, match="was killed by SIGKILL; the robot's own watchdog"):
            run.until(lambda _: False, v=0.4)


def test_a_station_that_is_told_to_end_stops_its_robot() -> None:
    with serve_pty(Device(PATIENT)) as served, driven(mission(arcos(served))) as run:
        run.until(drives, v=0.2)
        os.kill(run.station.pid, signal.SIGINT)  # this one is not heard
        run.until(drives, v=0.2)
        os.kill(run.station.pid, signal.SIGTERM)
        with pytest.raises(DriverError, match="SIGTERM"):
            run.until(lambda _: False, v=0.2)
        eventually(lambda: not served.device.is_open)


def test_nothing_waits_for_a_station_that_hangs() -> None:
    with driven(mission()) as run:
        run.until(drives, v=0.4)
        os.kill(run.station.pid, signal.SIGSTOP)
        for _ in range(2000):  # more than the link holds
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
    """A run in a process of its own, which drives the robot; at the end it is killed, and its station ends."""
    command = [sys.executable, "-c", RUN, encode(mission(arcos(robot), **limits)).hex()]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE, start_new_session=True)
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
    assert told_ns - killed_ns < 5_000_000_000  # some ms on a machine that is not loaded
    eventually(lambda: not robot.device.is_open)
    with driven(mission(arcos(robot))) as again:  # nobody holds its port any more
        again.until(drives, v=0.2)


def test_when_the_run_is_frozen_the_robot_stops_until_it_is_back(robot: ArcosServer) -> None:
    with another_run(robot, federation_s=1.5) as run:
        frozen_ns = robot.now_ns
        run.send_signal(signal.SIGSTOP)
        eventually(lambda: driven_ns(robot) > frozen_ns + 500_000_000)
        eventually(lambda: zero_ns(robot, driven_ns(robot)) is not None)
        told_ns = zero_ns(robot, driven_ns(robot))
        assert told_ns is not None
        assert told_ns - frozen_ns < 8_000_000_000  # 1.5 s and a turn, on a machine that is not loaded
        run.send_signal(signal.SIGCONT)
        eventually(lambda: is_driving(robot))  # the run is back, and says so
