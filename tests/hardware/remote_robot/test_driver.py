"""Both ends on one machine: `ZenohDriver` here, ``vcmvsp robot`` with a simulated robot in a process of its own."""

import contextlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.run_processes import Forwarder
from tests.support.cosim.secure_hub import issue_certificates
from tests.support.hardware.driver_runs import eventually
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, LinkLost, PortError, Sample
from vcmvsp.hardware.remote_robot.run_side.driver import ZenohDriver

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

PATIENCE_S = 30.0  # for loaded machines
PROGRAM = """
import time
shift_ns = {shift_ns}
if shift_ns:
    now = time.monotonic_ns
    time.monotonic_ns = lambda: now() + shift_ns
from vcmvsp.cosim.cli import app as cli
cli.main()
"""
LOGGED = """
import json, time
from vcmvsp.hardware.drivers.bench_robot import Bench


class Logged(Bench):
    def __init__(self, *, address: str, unplugged_s: float | None = None) -> None:
        super().__init__(rate_hz=50.0, latency_s=0.0, accel=5.0, decel=5.0, unplugged_s=unplugged_s)
        self._log = address

    def _note(self, *what: object) -> None:
        with open(self._log, "a") as file:
            file.write(json.dumps([time.monotonic_ns(), *what]) + "\\n")

    def open(self, start):
        self._note("open", list(start))
        super().open(start)

    def write(self, velocity):
        self._note("write", velocity.linear[0])
        super().write(velocity)

    def stop(self, cause):
        self._note("stop", cause)
        super().stop(cause)

    def close(self):
        self._note("close")
        super().close()
"""
RUN = """
import sys, time
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.remote_robot.run_side.driver import ZenohDriver
driver = ZenohDriver(listen=sys.argv[1], vehicle="car3", open_deadline_s=30.0, silence_s=30.0, reconnect_s=30.0)
driver.open()
print("open", flush=True)
while True:
    driver.write(Velocity(linear=(0.3, 0.0, 0.0)))
    driver.read()
    time.sleep(0.02)
"""


