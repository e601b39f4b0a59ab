"""A run that is watched live, from the command to the browser and back."""

import json
import re
import signal
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.run_processes import read_until, served
from tests.support.cosim.view_pages import browser, positions
from vcmvsp.cosim.tables.schema import load

pytestmark = [pytest.mark.processes, pytest.mark.browser]

WAIT_MS = 60_000
PICTURES = "Array.from(document.images).map(image => image.src).filter(src => src.startsWith('blob:'))"

SCENARIO = """
name = "looked-at"
duration_s = 3000.0
seed = 3

[physics]
kind = "kinematic"

[world]
kind = "boxes"
boxes = [{ center = [6, 6, 1], size = [3, 3, 2] }, { center = [-6, 6, 1], size = [1, 1, 2], color = [200, 30, 30] }]

[radio.loss]
kind = "bernoulli"
probability = 0.0

[agents]
period_s = 0.1

[vehicles]
kind = "kinematic"
sensors = { eye = { kind = "camera", rate_hz = 10.0, width = 64, height = 48 } }

[[vehicle]]
name = "car1"
agent = { kind = "trajectory", path = "circle" }

[[vehicle]]
name = "car2"
pose = [0.0, -1.0, 0.0]
agent = { kind = "leader_follower", leader = "car1" }
"""


def is_trouble(message: Any) -> bool:
    """Whether a message is an error; viser logs a harmless one where a chart is remade while the page is loading."""
    return message.type == "error" and "non-existent component" not in message.text


def watched_run(folder: Path, *options: str) -> AbstractContextManager[tuple["subprocess.Popen[str]", str]]:
    """The process of a run, and the URL of its page."""
    (folder / "looked-at.toml").write_text(SCENARIO)
    page_and_files = ("--view", "--view-port", "0", "--out", "out")
    return served(folder, "control station: ", "run", "looked-at.toml", *page_and_files, *options)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as started:
        yield started


def test_a_click_in_the_browser_loses_frames_of_the_run_and_the_run_can_be_repeated(chromium: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with watched_run(tmp_path) as (process, url):
        page = chromium.new_page(viewport={"width": 1000, "height": 600})
        problems: list[str] = []
        page.on("console", lambda message: problems.append(message.text) if is_trouble(message) else None)
        page.goto(url)
        page.wait_for_function("window.__viserSceneTree?.getState()['/vehicles/ground'] !== undefined", timeout=WAIT_MS)
        _until_it_changes(page, lambda: positions(page, "/vehicles/ground").round(1).tolist())
        page.get_by_label("eye (camera)").check()
        _until_it_changes(page, lambda: page.evaluate(PICTURES))
        page.get_by_text("Radio outage").click()
        page.get_by_role("button", name="Inject outage").click()
        page.get_by_text("no radio for car1, car2").wait_for(timeout=WAIT_MS)
        begin_s = _time_s(page)
        _until(page, lambda: _time_s(page) > begin_s + 0.5)  # five frames of each vehicle
        page.get_by_role("button", name="End the run").click()
        page.get_by_role("button", name="Yes, end it now").click()
        assert process.wait(WAIT_MS / 1e3) == 130
        assert problems == []
        page.close()
    assert set(load(out).radio["outcome"].to_pylist()) - {"under way"} == {"received", "outage"}
    resolved = tomllib.loads((out / "scenario.toml").read_text())
    assert [each["kind"] for each in resolved["intervention"]] == ["outage"]
    again = vcmvsp.run(out / "scenario.toml", set={"duration_s": json.loads((out / "metrics.json").read_text())["duration_s"]})
    end_ns = again.radio["sent_ns"].to_pylist()[-1]  # the interrupted run may have begun one more instant
    assert _lost(again.radio) == [each for each in _lost(load(out).radio) if each["sent_ns"] <= end_ns]


def test_the_page_opens_before_the_agents_join_and_shows_a_failed_start(chromium: Any, tmp_path: Path) -> None:
    hosts = ("--agents", "zenoh", "--listen", "tcp/127.0.0.1:0", "--set", "agents.join_timeout_s=6")
    with watched_run(tmp_path, *hosts) as (process, url):
        read_until(process, "vcmvsp agent")
        process.send_signal(signal.SIGSTOP)
        page = chromium.new_page()
        page.goto(url)
        page.get_by_text("waiting for its agents").wait_for(timeout=WAIT_MS)
        process.send_signal(signal.SIGCONT)
        page.locator("#over").wait_for(timeout=WAIT_MS)
        assert "car1" in page.inner_text("#over")  # name of an agent that did not join


def _lost(frames: Any) -> list[Any]:
    """Frames that were lost in an outage."""
    return [each for each in frames.to_pylist() if each["outcome"] == "outage"]


def _time_s(page: Any) -> float:
    """Simulated time on the page, s."""
    match = re.search(r"([\d.]+) s of 3000 s", page.inner_text("body"))
    assert match is not None
    return float(match[1])


def _until(page: Any, holds: Callable[[], bool]) -> None:
    """Wait until ``holds`` returns true."""
    end_s = time.monotonic() + WAIT_MS / 1e3
    while not holds():
        assert time.monotonic() < end_s
        page.wait_for_timeout(100)


def _until_it_changes(page: Any, look: Callable[[], Any]) -> None:
    """Wait until ``look`` returns something, and then something else."""
    first: list[Any] = []

    def changed() -> bool:
        value = look()
        if value and not first:
            first.append(value)
        return bool(value) and value != first[0]

    _until(page, changed)
