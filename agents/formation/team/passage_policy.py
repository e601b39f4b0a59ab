"""Policies for widening a narrow team.

Widening is harder to time than narrowing: the last members are in the passage when the leader is out of it, and Toh 2012 (7.2)
leaves the question open. `Policy.widens` is called at every tick at which the team is narrow.

============= ====================================================================================================
``immediate`` the leader's lane is free (Toh 2012): members behind are called out of the passage sideways
``timer``     it has been free for ``timer_s``: right for one length of the team at one speed only
``all-clear`` it is free, and all members report clear lanes, for ``steady_s`` on end; a silent member counts as not clear,
              and as gone after ``silence_s`` without any message
============= ====================================================================================================

The leader uses only reports that it receives itself: lane states are not relayed. Members beyond the reach of its radio, at
the end of a long chain, count as gone.
"""

from collections.abc import Iterable, Sequence
from typing import Protocol

from vcmvsp.agents.formation.reports.received import ReportReceiver
from vcmvsp.agents.formation.team.formation import Passage
from vcmvsp.cosim.clock import seconds_to_ns


class Policy(Protocol):
    """A policy for widening a narrow team; one object per leader, with its own state.

    Attributes:
        waits_for: members that prevented widening at the last tick.
    """

    waits_for: Sequence[str]

    def widens(self, now_ns: int, free: bool, names: Iterable[str], listening: ReportReceiver) -> bool:
        """Whether to widen; called at every tick at which the team is narrow.

        Args:
            now_ns: time of the tick.
            free: whether the leader's own lane is free.
            names: members behind the leader.
            listening: their reports.
        """


class Timer:
    """When the leader's lane has been free for some time on end."""

    def __init__(self, wait_s: float) -> None:
        self._wait_ns = seconds_to_ns(wait_s)
        self._since_ns: int | None = None
        self.waits_for: Sequence[str] = ()

    def widens(self, now_ns: int, free: bool, names: Iterable[str], listening: ReportReceiver) -> bool:
        """Whether that time is over; then it begins anew."""
        if free and self._since_ns is None:
            self._since_ns = now_ns
        over = free and self._since_ns is not None and now_ns - self._since_ns >= self._wait_ns
        if over or not free:
            self._since_ns = None
        return over


class Immediate(Timer):
    """At once when the leader's lane is free."""

    def __init__(self) -> None:
        super().__init__(0.0)


class AllClear(Timer):
    """As `Timer`, while all living members report clear lanes."""

    def __init__(self, steady_s: float, report_s: float, silence_s: float) -> None:
        super().__init__(steady_s)
        self._report_ns, self._silence_ns = seconds_to_ns(report_s), seconds_to_ns(silence_s)

    def widens(self, now_ns: int, free: bool, names: Iterable[str], listening: ReportReceiver) -> bool:
        """Whether all lanes have been free for that time."""
        self.waits_for = [name for name in names if not self._is_clear(now_ns, name, listening)]
        return super().widens(now_ns, free and not self.waits_for, names, listening)

    def _is_clear(self, now_ns: int, name: str, listening: ReportReceiver) -> bool:
        if listening.absent_ns(name, now_ns) >= self._silence_ns:
            return True  # it is gone
        report = listening.newest.get(name)
        return report is not None and now_ns - report.t_ns <= self._report_ns and report.body.get("cl") == 1


def policy_of(passage: Passage) -> Policy:
    """The policy that a table names."""
    if passage.policy == "immediate":
        return Immediate()
    if passage.policy == "timer":
        return Timer(passage.timer_s)
    return AllClear(passage.steady_s, passage.report_s, passage.silence_s)
