"""Logical time: integer nanoseconds, trains of ticks that never drift, and the two clocks that pace a run."""

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple, Protocol, Self

import msgspec

SECOND_NS = 1_000_000_000
Sleep = Callable[[float], bool | None]
"""Waits for so many seconds, or is woken before: whether it was."""

SLIPS = 1000  # that are remembered, for times before them
LONGEST_SLEEP_S = 3600.0  # the system refuses centuries
LISTEN_NS = 20_000_000  # between two looks at what those want who look on


def seconds_to_ns(seconds: float) -> int:
    """The nearest whole nanosecond; exact for decimal fractions such as 0.1 (10**8 ns)."""
    return round(Fraction(repr(float(seconds))) * SECOND_NS)


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
        """``hz`` ticks a second."""
        return cls._of(SECOND_NS / Fraction(repr(float(hz))))

    @classmethod
    def _of(cls, period: Fraction) -> Self:
        if period < 1:
            raise ValueError(f"a period must be at least one nanosecond, not {float(period)} ns")
        return cls(period.numerator, period.denominator)

    @property
    def period(self) -> Fraction:
        """Nanoseconds from tick to tick, exactly."""
        return Fraction(self.ns, self.per)

    def at(self, k: int) -> int:
        """Time of tick k, ns."""
        return k * self.ns // self.per

    def after(self, now_ns: int) -> int:
        """The first tick later than ``now_ns``; ticks start at 0, so any negative time gives 0."""
        return self.at(max(0, -(-(now_ns + 1) * self.per // self.ns)))

    def hits(self, now_ns: int) -> bool:
        """Whether ``now_ns`` is the time of a tick."""
        return self.after(now_ns - 1) == now_ns

    def is_multiple_of(self, finer: "Ticks") -> bool:
        """Whether every tick of this train is also one of ``finer``."""
        return (self.period / finer.period).denominator == 1


class Clock(Protocol):
    """What paces a run. The kernel asks it to wait before every instant that holds an event."""

    @property
    def speed(self) -> float | None:
        """Simulated seconds per second; None: as fast as the machine allows, and nothing is ever late."""

    @property
    def slipped_ns(self) -> int:
        """What was not made up for, in all."""

    def start(self) -> None:
        """Called once, when logical time 0 begins."""

    def wait_until(self, due_ns: int) -> int:
        """Return when logical time ``due_ns`` may begin; the answer is how late it is, ns (0: not late).

        A negative answer: somebody has woken the sleeper, so much earlier in logical time.
        """

    def slip(self, by_ns: int) -> None:
        """What is late by so much is not to be made up for."""


class SimClock:
    """Logical time jumps from event to event: as fast as the machine allows. Never late."""

    speed: float | None = None
    slipped_ns = 0

    def start(self) -> None:
        """Nothing to note: there is no wall clock here."""

    def wait_until(self, due_ns: int) -> int:
        """Return at once."""
        return 0

    def slip(self, by_ns: int) -> None:
        """Nothing is ever late."""


class WallClock:
    """Logical time follows the wall clock at ``speed`` simulated seconds per second.

    Every instant has its own place on the wall clock, so that nothing drifts: who was a little late catches up.

    Attributes:
        slipped_ns: what was not, in all.

    Args:
        speed: simulated seconds per second.
        now: the clock, ns.
        sleep: waits for so many seconds; may be set later, too.
    """

    def __init__(self, speed: float = 1.0, *, now: Callable[[], int] = time.monotonic_ns, sleep: Sleep = time.sleep) -> None:
        if not 0.0 < speed < float("inf"):
            raise ValueError(f"speed must be a positive number, not {speed}")
        self.speed, self._now, self.sleep, self._origin = speed, now, sleep, 0
        self.slipped_ns = 0
        self._slips: deque[_Slip] = deque(maxlen=SLIPS)

    def start(self) -> None:
        """Let logical time 0 be now."""
        self._origin = self._now()

    def logical_ns(self, monotonic_ns: int) -> int:
        """The logical time at which this machine's monotonic clock shows so much; any time may be asked for.

        It never decreases. Where the run slipped, it stood still from when the instant that was late was due.
        """
        slips = self._slips
        if not slips or monotonic_ns >= slips[-1].until_ns:
            return round((monotonic_ns - self._origin) * self.speed)
        then = slips[bisect_right(slips, monotonic_ns, key=lambda each: each.until_ns)]
        return min(round((monotonic_ns - then.origin_ns) * self.speed), then.stood_ns)

    def monotonic_ns(self, logical_ns: int) -> int:
        """What this machine's monotonic clock shows at a logical time."""
        return self._origin + round(logical_ns / self.speed)

    def wait_until(self, due_ns: int) -> int:
        """Sleep until ``due_ns``; if that has passed already, go on at once and say by how much."""
        wall_due = self.monotonic_ns(due_ns)
        while (left := wall_due - self._now()) > 0:
            if self.sleep(min(left / SECOND_NS, LONGEST_SLEEP_S)):
                return min(0, self.logical_ns(self._now()) - due_ns)
        return -left

    def slip(self, by_ns: int) -> None:
        """Let all that is still to come begin so much later."""
        until_ns, before_ns = self._now(), self._origin
        self._origin += by_ns
        self.slipped_ns += by_ns
        self._slips.append(_Slip(until_ns, before_ns, round((until_ns - self._origin) * self.speed)))


class _Slip(NamedTuple):
    """Of a `WallClock`."""

    until_ns: int  # on the wall clock
    origin_ns: int  # there: where logical time 0 was before it
    stood_ns: int  # logical time, from when it was due until then


class LiveClock:
    """Logical time as somebody wants it who looks on: standing still, at a pace, or as fast as the machine allows.

    Args:
        speed: simulated seconds per second at first; None: as fast as the machine allows.
        listen: called some fifty times a second, also while time stands still: who it hears calls `go`.
        now: the wall clock, ns.
        sleep: waits for so many seconds.
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
        self._listen, self._now, self._sleep = listen, now, sleep
        self._logical_ns, self._free_ns, self._heard_ns = 0, 0, 0
        self._anchor = 0, 0  # a logical time, and when it was or is to be

    def start(self) -> None:
        """Let logical time 0 be now."""
        self._anchor = 0, self._now()

    def go(self, *, paused: bool, speed: float | None, step_ns: int = 0) -> None:
        """Go on from here like this; paused, still for ``step_ns``."""
        self.paused, self.speed, self._free_ns = paused, speed, self._logical_ns + step_ns
        self._anchor = self._logical_ns, self._now()

    def wait_until(self, due_ns: int) -> int:
        """Wait as long as those who look on want it; the answer is how late it is, ns."""
        while (left := self._left_ns(due_ns)) > 0:
            self._sleep(min(left, LISTEN_NS) / SECOND_NS)
        self._logical_ns = due_ns
        return -left

    def slip(self, by_ns: int) -> None:
        """Let all that is still to come begin so much later."""
        logical_ns, wall_ns = self._anchor
        self._anchor = logical_ns, wall_ns + by_ns
        self.slipped_ns += by_ns

    def _left_ns(self, due_ns: int) -> int:
        """How long to wait, as far as is known now; not more than 0: no longer."""
        now_ns = self._now()
        if now_ns - self._heard_ns >= LISTEN_NS:
            self._heard_ns = now_ns
            self._listen()
        if self.paused and due_ns > self._free_ns:
            return LISTEN_NS
        if self.speed is None:
            return 0
        logical_ns, wall_ns = self._anchor
        return wall_ns + round((due_ns - logical_ns) / self.speed) - now_ns
