"""A leader that a person drives, by keyboard, gamepad, or a recorded table.

`Device.read` returns at once, without waiting, from the input since the last call.
"""

import atexit
import csv
import math
import os
import stat
import struct
import termios
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from vcmvsp.agents.formation.leaders.leader import Leader, towards
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.types import Count, NonNegative, Positive, Probability
from vcmvsp.cosim.util import limits

Speeds = tuple[float, float]  # forward, m/s, and turning, rad/s

KEYBOARD = "keyboard"
TERMINAL = Path("/dev/tty")  # of this process, wherever its input and output go
CHUNK = 4096

# Linux joystick API, Documentation/input/joydev/joystick-api.rst: struct js_event.
EVENT = struct.Struct("=IhBB")  # time ms, value, type, number
AXIS, INITIAL = 0x02, 0x80  # types; the state at the start comes as events with the second bit set
FULL = 32767  # of an axis that is pushed to its end; forward and left are negative

STEPS = 4  # presses from rest to a limit
PRESSES = {
    **dict.fromkeys([b"w", b"W", b"\x1b[A", b"\x1bOA"], (1, 0)),
    **dict.fromkeys([b"s", b"S", b"\x1b[B", b"\x1bOB"], (-1, 0)),
    **dict.fromkeys([b"a", b"A", b"\x1b[D", b"\x1bOD"], (0, 1)),
    **dict.fromkeys([b"d", b"D", b"\x1b[C", b"\x1bOC"], (0, -1)),
}
ESCAPE, SPACE = 0x1B, 0x20
LONGEST_KEY = 3  # bytes

HINT = (
    "allowed are 'keyboard' (an agent in the simulation's own process, started in the foreground of a terminal), a joystick "
    "such as /dev/input/js0, and a table FILE.csv"
)


class DeviceLostError(Exception):
    """The device is not there any more."""


class Device(Protocol):
    """Source of speeds for a vehicle."""

    def read(self, time_s: float) -> Speeds:
        """Requested speed, m/s, and yaw rate, rad/s."""

    def close(self) -> None:
        """Leave the device as it was found."""


def open_device(name: str, *, limits: Speeds, axes: tuple[int, int], deadband: float) -> Device:
    """Open an input device by its name: ``keyboard``, or the path of a joystick, a terminal or a table ``*.csv``.

    ``limits`` are the speed and yaw rate of a key held down, or a stick pushed to its end; `Teleop` explains the others.
    `ValueError`: there is no such device, or it cannot be used here.
    """
    path = TERMINAL if name == KEYBOARD else Path(name)
    if path.suffix == ".csv":
        return Table(path)
    try:
        file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError as error:
        problem = "this process has no terminal" if name == KEYBOARD else f"cannot be opened ({error.strerror})"
        raise ValueError(f"device = {name!r}: {problem}; {HINT}") from error
    try:
        return _device(name, file, limits, axes, deadband)
    except (OSError, termios.error, ValueError):
        os.close(file)
        raise


def _device(name: str, file: int, limits: Speeds, axes: tuple[int, int], deadband: float) -> Device:
    if name == KEYBOARD and os.tcgetpgrp(file) != os.getpgrp():  # the system would stop a process that reads keys there
        raise ValueError(f"device = {name!r}: this process runs in the background of its terminal; {HINT}")
    if os.isatty(file):
        return Keyboard(file, limits)
    mode = os.fstat(file).st_mode
    if not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):
        raise ValueError(f"device = {name!r} is neither a device nor a table *.csv; {HINT}")
    return Joystick(file, limits, axes, deadband)


