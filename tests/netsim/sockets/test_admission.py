"""Admission of programs to a run: all expected ones, from this machine alone, despite other connections."""

import random
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tomli_w

import vcmvsp
from tests.support.netsim.socket_programs import PATIENCE_S, by_hand, chat, idle, open_connection, run_programs, scenario
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.runs.api import check
from vcmvsp.cosim.scenario.schema import SocketsTable
from vcmvsp.cosim.sockets import connect
from vcmvsp.cosim.sockets.messages import VERSION, Hello, framed
from vcmvsp.cosim.testing import check_federate
from vcmvsp.cosim.types import Message, Reception
from vcmvsp.netsim.sockets.federate import Programs

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


def test_without_all_programs_the_run_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, lines = scenario(tmp_path, "a", "b", "c"), list[str]()
    came = threading.Event()
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + came.is_set() * PATIENCE_S)
    monkeypatch.setattr("vcmvsp.netsim.sockets.admission.time", clock)  # the wait ends as soon as one is connected

    def come() -> None:
        with pytest.raises(ConnectionError, match="the connection to the run is lost"):
            connect("a", content["sockets"]["listen"])
        lines.append("let down")

    def tell(text: str) -> None:
        lines.append(text)
        if text.startswith("the program of a connected"):
            came.set()

    thread = threading.Thread(target=come)
    thread.start()
    with pytest.raises(FederateError, match=r"no program connected for b, c within 60 s \(sockets.join_timeout_s\).*connect\("):
        vcmvsp.run(content, mcap=False, tell=tell)
    thread.join(PATIENCE_S)
    assert lines[1:] == ["the program of a connected; still waiting for: b, c", "let down"]
    assert not (tmp_path / "s").exists()


def test_a_refused_program_gets_the_reason(tmp_path: Path) -> None:
    content, reasons = scenario(tmp_path, "a", "b"), list[str]()

    def strangers() -> None:
        for vehicle in ("x" * 40, "a"):
            with pytest.raises(ConnectionRefusedError) as caught:
                connect(vehicle, content["sockets"]["listen"])
            reasons.append(str(caught.value))
        with open_connection(tmp_path) as end:
            end.sendall(framed(Hello(99, "b")))
            reasons.append(str(end.recv(1000)))
        connect("b", content["sockets"]["listen"]).close()

    late = threading.Thread(target=strangers, daemon=True)

    def tell(text: str) -> None:
        if text.startswith("the program of a connected"):
            late.start()

    run_programs(content, {"a": lambda end: None}, mcap=False, tell=tell)
    late.join(PATIENCE_S)
    assert "unknown vehicle 'xxx" in reasons[0]
    assert "a already has a program" in reasons[1]
    assert "install one vcmvsp version for both" in reasons[2]


def test_a_program_that_leaves_before_the_run_begins_may_be_replaced(tmp_path: Path) -> None:
    content, lines = scenario(tmp_path, "a", "b"), list[str]()

    def early() -> None:
        with open_connection(tmp_path) as end:
            end.sendall(framed(Hello(VERSION, "a")))
            end.recv(1 << 16)

    def come(vehicle: str) -> None:
        with connect(vehicle, content["sockets"]["listen"]) as end:
            idle(end)

    def tell(text: str) -> None:
        lines.append(text)
        if "disconnected" in text:
            for vehicle in "ab":
                threading.Thread(target=come, args=[vehicle], daemon=True).start()

    threading.Thread(target=early, daemon=True).start()
    result = vcmvsp.run(content, mcap=False, tell=tell)
    assert lines[2] == "the program of a disconnected; waiting for another"
    assert result.about["simulated_s"] == 1.0


def test_three_hundred_strange_connections_have_no_effect(tmp_path: Path) -> None:
    content, draw, open_ = scenario(tmp_path, "a", "b"), random.Random(4), list[socket.socket]()
    undisturbed = run_programs(content, {"a": chat, "b": chat}, mcap=False).metrics

    def flood() -> None:
        for number in range(300):
            end = socket.socket(socket.AF_UNIX)
            end.settimeout(0.2)
            open_.append(end)
            try:
                end.connect(f"{tmp_path}/s")
                end.sendall([b"", draw.randbytes(300), b"POST / HTTP/1.1\r\n\r\n", b"\x00\x00\x10\x00half"][number % 4])
            except OSError:
                pass

    thread = threading.Thread(target=flood, daemon=True)

    def tell(text: str) -> None:
        if text.startswith("waiting"):
            thread.start()

    result = run_programs(content, {"a": chat, "b": chat}, mcap=False, tell=tell)
    thread.join(PATIENCE_S)
    for end in open_:
        end.close()
    assert result.metrics == undisturbed


