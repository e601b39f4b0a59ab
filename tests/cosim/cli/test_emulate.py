"""``vcmvsp emulate``: drivers and readers connect to the printed address; at the end no process and no link is left."""

import json
import math
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import pytest
import serial  # type: ignore[import-untyped]

from tests.support.cosim.command_line import assert_refused, vcmvsp_command
from tests.support.cosim.forked_programs import ForkedProgram
from tests.support.cosim.run_processes import reserve_port
from tests.support.hardware.driver_runs import open_resources
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.drivers.arcos.driver import ArcosDriver
from vcmvsp.hardware.drivers.arcos.protocol import Command, PacketReader, command, is_sip
from vcmvsp.hardware.drivers.base import Sample
from vcmvsp.hardware.drivers.ros2.driver import Ros2Driver
from vcmvsp.hardware.localisation import ubisense

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

WALL = """
name = "wall"
duration_s = 1.0
[world]
kind = "boxes"
boxes = [{ center = [0.75, 0.0, 0.5], size = [0.2, 4.0, 1.0] }]
[[vehicle]]
name = "rosa"
kind = "amigobot"
"""
FACE_M = 0.65  # x of the wall's near side
PATIENCE_S = 60.0


class Emulated:
    """A running command and its output."""

    def __init__(self, *arguments: str) -> None:
        reads, writes = os.pipe()
        self.process = ForkedProgram("emulate", *arguments, folder=Path.cwd(), environment=os.environ, stdout=writes)
        os.close(writes)
        self.stdout = os.fdopen(reads)

    def line(self) -> str:
        assert select.select([self.stdout], [], [], PATIENCE_S)[0], "it says nothing"
        return self.stdout.readline().rstrip("\n")

    def end(self, number: signal.Signals = signal.SIGINT) -> tuple[int | None, str, str]:
        """Interrupt it; exit code, stdout, stderr. No child process may be left."""
        children = psutil.Process(self.process.pid).children(recursive=True)
        self.process.send_signal(number)
        out = self.stdout.read()
        _, err = self.process.communicate()
        _, alive = psutil.wait_procs(children, timeout=500)
        assert not alive
        return self.process.returncode, out, err


@contextmanager
def emulated(*arguments: str) -> Iterator[Emulated]:
    command_line = Emulated(*arguments)
    try:
        yield command_line
    finally:
        if command_line.process.poll() is None:
            command_line.process.kill()
        command_line.process.communicate()
        command_line.stdout.close()


