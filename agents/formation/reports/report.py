"""Reports of a vehicle to its followers, their validation, and the newest received ones.

========= ====== ===================================================================================
key       type   meaning
========= ====== ===================================================================================
``seq``   int    0, 1, 2, ... of this sender
``t_ns``  int    when the pose was valid, ns, by the sender's clock
``x y``   float  its own estimate of its position, m, world
``th``    float  its own estimate of its yaw, rad
``v w``   float  speeds from then on, m/s and rad/s: the command of this tick (a leader) or measured (a follower)
--------- ------ -----------------------------------------------------------------------------------
``a al``  float  how fast they change, m/s2 and rad/s2 (where the estimator ``acc`` or a feed-forward needs them)
``vx vy`` float  velocity from then on, m/s, world, of one that flies (``v`` is its part along the heading); with ``vz``
``vz z``  float  the climb, m/s, and its own estimate of its height, m, world
``plan``  list   the speeds after that, ``dt`` s from now, 2 ``dt``, ...: v1, w1, v2, w2, ... (for the estimator ``plan``)
``dt``    float  s between them
``lead``  list   ``t_ns x y th v w`` of the newest report of the team's leader, relayed
``shape`` str    present shape of the team (in a team)
``sn``    int    number of changes: the highest counts, from any sender
``order`` list   numbers of the members, by place; absent: in their order
``cl``    int    1: the sender sees nothing in the lane that the team's wide shape needs; 0: something, or nothing certain
``ak``    int    1: followers answer with the message ``ack`` (`agents.formation.reports.sending`)
========= ====== ===================================================================================

The keys are short because every byte costs air time. The answer is a unicast message to the sender with the one key
``ack``: the ``seq`` of the received report.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import yaw_of

# No pose on Earth and no speed of a vehicle is larger; one comparison refuses greater values, infinities and NaN.
PLAUSIBLE = 1e9
SHORTEST_PERIOD_S = 1e-6  # of agents, as a scenario allows it
STATE_KEYS = ("t_ns", "x", "y", "th", "v", "w")


class LeaderState(NamedTuple):
    """Planar pose and speeds of a vehicle that is followed."""

    x: float  # m, world
    y: float  # m, world
    th: float  # rad
    v: float  # m/s, forward
    w: float  # rad/s


class Report(NamedTuple):
    """A valid report of a vehicle."""

    t_ns: int
    state: LeaderState
    body: Mapping[str, Any]  # the whole message: user-defined estimators may use more of it


def send_report(radio: Radio, seq: int, obs: Observation, v: float, w: float, **more: Any) -> None:
    """Broadcast the report of this tick; ``more`` as in the second part of the table."""
    x, y, _ = obs.state.position
    radio.send(seq=seq, t_ns=obs.clock_ns, x=x, y=y, th=yaw_of(obs.state.attitude), v=v, w=w, **more)


def measured_speeds(obs: Observation) -> tuple[float, float]:
    """Forward speed, m/s, and yaw rate, rad/s, of the own vehicle by its pose source."""
    (vx, vy, _), yaw = obs.state.velocity, yaw_of(obs.state.attitude)
    return vx * math.cos(yaw) + vy * math.sin(yaw), obs.state.angular_velocity[2]


def plausible(values: Iterable[Any]) -> bool:
    """Whether all values are numbers of a plausible size."""
    try:
        return sum(map(abs, values)) < PLAUSIBLE
    except TypeError:
        return False


def accelerations(report: Report) -> tuple[float, float]:
    """Accelerations in a report, m/s2 and rad/s2; zero if they are missing or invalid."""
    a, al = report.body.get("a", 0.0), report.body.get("al", 0.0)
    return (a, al) if plausible((a, al)) else (0.0, 0.0)


def height_of(report: Report) -> float | None:
    """Height in a report, m, world; None: missing, as for ground vehicles, or invalid."""
    z = report.body.get("z")
    return z if plausible((z,)) else None


def plan_of(report: Report) -> tuple[float, list[tuple[float, float]]] | None:
    """Period of a plan, s, and its speeds (v, w), the present ones first; None: the report has no plan."""
    dt, flat = report.body.get("dt"), report.body.get("plan")
    if not isinstance(dt, float) or not isinstance(flat, list) or not flat or len(flat) % 2:
        return None
    if not SHORTEST_PERIOD_S <= dt < PLAUSIBLE or not plausible(flat):
        return None
    return dt, [report.state[3:], *zip(flat[::2], flat[1::2], strict=True)]


def lead_of(report: Report, latest_ns: int) -> Report | None:
    """Relayed report of the team's leader; None: missing, or `parse` would refuse it."""
    lead = report.body.get("lead")
    return parse(dict(zip(STATE_KEYS, lead, strict=False)), latest_ns) if isinstance(lead, list) else None


def parse(body: Mapping[str, Any], latest_ns: int) -> Report | None:
    """The report in a message body; None: it is invalid.

    Refused are missing keys, values that are not numbers, not finite or beyond `PLAUSIBLE`, and a ``t_ns`` later than
    ``latest_ns``.
    """
    try:
        t_ns, x, y, th, v, w = body["t_ns"], body["x"], body["y"], body["th"], body["v"], body["w"]
        if type(t_ns) is not int or t_ns > latest_ns or not abs(x) + abs(y) + abs(th) + abs(v) + abs(w) < PLAUSIBLE:
            return None
    except (KeyError, TypeError):
        return None
    return Report(t_ns, LeaderState(x, y, th, v, w), body)


LEAST_HEARTBEAT_S = 1.0


class ReportReceiver:
    """Keeps the newest valid report by sender; ignores late reports and copies, counts invalid messages (``refused``)."""

    def __init__(self, senders: Iterable[str], clock_bound_s: float) -> None:
        self._senders = frozenset(senders)
        self._clock_bound_ns = seconds_to_ns(clock_bound_s)
        self.newest: dict[str, Report] = {}
        self.refused = 0
        self._heard_ns: dict[str, int] = {}  # time of the newest usable report
        self._there_ns: dict[str, int] = {}  # time of the newest message of an agent

    def take(self, obs: Observation) -> list[Report]:
        """Process the messages since the last tick; returns their reports, oldest first."""
        reports = []
        for sender, body in obs.heard.bodies(self._senders):
            self._there_ns[sender] = obs.time_ns
            report = parse(body, obs.clock_ns + self._clock_bound_ns)
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
    """Silence, s, after which a parent counts as lost, for a given rate of false alarms by packet losses alone.

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