class Keyboard:
    """Keys of a terminal: W, S or up, down for the speed, A, D or left, right for the yaw rate; space stops.

    Each press changes a speed by a quarter of its limit: terminals do not report released keys. The terminal delivers each key
    at once while this is open, and is reset when it is closed or the process ends.
    """

    def __init__(self, file: int, limits: Speeds) -> None:
        self._file: int | None = file
        self._limits = limits
        self._ahead = self._left = 0  # presses
        self._rest = b""
        self._before = termios.tcgetattr(file)
        tty.setcbreak(file, termios.TCSANOW)
        atexit.register(self.close)

    def read(self, time_s: float) -> Speeds:
        """Requested speeds (m/s, rad/s) after all key presses so far."""
        keys = self._rest + _new(self._file)
        while keys:
            length = 1
            if keys[0] == ESCAPE:
                if len(keys) < LONGEST_KEY and keys in (b"\x1b", b"\x1b[", b"\x1bO"):
                    break  # the rest of an arrow is still under way
                length = LONGEST_KEY if keys[:LONGEST_KEY] in PRESSES else 1
            self._press(keys[:length])
            keys = keys[length:]
        self._rest = keys
        v, w = self._limits
        return v * self._ahead / STEPS, w * self._left / STEPS

    def _press(self, key: bytes) -> None:
        ahead, left = PRESSES.get(key, (0, 0))
        if key[0] == SPACE:
            self._ahead = self._left = 0
        self._ahead = max(-STEPS, min(self._ahead + ahead, STEPS))
        self._left = max(-STEPS, min(self._left + left, STEPS))

    def close(self) -> None:
        """Reset the terminal."""
        if self._file is None:
            return
        file, self._file = self._file, None
        atexit.unregister(self.close)
        try:
            termios.tcsetattr(file, termios.TCSANOW, self._before)
        except termios.error:
            pass  # the terminal is gone
        finally:
            os.close(file)


class Joystick:
    """Two axes of a gamepad or joystick, by the Linux joystick API."""

    def __init__(self, file: int, limits: Speeds, axes: tuple[int, int], deadband: float) -> None:
        self._file: int | None = file
        self._limits, self._axes, self._deadband = limits, axes, deadband
        self._rest = b""
        self._values = dict.fromkeys(axes, 0.0)

    def read(self, time_s: float) -> Speeds:
        """Speeds from the positions of the axes."""
        data = self._rest + _new(self._file)
        end = len(data) - len(data) % EVENT.size
        for _, value, kind, number in EVENT.iter_unpack(data[:end]):
            if kind & ~INITIAL == AXIS and number in self._values:
                self._values[number] = self._share(value)
        self._rest = data[end:]
        ahead, left = self._axes
        v, w = self._limits
        return v * self._values[ahead], w * self._values[left]

    def _share(self, value: int) -> float:
        """Deflection as a share, positive forward and left, 0 at the edge of the dead band."""
        beyond = (min(abs(value) / FULL, 1.0) - self._deadband) / (1.0 - self._deadband)
        return math.copysign(beyond, -value) if beyond > 0.0 else 0.0

    def close(self) -> None:
        """Close the device."""
        file, self._file = self._file, None
        if file is not None:
            os.close(file)


class Table:
    """Rows ``t_s,v,w``: speed (m/s) and yaw rate (rad/s) from ``t_s`` (s) until the next row; both 0 before the first row.

    Replays a drive of a person.
    """

    def __init__(self, path: Path) -> None:
        self._rows = _rows(path)
        self._next = 0

    def read(self, time_s: float) -> Speeds:
        """Speeds of the current row."""
        while self._next < len(self._rows) and self._rows[self._next][0] <= time_s:
            self._next += 1
        if self._next == 0:
            return 0.0, 0.0
        _, v, w = self._rows[self._next - 1]
        return v, w

    def close(self) -> None:
        """No effect: no device is open."""


