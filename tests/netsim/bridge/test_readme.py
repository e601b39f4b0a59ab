"""The README's example and its user-written gateway work as printed."""

import asyncio
import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tests.support.cosim.run_processes import PROGRAM
from tests.support.docs.readme_pages import PAGES, block
from tests.support.netsim.bridge_runs import BridgeRun, background_run
from tests.support.netsim.gateway_context import RunlessContext, free_ports, open_gateway
from tests.support.paths import ROOT
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.netsim.bridge.gateways.base import Gateway

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

HOME = ROOT / "netsim" / "bridge"
PAGE = "netsim/bridge/README.md"
README = PAGES[PAGE]


def at_ports(first: int, text: str) -> str:
    """The same text with other ports."""
    return re.sub(r"\b18(\d{3})\b", lambda port: str(first + int(port[1])), text)


def test_the_worked_example(tmp_path: Path) -> None:
    first = free_ports(200)
    for name, text in {
        "two-programs.toml": block(PAGE, 'two-programs"'),
        "echo.py": block(PAGE, "hears.sendto"),
        "ask.py": block(PAGE, "asks.sendto"),
    }.items():
        (tmp_path / name).write_text(at_ports(first, text))
    (command,) = re.findall(r"^    vcmvsp (run .*?) +#", README, re.MULTILINE)
    shorter = [*command.split(), "--set", "duration_s=3.0"]
    environment = {**os.environ, "PYTHONPATH": str(HOME.parents[1])}

    def start(*arguments: str, **streams: int) -> "subprocess.Popen[str]":
        return subprocess.Popen([sys.executable, *arguments], cwd=tmp_path, env=environment, encoding="utf-8", **streams)  # type: ignore[call-overload]

    started = [start("echo.py"), run := start(*PROGRAM, *shorter, stderr=subprocess.PIPE)]
    try:
        lines = [run.stderr.readline() for _ in range(2)] if run.stderr else []  # its ports are open from now on
        started.append(ask := start("ask.py", stdout=subprocess.PIPE))
        answers = ask.communicate(timeout=500)[0].splitlines()
        _, rest = run.communicate(timeout=500)
    finally:
        for process in started:
            process.kill()
            process.communicate()
    assert [line.split()[:3] for line in lines] == [["bridge.udp:", car, "sends"] for car in ("car1", "car2")]
    assert (ask.returncode, run.returncode) == (0, 0), rest
    assert [line.partition(":")[0] for line in answers] == [str(number) for number in range(20)]
    answered = sum(line.endswith(" ms") for line in answers)
    out = tmp_path / "two-programs"
    rows = pq.read_table(out / "bridge.parquet").to_pylist()
    left = [row for row in rows if row["late_s"] is not None]
    assert 0 < answered <= sum(row["receiver"] == "car1" for row in left)
    assert all(15_000_000 <= row["wanted_ns"] - row["came_ns"] <= 25_000_000 for row in rows)
    carried = json.loads((out / "about.json").read_text())["bridge"]
    assert carried["delivered"] == len(left)
    columns = re.search(r"`bridge.parquet` has a row per delivery: `(.*?)`.*?and `(.*?)`", " ".join(README.split()))
    assert columns
    assert [*rows[0]] == [*columns[1].split(", "), columns[2]]


def test_the_ten_lines_of_the_radios_page(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "setdefaulttimeout", lambda seconds: None)  # for all later tests
    run = BridgeRun("car1", "car2", "car3", delay={"seconds": 0.02})
    with background_run(run):
        space: dict[str, Any] = {}
        text = at_ports(run.first_port, block("docs/howto/programs.md", "where are you?"))
        exec(compile(text, "radio.md", "exec", dont_inherit=True), space)
        for each in ("car1", "car2"):
            space[each].close()
    assert capsys.readouterr().out == "b'behind you'\n"
    assert [(report.sender, report.receivers) for report in run.reports] == [("car1", ("car2",)), ("car2", ("car1",))]


async def test_the_custom_gateway_of_the_page_works(tmp_path: Path) -> None:
    space: dict[str, Any] = {}
    exec(compile(block(PAGE, "class RollCall"), "README.md", "exec", dont_inherit=True), space)
    path = tmp_path / "heard.txt"
    gateway: Gateway = space["RollCall"](out=str(path))
    async with open_gateway(gateway, RunlessContext(("a", "b", "c"))) as context:
        await asyncio.sleep(0.01)  # everything due before is delivered by then
    (line,) = context.lines
    assert str(path) in line
    assert sorted(path.read_text().splitlines()) == [f"{x} heard {y}" for x in "abc" for y in "abc" if x != y]


def test_every_gateway_has_a_section() -> None:
    for kind in builtin_kinds.KINDS["door"]:
        assert f"`[bridge.{kind}]`" in README
