"""``vcmvsp stop`` and ``vcmvsp operator`` with stations that drive simulated robots."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from tests.support.cosim.command_line import Outcome, vcmvsp_command
from tests.support.hardware.stations import Run, mission, ready_station
from tests.support.paths import ROOT
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.station import emergency_stop
from vcmvsp.hardware.station.emergency_stop import StopCaller, StopListener
from vcmvsp.hardware.station.messages import OPERATOR_STOP, PartSpec
from vcmvsp.hardware.stations import Station

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

FOLDERS = emergency_stop.folders
PATIENCE_S = 30.0
COMMANDS = """
import os, typer
from pathlib import Path
from vcmvsp.cosim.cli.robot import operator_command
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.station import emergency_stop as control
control.folders = lambda: [Path(os.environ["XDG_RUNTIME_DIR"]) / "vcmvsp"]
control.StopCaller.answers.__defaults__ = (float(os.environ["ANSWER_S"]),)
app = typer.Typer()
app.command("operator")(operator_command)
app()
"""


@pytest.fixture(autouse=True)
def runtime_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder of its own: the tests stop no other robots."""
    with tempfile.TemporaryDirectory(prefix="vcmvsp-", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        monkeypatch.setattr(emergency_stop, "folders", lambda: [Path(folder) / "vcmvsp"])
        yield Path(folder) / "vcmvsp"


def stop(*arguments: str, answer_s: float = PATIENCE_S) -> Outcome:
    """The command; waits up to ``answer_s`` for a station's answer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StopCaller.answers, "__defaults__", (answer_s,))
        return vcmvsp_command("stop", *arguments)


def drive(run: Run) -> None:
    run.until(lambda each: each.odometry is not None and each.odometry.v > 0.15, v=0.4)


def test_all_are_stopped_and_stay_so() -> None:
    with ready_station(mission()) as first, ready_station(mission(vehicle="car2")) as second:
        drive(first)
        drive(second)
        outcome = stop()
        assert sorted(outcome.out.splitlines()) == ["car1: stopped (run test)", "car2: stopped (run test)"]
        assert (outcome.err, outcome.code) == ("", 0)
        for run in (first, second):
            report = run.until(
                lambda each: each.odometry is not None and each.odometry.v == 0.0 and OPERATOR_STOP in each.causes, v=0.4
            )
            assert report.sent is not None
            assert report.sent.linear[0] == 0.0
            assert run.notices.count(("stopped", OPERATOR_STOP)) == 1


def test_one_is_stopped_and_a_missing_one_is_named() -> None:
    with ready_station(mission()) as first, ready_station(mission(vehicle="car2")) as second:
        outcome = stop("car2", "car9", "--json")
        assert outcome.code == 1
        assert "as car9" in outcome.err
        answers = json.loads(outcome.out)
        assert [(each["vehicle"], each["state"], each["pid"]) for each in answers] == [("car2", "stopped", second.station.pid)]
        drive(first)
        with StopCaller() as caller:
            states = {each.vehicle: each.state for each in caller.answers(caller.say("who"), PATIENCE_S)}
        assert states == {"car1": "driving", "car2": "stopped"}


def test_without_robots() -> None:
    outcome = stop()
    assert (outcome.out, outcome.code) == ("", 1)
    assert outcome.err == "vcmvsp: you drive no robot on this machine\n"


def test_remains_of_a_killed_station_are_removed(runtime_folder: Path) -> None:
    station = Station.start(mission())
    station.wait_ready()
    os.kill(station.pid, signal.SIGKILL)
    station.close()
    assert len(list(runtime_folder.iterdir())) == 1
    assert stop().code == 1
    assert list(runtime_folder.iterdir()) == []


def test_a_hanging_station_is_reported() -> None:
    with ready_station(mission()) as run:
        os.kill(run.station.pid, signal.SIGSTOP)
        outcome = stop(answer_s=emergency_stop.ANSWER_S)
        os.kill(run.station.pid, signal.SIGCONT)
        assert outcome.code == 1
        assert f"car1: DOES NOT ANSWER (process {run.station.pid})" in outcome.out
        run.until(lambda each: OPERATOR_STOP in each.causes)  # it has received the stop


def test_robots_drive_while_there_is_an_operator() -> None:
    environment = {**os.environ, "ANSWER_S": str(PATIENCE_S)}
    with ExitStack() as stack:
        run = stack.enter_context(ready_station(mission(operator_s=2.0)))
        report = run.until(lambda each: each.order > 3, v=0.4)
        assert report.causes == ("operator",)
        operator = stack.enter_context(
            subprocess.Popen([sys.executable, "-c", COMMANDS], stdout=subprocess.PIPE, text=True, env=environment)
        )
        stack.callback(operator.kill)
        drive(run)
        operator.send_signal(signal.SIGSTOP)  # as by Ctrl-Z
        report = run.until(lambda each: "operator" in each.causes, v=0.4)
        assert ("stopped", "no message of the operator for 2 s") in run.notices
        operator.send_signal(signal.SIGCONT)
        end = time.monotonic() + 0.4
        report = run.until(lambda _: time.monotonic() > end, v=0.4)
        assert report.causes == ("operator",)  # still stopped
        operator.send_signal(signal.SIGINT)
        output, _ = operator.communicate(timeout=2 * PATIENCE_S)
        assert operator.returncode == 0
        assert output.splitlines() == ["robots drive while this runs; Ctrl-C stops them", "car1", "car1: stopped (run test)"]
        run.until(lambda each: OPERATOR_STOP in each.causes, v=0.4)


def test_a_robot_that_is_still_being_connected_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\n"
        "from pathlib import Path\n"
        "from vcmvsp.hardware.drivers.bench_robot import Bench\n"
        "class Slow(Bench):\n"
        "    open_deadline_s = 60.0\n"
        "    def open(self, start):\n"
        "        while not Path(__file__).with_name('go').exists():\n"
        "            time.sleep(0.02)\n"
        "        super().open(start)\n"
    )
    slow_mission = msgspec.structs.replace(
        mission(PartSpec(group="driver", kind="slow.py:Slow", params={})), folder=str(tmp_path)
    )
    station = Station.start(slow_mission)
    try:
        end = time.monotonic() + 60.0
        with StopCaller() as caller:
            while not caller.say("who"):
                assert time.monotonic() < end
                time.sleep(0.02)
        outcome = stop()
        assert (outcome.out, outcome.code) == ("car1: stopped (run test)\n", 0)
        (tmp_path / "go").touch()
        with pytest.raises(DriverError, match=OPERATOR_STOP):  # it might be taking off
            station.wait_ready()
    finally:
        station.close()


RUN = """
import sys, time
from tests.support.hardware.stations import *
with ready_station(mission(federation_s=None, command_s=None)) as run:
    run.until(lambda each: each.odometry is not None and each.odometry.v > 0.15, v=0.4)
    print("drives", flush=True)
    time.sleep(100)
"""


def test_it_works_while_the_run_is_frozen(runtime_folder: Path) -> None:
    run = subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert run.stdout is not None
        assert select.select([run.stdout], [], [], 60.0)[0]
        assert run.stdout.readline() == "drives\n"
        run.send_signal(signal.SIGSTOP)
        outcome = stop()
        assert (outcome.out, outcome.code) == ("car1: stopped (run test)\n", 0)
    finally:
        run.kill()
        run.communicate(timeout=PATIENCE_S)
    end = time.monotonic() + PATIENCE_S
    while list(runtime_folder.iterdir()):  # the station ends with its run
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_folder_open_to_others_is_refused(runtime_folder: Path) -> None:
    runtime_folder.mkdir(mode=0o755)
    runtime_folder.chmod(0o755)
    with pytest.raises(Exception, match=r"robot at car1: 'vcmvsp stop' could not reach it.*set XDG_RUNTIME_DIR"):
        StopListener("car1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.bind(str(runtime_folder / "1-car1.sock"))
        with StopCaller() as caller:
            assert caller.say("who") == []


def test_unknown_words_are_ignored(runtime_folder: Path) -> None:
    ear = StopListener("a" * 200)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as somebody:
            for data in (b"", b"STOP", b"stop now", b"\xff" * 4000):
                somebody.sendto(data, str(next(runtime_folder.iterdir())))
        assert ear.hear() == []
        with StopCaller() as caller:
            assert len(caller.say("stop", ["a" * 200])) == 1
        assert [verb for verb, _ in ear.hear()] == ["stop"]
    finally:
        ear.close()
    assert list(runtime_folder.iterdir()) == []


def test_sockets_are_searched_in_the_folders_of_a_login(runtime_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert FOLDERS()[0] == runtime_folder
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert runtime_folder not in FOLDERS()
    assert FOLDERS()[-1] == Path(f"/tmp/vcmvsp-{os.getuid()}")
