"""Times of another clock, converted to this machine's monotonic clock.

Positioning servers, robots and autopilots stamp measurements with their own clocks. There are two methods:

- `ForeignClock`, for devices that only send. A message stamped s that arrives at a says ``a - s = offset + delay``; the
  smallest of many delays is nearest to the minimum delay (minimum filter of clock synchronisation by one-way delays: Moon,
  Skelly, Towsley 1999, "Estimation and removal of clock skew from network delay measurements", INFOCOM).
- `EchoClock`, for devices that answer. Four times give offset and round trip; the exchange with the least round trip is the
  best [RFC 5905, clauses 8 and 10].

An offset is added to the other clock's time. No function reads a clock: times are arguments, whole ns.
"""

from collections import deque
from typing import NamedTuple

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import NonNegative, Positive

_PARTS = 10**9  # drifts are counted in parts of 10^9
AGREE = 3  # messages in a row that show a jump of the clock


class ForeignClock:
    """Offset of a clock, estimated from the stamps of its messages.

    The drift against this clock is assumed to be at most ``drift_ppm``. The offset at t is then at most
    ``a_i - s_i - least + drift (t - a_i)`` for every message i of the window. The least bound is taken: it is too large
    by at most ``extra_i + 2 drift (t - a_i)`` for every i, where extra is the delay beyond ``least_s``.

    A message that is early, or has a stamp back, by more than ``jump_s``, does not count. `AGREE` such messages
    in a row that agree with each other are a jump of the clock: the window restarts with them. A late message changes nothing,
    unless it follows such a message and agrees with it: the stamps of a clock that was set back soon reach earlier stamps.

    Args:
        least_s: minimum delay from measurement to arrival.
        window_s: time for which a message counts.
        drift_ppm: maximum drift against this machine's clock; a quartz is within 100.
        jump_s: minimum size of a jump.

    Attributes:
        jumps: number of jumps.
        jumped_ns: size of the last jump; positive: the clock was set forward.
    """

    def __init__(
        self, *, least_s: NonNegative = 0.0, window_s: Positive = 30.0, drift_ppm: NonNegative = 100.0, jump_s: Positive = 1.0
    ) -> None:
        self._least_ns, self._window_ns, self._jump_ns = map(seconds_to_ns, (least_s, window_s, jump_s))
        self._drift = round(drift_ppm * 1000.0)
        self.jumps = self.jumped_ns = 0
        self._bounds: deque[tuple[int, int]] = deque()  # arrival, and bound without drift
        self._suspects: list[tuple[int, int]] = []  # stamp and arrival
        self._newest: int | None = None  # stamp that counted
        self._last: tuple[int, int] | None = None  # stamp of the previous message, and its result

    def local_time_ns(self, source_ns: int, arrived_ns: int) -> int:
        """Time of a stamp on this machine's clock; the message arrived now, and not before the previous one.

        The result is at most ``least_s`` before the arrival, and not before the result for an earlier stamp.
        """
        self._count(source_ns, arrived_ns)
        local = min(source_ns + self._offset(arrived_ns), arrived_ns - self._least_ns)
        if self._last is not None and source_ns >= self._last[0]:
            local = max(local, self._last[1])
        self._last = source_ns, local
        return local

    def offset_ns(self, now_ns: int) -> int | None:
        """Offset now; None: there was no message yet."""
        return self._offset(now_ns) if self._bounds else None

    def _count(self, source_ns: int, arrived_ns: int) -> None:
        """Use a message for the offset, or keep it as a suspect of a jump."""
        if not self._bounds:
            self._bound(source_ns, arrived_ns)
            return
        early = self._offset(arrived_ns) - (arrived_ns - self._least_ns - source_ns)
        back = (self._newest or source_ns) - source_ns
        delays = [arrived - stamp for stamp, arrived in (*self._suspects, (source_ns, arrived_ns))]
        agrees = max(delays) - min(delays) <= self._jump_ns
        follows = len(delays) > 1 and agrees and early < -self._jump_ns
        if early <= self._jump_ns and back <= self._jump_ns and not follows:
            self._suspects.clear()
            self._bound(source_ns, arrived_ns)
            return
        if not agrees:
            self._suspects.clear()
        self._suspects.append((source_ns, arrived_ns))
        if len(self._suspects) >= AGREE:
            self._restart(early)

    def _restart(self, early: int) -> None:
        self.jumps += 1
        self.jumped_ns = early
        suspects, self._suspects = self._suspects, []
        self._bounds.clear()
        self._newest = self._last = None
        for source_ns, arrived_ns in suspects:
            self._bound(source_ns, arrived_ns)

    def _bound(self, source_ns: int, arrived_ns: int) -> None:
        """Add a bound to the queue of increasing bounds; bounds that are not less than a newer one can never be the minimum."""
        bound = (arrived_ns - source_ns - self._least_ns) * _PARTS - self._drift * arrived_ns
        while self._bounds and self._bounds[-1][1] >= bound:
            self._bounds.pop()
        self._bounds.append((arrived_ns, bound))
        while self._bounds[0][0] < arrived_ns - self._window_ns:
            self._bounds.popleft()
        self._newest = source_ns if self._newest is None else max(self._newest, source_ns)

    def _offset(self, now_ns: int) -> int:
        return (self._bounds[0][1] + self._drift * now_ns) // _PARTS