class Program:
    """A ``vcmvsp robot`` process, its output, and the calls to its robot's driver."""

    def __init__(self, folder: Path, port: int, *options: str, protocol: str = "tcp", shift_ns: int = 0) -> None:
        self.log = folder / "robot.log"
        (folder / "logged.py").write_text(LOGGED)
        words = ["robot", "--vehicle", "car3", "--connect", f"{protocol}/127.0.0.1:{port}"]
        if "--driver" not in options:
            words += ["--driver", f"{folder / 'logged.py'}:Logged:{self.log}"]
        command = [sys.executable, "-c", PROGRAM.format(shift_ns=shift_ns), *words, *options]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE)
        self._output = b""

    def until(self, text: str) -> None:
        """Waits for this output."""
        end = time.monotonic() + PATIENCE_S
        pipe = self.process.stderr
        assert pipe is not None
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while text not in self.output:
                assert selector.select(max(0.0, end - time.monotonic())), f"it never said {text!r}: {self.output}"
                chunk = os.read(pipe.fileno(), 65536)
                self._output += chunk
                assert chunk or text in self.output, f"it ended without {text!r}: {self.output}"

    @property
    def output(self) -> str:
        return self._output.decode()

    def told(self) -> list[list[Any]]:
        """Calls to its robot's driver: time, ns, call, argument."""
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def when(self, found: Callable[[list[list[Any]]], object]) -> list[list[Any]]:
        """Calls, as soon as ``found`` accepts them."""
        eventually(lambda: self.log.exists() and found(self.told()))
        return self.told()

    def end(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        self._output += self.process.communicate(timeout=PATIENCE_S)[1]
        return self.process.returncode


@contextlib.contextmanager
def program(folder: Path, port: int, *options: str, **more: Any) -> Iterator[Program]:
    folder.mkdir(exist_ok=True)
    started = Program(folder, port, *options, **more)
    try:
        yield started
    finally:
        if started.process.poll() is None:
            started.process.kill()
        with contextlib.suppress(ValueError):  # communicate was called before
            started.process.communicate(timeout=PATIENCE_S)


@contextlib.contextmanager
def driver(port: int, **options: Any) -> Iterator[ZenohDriver]:
    """An open driver, closed at the end."""
    made = ZenohDriver(
        listen=f"tcp/127.0.0.1:{port}", vehicle="car3", **{"open_deadline_s": PATIENCE_S, "silence_s": PATIENCE_S, **options}
    )
    made.open((1.0, 2.0, 0.0))
    try:
        yield made
    finally:
        made.close()


def drive(made: ZenohDriver, found: Callable[[Sample], object], v: float = 0.3) -> Sample:
    """Drives until ``found`` accepts a sample."""
    last = time.monotonic() + PATIENCE_S
    while time.monotonic() < last:
        made.write(Velocity(linear=(v, 0.0, 0.0)))
        sample = made.read()
        if sample is not None and found(sample):
            return sample
        time.sleep(0.01)
    raise AssertionError("it never came true")


def lost(made: ZenohDriver) -> DriverError:
    """Error at the end of a connection."""
    with pytest.raises(DriverError) as caught:
        drive(made, lambda _: False)
    return caught.value


def write_times(calls: list[list[Any]]) -> list[int]:
    return [each[0] for each in calls if each[1] == "write"]


def test_it_is_driven_stopped_and_freed_run_after_run(tmp_path: Path, port: int) -> None:
    with program(tmp_path, port) as robot:
        robot.until("waiting for a run")
        with driver(port) as made:
            moved = drive(made, lambda each: each.odometry.pose[0] > 1.1)
            assert moved.odometry.pose[1:] == (2.0, 0.0)  # starts at the run's start pose
            assert moved.link == 1
            made.stop("enough")
            stood = robot.when(lambda calls: calls[-1][1:] == ["stop", "enough"])
            eventually(lambda: (each := made.read()) is not None and each.odometry.v == 0.0 and each.stopped == "enough")
            drive(made, lambda each: each.odometry.v > 0.1)  # the next command moves it again
            assert len(write_times(robot.told())) > len(write_times(stood))
            eventually(lambda: (each := made.read()) is not None and each.stopped == "no command for 0.5 s")
        assert robot.when(lambda calls: calls[-1][1] == "close")[-2][1:] == ["stop", "the run is over"]
        causes = [(each.what, each.cause) for each in made.notices()]
        assert ("stopped", "enough") in causes
        assert ("stopped", "the run is over") in causes
        with driver(port) as made:
            drive(made, lambda each: each.odometry.v > 0.1)
        assert [each[2] for each in robot.told() if each[1] == "open"] == [[1.0, 2.0, 0.0]] * 2
        assert robot.end() == 0
        assert robot.output.splitlines()[-1] == "car3: ended by SIGINT"


def test_the_start_pose_may_be_set_at_the_robot(tmp_path: Path, port: int) -> None:
    with program(tmp_path, port, "--pose", "5,-1,0") as robot, driver(port) as made:
        assert drive(made, lambda each: each.odometry.v > 0.1).odometry.pose[1] == -1.0
        assert robot.end(signal.SIGTERM) == 0  # while the run still exists
        assert robot.told()[-1][1] == "close"
        error = lost(made)
        assert isinstance(error, LinkLost)
        assert "its program was ended by SIGTERM" in str(error)


def test_a_killed_robot_program_is_a_named_loss(tmp_path: Path, port: int) -> None:
    with program(tmp_path, port) as robot, driver(port) as made:
        drive(made, lambda each: each.odometry.v > 0.1)
        robot.process.kill()
        error = lost(made)  # detected by its token, long before the silence timeout
        assert isinstance(error, LinkLost)
        assert str(error).startswith(f"robot at tcp/127.0.0.1:{port} (car3): the robot's program has ended")
        made.stop("after the loss")  # does not raise
        assert "lost" in [each.what for each in made.notices()]


def test_a_restarted_program_continues_the_odometry(tmp_path: Path, port: int) -> None:
    with driven_alone(tmp_path / "first", port) as (robot, made):
        before = drive(made, lambda each: each.odometry.pose[0] > 1.1)
        robot.process.kill()
        with program(tmp_path / "second", port) as again:
            after = drive(made, lambda each: each.link >= 2)
            assert after.odometry.pose[0] >= before.odometry.pose[0]
            assert after.number > before.number
            assert again.told()[0][2][0] >= before.odometry.pose[0]
            kinds = [each.what for each in made.notices()]
            assert kinds.index("lost") < len(kinds) - kinds[::-1].index("connected")


@contextlib.contextmanager
def driven_alone(folder: Path, port: int) -> Iterator[tuple[Program, ZenohDriver]]:
    with program(folder, port) as robot, driver(port, reconnect_s=PATIENCE_S) as made:
        yield robot, made


@pytest.mark.parametrize(
    ("number", "cause"),
    [(signal.SIGKILL, "the link to the run is lost"), (signal.SIGSTOP, "no velocity from the run for 0.5 s")],
)
def test_the_robot_stops_if_its_run_dies_or_hangs(tmp_path: Path, port: int, number: int, cause: str) -> None:
    with program(tmp_path, port) as robot:
        run = subprocess.Popen([sys.executable, "-c", RUN, f"tcp/127.0.0.1:{port}"], stdout=subprocess.PIPE)
        try:
            last = time.monotonic() + PATIENCE_S
            while True:
                driven = len(write_times(robot.told())) if robot.log.exists() else 0
                robot.when(lambda calls, driven=driven: len(write_times(calls)) > driven + 20)  # type: ignore[misc]
                run.send_signal(number)
                gone_ns = time.monotonic_ns()
                calls = robot.when(
                    lambda calls: calls[-1][1] == "stop" and (number == signal.SIGSTOP or calls[-1][2].startswith(cause))
                )
                if calls[-1][2].startswith(cause):
                    break
                assert time.monotonic() < last, f"it stands, as {calls[-1][2]}"
                run.send_signal(signal.SIGCONT)  # stopped for a delay shortly before, on a loaded machine
            assert calls[-1][0] - gone_ns < 5e9  # 0.5 s nominal, tenfold under load
            if number == signal.SIGSTOP:
                assert calls[-1][0] - write_times(calls)[-1] > 0.4e9  # 0.5 s, minus the time between clock and log
        finally:
            run.kill()
            run.communicate(timeout=PATIENCE_S)
        assert robot.end() == 0
        assert robot.told()[-1][1] == "close"


def test_after_a_frozen_link_zero_speed_comes_first(tmp_path: Path, port: int) -> None:
    with contextlib.closing(Forwarder(port)) as forwarder, program(tmp_path, forwarder.port) as robot:
        with driver(port, silence_s=1.0, reconnect_s=PATIENCE_S) as made:
            drive(made, lambda each: each.odometry.v > 0.1)
            made.notices()
            forwarder.hold()
            eventually(lambda: "lost" in [each.what for each in made.notices()])
            frozen = len(robot.when(lambda calls: calls[-1][1] == "stop"))
            made.write(Velocity(linear=(0.9, 0.0, 0.0)))  # dropped: no robot is connected
            made.read()
            forwarder.release()
            again = drive(made, lambda each: each.link >= 2 and each.odometry.v > 0.1)
            assert again.odometry.pose[0] > 1.0
            calls = robot.told()
            assert "open" not in [each[1] for each in calls[1:]]  # its own driver stayed open
            anew = [each[1] for each in calls[frozen:]]
            assert anew[0] == "stop"
            assert anew[-1] == "write"
            assert {each[2] for each in calls if each[1] == "write"} == {0.3}
        assert robot.end() == 0


@pytest.mark.parametrize("ahead_s", [None, 3600.0], ids=["just booted", "an hour ahead"])
def test_its_clock_may_be_wrong(tmp_path: Path, port: int, ahead_s: float | None) -> None:
    shift_ns = 10**9 - time.monotonic_ns() if ahead_s is None else round(ahead_s * 1e9)
    with program(tmp_path, port, shift_ns=shift_ns), driver(port) as made:
        samples: list[Sample] = []
        while len(samples) < 20:
            before_ns = time.monotonic_ns()
            samples.append(drive(made, lambda _: True))
            assert samples[-1].measured_ns <= samples[-1].arrived_ns <= time.monotonic_ns()
            assert samples[-1].measured_ns > before_ns - PATIENCE_S * 10**9
        assert [each.number for each in samples] == sorted({each.number for each in samples})
        measured = [each.measured_ns for each in samples]
        assert measured == sorted(measured)  # equal times are possible when the clock offset is refined
        drive(made, lambda each: each.measured_ns > measured[0])
        for notice in made.notices():
            assert abs(notice.time_ns - time.monotonic_ns()) < PATIENCE_S * 10**9


def test_a_second_program_waits_its_turn(tmp_path: Path, port: int) -> None:
    with driven_alone(tmp_path / "first", port) as (first, made), program(tmp_path / "second", port) as second:
        second.until("waiting: another program already drives car3")
        drive(made, lambda each: each.odometry.v > 0.1)
        first.process.kill()
        drive(made, lambda each: each.link >= 2)
        made.close()
        second.until("the run is over")


def test_a_robot_lost_by_its_own_driver_may_return_or_ends_the_run(tmp_path: Path, port: int) -> None:
    with program(tmp_path, port, "--set", "unplugged_s=0.4") as robot:
        with driver(port, reconnect_s=PATIENCE_S) as made:
            drive(made, lambda each: each.link >= 2)
            assert [each[1] for each in robot.told()].count("open") >= 2
            assert "bench aboard car3: the link is lost" in " ".join(each.cause for each in made.notices())
        with pytest.raises(LinkLost, match="bench aboard car3: the link is lost"), driver(port) as made:
            drive(made, lambda _: False)
        assert robot.end() == 0


def test_a_missing_robot_error_names_the_command(port: int) -> None:
    made = ZenohDriver(listen=f"tcp/127.0.0.1:{port}", vehicle="car3", open_deadline_s=0.2)
    with pytest.raises(
        HandshakeError, match=rf"robot of car3 did not connect within 0.2 s; .*vcmvsp robot --vehicle car3 .*:{port}"
    ):
        made.open()
    made.close()
    made.close()
    with pytest.raises(RuntimeError, match="is not open"):
        made.read()


def test_a_port_in_use(port: int) -> None:
    with socket.create_server(("127.0.0.1", port)):
        made = ZenohDriver(listen=f"tcp/127.0.0.1:{port}", vehicle="car3")
        with pytest.raises(PortError, match="cannot listen there"):
            made.open()


# --- certificates ---


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return issue_certificates(tmp_path_factory.mktemp("robots")).folder


def test_with_its_certificate_it_is_driven(tmp_path: Path, port: int, keys: Path) -> None:
    with program(tmp_path, port, "--keys", str(keys / "car3.keys"), protocol="tls") as robot:
        made = ZenohDriver(listen=f"tls/127.0.0.1:{port}", keys=keys.name, folder=str(keys.parent), vehicle="car3")
        try:
            made.open()
            drive(made, lambda each: each.odometry.v > 0.1)
        finally:
            made.close()
        assert any("certificate of 'car3'" in each.cause for each in made.notices())
        assert robot.end() == 0


def test_the_wrong_certificate_is_named_at_both_ends(tmp_path: Path, port: int, keys: Path) -> None:
    made = ZenohDriver(listen=f"tls/127.0.0.1:{port}", keys=str(keys), vehicle="car3", open_deadline_s=PATIENCE_S)
    with ThreadPoolExecutor(1) as pool:
        opening = pool.submit(made.open)
        try:
            wait_for_listener(port)
            with program(tmp_path, port, "--keys", str(keys / "car2.keys"), protocol="tls") as robot:
                assert robot.process.wait(PATIENCE_S) == 2
                robot.until("the certificate of 'car2' is for car2, not for car3")
                assert not robot.log.exists()
        finally:
            made.close()
        assert isinstance(opening.exception(PATIENCE_S), HandshakeError)
    causes = [each.cause for each in made.notices()]
    assert "a robot was rejected: the certificate of 'car2' is for car2, not for car3" in causes


def wait_for_listener(port: int) -> None:
    def there() -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return True
        return False

    eventually(there)


def test_without_a_run_the_wrong_certificate_ends_the_program_at_once(tmp_path: Path, port: int, keys: Path) -> None:
    with program(tmp_path, port, "--keys", str(keys / "car2.keys"), protocol="tls") as robot:
        assert robot.process.wait(PATIENCE_S) == 2
        robot.until("car2.keys: is for car2, not for car3")
