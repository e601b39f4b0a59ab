"""Logical time: integer nanoseconds, trains of ticks that never drift, and the clocks that pace a run."""

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import NamedTuple, Protocol, Self

import msgspec

SECOND_NS = 1_000_000_000
Sleep = Callable[[float], bool | None]
"""Waits for so many seconds; returns whether it was woken earlier."""

SLIPS = 1000  # number of remembered slips, for earlier times
LONGEST_SLEEP_S = 3600.0  # s; the operating system refuses centuries
LISTEN_NS = 20_000_000  # ns between two calls of ``listen``


def seconds_to_ns(seconds: float) -> int:
    """Seconds as the nearest nanosecond; exact for decimal fractions such as 0.1 (10**8 ns)."""
    return round(Decimal(repr(float(seconds))).scaleb(9))  # at most 17 digits; Fraction takes five times as long


class Ticks(msgspec.Struct, frozen=True, order=True):
    """A train of ticks: tick k is at ``floor(k * period)`` ns, where the period is ``ns / per`` nanoseconds.

    The period is a fraction, so 120 Hz is exact and tick 120 000 falls on second 1000 to the nanosecond.
    """

    ns: int
    per: int = 1

    @classmethod
    def every(cls, period_s: float) -> Self:
        """Ticks ``period_s`` seconds apart (the decimal that was written, not its binary neighbour)."""
        return cls._of(Fraction(repr(float(period_s))) * SECOND_NS)

    @classmethod
    def rate(cls, hz: float) -> Self:
        """A train of ``hz`` ticks per second."""
        return cls._of(SECOND_NS / Fraction(repr(float(hz))))

    @classmethod
    def _of(cls, period: Fraction) -> Self:
        if period < 1:
            raise ValueError(f"a period must be at least one nanosecond, not {float(period)} ns")
        return cls(period.numerator, period.denominator)

    @property
    def period(self) -> Fraction:
        """Exact time between ticks, ns."""
        return Fraction(self.ns, self.per)

    def at(self, k: int) -> int:
        """Time of tick k, ns."""
        return k * self.ns // self.per

    def after(self, now_ns: int) -> int:
        """The first tick later than ``now_ns``; ticks start at 0, so any negative time gives 0."""
        return 0 if now_ns < 0 else -(-(now_ns + 1) * self.per // self.ns) * self.ns // self.per

    def between(self, from_ns: int, to_ns: int) -> range:
        """The k of the ticks with ``from <= t < to``."""
        first, stop = (-(-max(0, bound) * self.per // self.ns) for bound in (from_ns, to_ns))
        return range(first, stop)

    def hits(self, now_ns: int) -> bool:
        """Whether ``now_ns`` is the time of a tick."""
        return -(-now_ns * self.per // self.ns) * self.ns // self.per == now_ns >= 0

    def is_multiple_of(self, finer: "Ticks") -> bool:
        """Whether every tick of this train is also a tick of ``finer``."""
        return (self.period / finer.period).denominator == 1


class Clock(Protocol):
    """Paces a run: the kernel waits for it before every instant with an event."""

    @property
    def speed(self) -> float | None:
        """Simulated seconds per second; None: as fast as the machine allows, and nothing is ever late."""

    @property
    def slipped_ns(self) -> int:
        """Total slip: lag behind the wall clock that is not caught up."""

    def start(self) -> None:
        """Called once, when logical time 0 begins."""

    def wait_until(self, due_ns: int) -> int:
        """Wait until logical time ``due_ns`` may begin; returns the lag, ns (0: in time).

        A negative lag: the wait was interrupted so much earlier in logical time.
        """

    def slip(self, by_ns: int) -> None:
        """Give up catching up a lag of ``by_ns``."""


class SimClock:
    """Logical time jumps from event to event, as fast as the machine allows, and never lags."""

    speed: float | None = None
    slipped_ns = 0

    def start(self) -> None:
        """Do nothing: there is no wall clock."""

    def wait_until(self, due_ns: int) -> int:
        """Return at once."""
        return 0

    def slip(self, by_ns: int) -> None:
        """Do nothing: there is never a lag."""


class WallClock:
    """Logical time follows the wall clock at ``speed`` simulated seconds per second.

    Every instant has a fixed place on the wall clock, so nothing drifts: a small lag is caught up.

    Attributes:
        slipped_ns: total lag that is not caught up.

    Args:
        speed: simulated seconds per second.
        now: the wall clock, ns.
        sleep: waits for so many seconds; may be set later, too.
    """

    def __init__(self, speed: float = 1.0, *, now: Callable[[], int] = time.monotonic_ns, sleep: Sleep = time.sleep) -> None:
        if not 0.0 < speed < float("inf"):
            raise ValueError(f"speed must be a positive number, not {speed}")
        self.speed, self._now, self.sleep, self._origin = speed, now, sleep, 0
        self.slipped_ns = 0
        self._slips: deque[_Slip] = deque(maxlen=SLIPS)

    def start(self) -> None:
        """Begin logical time 0 now."""
        self._origin = self._now()

    def logical_ns(self, monotonic_ns: int) -> int:
        """The logical time at a reading of this machine's monotonic clock, also a past one.

        It never decreases: before a slip it stands still from the time at which the late instant was due.
        """
        slips = self._slips
        if not slips or monotonic_ns >= slips[-1].until_ns:
            return round((monotonic_ns - self._origin) * self.speed)
        then = slips[bisect_right(slips, monotonic_ns, key=lambda each: each.until_ns)]
        return min(round((monotonic_ns - then.origin_ns) * self.speed), then.stood_ns)

    def monotonic_ns(self, logical_ns: int) -> int:
        """The reading of this machine's monotonic clock at a logical time."""
        return self._origin + round(logical_ns / self.speed)

    def wait_until(self, due_ns: int) -> int:
        """Sleep until ``due_ns``; returns the lag if that has passed already."""
        wall_due = self.monotonic_ns(due_ns)
        while (remaining_ns := wall_due - self._now()) > 0:
            if self.sleep(min(remaining_ns / SECOND_NS, LONGEST_SLEEP_S)):
                return min(0, self.logical_ns(self._now()) - due_ns)
        return -remaining_ns

    def slip(self, by_ns: int) -> None:
        """Delay all later instants by ``by_ns``."""
        until_ns, before_ns = self._now(), self._origin
        self._origin += by_ns
        self.slipped_ns += by_ns
        self._slips.append(_Slip(until_ns, before_ns, round((until_ns - self._origin) * self.speed)))


class _Slip(NamedTuple):
    until_ns: int  # time of the slip on the wall clock
    origin_ns: int  # logical time 0 on the wall clock before the slip
    stood_ns: int  # logical time at which the run stood still until the slip


class LiveClock:
    """Logical time under a viewer's control: paused, at a speed, or as fast as the machine allows.

    Args:
        speed: simulated seconds per second at first; None: as fast as the machine allows.
        listen: called some fifty times a second, also while paused; it calls `go` on a command of the viewer.
        now: the wall clock, ns.
        sleep: waits for so many seconds.

    Attributes:
        held: the run is paused, and the step that was asked for is over.
    """

    def __init__(
        self,
        speed: float | None,
        listen: Callable[[], None],
        *,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.speed, self.paused, self.slipped_ns = speed, False, 0
        self.held = False
        self._listen, self._now, self._sleep = listen, now, sleep
        self._logical_ns, self._free_ns, self._heard_ns = 0, 0, 0
        self._anchor = 0, 0  # a logical time and its wall-clock time

    def start(self) -> None:
        """Begin logical time 0 now."""
        self._anchor = 0, self._now()

    def go(self, *, paused: bool, speed: float | None, step_ns: int = 0) -> None:
        """Change pause and speed from here on; a paused run still advances by ``step_ns``."""
        self.paused, self.speed, self._free_ns, self.held = paused, speed, self._logical_ns + step_ns, False
        self._anchor = self._logical_ns, self._now()

    def wait_until(self, due_ns: int) -> int:
        """Wait until the viewer's pace lets ``due_ns`` begin; returns the lag, ns."""
        while (remaining_ns := self._remaining_ns(due_ns)) > 0:
            self._sleep(min(remaining_ns, LISTEN_NS) / SECOND_NS)
        self._logical_ns = due_ns
        return -remaining_ns

    def slip(self, by_ns: int) -> None:
        """Delay all later instants by ``by_ns``."""
        logical_ns, wall_ns = self._anchor
        self._anchor = logical_ns, wall_ns + by_ns
        self.slipped_ns += by_ns

    def _remaining_ns(self, due_ns: int) -> int:
        """Remaining wait as known now; <= 0: no wait."""
        now_ns = self._now()
        if now_ns - self._heard_ns >= LISTEN_NS:
            self._heard_ns = now_ns
            self._listen()
        self.held = self.paused and due_ns > self._free_ns
        if self.held:
            return LISTEN_NS
        if self.speed is None:
            return 0
        logical_ns, wall_ns = self._anchor
        return wall_ns + round((due_ns - logical_ns) / self.speed) - now_ns
