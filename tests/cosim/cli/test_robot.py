"""``vcmvsp robot``: its options, and waiting for a run."""

import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.cosim.command_line import Outcome, assert_refused, vcmvsp_command
from tests.support.cosim.run_processes import reserve_port
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.security import authority
from vcmvsp.hardware.drivers.arcos.driver import ArcosDriver
from vcmvsp.hardware.drivers.bench_robot import Bench
from vcmvsp.hardware.remote_robot.robot_side.program import kind_of, make_driver

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

HERE = "tcp/127.0.0.1:7448"


def robot(*options: str) -> Outcome:
    """The outcome of the command with these options in place of the usual ones."""
    return vcmvsp_command("robot", "--vehicle", "car3", "--driver", "bench", "--connect", HERE, *options)


@pytest.mark.parametrize(
    ("text", "kind", "address"),
    [
        ("bench", "bench", ""),
        ("arcos:/dev/ttyUSB0", "arcos", "/dev/ttyUSB0"),
        ("arcos:socket://localhost:8101", "arcos", "socket://localhost:8101"),
        ("mavlink:udpin:0.0.0.0:14540", "mavlink", "udpin:0.0.0.0:14540"),
        ("my_robots.rover:Rover", "my_robots.rover:Rover", ""),
        ("my_robot.py:Rover:/dev/ttyUSB0", "my_robot.py:Rover", "/dev/ttyUSB0"),
        ("/home/anna/my_robot.py:Rover:tcp:1", "/home/anna/my_robot.py:Rover", "tcp:1"),
        ("nonsense:/dev/ttyUSB0", "nonsense", "/dev/ttyUSB0"),
    ],
)
def test_the_driver_is_a_kind_and_an_address(text: str, kind: str, address: str) -> None:
    assert kind_of(text) == (kind, address)


def test_the_address_is_the_drivers_own_parameter() -> None:
    driver = make_driver("arcos:socket://localhost:8101", {"robot": "amigo", "baud": 38400})
    assert isinstance(driver, ArcosDriver)
    assert driver.device == "socket://localhost:8101"
    assert make_driver("mavlink:udpin:0.0.0.0:14540", {}).device == "udpin:0.0.0.0:14540"
    assert isinstance(make_driver("bench", {"rate_hz": 50}), Bench)
    with pytest.raises(ScenarioError, match="the address is given twice"):
        make_driver("arcos:/dev/ttyUSB0", {"port": "/dev/ttyUSB1"})


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("--driver bench:/dev/ttyUSB0", "'bench' has no address"),
        ("--driver arcsos:/dev/ttyUSB0", "unknown driver kind 'arcsos'; did you mean 'arcos'?"),
        ("--driver zenoh", "is the run's side of this program"),
        ("--driver missing.py:Rover", "there is no file"),
        ("--connect 7448", "must be tcp/HOST:PORT or tls/HOST:PORT"),
        ("--connect tls/10.0.0.1:7448", "TLS needs certificates: add --keys FILE"),
        ("--connect tcp/10.0.0.1:7448", "add --insecure in a trusted network"),
        ("--vehicle car/3", "letters, digits, _ and -"),
        ("--set rate=5", "rate"),
        ("--set rate_hz=fast", "rate_hz"),
        ("--set rate_hz", "write KEY=VALUE"),
        ("--pose 1,2", "write X,Y,YAW"),
        ("--pose 1,2,nan", "write X,Y,YAW"),
        ("--keys missing.keys", "cannot be read"),
    ],
)
def test_unusable_options_are_named(options: str, problem: str) -> None:
    assert_refused(robot(*options.split()), problem)


def test_the_certificate_of_an_observer_drives_nothing(tmp_path: Path) -> None:
    authority.init(tmp_path / "keys")
    authority.issue(tmp_path / "keys", "anna")
    keys = str(tmp_path / "keys" / "anna.keys")
    assert_refused(robot("--keys", keys, "--connect", "tls/127.0.0.1:7448"), "is for watching only")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_waits_for_a_run_until_it_is_ended(number: int, stack: ExitStack) -> None:
    endpoint = f"tcp/127.0.0.1:{stack.enter_context(reserve_port())}"
    code = "from vcmvsp.cosim.cli import app as cli; cli.main()"
    arguments = ["robot", "--vehicle", "car3", "--driver", "bench", "--connect", endpoint]
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        assert process.stderr.readline().startswith(f"car3: waiting for a run at {endpoint}: no program listens there")
        time.sleep(0.3)
        process.send_signal(number)
        _, rest = process.communicate(timeout=500)
        assert (process.returncode, rest) == (0, f"car3: ended by {signal.Signals(number).name}\n")
    finally:
        process.kill()
        process.communicate(timeout=500)