@pytest.fixture
def ear() -> Iterator[socket.socket]:
    """A socket that receives datagrams."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened


def url_of(ear: socket.socket) -> str:
    return "udp://127.0.0.1:{1}".format(*ear.getsockname())


def drive(
    url: str, until: Callable[[Sample], bool], v: float, begin: Callable[[Sample], bool] = bool, **options: Any
) -> list[Sample]:
    """Stand still until a sample meets ``begin``, then drive until one meets ``until``, within PATIENCE_S; all samples."""
    driver = ArcosDriver(url, **{"connect_s": 30.0, "silence_s": 20.0, **options})
    samples: list[Sample] = []
    driver.open()
    try:
        end, begun = time.monotonic() + PATIENCE_S, False
        while time.monotonic() < end and not (samples and until(samples[-1])):
            driver.write(Velocity(linear=(v if begun else 0.0, 0.0, 0.0)))
            time.sleep(0.05)
            if (sample := driver.read()) is not None:
                samples.append(sample)
                begun = begun or begin(sample)
    finally:
        driver.close()
    return samples


@pytest.mark.parametrize(("robot", "port"), [("p2dx", "tcp://:0"), ("amigo-sh", "link")])
def test_a_driver_drives_it(robot: str, port: str, tmp_path: Path) -> None:
    port = str(tmp_path / "robot") if port == "link" else port
    with emulated(robot, "--port", port) as command_line:
        url = command_line.line()
        assert url.startswith({"tcp://:0": "socket://127.0.0.1:"}.get(port, port))
        begin_s = time.monotonic()
        last = drive(url, lambda sample: sample.odometry.pose[0] > 0.1, 0.2, robot=robot)[-1]
        assert 0.1 < last.odometry.pose[0] < 0.2 * (time.monotonic() - begin_s)
        code, out, err = command_line.end()
        assert code == 0
        assert "information packets sent" in out
        assert err.startswith("lines for its [[vehicle]]")
    assert not Path(port).is_symlink()


def test_json_is_two_lines_and_sigterm_ends_it_too() -> None:
    with emulated("amigobot", "--json", "--dwm1001", "PTY", "--ubisense", "udp://127.0.0.1:9") as command_line:
        about = json.loads(command_line.line())
        assert about["url"].startswith("/dev/pts/")
        assert about["positioning"]["ubisense"] == "udp://127.0.0.1:9"
        assert drive(about["url"], bool, 0.0)
        code, out, _ = command_line.end(signal.SIGTERM)
    assert code == 0
    happened = json.loads(out)
    assert happened["commands"] > 5
    assert happened["packets"] > 0
    assert happened["fixes"]["ubisense"] > 0


@pytest.mark.parametrize("where", [(), ("--scenario", "lab-patrol", "--vehicle", "ugv1")])
def test_it_ends_by_itself_after_the_duration(where: tuple[str, ...]) -> None:
    with emulated("p2dx", "--duration", "0.33", *where) as command_line:
        assert command_line.line().startswith("/dev/pts/")
        assert command_line.process.wait(60) == 0


def test_a_bad_line_is_counted() -> None:
    faults = "drop=0.005,flip=0.005,split=0.01"
    with emulated("amigobot", "--faults", faults, "--paced", "--baud", "57600", "--json", "--seed", "3") as command_line:
        url = json.loads(command_line.line())["url"]
        far = drive(url, lambda sample: sample.odometry.pose[0] > 0.05, 0.2, baud=57600)
        assert far[-1].odometry.pose[0] > 0.05
        _, out, _ = command_line.end()
    happened = json.loads(out)
    assert happened["bytes_lost"] + happened["bytes_changed"] > 0


def sonar_ranges(sample: Sample) -> list[float]:
    """New ranges of sonar 2, m."""
    return [metres for number, metres in sample.sonar if number == 2]


def expected_range(x: float) -> float:
    """Range of sonar 2 with the robot at x, m: it is 0.15 m ahead, turned 15 degrees to the left; its cone's edge is at 5
    degrees.
    """
    return (FACE_M - 0.15 - x) / math.cos(math.radians(5.0))


def test_in_a_scenario_the_sonar_sees_the_wall_and_the_robot_stalls_against_it(tmp_path: Path, ear: socket.socket) -> None:
    (tmp_path / "wall.toml").write_text(WALL)
    tags = ("--ubisense", url_of(ear), "--fix-hz", "20", "--sigma-m", "0.05", "--tag", "ABC")
    with emulated("amigobot", "--scenario", str(tmp_path / "wall.toml"), *tags) as command_line:
        url = command_line.line()
        samples = drive(
            url, lambda sample: sample.stalled == (True, True), 0.4, begin=lambda sample: bool(sonar_ranges(sample))
        )
        assert samples[-1].stalled == (True, True)
        xs = [sample.odometry.pose[0] for sample in samples]
        ahead = [
            (*way, metres) for way, each in zip(pairwise([0.0, *xs]), samples, strict=True) for metres in sonar_ranges(each)
        ]
        standing = [metres for before, x, metres in ahead if before == x == 0.0]
        assert standing
        assert standing == pytest.approx([expected_range(0.0)] * len(standing), abs=0.12)
        for before, x, metres in ahead:  # a range may be older than the pose
            assert x >= 0.2 or expected_range(x) - 0.12 <= metres <= expected_range(before) + 0.12
        assert ahead[-1][-1] < 0.1
        ear.setblocking(False)
        located = []
        while select.select([ear], [], [], 0)[0]:
            located.append(ubisense.decode(ear.recv(100)))
        code, out, err = command_line.end()
    assert code == 0, err
    assert "fixes of ubisense" in out
    assert {each.tag for each in located} == {"0000000000000ABC"}
    along = [each.position[0] for each in located if each.position]
    assert min(along) < 0.2
    assert 0.25 < along[-1] < FACE_M  # the robot's front is 0.16 m ahead; margin of five standard deviations
    assert max(along) < FACE_M + 0.1


def test_the_emulator_replaces_the_agent_of_a_vehicle(tmp_path: Path) -> None:
    text = """
