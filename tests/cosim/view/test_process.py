"""The process of a run's page: events are shown, orders come back, and it ends with the run."""

import http.client
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from websockets.sync.connection import Connection

from tests.support.cosim import view_pages
from tests.support.cosim.view_pages import PATIENCE_S
from tests.support.waiting import wait_for
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.scenario.schema import HaltTable
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.server import pump
from vcmvsp.cosim.view.live.session import Viewing
from vcmvsp.cosim.view.messages import Pace, PageUpdate

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SCENERY = view_pages.scenery()
CAMERA = {  # first message of a page
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 5.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewing]:
    """A page in its own process."""
    with Viewing(port=0).open(SCENERY) as opened:
        yield opened


def host_and_token(viewer: Viewing) -> tuple[str, str]:
    parts = urllib.parse.urlsplit(viewer.url)
    return parts.netloc, urllib.parse.parse_qs(parts.query)["token"][0]


def messages_to(page: Connection) -> list[dict[str, Any]]:
    """Next messages to the page; empty: none at present."""
    try:
        data = page.recv(timeout=0.1)
    except TimeoutError:
        return []
    return msgspec.msgpack.decode(view_pages.unpacked(data))["messages"]


def test_events_reach_the_page_and_buttons_give_orders(viewer: Viewing) -> None:
    feed, buttons = viewer.feed, dict[str, str]()
    with view_pages.page_connection(*host_and_token(viewer)) as page:
        page.send(msgspec.msgpack.encode(CAMERA))

        def press() -> bool:
            for message in messages_to(page):
                if message["type"] == "GuiButtonMessage":
                    buttons[message["props"]["label"]] = message["uuid"]
            return "Stop all vehicles" in buttons

        wait_for(press)
        stop = buttons["Stop all vehicles"]
        page.send(msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": stop, "updates": {"value": True}}))
        assert wait_for(feed.orders) == [HaltTable(at_s=0.0, halted=True)]
        feed.say("warning", "the bridge is up")
        feed.on(Event("world/states", SECOND_NS, view_pages.moving_state(SCENERY, 1.0).states))  # type: ignore[arg-type]  # not None
        feed.pace(Pace())
        wait_for(lambda: "the bridge is up" in str(messages_to(page)))


def test_a_browser_shows_the_page_without_errors_and_after_the_run_the_cause_and_the_last_state() -> None:
    end = "the run is complete; `vcmvsp view runs/a <b>` opens the recording"
    with view_pages.browser() as browser, Viewing(port=0).open(SCENERY) as viewer:
        page, errors = browser.new_page(), list[str]()
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("requestfailed", lambda request: errors.append(request.url))
        page.goto(viewer.url)
        page.get_by_role("button", name="Stop all vehicles").wait_for(timeout=1e3 * PATIENCE_S)
        assert "token" not in page.url
        assert errors == []
        viewer.feed.close(end)
        page.locator("#over").get_by_text(end).wait_for(timeout=1e3 * PATIENCE_S)
        viewer.close()
        page.locator("#disconnected").get_by_text(end).wait_for(timeout=1e3 * PATIENCE_S)
        assert page.get_by_role("button", name="Stop all vehicles").is_visible()
        viewer.close()
        with pytest.raises(ConnectionRefusedError):
            http.client.HTTPConnection(host_and_token(viewer)[0]).connect()


def test_a_run_outlives_its_page() -> None:
    with Viewing(port=0).open(SCENERY) as viewer:
        viewer._process.kill()
        viewer._process.wait()
        for k in range(3):
            viewer.feed.on(Event("world/states", k, view_pages.moving_state(SCENERY, 1.0).states))  # type: ignore[arg-type]  # not None
            viewer.feed.pace(Pace(speed=float(k)))
            time.sleep(0.05)
        assert not viewer.feed.open
        viewer.stay()


PARENT = """
import contextlib, sys
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live.session import Viewing
from vcmvsp.cosim.view.messages import Scenery
scenery = codec.Decoder(Scenery).decode(open(sys.argv[1], "rb").read())
with Viewing(port=0).open(scenery) as viewer, contextlib.suppress(KeyboardInterrupt):  # before it can stay, too
    print(viewer._process.pid, flush=True)
    viewer.stay()
print("done", flush=True)
"""


@pytest.mark.parametrize(
    ("number", "last", "code"), [(signal.SIGKILL, "", -9), (signal.SIGINT, "done\n", 0)], ids=["killed", "Ctrl-C"]
)
def test_the_process_ends_with_its_parent(number: signal.Signals, last: str, code: int, tmp_path: Path) -> None:
    (tmp_path / "scenery").write_bytes(codec.encode(SCENERY))
    command = [sys.executable, "-c", PARENT, str(tmp_path / "scenery")]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent, parent.stdout:
        child = int(parent.stdout.readline())
        assert is_running(child)
        parent.send_signal(number)
        assert parent.stdout.read() == last
        assert parent.wait(PATIENCE_S) == code
    wait_for(lambda: not is_running(child))


def is_running(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_waiting_updates_are_shown_together() -> None:
    sender, receiver = protocol.pair()
    shown: list[list[int]] = []
    assert all(sender.offer(codec.encode(PageUpdate(time_ns=k))) for k in range(20))
    sender.close()
    end = protocol.Pipe(receiver)
    pump(end, lambda *updates: shown.append([each.time_ns for each in updates]))
    end.close()
    assert shown == [[*range(20)]]


def test_drawing_does_not_block_the_run() -> None:
    sender, receiver = protocol.pair()
    times, drawing, go_on = list[int](), threading.Event(), threading.Event()

    def show(*updates: PageUpdate) -> None:
        times.append(updates[-1].time_ns)
        drawing.set()
        go_on.wait(PATIENCE_S)

    end = protocol.Pipe(receiver)
    thread = threading.Thread(target=pump, args=(end, show))
    thread.start()
    sender.offer(codec.encode(PageUpdate(time_ns=0)))
    drawing.wait(PATIENCE_S)
    taken = [k for k in range(1, 100_000) if sender.offer(codec.encode(PageUpdate(time_ns=k)))]
    assert taken[-1] < 99_999  # finally there was no room
    sender.close()
    go_on.set()
    thread.join(PATIENCE_S)
    end.close()
    assert times == [0, taken[-1]]


def test_no_secret_is_in_the_list_of_processes(viewer: Viewing) -> None:
    _, token = host_and_token(viewer)
    pid = viewer._process.pid
    for file in ("cmdline", "environ"):
        assert token.encode() not in Path(f"/proc/{pid}/{file}").read_bytes()
    assert os.getpgid(pid) == pid  # out of reach of Ctrl-C