def _rows(path: Path) -> Sequence[tuple[float, float, float]]:
    try:
        limits.check_size(path, limits.JSON_BYTES)
        with path.open(newline="", encoding="utf-8") as file:
            lines = [line for line in csv.reader(file) if line]
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"device = {str(path)!r} cannot be read: {error}") from error
    rows: list[tuple[float, float, float]] = []
    for number, line in enumerate(lines, 1):
        if number == 1 and line == ["t_s", "v", "w"]:
            continue
        try:
            t_s, v, w = map(float, line)
        except ValueError:
            t_s = v = w = math.nan
        if not math.isfinite(t_s + v + w) or (rows and t_s < rows[-1][0]):
            raise ValueError(f"device = {str(path)!r}, row {number}: must be three numbers t_s,v,w with increasing times")
        rows.append((t_s, v, w))
    return rows


def _new(file: int | None) -> bytes:
    """All new input. A removed device, or one with a closed end, is lost."""
    data = b""
    while file is not None:
        try:
            part = os.read(file, CHUNK)
        except BlockingIOError:
            return data
        except OSError as error:
            raise DeviceLostError(error.strerror) from error
        if not part:
            raise DeviceLostError("closed")
        data += part
    raise DeviceLostError("closed")


class Teleop(Leader):
    """Drive by keyboard, gamepad or table; changes of speed are ramped.

    A person needs a run at wall pace (``vcmvsp run --realtime``). Notes at every tick ``asked_v`` and ``asked_w``, the
    requested speeds before the ramp, and ``status`` ``device lost`` after a loss of the device, which stops the vehicle for
    good. A table of the times and requested speeds repeats a drive.

    Args:
        device: ``keyboard`` (of the terminal: W A S D or the arrows, a quarter of the limit each; space stops), a joystick such
            as ``/dev/input/js0``, or a table ``FILE.csv`` with rows ``t_s,v,w``.
        speed: fastest, m/s.
        max_reverse: fastest reverse, m/s.
        yaw_rate: fastest turning, rad/s.
        acceleration: of the ramp, m/s2.
        yaw_acceleration: of the ramp, rad/s2.
        axes: of a joystick: numbers of the axes for speed and yaw rate.
        deadband: of a joystick: share of an axis about its middle that counts as zero.
        leading: tell, plan_ticks, estimator, horizon_s, fade_s, sending, formation, avoidance, clock_bound_s, as of `Leader`.
    """

    def __init__(
        self,
        device: str = KEYBOARD,
        *,
        speed: Positive = 0.3,
        max_reverse: NonNegative = 0.1,
        yaw_rate: Positive = 0.5,
        acceleration: Positive = 0.3,
        yaw_acceleration: Positive = 0.6,
        axes: tuple[Count, Count] = (1, 0),
        deadband: Probability = 0.1,
        **leading: Any,
    ) -> None:
        super().__init__(**leading)
        if deadband == 1.0:
            raise ValueError("deadband = 1 disables the axis; it must be below 1")
        self.device, self.speed, self.max_reverse, self.yaw_rate = device, speed, max_reverse, yaw_rate
        self.acceleration, self.yaw_acceleration = acceleration, yaw_acceleration
        self.axes, self.deadband = axes, deadband
        self._device: Device | None = None
        self._v = self._w = 0.0

    def start(self, info: VehicleInfo) -> None:
        """Open the device."""
        super().start(info)
        limits = self.speed, self.yaw_rate
        self._device = open_device(self.device, limits=limits, axes=self.axes, deadband=self.deadband)

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """The requested speeds, ramped."""
        v = w = 0.0
        if self._device is not None:
            try:
                v, w = self._device.read(obs.time_s)
            except DeviceLostError:
                self.close()
        if self._device is None:
            self.note(status="device lost")
        v_limited = max(-self.max_reverse, min(v, self.speed))
        w_limited = max(-self.yaw_rate, min(w, self.yaw_rate))
        self.note(asked_v=v_limited, asked_w=w_limited)
        self._v = towards(self._v, v_limited, self.acceleration * self._period_s)
        self._w = towards(self._w, w_limited, self.yaw_acceleration * self._period_s)
        return self._v, self._w

    def close(self) -> None:
        """Close the device."""
        device, self._device = self._device, None
        if device is not None:
            device.close()
