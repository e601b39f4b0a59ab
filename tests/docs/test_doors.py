"""Examples of programs at the gateways of a run in the READMEs, at free ports."""

import json
import re
import signal
import socket
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
import zenoh

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, exit_of
from tests.support.docs.readme_pages import block, command, words_of
from tests.support.docs.readme_sessions import BRIEF
from tests.support.netsim.gateway_context import free_ports

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

PAGE = "netsim/bridge/README.md"
TWO = """
name = "two"
duration_s = 600.0
[physics]
kind = "kinematic"
[radio]
preset = "wss"
[bridge.wss]
[bridge.zenoh]
[[vehicle]]
name = "car1"
kind = "p2dx"
[[vehicle]]
name = "car2"
kind = "p2dx"
position = [20.0, 0.0, 0.0]
"""


def test_ports_agree_with_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = free_ports(300)
    words = words_of(command("vcmvsp run formation-circle --set bridge").replace("18000", str(first)))
    code, _, err = vcmvsp_command(*words[1:], *BRIEF.split())
    assert code == 0, err
    shown = {int(port) - 18000 for port in re.findall(r"\b18\d{3}\b", block("docs/howto/programs.md", "where are you?"))}
    assert {int(port) - first for port in re.findall(r"\b\d{5}\b", err)} >= shown == {0, 2, 99, 199}


class Robot:
    """A client of the Wireless Simulation Server."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20.0)
        self._lines = self._socket.makefile("rw", newline="\r\n")

    def ask(self, line: str) -> str:
        self._lines.write(f"{line}\r\n")
        self._lines.flush()
        return self._lines.readline().strip()

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


def test_programs_at_the_gateways(tmp_path: Path) -> None:
    """The dialogue is that of the page, except for a port; the program beside car2 prints the publications of car1."""
    wss, first = free_ports(1, socket.SOCK_STREAM), free_ports(2, socket.SOCK_STREAM)
    (tmp_path / "two.toml").write_text(TWO)
    ports = f"--set bridge.wss.port={wss} --set bridge.zenoh.first_port={first}"
    with Stage(tmp_path) as stage:
        run = stage.start("run", "two.toml", "--out", "out", *ports.split())
        assert run.stderr is not None
        lines = [run.stderr.readline() for _ in range(3)]  # then the gateways are open
        assert [line.partition(":")[0] for line in lines] == ["bridge.wss", "bridge.zenoh", "bridge.zenoh"]
        dialogue(wss)
        publications(first)
        run.send_signal(signal.SIGINT)
        assert exit_of(run)[0] == 130


def dialogue(port: int) -> None:
    """Levels are updated every 0.1 s; before, there are none."""
    lines = block(PAGE, "GETSS {Robot car2}").splitlines()[1:]
    with closing(Robot(port)) as car1, closing(Robot(port)) as car2:
        assert car2.ask("INIT {Robot car2} {Port 7002}") == "INITREPLY {Status OK}"
        for line, answer in zip(lines[::2], lines[1::2], strict=True):
            last = time.monotonic() + 20.0
            while "NaN" in (reply := car1.ask(line)) and time.monotonic() < last:
                time.sleep(0.02)
            assert re.sub(r"Port \d+", "Port", reply) == re.sub(r"Port \d+", "Port", answer)


def publications(first: int) -> None:
    """Enter is pressed as soon as the program has printed a reception."""
    program, reception = block(PAGE, "declare_subscriber").replace("7461", str(first + 1)), threading.Event()
    printed: list[str] = []

    def print_(*words: object) -> None:
        printed.append(" ".join(map(str, words)))
        reception.set()

    def enter(_: str) -> str:
        endpoints = {"endpoints": [f"tcp/127.0.0.1:{first}"]}
        config = {"mode": "client", "connect": endpoints, "scouting": {"multicast": {"enabled": False}}}
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as car1:
            for _attempt in range(400):  # no notice when the router has connected both
                car1.put("pose", "ahead")
                if reception.wait(0.05):
                    break
        return ""

    exec(compile(program, PAGE, "exec", dont_inherit=True), {"input": enter, "print": print_})
    assert {*printed} == {"pose ahead"}
