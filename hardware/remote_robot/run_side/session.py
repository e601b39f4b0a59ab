"""Samples, notices and commands of a robot on another machine, with clock and numbers of the run. No clock, no link."""

import math
from typing import Any

import msgspec

from vcmvsp.cosim.estimation.clock_offset import EchoClock
from vcmvsp.cosim.types import Vec3, Velocity
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import Notice, Sample
from vcmvsp.hardware.drivers.threaded import NOT_YET, CommandRepeater
from vcmvsp.hardware.remote_robot.messages import RobotStatus

WINDOW = 50  # number of exchanges in the window: some two seconds
MOST_READINGS = 64  # of sonar, in a sample
MOST_MISSED = 1_000_000  # samples between two received ones


class RemoteSampler:
    """Converts messages of a robot to samples and notices."""

    def __init__(self, start: Vec3) -> None:
        self.clock = EchoClock(window=WINDOW)
        self.pose, self.link = start, 0  # newest pose by odometry, where a reopened robot starts
        self.noticed = 0  # notices of this robot so far
        self._number = 0
        self._last: tuple[int, int, int] | None = None  # openings, link and number of the robot's newest sample
        self._measured_ns = 0
        self._sonar: dict[int, float] = {}

    def connect(self, *, anew: bool) -> None:
        """A robot connected; ``anew``: another robot or clock than before."""
        self.link += 1
        self._last = None
        if anew:
            self.clock = EchoClock(window=WINDOW)
            self.noticed = 0

    def hear(self, status: RobotStatus, arrived_ns: int) -> None:
        """Use the times of a message."""
        if status.heard:
            self.clock.add(status.yours_ns, status.heard_ns, status.said_ns, arrived_ns)

    def sample(self, status: RobotStatus, arrived_ns: int, stopped: str) -> Sample | None:
        """Sample of a message; None: it has none, an old one, one that is not finite, or the clock is unknown."""
        sample, clock = status.sample, self.clock.best(arrived_ns)
        if sample is None or clock is None or not _finite(msgspec.to_builtins(sample)):
            return None
        key = (status.opened, sample.link, sample.number)
        if self._last is not None and self._last[0] == status.opened and sample.number <= self._last[2]:
            return None
        if self._last is not None and self._last[:2] != key[:2]:
            self.link += 1
        goes_on = self._last is not None and self._last[0] == status.opened
        self._number += min(sample.number - self._last[2], MOST_MISSED) if self._last is not None and goes_on else 1
        self._last = key
        came_ns = min(sample.arrived_ns + clock.offset_ns, arrived_ns)
        self._measured_ns = max(self._measured_ns, min(sample.measured_ns + clock.offset_ns, came_ns))
        self.pose = sample.odometry.pose
        self._sonar |= dict(sample.sonar[:MOST_READINGS])
        return msgspec.structs.replace(
            sample,
            number=self._number,
            link=self.link,
            arrived_ns=max(came_ns, self._measured_ns),
            measured_ns=self._measured_ns,
            sonar=tuple(self._sonar.items())[-MOST_READINGS:],
            stopped=stopped or plain(sample.stopped),
        )

    def clear_sonar(self) -> None:
        """The newest sample was read: its sonar readings are not repeated."""
        self._sonar.clear()

    def notices(self, status: RobotStatus, arrived_ns: int) -> list[Notice]:
        """New notices of a message."""
        new = status.notices[max(0, self.noticed - status.noticed) :]
        self.noticed = max(self.noticed, status.noticed + len(status.notices))
        clock = self.clock.best(arrived_ns)

        def here(notice: Notice) -> Notice:
            time_ns = arrived_ns if clock is None else max(0, min(notice.time_ns + clock.offset_ns, arrived_ns))
            return msgspec.structs.replace(notice, time_ns=time_ns, cause=plain(notice.cause))

        return [here(each) for each in new]


def _finite(value: Any) -> bool:
    if isinstance(value, dict | list | tuple):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


class CommandState(CommandRepeater[Velocity]):
    """Command for a robot; each connection starts with standing. ``held``: it has not confirmed yet that it stands."""

    held, _stands_from = True, 0

    def __init__(self, timeout_s: float) -> None:
        super().__init__(Velocity(), timeout_s, again_ns=0)

    def connect(self, number: int) -> None:
        """A robot connected: it must stand until it confirms a message of at least this number."""
        self.stop(NOT_YET)
        self.held, self._stands_from = True, number

    def acknowledge(self, number: int) -> None:
        """The robot has obeyed this message."""
        self.held = self.held and number < self._stands_from

    def at(self, now_ns: int) -> Velocity | None:
        """Velocity to send now; None: stand."""
        velocity = self.current(now_ns)
        return None if self.stopped or self.held else velocity
