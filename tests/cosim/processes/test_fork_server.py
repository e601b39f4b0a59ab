"""Child processes of a fork server: equal to freshly started ones, for the caller and for the child."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import psutil
import pytest

from vcmvsp.cosim.config.builtin_kinds import KINDS
from vcmvsp.cosim.processes import fork_server
from vcmvsp.cosim.processes.fork_server import ForkServer
from vcmvsp.cosim.runs.figures import IMPORTS

pytestmark = pytest.mark.processes

CHILD = """
import json, os, random, sys, threading
import numpy as np

FILE = None

def main():
    out, code = sys.argv[1:]
    first, file = sys.stdin.readline(), FILE and os.read(FILE, 9).decode()
    about = {"first": first, "file": file, "draws": [random.random(), np.random.random()], "pid": os.getpid()}
    with open(out, "w") as stream:
        json.dump(about, stream)
    if code == "wait":
        sys.stdin.read()
        sys.exit(3)
    return int(code)
"""


@pytest.fixture(params=[True, False], ids=["forked", "afresh"])
def ways(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways to start child processes; their module is in ``tmp_path``."""
    if request.param and not fork_server.FORKS:
        pytest.skip("no forks on this operating system")
    monkeypatch.setattr(fork_server, "FORKS", request.param)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "child.py").write_text(CHILD)


def about(out: Path) -> Any:
    return json.loads(out.read_text())


@pytest.mark.usefixtures("ways")
def test_each_child_has_its_arguments_first_text_file_exit_code_and_random_numbers(tmp_path: Path) -> None:
    with (tmp_path / "given").open("w+b", buffering=0) as file:
        file.write(b"for both!" * 2)
        file.seek(0)
        (tmp_path / "child.py").write_text(CHILD.replace("None", str(file.fileno())))
        with ForkServer("child", files=[file.fileno()]) as server:
            children = [server.start(str(tmp_path / str(code)), str(code), first=f"to {code}\n") for code in (0, 5)]
            for child in children:
                child.wait()
                assert child.close(0.0)
            assert [child.returncode for child in children] == [0, 5]
            assert children[1].why_ended() == "ended with exit code 5"
    first, second = about(tmp_path / "0"), about(tmp_path / "5")
    assert [first["first"], second["first"]] == ["to 0\n", "to 5\n"]
    assert first["file"] == second["file"] == "for both!"
    assert [first["pid"], second["pid"]] == [child.pid for child in children]
    for one, other in zip(first["draws"], second["draws"], strict=True):
        assert one != other


@pytest.mark.usefixtures("ways")
def test_a_child_ends_by_itself_when_its_input_closes_and_else_is_killed(tmp_path: Path) -> None:
    with ForkServer("child") as server:
        ends, hangs = (server.start(str(tmp_path / name), "wait", first="x\n") for name in ("ends", "hangs"))
        assert ends.why_ended() == hangs.why_ended() == ""
        assert ends.close(500.0)
        assert ends.why_ended() == "ended with exit code 3"
        os.kill(hangs.pid, signal.SIGSTOP)
        assert not hangs.close(0.1)
        assert hangs.why_ended() == "was killed by SIGKILL"


@pytest.mark.usefixtures("ways")
def test_all_threads_that_wait_for_a_child_get_its_exit_code(tmp_path: Path) -> None:
    with ForkServer("child") as server, ThreadPoolExecutor(8) as threads:
        for number in range(20):
            child = server.start(str(tmp_path / str(number)), "wait", first="x\n")
            codes = [threads.submit(child.wait) for _ in range(8)]
            child.kill()
            assert [code.result() for code in codes] == [-signal.SIGKILL] * 8
            child.close(0.1)


@pytest.mark.skipif(not fork_server.FORKS, reason="no forks on this operating system")
def test_a_server_that_is_killed_is_replaced_and_its_forks_live_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    slow = "import time\nos.register_at_fork(after_in_child=lambda: time.sleep(0.5))\n"  # holds the server's descriptors
    (tmp_path / "child.py").write_text(CHILD + slow)
    with ForkServer("child") as server:
        waits = server.start(str(tmp_path / "waits"), "wait", first="x\n")
        forked = psutil.Process(waits.pid)
        parent = forked.ppid()
        os.kill(parent, signal.SIGKILL)
        os.waitid(os.P_PID, parent, os.WEXITED | os.WNOWAIT)
        ends = server.start(str(tmp_path / "ends"), "0", first="x\n")
        assert waits.why_ended(500.0) == "was killed by SIGKILL"  # its own status is unknown
        assert forked.is_running()
        assert ends.why_ended(500.0) == "ended with exit code 0"
        for child in (waits, ends):
            child.close(0.1)
        forked.wait(500.0)


def test_children_of_a_server_that_cannot_start_have_ended() -> None:
    with ForkServer("no_such_module") as server:
        child = server.start("x")
        assert child.why_ended(500.0) in ("ended with exit code 1", "was killed by SIGKILL")
        child.kill()
        child.close(0.1)


THREADS = """
import importlib, os, sys
for module in sys.argv[1:]:
    importlib.import_module(module)
for thread in os.listdir("/proc/self/task"):
    if int(thread) != os.getpid():
        print(open(f"/proc/self/task/{thread}/comm").read().strip())
"""


@pytest.mark.skipif(not fork_server.FORKS, reason="no forks on this operating system")
def test_hosts_built_in_agents_and_figures_start_no_thread_when_they_are_imported() -> None:
    modules = {"vcmvsp.agents.host_process", *IMPORTS, *(kind.partition(":")[0] for kind in KINDS["agent"].values())}
    command = [sys.executable, "-c", THREADS, *sorted(modules)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    threads = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
    assert set(threads) <= {"jemalloc_bg_thd"}  # of pyarrow, safe for forks
