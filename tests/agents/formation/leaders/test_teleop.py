"""A leader driven by hand: keys through a pseudo-terminal, joystick events through a pipe, a table."""

import contextlib
import os
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.agents.agent_loop import bodies, info, observe
from vcmvsp.agents.formation.leaders.teleop import Teleop
from vcmvsp.cosim.agent import Radio

pytestmark = pytest.mark.processes

INFO = info("car1", ("car1", "car2"))
FAST: dict[str, Any] = {"acceleration": 1e3, "yaw_acceleration": 1e3, "max_reverse": 1.0}  # no visible ramp
UP, DOWN, RIGHT, LEFT = b"\x1b[A", b"\x1b[B", b"\x1b[C", b"\x1b[D"


class Hand:
    """A started agent, tick by tick."""

    def __init__(self, agent: Teleop) -> None:
        self.agent, self.tick = agent, 0
        self.radio = Radio("car1", ("car1", "car2"))
        agent.start(INFO)

    def __call__(self) -> tuple[float, float]:
        command = self.agent.act(observe((0.0, 0.0, 0.0), self.tick * 100_000_000), self.radio)
        self.notes, self.sent = self.agent.drain_notes(), bodies(self.radio)
        self.tick += 1
        return command.linear[0], command.yaw_rate


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The user's end of a pseudo-terminal, and the path of the other end."""
    person, other = os.openpty()
    yield person, os.ttyname(other)
    for end in (person, other):
        with contextlib.suppress(OSError):
            os.close(end)


@pytest.mark.parametrize(
    ("keys", "v", "w"),
    [
        (b"", 0, 0),
        (b"w", 1, 0),
        (b"WWw", 3, 0),
        (UP * 9, 4, 0),
        (b"\x1bOA\x1bOD", 1, 1),
        (DOWN + b"S", -2, 0),
        (LEFT * 2 + b"d", 0, 1),
        (RIGHT * 9 + b"a", 0, -3),
        (b"wwaa ", 0, 0),
        (b"ww wd", 1, -1),
        (b"?\x1b[Z\x7f\xc3\xa4w", 1, 0),
    ],
)
def test_each_press_is_a_quarter_of_the_limit_and_space_stops(terminal: tuple[int, str], keys: bytes, v: int, w: int) -> None:
    person, path = terminal
    hand = Hand(Teleop(path, speed=0.8, yaw_rate=2.0, **FAST))
    os.write(person, keys)
    assert hand() == pytest.approx((0.8 * v / 4, 2.0 * w / 4))
    assert hand() == pytest.approx((0.8 * v / 4, 2.0 * w / 4))  # the speed stays
    hand.agent.close()


def test_an_arrow_in_single_bytes_is_one_press(terminal: tuple[int, str]) -> None:
    person, path = terminal
    hand = Hand(Teleop(path, speed=0.8, **FAST))
    speeds = []
    for byte in UP + LEFT:
        os.write(person, bytes([byte]))
        speeds.append(hand())
    assert [v for v, _ in speeds] == pytest.approx([0, 0, 0.2, 0.2, 0.2, 0.2])
    assert [w for _, w in speeds] == pytest.approx([0, 0, 0, 0, 0, 0.125])
    hand.agent.close()


def test_the_terminal_is_restored(terminal: tuple[int, str]) -> None:
    person, path = terminal
    before = termios.tcgetattr(person)
    hand = Hand(Teleop(path))
    during = termios.tcgetattr(person)
    assert not during[3] & (termios.ICANON | termios.ECHO)  # keys arrive at once and without echo
    assert during[3] & termios.ISIG  # Ctrl-C still ends the run
    hand.agent.close()
    hand.agent.close()
    assert termios.tcgetattr(person) == before


def test_the_terminal_is_restored_when_the_process_fails(terminal: tuple[int, str]) -> None:
    person, path = terminal
    before = termios.tcgetattr(person)
    code = (
        "import sys; from vcmvsp.agents.formation.leaders.teleop import Teleop; from vcmvsp.cosim.agent import VehicleInfo\n"
        f"agent = Teleop({path!r})\n"
        "agent.start(VehicleInfo(name='a', vehicles=('a',), period_s=0.1, latency_s=0.0, seed=1))\n"
        "import termios, os; fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)\n"
        "print(bool(termios.tcgetattr(fd)[3] & termios.ICANON)); 1 / 0"
    )
    ended = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
    assert ended.stdout == "False\n"
    assert "ZeroDivisionError" in ended.stderr
    assert termios.tcgetattr(person) == before