name = "two"
duration_s = 1.0
physics = { kind = "kinematic" }
agents = { kind = "trajectory", period_s = 0.1, path = "circle" }
vehicles = { kind = "p2dx" }
[[vehicle]]
name = "car1"
agent = {}
[[vehicle]]
name = "car2"
position = [0.0, 3.0, 0.0]
agent = { fails_s = 0.5 }
"""
    (tmp_path / "two.toml").write_text(text)
    with emulated("p2dx", "--scenario", str(tmp_path / "two.toml"), "--vehicle", "car2", "--pose", "5,5,1.5", "--json") as one:
        about = json.loads(one.line())
        assert drive(about["url"], lambda sample: sample.odometry.pose[0] > 0.1, 0.3)[-1].odometry.pose[0] > 0.1
        code, out, err = one.end()
    assert code == 0, err
    assert json.loads(out)["vehicle"] == "car2"


def test_a_tag_alone_circles(ear: socket.socket) -> None:
    options = ("--circle", "2,1", "--fix-hz", "50", "--sigma-m", "0.01")
    with emulated("ubisense", "--port", url_of(ear), *options) as command_line:
        assert command_line.line() == url_of(ear)
        for _ in range(10):
            x, y, _ = ubisense.decode(ear.recv(100)).position or (math.nan,) * 3
            assert math.hypot(x, y - 2.0) == pytest.approx(2.0, abs=0.06)
        assert command_line.end()[0] == 0


def test_a_client_raises_the_baud_rate_and_comes_back_at_the_new_one() -> None:
    """As in ARIA: HOSTBAUD at the old rate, then the port is opened again at the new one; the session continues."""
    with emulated("p2dx", "--paced") as command_line:
        url = command_line.line()
        with serial.Serial(url, 9600, timeout=0.05) as port:
            reader = PacketReader()

            def hear(condition: Callable[[bytes], bool]) -> bytes:
                end = time.monotonic() + PATIENCE_S
                while time.monotonic() < end:
                    for packet in reader.feed(port.read(200)):
                        if condition(packet):
                            return packet
                raise AssertionError("nothing comes")

            for number in range(3):
                port.write(command(number))
                hear(bytes((number,)).__eq__ if number < 2 else lambda packet: packet[0] == 2)
            port.write(command(Command.OPEN, 1) + command(Command.HOSTBAUD, 2))
            time.sleep(0.5)
            assert not any(is_sip(packet) for packet in reader.feed(port.read(1000))[1:])  # noise after earlier packets
            port.close()
            port.baudrate = 38400
            port.open()
            reader = PacketReader()
            hear(is_sip)
            port.write(command(Command.CONFIG))
            hear(lambda packet: packet[:1] == b"\x20")
            port.write(command(Command.CLOSE))
        assert command_line.end()[0] == 0


@pytest.mark.parametrize("port", ["tcp://:0", "udp"])
def test_an_autopilot_sends_mavlink(port: str, ear: socket.socket) -> None:
    there = url_of(ear) if port == "udp" else port
    with emulated("mavlink", "--port", there, "--pose", "1,2,0", "--system-id", "7", "--json") as command_line:
        url = json.loads(command_line.line())["url"]
        if port == "udp":
            assert url == there.replace("udp://", "udpin:")
            data = ear.recv(4096)
        else:
            _, host, number = url.split(":")
            with socket.create_connection((host, int(number)), PATIENCE_S) as client:
                data = client.recv(4096)
        assert data[0] == 0xFD  # MAVLink 2
        code, out, _ = command_line.end()
    assert code == 0
    happened = json.loads(out)
    assert (happened["x_m"], happened["y_m"], happened["armed"]) == (1.0, 2.0, False)


def test_a_robot_that_runs_ros_2_is_driven(stack: ExitStack) -> None:
    endpoint = f"tcp/127.0.0.1:{stack.enter_context(reserve_port())}"
    with emulated("ros2", "--port", endpoint, "--stamped", "--pose", "1,2,0", "--json") as command_line:
        assert json.loads(command_line.line())["url"] == endpoint
        driver = Ros2Driver(endpoint=endpoint, stamped=True, pose="world", connect_s=30.0, silence_s=20.0)
        driver.open()
        try:
            x, command_count, end = 1.0, 0, time.monotonic() + PATIENCE_S
            while (x < 1.05 or command_count < 5) and time.monotonic() < end:
                driver.write(Velocity(linear=(0.3, 0.0, 0.0)))
                command_count += 1
                time.sleep(0.05)
                if (sample := driver.read()) is not None:
                    x = sample.odometry.pose[0]
        finally:
            driver.close()
        code, out, err = command_line.end()
    assert (code, err) == (0, "")
    assert json.loads(out)["messages"] > 2
    assert json.loads(out)["x_m"] >= x >= 1.05


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("amigobot", "--port", "/no/such/folder/robot"), "--port /no/such/folder/robot: No such file or directory"),
        (("amigobot", "--port", "tcp://no.such.host.invalid:8101"), "--port tcp://no.such.host.invalid:8101"),
        (("amigobot", "--dwm1001", "tag"), "--dwm1001 tag"),
        (("amigobot", "--vehicle", "car1"), "add --scenario"),
        (("amigobot", "--duration", "-1"), "--duration"),
        (("amigobot", "--scenario", "no-such"), "no-such"),
        (("p2dx", "--scenario", "lab-patrol"), "ugv1, ugv2, ugv3"),
        (("p2dx", "--scenario", "lab-patrol", "--vehicle", "car1"), "--vehicle car1"),
        (("amigobot", "--scenario", "swarm-100", "--vehicle", "drone1"), "--vehicle drone1"),
        (("dwm1001", "--port", "tag"), "--port tag"),
        (("ros2", "--port", "nonsense"), "--port nonsense: no session"),
        (("mavlink", "--port", "udp://no.such.host.invalid:14540"), "--port udp://no.such.host.invalid:14540"),
        (("mavlink", "--port", "/dev/ttyUSB0"), "udp://HOST:PORT or tcp://HOST:PORT"),
        (("mavlink", "--autopilot", "x"), "px4 or ardupilot"),
        (("mavlink", "--kind", "boat"), "quadrotor or rover"),
        (("mavlink", "--system-id", "0"), "from 1 to 255"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(arguments: tuple[str, ...], words: str) -> None:
    assert_refused(vcmvsp_command("emulate", *arguments), words)


def test_a_port_in_use_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "robot").touch()
    assert_refused(vcmvsp_command("emulate", "amigobot", "--port", str(tmp_path / "robot")), "already exists")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert_refused(vcmvsp_command("emulate", "amigobot", "--port", f"tcp://:{taken.getsockname()[1]}"), "in use")


def test_it_leaves_nothing_open_in_its_process() -> None:
    before = open_resources()
    outcome = vcmvsp_command("emulate", "amigobot", "--duration", "0.2", "--ubisense", "udp://127.0.0.1:9", "--dwm1001", "PTY")
    assert outcome.code == 0
    assert len(outcome.out.splitlines()) >= 4
    assert open_resources() <= before
