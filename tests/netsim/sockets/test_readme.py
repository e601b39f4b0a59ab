"""The README's example does what it says, in whatever order its programs are started."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.cosim.run_processes import PROGRAM
from tests.support.paths import ROOT

pytestmark = pytest.mark.processes

HOME = ROOT / "netsim" / "sockets"
README = (HOME / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("order", [("run", "ping", "pong"), ("pong", "ping", "run")])
def test_the_worked_example(tmp_path: Path, order: tuple[str, ...]) -> None:
    (output,), (scenario,), (ping, pong) = blocks("text"), blocks("toml"), blocks("python")
    (tmp_path / "sockets.toml").write_text(scenario)
    (tmp_path / "ping.py").write_text(ping)
    (tmp_path / "pong.py").write_text(pong)
    listen = f"unix/{tmp_path}/s"
    run = [*PROGRAM, "run", "sockets.toml", "--out", "out", "--set", f"sockets.listen={listen}"]
    commands = {"run": run, "ping": ["ping.py"], "pong": ["pong.py"]}
    environment = {**os.environ, "VCMVSP_SOCKETS": listen, "PYTHONPATH": str(HOME.parents[1])}
    started = {}
    try:
        for name in order:
            started[name] = subprocess.Popen(
                [sys.executable, *commands[name]], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
            )
        outputs = {name: process.communicate(timeout=500)[0] for name, process in started.items()}
    finally:
        for process in started.values():
            process.kill()
    assert [process.returncode for process in started.values()] == [0, 0, 0]
    assert outputs["ping"] == output
    assert outputs["pong"] == ""
