"""Command line options of emulated devices."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import UsageError
from vcmvsp.hardware.drivers.arcos.protocol import Command, command
from vcmvsp.hardware.emulators.arcos import program as options
from vcmvsp.hardware.emulators.arcos.in_run import robot_of
from vcmvsp.hardware.emulators.arcos.program import HostPort, PtyPort, RobotOptions, device_of, parameters

NUMBERS = st.floats(-1e6, 1e6)


@pytest.mark.parametrize(
    ("text", "port"),
    [
        ("PTY", PtyPort()),
        ("pty", PtyPort()),
        ("/tmp/robot", PtyPort(Path("/tmp/robot"))),
        ("./robot", PtyPort(Path("robot"))),
        ("tcp://:8102", HostPort("127.0.0.1", 8102)),
        ("tcp://:0", HostPort("127.0.0.1", 0)),
        ("tcp://", HostPort("127.0.0.1", 8101)),
        ("tcp://0.0.0.0:8101", HostPort("0.0.0.0", 8101)),
        ("socket://localhost:8103", HostPort("localhost", 8103)),
    ],
)
def test_ports(text: str, port: PtyPort | HostPort) -> None:
    assert options.port_of(text) == port


def test_addresses_of_datagrams_and_faults() -> None:
    assert options.udp_of("udp://127.0.0.1:5000", "--ubisense") == HostPort("127.0.0.1", 5000)
    faults = options.faults_of("drop=0.01,flip=0.001,split=0.2,gap_ms=5", 3)
    assert (faults.drop, faults.flip, faults.split, faults.gap_ns, faults.seed) == (0.01, 0.001, 0.2, 5_000_000, 3)
    assert options.faults_of("", 0).drop == 0.0
    assert options.tag_of("11ce0000a1") == "00000011CE0000A1"


@given(NUMBERS.filter(bool), NUMBERS)
def test_circles(radius_m: float, speed: float) -> None:
    assert options.circle_of(f"{radius_m},{speed}") == (radius_m, speed)


@pytest.mark.parametrize(
    ("parse", "texts", "error_text"),
    [
        (
            options.port_of,
            ("robot", "", "udp://127.0.0.1:5", "http://x/", "tcp://x:70000", "tcp://x:y", "tcp://x:1/y"),
            "--port",
        ),
        (
            partial(options.udp_of, option="--ubisense"),
            ("udp://127.0.0.1", "udp://:5000", "127.0.0.1:5000", "tcp://127.0.0.1:5000", "udp://127.0.0.1:0"),
            "--ubisense .*udp://HOST:PORT",
        ),
        (
            partial(options.faults_of, seed=0),
            ("drop", "drop=x", "drop=1.5", "flip=-0.1", "drip=0.1", "drop=nan", "gap_ms=-1", "seed=1"),
            "--faults",
        ),
        (options.circle_of, ("0,1", "1", "1,2,3", "x,1"), "--circle"),
        (options.tag_of, ("", "xyz", "-1", "1" * 17), "--tag"),
    ],
    ids=["port", "datagrams", "faults", "circle", "tag"],
)
def test_other_texts_are_refused(parse: Callable[[str], object], texts: tuple[str, ...], error_text: str) -> None:
    for text in texts:
        with pytest.raises(UsageError, match=error_text):
            parse(text)


@pytest.mark.parametrize(
    ("changes", "error_text"),
    [
        ({"rate_hz": 3.0}, "--rate-hz 3"),
        ({"rate_hz": 101.0}, "--rate-hz"),
        ({"baud": 1200}, "--baud 1200"),
        ({"ping_ms": 7}, "--ping-ms"),
    ],
)
def test_impossible_robots(changes: dict[str, Any], error_text: str) -> None:
    with pytest.raises(UsageError, match=error_text):
        device_of("amigobot", RobotOptions(**changes), (0.0, 0.0, 0.0))


def test_rate_baud_and_watchdog_become_parameters_of_the_robot() -> None:
    robot = parameters("p2dx", RobotOptions(rate_hz=20.0, baud=38400, watchdog=False))
    assert (robot.kind, robot.period_s, robot.baud, robot.watchdog_s) == ("p2dx", 0.05, 38400, 0.0)
    assert parameters("amigobot", RobotOptions()).watchdog_s == 2.0


def test_without_a_watchdog_a_robot_drives_on() -> None:
    packets = [command(number) for number in (0, 1, 2)] + [
        command(Command.OPEN),
        command(Command.ENABLE, 1),
        command(Command.VEL, 200),
    ]
    for watchdog in (True, False):
        device = device_of("amigobot", RobotOptions(watchdog=watchdog), (0.0, 0.0, 0.0))
        sent = sum(bool(device.receive(each, 0)) for each in packets)
        device.advance(10_000_000_000)
        assert sent == 3
        assert (device.odometry[0] > 1.5) is not watchdog
        assert (device.commands, device.packets) == (6, 100)


@pytest.mark.parametrize(
    ("required", "kind", "robot"),
    [
        ("", "p2dx", "p2dx"),
        ("", "amigobot", "amigobot"),
        ("", "my_robot.py:Rover", "amigobot"),
        ("amigo-sh", "p2dx", "amigo-sh"),
    ],
)
def test_the_emulated_robot_in_a_run_is_of_the_kind_of_its_vehicle_unless_the_driver_requires_another(
    required: str, kind: str, robot: str
) -> None:
    assert robot_of(required, kind) == robot
