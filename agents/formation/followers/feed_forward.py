"""Whose speed a follower feeds forward: its parent's, that of the team's leader, or nobody's."""

from typing import Literal

from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.report import LeaderState, Report, lead_of
from vcmvsp.cosim.clock import seconds_to_ns

Feed = Literal["parent", "leader", "none"]


class FeedForward:
    """Keeps what it takes to feed the leader's speed forward.

    Attributes:
        lead: the newest report of the team's leader, where that is whose speed counts.
    """

    def __init__(self, feed: Feed, estimator: Estimator, timeout_s: float, clock_bound_s: float) -> None:
        self._feed, self._estimator, self._timeout_s = feed, estimator, timeout_s
        self._clock_bound_ns = seconds_to_ns(clock_bound_s)
        self.lead: Report | None = None

    def hear(self, now_ns: int, parent: Report | None, *leader: Report | None) -> None:
        """Keep the newest report of the leader, from itself or relayed by the parent.

        Args:
            now_ns: time of the tick.
            parent: the newest report of whom the vehicle follows.
            leader: in a team, the newest of its leader. Outside one, a parent that relays none is taken to be the leader.
        """
        if self._feed != "leader":
            return
        relayed = None if parent is None else lead_of(parent, now_ns + self._clock_bound_ns)
        reports = (relayed, *leader) if leader else (relayed or parent,)
        for report in reports:
            if report is not None and (self.lead is None or report.t_ns > self.lead.t_ns):
                self.lead = report

    def fed(self, parent: LeaderState, now_ns: int) -> LeaderState:
        """The parent's state with the speeds that are to be fed forward."""
        if self._feed == "none":
            return parent._replace(v=0.0, w=0.0)
        if self.lead is not None:
            age_s = max(0, now_ns - self.lead.t_ns) / 1e9
            if age_s < self._timeout_s:
                return parent._replace(v=self._estimator.predict(self.lead, age_s).v)
        return parent
