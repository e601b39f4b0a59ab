"""``vcmvsp view``: refusals, output, the served page, and exit."""

import json
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.command_line import assert_refused, two_cars, vcmvsp_command
from tests.support.cosim.recorded_run import chunk_ends
from tests.support.cosim.run_processes import VCMVSP
from tests.support.cosim.view_pages import browser, positions
from vcmvsp.cosim.tables.columns import numbers
from vcmvsp.cosim.tables.schema import load

pytestmark = [pytest.mark.processes, pytest.mark.sockets, pytest.mark.browser]

PATIENCE_S = 45.0
ROBOTS = "/vehicles/ground"


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of half a second."""
    folder = tmp_path_factory.mktemp("view")
    (folder / "s.toml").write_text(two_cars())
    vcmvsp.run(folder / "s.toml", out=folder / "out")
    return folder / "out"


@contextmanager
def viewing(run_dir: Path, *options: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """The process and the first line of its output."""
    command = [*VCMVSP, "view", str(run_dir), "--port", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().rstrip("\n")
        finally:
            process.kill()


@pytest.mark.parametrize("name", ["nowhere", "empty", "file.txt", "zeros"])
def test_it_refuses_a_path_without_a_recording(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").touch()
    (tmp_path / "zeros").mkdir()
    (tmp_path / "zeros" / "run.mcap").write_bytes(bytes(100))
    assert_refused(vcmvsp_command("view", str(tmp_path / name)), f"vcmvsp: {tmp_path / name}")


@pytest.mark.parametrize("options", [["--port"], ["--view-host", "127.0.0.1", "--view-port"]])
def test_a_port_in_use_is_refused_in_one_line(run_dir: Path, options: list[str]) -> None:
    """The options of `vcmvsp run` choose the page, too."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        assert_refused(vcmvsp_command("view", str(run_dir), *options, port), "--view-port", port)


@pytest.mark.parametrize("place", ["vcmvsp.cosim.view.player.recording.Recording", "vcmvsp.cosim.view.web_server.open_server"])
def test_an_end_before_the_page_is_no_success(place: str, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A caller that waits for the page is informed that there is none."""

    def interrupted(*_: object) -> NoReturn:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the signal was not heard")

    monkeypatch.setattr(place, interrupted)
    assert vcmvsp_command("view", str(run_dir), "--port", "0") == (130, "", "vcmvsp: interrupted\n")


@pytest.mark.parametrize(("number", "options"), [(signal.SIGINT, []), (signal.SIGTERM, ["--json"])])
def test_it_prints_a_url_serves_the_page_only_there_and_ends_quietly(run_dir: Path, number: int, options: list[str]) -> None:
    with viewing(run_dir, *options) as (process, line):
        url = json.loads(line)["url"] if options else line
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.build_opener(urllib.request.HTTPCookieProcessor()).open(url, timeout=PATIENCE_S) as page:
            assert b"<html" in page.read().lower()
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(url.partition("?")[0], timeout=PATIENCE_S)
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, out, err) == (0, "", "")


def test_a_truncated_recording_is_shown_with_a_warning(run_dir: Path, tmp_path: Path) -> None:
    data = (run_dir / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: chunk_ends(data)[-1]])
    with viewing(tmp_path) as (process, url):
        assert url.startswith("http://")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert [line.partition(": ")[0] for line in err.splitlines()] == [str(tmp_path)] * 2
    assert "it is truncated" in err


def test_a_browser_shows_vehicles_at_recorded_places(run_dir: Path) -> None:
    """The page opens at the end of the recording."""
    table = load(run_dir).states
    truth = np.column_stack([numbers(table, name) for name in ("x", "y", "z")])[-2:]
    with viewing(run_dir) as (_, url), browser() as started:
        page = started.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda problem: problems.append(str(problem)))
        page.goto(url)
        page.locator("#over").get_by_text("the run is complete").wait_for(timeout=1e3 * PATIENCE_S)
        page.wait_for_function(f"window.__viserSceneTree?.getState()['{ROBOTS}'] !== undefined", timeout=1e3 * PATIENCE_S)
        end_s = time.monotonic() + PATIENCE_S
        while not np.allclose(shown := positions(page, ROBOTS)[:, :2], truth[:, :2], atol=0.06):  # centres of bodies
            assert time.monotonic() < end_s, shown
            page.wait_for_timeout(50)
        assert problems == []
