"""Messages to users during the wait for hosts; the unnamed socket for hosts on the same machine."""

import contextlib
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.studies import two
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.errors import AgentError, ScenarioError
from vcmvsp.cosim.hosts import listener
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.security import authority, certificates
from vcmvsp.cosim.transport import access_control

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


class EmptyHub:
    """A hub without join requests."""

    def next_hello(self, timeout_s: float) -> None:
        return None


def test_a_missing_host_is_named_during_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    now, lines = [100.0], list[str]()

    def later() -> float:
        now[0] += 1.0
        return now[0]

    monkeypatch.setattr("vcmvsp.cosim.hosts.listener.time.monotonic", later)
    with pytest.raises(AgentError, match="did not join within 60 s"):
        list(listener.knocking(EmptyHub(), 60.0, lambda: ["car2", "car3"], lines.append))  # type: ignore[arg-type]
    assert set(lines) == {"still waiting for the host of car2, car3"}
    assert len(lines) >= 3


def test_only_a_host_slow_to_build_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    notice, lines = threading.Event(), list[str]()

    def tell(text: str) -> None:
        lines.append(text)
        notice.set()

    with listener.telling_of(["car1"], tell):
        pass  # ends at once
    monkeypatch.setattr(listener, "SAY_S", 0.0)
    with listener.telling_of(["car2"], tell):
        assert notice.wait(60.0)
    assert lines == ["still waiting for the host of car2"]


def test_a_run_that_listens_without_hosts_reports_it() -> None:
    lines: list[str] = []
    vcmvsp.run(two(duration_s=0.1), listen="tcp://127.0.0.1:0", tell=lines.append, mcap=False)
    (line,) = [each for each in lines if "waits for no host" in each]
    assert line.startswith("tcp/127.0.0.1:")
    assert "--agents zenoh" in line


def test_the_named_keys_file_is_the_machines(tmp_path: Path) -> None:
    authority.init(tmp_path / "keys")
    authority.issue(tmp_path / "keys", "laptop", ["car3", "car4"])
    keys = certificates.load(tmp_path / "keys")
    assert keys.file_of("car4") == "laptop.keys"
    assert (keys.folder / keys.file_of("car4")).is_file()


def test_the_command_for_another_machine_has_its_file_and_the_agents_class(tmp_path: Path) -> None:
    assert vcmvsp_command("keys", "init", str(tmp_path / "keys")).code == 0
    outcome = vcmvsp_command("keys", "vehicle", "car3", "car4", "--as", "laptop", "--keys", str(tmp_path / "keys"))
    assert "--vehicle car3 --vehicle car4 --connect tls/HOST:PORT --keys laptop.keys [MODULE_OR_FILE:Class]" in outcome.out


def test_a_missing_file_is_named_with_its_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.node", lambda: "robot-7")
    wrong = two()
    wrong["vehicle"][1]["agent"] = {"kind": "nowhere.py:Agent"}
    with pytest.raises(ScenarioError, match=r"there is no file .*nowhere\.py on robot-7"):
        api.check(wrong)


DIALS = """
import sys
from vcmvsp.cosim.hosts import host_client
with host_client.dial(sys.argv[1], None, print, secret="") as session:
    print(host_client.hub_of(session))
"""
LISTENS = "0A"


def open_files() -> list[str]:
    """Targets of the open file descriptors of this process."""
    links = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            links.append(str(link.readlink()))
    return links


def listening() -> set[str]:
    """The TCP sockets on which this process listens."""
    lines = [line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    return {f"socket:[{fields[9]}]" for fields in lines if fields[3] == LISTENS} & set(open_files())


def test_a_run_in_processes_listens_at_no_port_and_its_socket_has_no_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = listening()
    scenario, source = loader.load(two())
    with assemble(scenario, source, runs="process"):
        assert listening() <= before
        assert list(tmp_path.iterdir()) == []


def test_a_hub_for_children_needs_no_short_path_and_closes_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    long = tmp_path / ("x" * 100) / ("y" * 100)  # a socket's path has at most 107 bytes
    long.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    hub = Hub(None)
    stack.callback(hub.close)
    command = [sys.executable, "-c", DIALS, hub.endpoint]
    output = subprocess.run(command, pass_fds=hub.files, capture_output=True, text=True, check=True).stdout
    assert output == f"{hub.session.zid()}\n"
    hub.close()
    assert not [link for link in open_files() if link.startswith(str(long))]


def test_a_connection_that_does_not_finish_its_greeting_does_not_spoil_the_end(
    monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    monkeypatch.setitem(access_control.LIMITS["transport"], "unicast", {"accept_timeout": 300})  # ms
    hub = Hub()
    host, port = hub.endpoint.removeprefix("tcp/").rsplit(":", 1)
    for _ in range(20):
        stack.enter_context(socket.create_connection((host, int(port)))).sendall(b"\x10")
    hub.close()