@pytest.mark.parametrize(
    ("listen", "says"),
    [
        ("tcp/0.0.0.0:7550", r"other machines cannot connect: .* ssh -L 7550:127.0.0.1:7550"),
        ("tcp/[::]:7550", "ssh -L"),
        ("tcp/192.168.1.5:7550", "ssh -L"),
        ("tcp/127.0.0.1:99999", "must be tcp/HOST:PORT or unix/PATH"),
        ("7550", "must be tcp/HOST:PORT or unix/PATH"),
        ("unix/", "must be tcp/HOST:PORT or unix/PATH"),
    ],
)
def test_only_this_machine_may_be_let_in(tmp_path: Path, listen: str, says: str) -> None:
    with pytest.raises(ScenarioError, match=f"sockets.listen: .*{says}"):
        check(scenario(tmp_path, "a", sockets={"listen": listen}))


def test_a_scenario_is_checked_without_its_programs(tmp_path: Path) -> None:
    assert check(scenario(tmp_path, "a"))["sockets"]["vehicles"] == ["a"]
    assert not (tmp_path / "s").exists()
    for bad, says in ((["a", "a"], "contains a twice"), (["z"], "z")):
        with pytest.raises(ScenarioError, match=f"sockets.vehicles: .*{says}"):
            check(scenario(tmp_path, "a", sockets={"vehicles": bad}))
        with pytest.raises(ScenarioError, match=f"^--set sockets.vehicles=.*: sockets.vehicles: .*{says}"):
            check(scenario(tmp_path, "a"), set={"sockets.vehicles": bad})


def test_where_nothing_is_opened_it_is_a_federate_like_others() -> None:
    table = SocketsTable(vehicles=("b", "a"))
    run = RunInfo(scenario="s", seed=1, duration_ns=10**9, vehicles=("a", "b"))
    message = Message(sender="b", body=b"", size_bytes=0)
    inbox = [Event("a/heard", 5, Reception(message=message, rssi_dbm=0.0, sent_ns=1, received_ns=5))]
    check_federate(lambda: Programs(table, run.vehicles, tell=print, connect=False), run, inbox)


def test_a_taken_endpoint_is_one_error_line_and_a_stale_one_is_reused(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(
            ScenarioError, match=f"sockets.listen: cannot listen on {listen}: .*another run may use it; choose another endpoint"
        ):
            vcmvsp.run(scenario(tmp_path, "a", sockets={"listen": listen}), mcap=False)
    (tmp_path / "s").write_text("a file of mine")
    with pytest.raises(ScenarioError, match=r"sockets\.listen: cannot listen on .*/none/s: No such file or directory; choose"):
        vcmvsp.run(scenario(tmp_path / "none", "a"), mcap=False)
    with pytest.raises(ScenarioError, match=r"sockets\.listen: cannot listen on"):
        vcmvsp.run(scenario(tmp_path, "a"), mcap=False)
    assert (tmp_path / "s").read_text() == "a file of mine"
    (tmp_path / "s").unlink()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(f"{tmp_path}/s")
    assert run_programs(scenario(tmp_path, "a"), {"a": chat}, mcap=False).about["simulated_s"] == 1.0


def test_over_tcp_on_any_port(tmp_path: Path) -> None:
    ends, received = list[threading.Thread](), list[Any]()

    def tell(text: str) -> None:
        if text.startswith("waiting"):
            endpoint = text.partition(" at ")[2].partition(": ")[0]
            for name, play in (("a", chat), ("b", received.extend)):
                ends.append(threading.Thread(target=enter, args=(name, endpoint, play), daemon=True))
                ends[-1].start()

    def enter(name: str, endpoint: str, play: Any) -> None:
        with connect(name, endpoint) as end:
            play(end)

    vcmvsp.run(scenario(tmp_path, "a", "b", sockets={"listen": "tcp/127.0.0.1:0"}), mcap=False, tell=tell)
    for thread in ends:
        thread.join(PATIENCE_S)
    assert received == 10 * [(b"here", "a")]


@pytest.mark.parametrize("hangs", [False, True])
def test_ctrl_c_ends_a_run_that_waits_for_a_program(tmp_path: Path, hangs: bool) -> None:
    (tmp_path / "s.toml").write_text(tomli_w.dumps(scenario(tmp_path, "a")))

    def hang() -> None:
        with by_hand(tmp_path, "a") as end:
            (tmp_path / "hangs").touch()
            end.recv(1 << 16)

    def wait_for(file: str) -> None:
        while not (tmp_path / file).exists():
            assert run.poll() is None
            time.sleep(0.02)

    command = [sys.executable, "-m", "vcmvsp.cosim.cli.app", "run", "s.toml", "--out", "out"]
    run = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        wait_for("s")
        if hangs:
            threading.Thread(target=hang, daemon=True).start()
            wait_for("hangs")
        time.sleep(0.2)
        run.send_signal(signal.SIGINT)
        _, error_text = run.communicate(timeout=500)
    finally:
        run.kill()
    assert run.returncode == 130, error_text
    assert "Traceback" not in error_text
    assert not (tmp_path / "s").exists()