def test_without_a_terminal_the_keyboard_is_refused() -> None:
    """A process in a session of its own has no terminal."""
    code = (
        "from vcmvsp.agents.formation.leaders.teleop import Teleop; from vcmvsp.cosim.agent import VehicleInfo\n"
        "Teleop().start(VehicleInfo(name='a', vehicles=('a',), period_s=0.1, latency_s=0.0, seed=1))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, start_new_session=True)
    assert "device = 'keyboard': this process has no terminal; allowed are 'keyboard' (" in ended.stderr


def event(kind: int, number: int, value: int) -> bytes:
    return struct.pack("=IhBB", 12345, value, kind, number)


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[tuple[int, str]]:
    """The write end of a pipe that replaces a joystick, and its path."""
    path = tmp_path / "js0"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    yield writer, str(path)
    with contextlib.suppress(OSError):
        os.close(writer)


@pytest.mark.parametrize(
    ("events", "v", "w"),
    [
        (b"", 0.0, 0.0),
        (event(2, 1, -32767), 0.8, 0.0),  # forward is negative
        (event(0x82, 1, 32767) + event(0x82, 0, -32767), -0.8, 2.0),  # the state at the start; left is negative
        (event(2, 0, 32767), 0.0, -2.0),
        (event(2, 1, -32768), 0.8, 0.0),
        (event(2, 1, 3276) + event(2, 0, -3276), 0.0, 0.0),  # inside the dead band
        (event(2, 1, -round(0.55 * 32767)), 0.4, 0.0),  # half of the range beyond the dead band
        (event(2, 1, -32767) + event(2, 1, 0), 0.0, 0.0),  # the last event counts
        (event(1, 1, 1) + event(2, 5, -32767), 0.0, 0.0),  # a button, another axis
    ],
)
def test_a_joysticks_axes_are_shares_of_the_limits(pipe: tuple[int, str], events: bytes, v: float, w: float) -> None:
    writer, path = pipe
    hand = Hand(Teleop(path, speed=0.8, yaw_rate=2.0, **FAST))
    os.write(writer, events)
    assert hand() == pytest.approx((v, w), abs=1e-4)
    hand.agent.close()


def test_events_may_arrive_in_pieces_and_axes_can_be_chosen(pipe: tuple[int, str]) -> None:
    writer, path = pipe
    hand = Hand(Teleop(path, speed=0.8, axes=(4, 3), **FAST))
    both = event(2, 4, -32767) + event(2, 3, -32767)
    speeds = []
    for piece in (both[:3], both[3:11], both[11:]):
        os.write(writer, piece)
        speeds.append(hand())
    assert speeds == [(0.0, 0.0), (0.8, 0.0), (0.8, 0.5)]


def test_without_its_joystick_the_vehicle_stops_by_its_ramp(pipe: tuple[int, str]) -> None:
    writer, path = pipe
    hand = Hand(Teleop(path, speed=0.8, acceleration=2.0, yaw_acceleration=10.0))
    os.write(writer, event(2, 1, -32767) + event(2, 0, -32767))
    speeds = np.array([hand() for _ in range(5)])
    np.testing.assert_allclose(speeds, [(0.2, 0.5), (0.4, 0.5), (0.6, 0.5), (0.8, 0.5), (0.8, 0.5)], atol=1e-12)
    assert "status" not in hand.notes
    os.close(writer)
    speeds = np.array([hand() for _ in range(6)])
    np.testing.assert_allclose(speeds, [(0.6, 0), (0.4, 0), (0.2, 0), (0, 0), (0, 0), (0, 0)], atol=1e-12)
    assert hand.notes == {"status": "device lost", "asked_v": 0.0, "asked_w": 0.0}


def test_a_silent_device_never_blocks_a_tick(pipe: tuple[int, str]) -> None:
    """A hundred ticks without input; a blocking read would never return."""
    _, path = pipe
    hand = Hand(Teleop(path))
    assert {hand() for _ in range(100)} == {(0.0, 0.0)}


def test_a_table_is_followed_and_the_noted_requests_form_an_equal_table(tmp_path: Path) -> None:
    first = tmp_path / "commands.csv"
    first.write_text("t_s,v,w\n0.2,0.25,0.1\n\n0.45,0.4,-9\n0.6,-1,0\n")
    hand, driven, lines = Hand(Teleop(str(first), speed=0.3, yaw_rate=0.5)), [], ["t_s,v,w"]
    for _ in range(12):
        driven.append(hand())
        lines.append(f"{(hand.tick - 1) / 10},{hand.notes['asked_v']!r},{hand.notes['asked_w']!r}")
    expected = [0, 0, 0.25, 0.25, 0.25, 0.3, -0.1, -0.1, -0.1, -0.1, -0.1, -0.1]  # limited
    assert [float(row.split(",")[1]) for row in lines[1:]] == expected
    v = 0.0
    for (got, _), target in zip(driven, expected, strict=True):  # and ramped, 0.03 m/s a tick
        v += max(-0.03, min(target - v, 0.03))
        assert got == pytest.approx(v, abs=1e-12)
    again = tmp_path / "again.csv"
    again.write_text("\n".join(lines))
    hand = Hand(Teleop(str(again), speed=0.3, yaw_rate=0.5))
    assert [hand() for _ in range(12)] == driven  # to the last bit


def test_reports_contain_the_commands(tmp_path: Path) -> None:
    table = tmp_path / "commands.csv"
    table.write_text("0,0.3,0.2\n")
    hand = Hand(Teleop(str(table)))
    v, w = hand()
    assert [(report["v"], report["w"]) for report in hand.sent] == [(v, w)]
    assert v > 0.0


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("t_s,v,w\n0,1\n", "row 2: must be three numbers"),
        ("0,a,1\n", "row 1: must be three numbers"),
        ("0,nan,1\n", "row 1: must be three numbers"),
        ("1,0,0\n0.5,0,0\n", "row 2: .* with increasing times"),
    ],
)
def test_a_malformed_table_is_refused_with_its_row(tmp_path: Path, rows: str, says: str) -> None:
    table = tmp_path / "commands.csv"
    table.write_text(rows)
    with pytest.raises(ValueError, match=says):
        Teleop(str(table)).start(INFO)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("/dev/input/js99", r"device = '/dev/input/js99': cannot be opened \(No such file or directory\); allowed are"),
        ("none.csv", "device = 'none.csv' cannot be read: .*No such file"),
        ("/", "device = '/' is neither a device nor a table"),
        (__file__, "is neither a device nor a table"),
    ],
)
def test_an_invalid_device_is_refused(name: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Teleop(name).start(INFO)


def test_a_full_dead_band_is_refused() -> None:
    with pytest.raises(ValueError, match="deadband = 1 disables the axis"):
        Teleop(deadband=1.0)
