"""Hosts that a run has started itself reach it by a socket without a name: nobody else on the machine finds a way in."""

import contextlib
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.support.cosim.studies import two
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.scenario import loader

DIALS = """
import sys
from vcmvsp.cosim.hosts import host_client
with host_client.dial(sys.argv[1], None, print, secret="") as session:
    print(host_client.hub_of(session))
"""
LISTENS = "0A"


def open_files() -> list[str]:
    """What the file descriptors of this process stand for."""
    links = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            links.append(str(link.readlink()))
    return links


def listening() -> set[str]:
    """The TCP sockets at which this process listens."""
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


def test_a_hub_for_children_needs_no_short_path_and_gives_its_files_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    long = tmp_path / ("x" * 100) / ("y" * 100)  # a socket's path has at most 107 bytes
    long.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    hub = Hub(None)
    stack.callback(hub.close)
    command = [sys.executable, "-c", DIALS, hub.endpoint]
    said = subprocess.run(command, pass_fds=hub.files, capture_output=True, text=True, check=True).stdout
    assert said == f"{hub.session.zid()}\n"
    hub.close()
    assert not [link for link in open_files() if link.startswith(str(long))]


def test_a_connection_that_does_not_finish_its_greeting_does_not_spoil_the_end(stack: contextlib.ExitStack) -> None:
    hub = Hub()
    host, port = hub.endpoint.removeprefix("tcp/").rsplit(":", 1)
    for _ in range(20):
        stack.enter_context(socket.create_connection((host, int(port)))).sendall(b"\x10")
    hub.close()
