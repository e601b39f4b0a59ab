"""Reports of a vehicle to its followers, sent at every tick, and their validation by a follower.

========= ====== ===================================================================================
key       type   meaning
========= ====== ===================================================================================
``seq``   int    0, 1, 2, ... of this sender
``t_ns``  int    when the pose was valid, ns of simulated time
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
from collections.abc import Mapping
from typing import Any, NamedTuple

from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.frames import yaw_of

# No pose on Earth and no speed of a vehicle is larger; greater values, infinities and NaN are all refused by one comparison.
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
    """A message that was accepted."""

    t_ns: int
    state: LeaderState
    body: Mapping[str, Any]  # all that was sent: estimators of your own may find more in it


def send_report(radio: Radio, seq: int, obs: Observation, v: float, w: float, **more: Any) -> None:
    """Broadcast the report of this tick; ``more`` as in the second part of the table."""
    x, y, _ = obs.state.position
    radio.send(seq=seq, t_ns=obs.time_ns, x=x, y=y, th=yaw_of(obs.state.attitude), v=v, w=w, **more)


def measured_speeds(obs: Observation) -> tuple[float, float]:
    """The vehicle's own forward speed, m/s, and yaw rate, rad/s, as its pose source tells them."""
    (vx, vy, _), yaw = obs.state.velocity, yaw_of(obs.state.attitude)
    return vx * math.cos(yaw) + vy * math.sin(yaw), obs.state.angular_velocity[2]


def accelerations(report: Report) -> tuple[float, float]:
    """How fast the speeds change, m/s2 and rad/s2; zero where the report does not say, or says nonsense."""
    a, al = report.body.get("a", 0.0), report.body.get("al", 0.0)
    try:
        return (a, al) if abs(a) + abs(al) < PLAUSIBLE else (0.0, 0.0)
    except TypeError:
        return 0.0, 0.0


def height_of(report: Report) -> float | None:
    """The height in a report, m, world; None where it does not say, as on wheels, or says nonsense."""
    z = report.body.get("z")
    try:
        return z if abs(z) < PLAUSIBLE else None  # type: ignore[arg-type]
    except TypeError:
        return None


def plan_of(report: Report) -> tuple[float, list[tuple[float, float]]] | None:
    """The seconds between the speeds of a plan, and the speeds (v, w) themselves, first those of now; None: it has no plan."""
    dt, flat = report.body.get("dt"), report.body.get("plan")
    if not isinstance(dt, float) or not isinstance(flat, list) or not flat or len(flat) % 2:
        return None
    try:
        if not SHORTEST_PERIOD_S <= dt < PLAUSIBLE or not sum(map(abs, flat)) < PLAUSIBLE:
            return None
    except TypeError:
        return None
    return dt, [report.state[3:], *zip(flat[::2], flat[1::2], strict=True)]


def lead_of(report: Report, latest_ns: int) -> Report | None:
    """The report of the team's leader that this one relays; None where there is none that `parse` would believe."""
    lead = report.body.get("lead")
    return parse(dict(zip(STATE_KEYS, lead, strict=False)), latest_ns) if isinstance(lead, list) else None


def parse(body: Mapping[str, Any], latest_ns: int) -> Report | None:
    """The report in a message body; None where it is not one that can be followed.

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
