"""``vcmvsp watch`` at real runs: it shows the recorded values and does not change the run."""

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.reader import make_reader

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit, read_until, staged, wait_for
from tests.support.cosim.teams import FOLLOWER, LEADER, WAITS, team
from tests.support.cosim.view_pages import browser
from tests.support.paths import ROOT
from vcmvsp.cosim.cli import remote
from vcmvsp.cosim.hosts.observers import TopicValue
from vcmvsp.cosim.security import authority

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

SCENARIO = team("shown", LEADER, FOLLOWER, duration_s=2.0, loss=0.3, deadline_s=20.0, join_timeout_s=60.0)
SAME = ("car1/command", "car2/command", "car1/send", "car2/note", "car2/odometry", "car1/state", "radio/frame")


class WatchStage(Stage):
    """Runs with published topics, and their observers."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        (folder / "shown.toml").write_text(SCENARIO)

    def run(self, *more: str) -> subprocess.Popen[str]:
        return self.start("run", "shown.toml", "--listen", self.endpoint, "--out", "out", *more)

    def watch(self, name: str, *more: str) -> subprocess.Popen[str]:
        with (self.folder / name).open("wb") as out:
            return self.start("watch", self.endpoint, *more, stdout=out.fileno())

    def waiting(self, *more: str) -> subprocess.Popen[str]:
        """A run that begins when its host joins."""
        return self.run("--agents", "zenoh", "--realtime", *more)

    def host(self, *more: str) -> subprocess.Popen[str]:
        return self.start("agent", "--vehicle", "car1", "--vehicle", "car2", "--connect", self.endpoint, *more)

    def endless(self, *more: str) -> subprocess.Popen[str]:
        return self.run("--set", "duration_s=600", "--realtime", *more)

    def secure(self) -> None:
        """Certificates: of an observer, anna, and of both vehicles, laptop."""
        authority.init(self.folder / "keys")
        authority.issue(self.folder / "keys", "anna")
        authority.issue(self.folder / "keys", "laptop", ("car1", "car2"))
        self.endpoint = f"tls/127.0.0.1:{self.port}"

    def seen(self, name: str) -> list[dict[str, Any]]:
        return [json.loads(each) for each in (self.folder / name).read_text().splitlines()]

    def alone(self) -> str:
        """Digest of the run without observers."""
        return vcmvsp.run(self.folder / "shown.toml", mcap=False).metrics["digest"]


stage = staged(WatchStage)


class Watched(NamedTuple):
    """A run that observers have watched: two to its end, one that left, one that was stopped, and one on a terminal."""

    stage: WatchStage
    left: tuple[int, str]  # exit code and output
    stopped: str
    shown: str  # on the terminal


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """The first two wait for the run, which waits for its host: they receive it from its first event to its last."""
    with WatchStage(tmp_path_factory.mktemp("watched")) as stage:
        stage.secure()
        keys = ("--keys", "keys/anna.keys")
        first = stage.watch("all", "--json", *keys), stage.watch("one", "--topic", "car2/note", "--topic", "car1/*", *keys)
        read_until(first[0], "waiting for a run at")
        run = stage.waiting("--keys", "keys")
        stops, leaves = stage.watch("stops", "--json", *keys), stage.watch("leaves", "--json", *keys)
        controller, terminal = pty.openpty()
        shows = stage.start("watch", stage.endpoint, "--topic", "car1/command", *keys, stdout=terminal)
        os.close(terminal)
        for observer in (*first, stops, leaves, shows):
            read_until(observer, "watching")
        stops.send_signal(signal.SIGSTOP)
        leaves.send_signal(signal.SIGINT)
        left, host, shown = exit_of(leaves), stage.host("--keys", "keys/laptop.keys"), b""
        with contextlib.suppress(OSError):  # it has exited
            while data := os.read(controller, 65536):
                shown += data
        os.close(controller)
        assert [exit_of(each)[0] for each in (run, host, *first, shows)] == [0, 0, 0, 0, 0]
        stops.send_signal(signal.SIGCONT)
        yield Watched(stage, left, output_at_exit(0, stops), shown.decode())


def test_observers_see_the_recording(watched: Watched) -> None:
    recorded: dict[str, list[Any]] = {topic: [] for topic in SAME}
    with (watched.stage.out / "run.mcap").open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(SAME)):
            recorded[channel.topic].append((message.log_time, json.loads(message.data)))
    events = watched.stage.seen("all")
    for topic in SAME:
        assert recorded[topic]
        shown = [(each["time_ns"], each["value"]) for each in events if each["topic"] == topic]
        if topic == "car1/state":  # shown as often as published, recorded less often
            assert [each for each in shown if each in recorded[topic]] == recorded[topic]
        else:
            assert shown == recorded[topic]
        assert all(each["type"] == each["value"]["type"] for each in events)
    assert events[-1]["time_ns"] == 2_000_000_000
    lines = (watched.stage.folder / "one").read_text().splitlines()
    topics = {re.split(r"\s+", each.strip())[2] for each in lines}
    assert topics == {"car2/note", *(f"car1/{name}" for name in ("state", "estimate", "odometry", "command", "send"))}
    assert any(re.fullmatch(r" +\d\.\d00 s  car1/command      v 0\.\d\d m/s  w -?\d\.\d\d rad/s", each) for each in lines)


def test_observers_change_no_bit_also_if_they_hang_or_are_interrupted(watched: Watched) -> None:
    assert watched.stage.digest() == watched.stage.alone()
    assert watched.left == (130, "vcmvsp: interrupted\n")
    assert "the run has ended" in watched.stopped


def test_a_terminal_shows_the_newest_twice_a_second(watched: Watched) -> None:
    times = [float(each.split()[0]) for each in watched.shown.splitlines()]
    assert times[-1] == 1.9
    assert len(times) < 15  # of 20 events


def test_a_late_observer_sees_the_rest(stage: WatchStage) -> None:
    run = stage.endless()
    wait_for(stage.out / "run.mcap")
    rest = stage.watch("rest", "--json", "--topic", "car1/command", "--topic", "car1/state")
    read_until(rest, "watching")
    some = stage.watch("some", "--json", "--count", "5", "--topic", "car$*/note")
    assert exit_of(some)[0] == 0
    assert [each["topic"] for each in stage.seen("some")] == ["car2/note"] * 5
    run.send_signal(signal.SIGINT)
    assert [exit_of(each)[0] for each in (run, rest)] == [130, 0]
    times = [each["time_ns"] for each in stage.seen("rest")]
    assert times == sorted(times)
    assert 0 < times[0] <= stage.seen("some")[0]["time_ns"] < stage.seen("some")[-1]["time_ns"] <= times[-1]


def test_with_certificates_only_observers_watch(stage: WatchStage) -> None:
    stage.secure()
    authority.issue(stage.folder / "keys", "gone")
    authority.revoke(stage.folder / "keys", "gone")
    other = stage.folder / "other"
    authority.init(other)
    authority.issue(other, "anna")
    read_until(stage.waiting("--keys", "keys"), "vcmvsp agent")
    refusals = {
        "keys/laptop.keys": "is for the host of car1, car2; to watch, use a file made by 'vcmvsp keys observer NAME'",
        "keys/gone.keys": "'gone' is unknown to this run: its certificate was revoked",
        "other/anna.keys": "the run's certificate is of another authority",
        "keys/nobody.keys": "nobody.keys: cannot be read: No such file",
    }
    for file, words in refusals.items():
        code, _, err = vcmvsp_command("watch", stage.endpoint, "--keys", str(stage.folder / file))
        assert (code, len(err.splitlines())) == (2, 1)
        assert words in err
    code, _, err = vcmvsp_command("watch", stage.endpoint)
    assert code == 2
    assert "add --keys FILE (made on the run's machine with: vcmvsp keys observer NAME" in err


def test_a_page_elsewhere_shows_the_run_without_controls_and_changes_no_bit(stage: WatchStage) -> None:
    stage.secure()
    (stage.folder / "waits.py").write_text(WAITS)
    text = SCENARIO.replace(LEADER, 'kind = "waits.py:Waits", until = 1.0').replace("deadline_s = 20.0", "deadline_s = 300.0")
    (stage.folder / "shown.toml").write_text(text)
    with browser() as chromium:
        run = stage.run("--agents", "zenoh", "--keys", "keys")
        observer = stage.watch("page", "--keys", "keys/anna.keys", "--view", "--view-port", "0")
        host = stage.host("--keys", "keys/laptop.keys", "--folder", ".")
        url = read_until(observer, "control station: ").split()[-1]
        page = chromium.new_page()
        page.goto(url)
        page.get_by_text("car1, kinematic").wait_for(timeout=60_000)
        (stage.folder / "go").touch()
        page.locator("#over").get_by_text("the run is complete").wait_for(timeout=60_000)
        for control in ("Stop all vehicles", "End the run", "Pause", "Inject outage"):
            assert page.get_by_text(control).count() == 0
        assert [exit_of(each)[0] for each in (run, host, observer)] == [0, 0, 0]
    assert stage.digest() == stage.alone()


def test_a_page_excludes_options_of_lines() -> None:
    code, _, err = vcmvsp_command("watch", "tcp/127.0.0.1:1", "--view", "--json")
    assert (code, err) == (2, "vcmvsp: --view shows the whole run on a page: leave out --topic, --json and --count\n")


@pytest.mark.parametrize("topic", ["", "/", "car1/", "a//b", "car1/#", "a*"])
def test_topics_are_key_expressions(topic: str) -> None:
    code, _, err = vcmvsp_command("watch", "tcp/127.0.0.1:1", "--topic", topic)
    assert (code, err) == (
        2,
        f"vcmvsp: --topic {topic}: must be a topic such as car2/command, with * for one part and ** for any number\n",
    )


# --- words ---


HERE = "(1.00, 2.00, 0.00) m"
WORDS = [
    ("state", {"position": [1, 2, 0], "velocity": [3, 4, 0], "attitude": [1, 0, 0, 0]}, f"at {HERE}  yaw 0.00 rad  5.00 m/s"),
    ("velocity", {"linear": [0.3, 0, 0], "yaw_rate": -0.001}, "v 0.30 m/s  w 0.00 rad/s"),
    ("velocity", {"linear": [0.3, 0, 1], "yaw_rate": 0.5}, "(0.30, 0.00, 1.00) m/s  w 0.50 rad/s"),
    ("scan", {"ranges": [None, 2.5, 1.25]}, "3 beams, the nearest 1.25 m"),
    ("scan", {"ranges": [None]}, "1 beams, all free"),
    ("message", {"sender": "car1", "to": None, "size_bytes": 40, "body": {"x": 1.5}}, "car1 to all, 40 bytes: x 1.5"),
    ("frame", {"sender": "a", "size_bytes": 4, "receivers": ["b"], "outcome": ["fading"]}, "of a, 4 bytes: b fading"),
    ("note", {"values": {"mode": "\x1b[2J", "x": 1 / 3}}, "mode   x 0.3333"),
    ("looks", {"cell_m": 2.0, "cells": [[0, 1], [5, 5]], "hits": [True, False]}, "at 2 cells, 1 with a target"),
    ("map", {"columns": 3, "rows": 1, "cell_m": 2.0, "probability": "AID/", "seen": "AAEB"},
     "3 x 1 cells of 2 m, 67 % seen, 1 with P > 0.9"),
    ("mosaic", {"columns": 400, "rows": 300, "cell_m": 0.25, "pixels": "AAAA"}, "400 x 300 cells of 0.25 m"),
    ("sightings", {"sensor": "camera", "found": [], "jpeg": ""}, "camera: nothing"),
    ("sightings", {"sensor": "camera", "found": [{"target": "a", "score": 0.914, "place": [1, 2]}]},
     "camera: a 0.91 at (1.00, 2.00) m"),
    ("map", {"columns": 0, "rows": 0, "cell_m": 2.0, "probability": "", "seen": ""},
     '{"columns":0,"rows":0,"cell_m":2.0,"probability":"","seen":""}'),
    ("of tomorrow", {"x": [1, None]}, '{"x":[1,null]}'),
    ("state", {"position": None}, '{"position":null}'),
    ("velocity", None, "null"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "value", "words"), WORDS)
def test_values_in_words(kind: str, value: Any, words: str) -> None:
    line = remote.line(TopicValue(12_300_000_000, "car2/x", kind, json.dumps(value).encode()))
    assert line == f"   12.300 s  car2/x            {words}\n"


def test_invalid_json_is_shown_as_null() -> None:
    assert remote.line(TopicValue(0, "car2/x", "note", b"\xff{")) == "    0.000 s  car2/x            null\n"
    assert len(remote.words("x", "y" * 1000)) == remote.WIDTH


# --- without vcmvsp ---


def test_the_readme_watches_a_run(stage: WatchStage) -> None:
    """The program uses nothing of this project but that page."""
    readme = (ROOT / "cosim" / "hosts" / "README.md").read_text("utf-8")
    blocks = dict(re.findall(r"^```(json5|python)\n(.*?)^```", readme, re.DOTALL | re.MULTILINE))
    stage.endpoint = f"tls/127.0.0.1:{stage.port}"
    authority.init(stage.folder / "keys")
    authority.issue(stage.folder / "keys", "anna", out=stage.folder / "anna.keys")
    (stage.folder / "watch.json5").write_text(blocks["json5"].replace("tls/192.168.1.10:7447", stage.endpoint))
    (stage.folder / "program.py").write_text(blocks["python"])
    assert len(blocks["python"].splitlines()) <= 30
    assert "cosim" not in blocks["python"]
    program = subprocess.Popen(
        [sys.executable, "-I", "program.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=stage.folder
    )
    stage.processes.append(program)
    run = stage.endless("--keys", "keys")
    assert program.stdout is not None
    topics: dict[str, str] = {}
    for line in program.stdout:
        time_s, key, kind, _ = line.split(maxsplit=3)
        topics[key.removeprefix("vcmvsp/topic/car1/")] = kind
        if len(topics) == 5 and float(time_s) > 0.0:
            break
    program.kill()
    run.send_signal(signal.SIGINT)
    assert exit_of(run)[0] == 130
    kinds = {"state": "state", "estimate": "state", "odometry": "odometry", "command": "velocity", "send": "message"}
    assert topics == kinds