class OffsetEstimate(NamedTuple):
    """Offset from one exchange."""

    offset_ns: int
    error_ns: int  # maximum error
    at_ns: int  # arrival of the reply


class EchoClock:
    """Offset of a clock that answers: the best of the newest ``window`` exchanges.

    The error of an offset is at most half the round trip, for any ratio of the two delays, plus the drift since then. Exchanges
    that contradict each other show a jump of the clock: earlier exchanges are then dropped.

    Attributes:
        jumps: number of jumps.
        refused: number of impossible exchanges, with a reply before its request.
    """

    def __init__(self, *, window: int = 8, drift_ppm: NonNegative = 100.0) -> None:
        self._drift = round(drift_ppm * 1000.0)
        self._offsets: deque[OffsetEstimate] = deque(maxlen=window)
        self.jumps = self.refused = 0

    def add(self, request_ns: int, remote_arrival_ns: int, remote_reply_ns: int, reply_ns: int) -> None:
        """An exchange: request and reply by this machine's clock, arrival and reply there by the other clock."""
        round_trip = (reply_ns - request_ns) - (remote_reply_ns - remote_arrival_ns)
        drifted = self._drifted(reply_ns - request_ns)
        if remote_reply_ns < remote_arrival_ns or reply_ns < request_ns or round_trip < -drifted:
            self.refused += 1
            return
        offset = (request_ns - remote_arrival_ns + reply_ns - remote_reply_ns) // 2
        new = OffsetEstimate(offset, (max(round_trip, 0) + 1) // 2 + 1 + drifted, reply_ns)  # both divisions round
        if self._offsets and self._contradicts(new):
            self.jumps += 1
            self._offsets.clear()
        self._offsets.append(new)

    def best(self, now_ns: int) -> OffsetEstimate | None:
        """Estimate with the least maximum error now; None: there was no exchange yet."""
        aged = (each._replace(error_ns=each.error_ns + self._drifted(now_ns - each.at_ns)) for each in self._offsets)
        return min(aged, key=lambda each: each.error_ns, default=None)

    def _contradicts(self, new: OffsetEstimate) -> bool:
        best = self.best(new.at_ns)
        return best is not None and abs(new.offset_ns - best.offset_ns) > new.error_ns + best.error_ns

    def _drifted(self, elapsed_ns: int) -> int:
        return -(-abs(elapsed_ns) * self._drift // _PARTS)  # rounded up
