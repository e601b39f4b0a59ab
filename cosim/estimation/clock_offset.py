"""What another clock says, in times of this machine's monotonic clock.

Positioning servers, robots and autopilots stamp what they measure with clocks of their own. Two ways lead from there to here:

- `ForeignClock`, for those that only talk. A message stamped s that arrives at a says ``a - s = offset + delay``, and of many
  delays the least is nearest to the least that is possible (the minimum filter of clock synchronisation by one-way delays,
  as in Moon, Skelly, Towsley 1999, "Estimation and removal of clock skew from network delay measurements", INFOCOM).
- `EchoClock`, for those that echo. Four times give offset and round trip, and the exchange with the least round trip is the
  best [RFC 5905, clauses 8 and 10].

Offsets are what is added to the other's time to get ours. All is pure: times are arguments, whole ns.
"""

from collections import deque
from typing import NamedTuple

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import NonNegative, Positive

_PARTS = 10**9  # drifts are counted in parts of 10^9
AGREE = 3  # so many messages in a row must tell of a jump of the clock


class ForeignClock:
    """A clock that is known from the messages that it stamped.

    Within the window, the clock is supposed to drift by no more than ``drift_ppm`` against ours. Then the offset at t is at
    most ``a_i - s_i - least + drift (t - a_i)`` for every message i, and the least of these bounds is taken: it is too large
    by at most ``extra_i + 2 drift (t - a_i)``, whichever i, where extra is what a message took beyond ``least_s``.

    A message that comes too early by ``jump_s``, or whose stamp lies back by so much, is not counted; `AGREE` in a row that
    agree among themselves mean that the clock has jumped, and the window starts anew with them. One that is merely late moves
    nothing, unless it follows such a message and agrees with it: the stamps of a clock that was put back soon reach those of
    before.

    Args:
        least_s: what lies between measuring and arriving at least.
        window_s: how long a message counts.
        drift_ppm: drift against our clock at most; a quartz is within 100.
        jump_s: from what size on a jump is one.

    Attributes:
        jumps: how often the clock has jumped.
        jumped_ns: by how much it did so last; positive: it was put forward.
    """

    def __init__(
        self, *, least_s: NonNegative = 0.0, window_s: Positive = 30.0, drift_ppm: NonNegative = 100.0, jump_s: Positive = 1.0
    ) -> None:
        self._least_ns, self._window_ns, self._jump_ns = map(seconds_to_ns, (least_s, window_s, jump_s))
        self._drift = round(drift_ppm * 1000.0)
        self.jumps = self.jumped_ns = 0
        self._bounds: deque[tuple[int, int]] = deque()  # arrival, and bound less drift: those that may still be the least
        self._suspects: list[tuple[int, int]] = []  # stamp and arrival
        self._newest: int | None = None  # stamp that counted
        self._last: tuple[int, int] | None = None  # stamp and what it was taken for, of the message that was heard last

    def heard(self, source_ns: int, arrived_ns: int) -> int:
        """When a message was stamped, by our clock; it arrived just now, and not before the one that was heard last.

        It is never later than ``least_s`` before the arrival; and what was stamped later than the message before is not
        earlier than that.
        """
        self._count(source_ns, arrived_ns)
        local = min(source_ns + self._offset(arrived_ns), arrived_ns - self._least_ns)
        if self._last is not None and source_ns >= self._last[0]:
            local = max(local, self._last[1])
        self._last = source_ns, local
        return local

    def offset_ns(self, now_ns: int) -> int | None:
        """What is added to its time now; None: nothing was heard yet."""
        return self._offset(now_ns) if self._bounds else None

    def _count(self, source_ns: int, arrived_ns: int) -> None:
        """Let a message tell of the offset, or suspect it."""
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
        """The clock has jumped: only the suspects count."""
        self.jumps += 1
        self.jumped_ns = early
        suspects, self._suspects = self._suspects, []
        self._bounds.clear()
        self._newest = self._last = None
        for source_ns, arrived_ns in suspects:
            self._bound(source_ns, arrived_ns)

    def _bound(self, source_ns: int, arrived_ns: int) -> None:
        """Keep the bounds in a queue that rises: what is not less than a newer one will never be the least."""
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
    """What an exchange says."""

    offset_ns: int
    error_ns: int  # by so much it may be wrong at most, either way
    at_ns: int  # when the answer came


class EchoClock:
    """A clock that answers: offsets from exchanges of four times each, the best of the newest ``window``.

    An offset is wrong by at most half the round trip, however unequal the two ways are, and later by what the clock may have
    drifted. So two exchanges may contradict each other: then the clock has jumped, and what came before is forgotten.

    Attributes:
        jumps: how often that was so.
        refused: exchanges that cannot be: an answer before its question.
    """

    def __init__(self, *, window: int = 8, drift_ppm: NonNegative = 100.0) -> None:
        self._drift = round(drift_ppm * 1000.0)
        self._kept: deque[OffsetEstimate] = deque(maxlen=window)
        self.jumps = self.refused = 0

    def add(self, request_ns: int, remote_arrival_ns: int, remote_reply_ns: int, reply_ns: int) -> None:
        """An exchange: sent and received by our clock, heard and answered by the other."""
        round_trip = (reply_ns - request_ns) - (remote_reply_ns - remote_arrival_ns)
        drifted = self._drifted(reply_ns - request_ns)  # in the meantime
        if remote_reply_ns < remote_arrival_ns or reply_ns < request_ns or round_trip < -drifted:
            self.refused += 1
            return
        offset = (request_ns - remote_arrival_ns + reply_ns - remote_reply_ns) // 2
        new = OffsetEstimate(offset, (max(round_trip, 0) + 1) // 2 + 1 + drifted, reply_ns)  # both divisions round
        if self._kept and self._contradicts(new):
            self.jumps += 1
            self._kept.clear()
        self._kept.append(new)

    def best(self, now_ns: int) -> OffsetEstimate | None:
        """The estimate with the least possible error now; None: there was no exchange yet."""
        aged = (each._replace(error_ns=each.error_ns + self._drifted(now_ns - each.at_ns)) for each in self._kept)
        return min(aged, key=lambda each: each.error_ns, default=None)

    def _contradicts(self, new: OffsetEstimate) -> bool:
        best = self.best(new.at_ns)
        return best is not None and abs(new.offset_ns - best.offset_ns) > new.error_ns + best.error_ns

    def _drifted(self, elapsed_ns: int) -> int:
        return -(-abs(elapsed_ns) * self._drift // _PARTS)  # rounded up
