"""Sending of reports: the table ``sending = {...}`` of an agent, and the reporter.

Event-triggered sending saves the channel. The sender runs the followers' estimator on the last report that they have, and
sends a new one when the prediction is off by the threshold. Acknowledgements show which report they have: each follower
answers a report that asks for it with its number (`acknowledge`). Until an answer is due, the report counts as received; if
none came, the one before it counts again, whose prediction is off by then, so that a new report goes out at once.
"""

import math
from collections.abc import Iterable
from typing import Any, Literal

import msgspec

from vcmvsp.agents.formation.reports.prediction import DeadReckoning, Estimator
from vcmvsp.agents.formation.reports.report import LeaderState, Report, send_report
from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.frames import wrap, yaw_of
from vcmvsp.cosim.types import NonNegative, Positive

METRES_PER_RADIAN = 0.5  # weight of an error of the heading
GIVEN_UP = 5.0  # times silence_s: wait for a missing answer
REMEMBERED = 64  # unconfirmed reports in memory; answers to older ones are ignored


class Sending(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When reports are sent."""

    when: Literal["always", "needed"] = "always"  # at every tick, or when the followers' prediction is off by the threshold
    threshold: Positive = 0.02  # of "needed": m; an error of the heading counts half a metre a radian
    silence_s: Positive = 2.0  # of "needed": longest time between two reports, s
    acknowledge: bool = True  # of "needed": followers confirm what they hear, and it is sent again until they do
    answer_s: NonNegative = 0.2  # of "needed": how long an answer takes; it counts as given until then, s


def acknowledge(radio: Radio, report: Report, to: str) -> None:
    """For a follower: answer a report of ``to``, if it asks for that."""
    if report.body.get("ak") and isinstance(seq := report.body.get("seq"), int):
        radio.send(ack=seq, to=to)


class Reporter:
    """Sends the reports of one vehicle; ``estimator`` is the followers' estimator, `DeadReckoning` by default."""

    def __init__(self, sending: Sending | None = None, estimator: Estimator | None = None) -> None:
        self.sending = sending or Sending()
        self.estimator = estimator or DeadReckoning()
        self._flight = getattr(self.estimator, "flight", None)  # of an estimator with heights
        self._seq = 0
        self._always = self.sending.when == "always"
        self._sent: dict[int, Report] = {}  # by number: possible newest reports of followers, the latest last
        self._has: dict[str, int] = {}  # last number that each follower confirmed; -1: none
        self._answered_ns: dict[str, float] = {}  # time of that; inf: newly announced

    def start(self, listeners: Iterable[str]) -> None:
        """Set the followers, whose answers are awaited; before the first tick and whenever they change.

        Answers of any other vehicle are awaited, too. A vehicle without an answer for ``GIVEN_UP`` times ``silence_s`` counts
        as gone: reports are not repeated for it until it answers again.
        """
        names = tuple(listeners)
        self._has = {name: self._has.get(name, -1) for name in names}
        self._answered_ns = dict.fromkeys(names, math.inf)

    def tell(self, radio: Radio, obs: Observation, v: float, w: float, **more: Any) -> None:
        """Send a report if it is due; called at every tick with the speeds from now on, m/s and rad/s, and further content."""
        if self._always:
            send_report(radio, self._seq, obs, v, w, **more)
            self._seq += 1
            return
        x, y, _ = obs.state.position
        if self.sending.acknowledge:
            self._hear(obs)
            more["ak"] = 1
        now = Report(obs.clock_ns, LeaderState(x, y, yaw_of(obs.state.attitude), v, w), more)
        if self._due(now):
            send_report(radio, self._seq, obs, v, w, **more)
            self._sent[self._seq] = now
            self._seq += 1
            if len(self._sent) > REMEMBERED:
                needed = {*self._has.values(), *range(self._seq - REMEMBERED // 2, self._seq)}
                self._sent = {number: report for number, report in self._sent.items() if number in needed}

    def _hear(self, obs: Observation) -> None:
        for name, body in obs.heard.bodies():
            number = body.get("ack")
            if type(number) is int and number in self._sent:
                self._has[name] = max(number, self._has.get(name, -1))
                self._answered_ns[name] = obs.time_ns
        self._answered_ns = {name: min(when, obs.time_ns) for name, when in self._answered_ns.items()}
        patience_ns = GIVEN_UP * self.sending.silence_s * 1e9
        for name in [each for each, when in self._answered_ns.items() if obs.time_ns - when > patience_ns]:
            del self._has[name], self._answered_ns[name]

    def _due(self, now: Report) -> bool:
        """Whether a follower's prediction may be off by the threshold."""
        if not self._sent:
            return True
        since_s = (now.t_ns - self._sent[self._seq - 1].t_ns) / 1e9
        if since_s >= self.sending.silence_s:
            return True
        unanswered = not self.sending.acknowledge or since_s < self.sending.answer_s or not self._has
        numbers = {self._seq - 1} if unanswered else set(self._has.values())
        return any(number < 0 or self._wrong(self._sent[number], now) for number in sorted(numbers))

    def _wrong(self, last: Report, now: Report) -> bool:
        """Whether a follower with the report ``last`` has a wrong pose, shape or lane state of this vehicle."""
        if any(last.body.get(key) != now.body.get(key) for key in ("sn", "cl")):
            return True
        age_s = (now.t_ns - last.t_ns) / 1e9
        x, y, th, _, _ = self.estimator.predict(last, age_s)
        up = 0.0 if self._flight is None else self._flight(last, age_s).position[2] - self._flight(now, 0.0).position[2]
        aside = math.hypot(x - now.state.x, y - now.state.y, up)
        return aside + METRES_PER_RADIAN * abs(wrap(th - now.state.th)) > self.sending.threshold
