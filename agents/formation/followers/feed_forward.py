"""Source of the speed that a follower feeds forward: its parent, the leader of the team, or none."""

from typing import Literal

from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.report import LeaderState, Report, lead_of
from vcmvsp.cosim.clock import seconds_to_ns

Feed = Literal["parent", "leader", "none"]


class FeedForward:
    """Collects the reports for feeding the leader's speed forward.

    Attributes:
        lead: newest report of the team's leader, if its speed is fed forward.
    """

    def __init__(self, feed: Feed, estimator: Estimator, timeout_s: float, clock_bound_s: float) -> None:
        self._feed, self._estimator, self._timeout_s = feed, estimator, timeout_s
        self._clock_bound_ns = seconds_to_ns(clock_bound_s)
        self.lead: Report | None = None

    def hear(self, now_ns: int, parent: Report | None, *leader: Report | None) -> None:
        """Take the newest report of the leader, direct or relayed by the parent.

        Args:
            now_ns: time of the tick.
            parent: newest report of the parent.
            leader: in a team, newest report of its leader. Outside a team, a parent that relays none is the leader.
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
