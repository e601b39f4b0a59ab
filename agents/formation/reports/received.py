"""Received reports: the newest of each relevant sender, and the time since then.

Messages of bytes come from other programs on the same radio; they are no sign of life of the agent there.
"""

import math
from collections.abc import Iterable

from vcmvsp.agents.formation.reports.report import Report, parse
from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.clock import seconds_to_ns

LEAST_HEARTBEAT_S = 1.0


class ReportReceiver:
    """Keeps the report of each sender that was valid last: late ones and copies change nothing, nonsense is counted.

    Attributes:
        newest: by sender.
        refused: how many messages could not be used.
    """

    def __init__(self, senders: Iterable[str], clock_bound_s: float) -> None:
        self._senders = frozenset(senders)
        self._clock_bound_ns = seconds_to_ns(clock_bound_s)
        self.newest: dict[str, Report] = {}
        self.refused = 0
        self._heard_ns: dict[str, int] = {}  # when a report came that can be used
        self._there_ns: dict[str, int] = {}  # when anything of an agent came

    def take(self, obs: Observation) -> list[Report]:
        """Go through what came in since the last tick; the reports of it, oldest first."""
        reports = []
        for reception in obs.heard:
            message = reception.message
            sender, body = message.sender, message.body
            if sender not in self._senders or isinstance(body, bytes):
                continue
            self._there_ns[sender] = obs.time_ns
            report = parse(body, obs.time_ns + self._clock_bound_ns)
            if report is None:
                self.refused += "ack" not in body  # answers to own reports are for the Reporter
                continue
            self._heard_ns[sender] = obs.time_ns
            reports.append(report)
            before = self.newest.get(sender)
            if before is None or report.t_ns > before.t_ns:
                self.newest[sender] = report
        return reports

    def silent_ns(self, sender: str, now_ns: int) -> int:
        """Time since the last usable report of a sender; without one, since the start."""
        return now_ns - self._heard_ns.get(sender, 0)

    def absent_ns(self, sender: str, now_ns: int) -> int:
        """Time since the last message of a sender, usable or not."""
        return now_ns - self._there_ns.get(sender, 0)


def heartbeat_for(loss: float, period_s: float, false_alarms_per_s: float) -> float:
    """After how much silence to give a parent up, s, so that losses alone raise about so many false alarms a second.

    Of independent losses p at period T, a silence of t comes about by chance (1 - p) / T p^(t / T) times a second. Solved for t
    (without the factor 1 - p, which errs on the safe side), and one second at least: ``max(1 s, T ln(eps T) / ln p)``.

    Raises:
        ValueError: ``loss`` of 1 or more, where every silence is chance; a period or rate that is not > 0.
    """
    if not 0.0 <= loss < 1.0:
        raise ValueError(f"loss = {loss} must be >= 0 and < 1")
    if not (period_s > 0.0 and false_alarms_per_s > 0.0):
        raise ValueError(f"period_s = {period_s} and false_alarms_per_s = {false_alarms_per_s} must be > 0")
    if loss == 0.0:
        return LEAST_HEARTBEAT_S
    return max(LEAST_HEARTBEAT_S, period_s * math.log(false_alarms_per_s * period_s) / math.log(loss))
