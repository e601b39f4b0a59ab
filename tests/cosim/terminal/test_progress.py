"""Progress display: on a terminal a bar and a table that leave nothing behind, in a log file lines."""

import contextlib
import fcntl
import io
import os
import re
import struct
import sys
import termios
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

import vcmvsp
from tests.support.cosim.command_line import two_cars
from tests.support.cosim.recordings import states
from tests.support.cosim.studies import two
from vcmvsp.cosim.cli.app import main
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.terminal import progress
from vcmvsp.cosim.terminal.progress import Progress, StudyProgress
from vcmvsp.cosim.util.text import stdout_to_stderr

SEQUENCE = re.compile(rb"\x1b\[([0-9;?]*)([A-Za-z])")
REAL = ("fixes", "gated", "limited_s", "frames_too_early")
POSES = {"car1": (1.0, 2.0, 0.0), "car2": (3.0, 4.0, 0.0)}


class Terminal:
    """A pseudo-terminal and the contents of its screen. Within it, it is stderr."""

    def __init__(self, columns: int, lines: int) -> None:
        self._controller, terminal_end = os.openpty()
        self.file: IO[str] = os.fdopen(terminal_end, "w", buffering=1)
        self.resize(columns, lines)
        self._data = bytearray()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> None:
        self._stack = contextlib.ExitStack()
        self._stack.enter_context(contextlib.redirect_stderr(self.file))
        saved = os.dup(2)
        self._stack.callback(os.close, saved)
        self._stack.callback(os.dup2, saved, 2)
        os.dup2(self.file.fileno(), 2)  # source of the terminal's width

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def resize(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self.file.fileno(), termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def _read(self) -> None:
        with contextlib.suppress(OSError):  # the other end is closed
            while data := os.read(self._controller, 65536):
                self._data += data

    def sent(self) -> bytes:
        """All written bytes; complete: they end with a mark of this call, which is removed."""
        mark = b"\x00%d\x00" % len(self._data)
        os.write(self.file.fileno(), mark)
        until = time.monotonic() + 60.0
        while not self._data.endswith(mark):
            assert time.monotonic() < until
            time.sleep(0.001)
        del self._data[-len(mark) :]
        return bytes(self._data)

    def screen(self) -> list[str]:
        """Current lines of the screen."""
        rows, row, column = [""], 0, 0
        for part in re.split(rb"(\x1b\[[0-9;?]*[A-Za-z]|\r|\n)", self.sent()):
            found = SEQUENCE.fullmatch(part)
            if found and found[2] == b"A":
                row -= int(found[1] or b"1")
            elif found and found[2] == b"K":
                rows[row] = ""
            elif part == b"\r":
                column = 0
            elif part == b"\n":
                row += 1
                rows += [""] * (row + 1 - len(rows))
            elif not found:
                text = part.decode()
                rows[row] = rows[row][:column].ljust(column) + text + rows[row][column + len(text) :]
                column += len(text)
        return rows

    def close(self) -> None:
        self.file.close()
        self._reader.join(10.0)
        os.close(self._controller)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """A terminal on which everything is drawn at once."""
    shown = Terminal(100, 30)
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(progress, "DRAW_EVERY_S", 0.0)
    monkeypatch.setattr(progress, "SHARE", 0.0)
    yield shown
    shown.close()


def show_vehicles(shown: Progress) -> None:
    """Show two vehicles half-way through a run."""
    observer = shown.observer({"car1": "trajectory"})
    assert observer is not None
    observer(states(0, POSES))
    shown.on_instant(5 * SECOND_NS, 10 * SECOND_NS)


def test_a_bar_is_above_the_vehicles_and_all_is_erased_at_the_end(terminal: Terminal) -> None:
    with terminal, Progress(quiet=False) as shown:
        show_vehicles(shown)
        bar, head, *vehicles = [line for line in terminal.screen() if line]
        assert "5.0 of 10 s" in bar
        assert head.startswith("vehicle  state")
        assert [line.split()[:2] for line in vehicles] == [["car1", "ok"], ["car2", "ok"]]
        shown.on_instant(6 * SECOND_NS, 10 * SECOND_NS)
        assert "6.0 of 10 s" in terminal.screen()[0]
        assert len([line for line in terminal.screen() if line]) == 4  # in the same place
    assert not any(terminal.screen())


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_the_cursor_comes_back_after_any_error(terminal: Terminal, error: type[BaseException]) -> None:
    def stopped() -> None:
        with terminal, Progress(quiet=False) as shown:
            show_vehicles(shown)
            assert terminal.sent().rfind(b"\x1b[?25l") > terminal.sent().rfind(b"\x1b[?25h")  # hidden
            raise error

    with pytest.raises(error):
        stopped()
    assert terminal.sent().rfind(b"\x1b[?25h") > terminal.sent().rfind(b"\x1b[?25l")
    assert not any(terminal.screen())


def test_lines_for_the_user_stay_above_the_bar(terminal: Terminal) -> None:
    with terminal, Progress(quiet=False) as shown:
        show_vehicles(shown)
        shown.tell("car2 is [bold]lost[/bold]")
        shown.on_instant(6 * SECOND_NS, 10 * SECOND_NS)
        lines = [line.rstrip() for line in terminal.screen() if line]
        assert lines[0] == "car2 is [bold]lost[/bold]"
        assert "6.0 of 10 s" in lines[1]
    assert [line.rstrip() for line in terminal.screen() if line] == ["car2 is [bold]lost[/bold]"]


@pytest.mark.parametrize("columns", [20, 40, 60, 80])
def test_lines_fit_a_terminal_that_becomes_narrow(terminal: Terminal, columns: int) -> None:
    with terminal, Progress(quiet=False) as shown:
        show_vehicles(shown)
        before = len(terminal.sent())
        terminal.resize(columns, 12)
        shown.on_instant(6 * SECOND_NS, 10 * SECOND_NS)
        drawn = SEQUENCE.sub(b"", terminal.sent()[before:]).decode().replace("\r", "").split("\n")
    assert any("car2" in line for line in drawn)
    assert any("6.0" in line for line in drawn)
    assert max(map(len, drawn)) <= columns


def test_no_color_removes_colours(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    with terminal, Progress(quiet=False) as shown:
        show_vehicles(shown)
    kinds = {found[1] + found[2] for found in SEQUENCE.finditer(terminal.sent())}
    assert kinds <= {b"?25l", b"?25h", b"1A", b"2K"}
    assert terminal.sent().count(b"\x1b") == len(SEQUENCE.findall(terminal.sent()))


def test_drawing_takes_a_bounded_share_of_the_time(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    now, draws = [100.0], list[float]()
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "DRAW_EVERY_S", 0.25)
    monkeypatch.setattr(progress, "SHARE", 100.0)

    def slow(*_: object) -> None:
        draws.append(now[0])
        now[0] += 0.01

    monkeypatch.setattr(Progress, "_draw_on", slow)
    with terminal, Progress(quiet=False) as shown:
        for k in range(10_000):
            now[0] += 0.001
            shown.on_instant(k, SECOND_NS)
    assert 0.01 * len(draws) < 0.0102 * (now[0] - 100.0)
    assert len(draws) >= 9


def test_the_last_shown_speed_is_of_the_whole_run(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "DRAW_EVERY_S", 0.25)
    texts: list[str] = []
    monkeypatch.setattr(Progress, "_draw_on", lambda _shown, _screen, _completed, _total, text: texts.append(text))
    with terminal, Progress(quiet=False) as shown:
        for tenths in (0, 3, 4):  # too early to be drawn, except as the last
            now[0] = 100.0 + 0.1 * tenths
            shown.on_instant(tenths * SECOND_NS // 2, 2 * SECOND_NS)
    assert texts == ["1.5 of 2 s, 5.0x, 0 s left", "2.0 of 2 s, 5.0x, writing"]


def test_a_lost_terminal_does_not_end_the_run(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with terminal, Progress(quiet=False) as shown:
        show_vehicles(shown)
        monkeypatch.setattr(Progress, "_draw_on", gone)
        for now_ns in (6, 7):
            shown.on_instant(now_ns * SECOND_NS, 10 * SECOND_NS)


def test_a_run_shows_its_vehicles_and_keeps_its_answer_for_stdout(
    terminal: Terminal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.toml").write_text(two_cars(), "utf-8")
    answer = io.StringIO()
    with terminal, contextlib.redirect_stdout(answer), contextlib.suppress(SystemExit):
        main(["run", "s.toml", "--out", "out"])
    sent = terminal.sent().decode()
    assert re.search(r"car2 +ok +leader_follower", sent)
    assert "error [m]" in sent
    assert not any(terminal.screen())
    assert answer.getvalue().startswith("two-cars: 2 agents (inprocess), 0.5 s simulated in ")
    assert answer.getvalue().endswith("results:   out\n")


def test_printing_during_progress_keeps_stdout(terminal: Terminal) -> None:
    before = sys.stdout
    with terminal, stdout_to_stderr(), Progress(quiet=False) as shown:
        show_vehicles(shown)
        print("an agent says so")  # noqa: T201
        shown.on_instant(6 * SECOND_NS, 10 * SECOND_NS)
    assert sys.stdout is before
    assert [line.rstrip() for line in terminal.screen() if line] == ["an agent says so"]


def test_a_dumb_terminal_gets_lines_like_a_file(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    with terminal, Progress(quiet=False) as shown:
        assert shown.observer({}) is None  # it costs nothing
        shown.on_instant(5 * SECOND_NS, 10 * SECOND_NS)
    assert b"\x1b" not in terminal.sent()
    assert terminal.screen()[0].startswith("5.0 of 10 s simulated (50 %, ")


def test_a_file_has_plain_lines_even_where_colours_are_forced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    with (tmp_path / "log").open("w+") as log, contextlib.redirect_stderr(log):
        with Progress(quiet=False) as shown:
            shown.tell("waiting for car2")
            shown.on_instant(5 * SECOND_NS, 10 * SECOND_NS)
        log.seek(0)
        text = log.read()
    assert "\x1b" not in text
    assert [line.split(" simulated")[0] for line in text.splitlines()] == ["waiting for car2", "5.0 of 10 s"]


def test_quiet_is_quiet_on_a_terminal(terminal: Terminal) -> None:
    with terminal, Progress(quiet=True) as shown:
        assert shown.observer({}) is None
        shown.on_instant(5 * SECOND_NS, 10 * SECOND_NS)
        shown.tell("a line")
    assert terminal.sent() == b""


def test_a_study_shows_the_range_of_its_first_metric(terminal: Terminal) -> None:
    with terminal, StudyProgress(quiet=False) as shown:
        shown.on_run(0, 0, 4)
        for done, value in enumerate((0.25, 0.0123456, 0.5), 1):
            shown.on_value("formation.rms_m", value)
            shown.on_run(done, 0, 4)
        assert "3 of 4 runs done" in terminal.screen()[0]
        assert "formation.rms_m 0.0123 to 0.5" in terminal.screen()[0]


def test_the_summary_of_a_run_has_columns() -> None:
    result = vcmvsp.run(tomllib.loads(two_cars()), mcap=False)
    result.metrics["safety"]["collisions"] = 2
    result.metrics["agents"]["car2"]["lost_s"] = 0.25
    result.metrics["hardware"] = {"a-vehicle-of-a-long-name": {**dict.fromkeys(REAL, 0), "age_s": {"p50": 0.01}, "stops": {}}}
    head, *lines = progress.summary(result).splitlines()
    assert head.startswith("two-cars: 2 agents (inprocess), 0.5 s simulated in ")
    entries = dict(line.split(": ", 1) for line in lines)
    assert {len(line) - len(line.split(": ", 1)[1].lstrip()) for line in lines} == {len("a-vehicle-of-a-long-name: ")}
    assert entries["safety"].strip() == "2 collisions"
    assert entries["lost"].strip() == "car2 for 0.2 s"
    assert list(entries)[-1] == "results"


def test_the_summary_reports_frames_all_under_way() -> None:
    result = vcmvsp.run(two(duration_s=0.05, radio={"preset": "ideal", "delay": {"seconds": 0.3}}), mcap=False)
    assert "radio:     1 frames, all still under way\n" in progress.summary(result)


def test_routing_with_one_vehicle_has_no_delivery_ratio() -> None:
    content = {**tomllib.loads(two_cars()), "routing": {"kind": "flooding"}}
    summary = progress.summary(vcmvsp.run(content, mcap=False))
    assert "routing:   5 messages, 100.0 % delivered over 1.0 hops (1 at most), 5 frames passed on\n" in summary
    content["vehicle"] = content["vehicle"][:1]
    assert "routing:   5 messages, 0 frames passed on\n" in progress.summary(vcmvsp.run(content, mcap=False))
