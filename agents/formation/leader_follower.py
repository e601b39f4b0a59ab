"""The follower: keeps a place beside a leader of which it knows only what the radio brings.

Geometry (Toh 2012, 3.3). The follower has a handle h, ``ell`` ahead of its centre; the leader carries a point r. ``rho_d`` and
``phi_d`` are the distance to the leader and its bearing when both head the same way (positive: the leader is on the left)::

    L = rho_d cos phi_d     L' = rho_d sin phi_d     slot of the follower in the leader's frame: (-L, -L')
    h = p_f + ell (cos th_f, sin th_f)               r = p_l + Rot(th_l) c,    c = (ell - L, -L')

Error in the follower's frame (3-31, 3-34) and law (3-33, 3-35), with ``thb = th_l - th_f``::

    z   = Rot(-th_f) (r - h)
    u   = Rot(thb) (v_l - w_l c_y, w_l c_x)          velocity of r, in the follower's frame
    v_f = u1 + k1 z1                                 w_f = (u2 + k2 z2) / ell

so that ``z1' = -k1 z1 + w_f z2``, ``z2' = -k2 z2 - w_f z1`` and, with ``V = |z|^2 / 2``, ``V' = -k1 z1^2 - k2 z2^2``: the
error decays exponentially whatever the leader does. Where the printed equations differ, ``agents/README.md`` says how and why.
"""

import math
from typing import NamedTuple

from agents.formation.prediction import Estimator, estimator_of
from agents.formation.report import LeaderState, Report, measured_speeds, parse, send_report
from cosim.agent import Agent, Observation, Radio, VehicleInfo
from cosim.clock import seconds_to_ns
from cosim.frames import yaw_of
from cosim.types import Follows, NonNegative, Positive, Velocity

SHORTEST_HANDLE_M = 0.01  # 1/ell amplifies every error of the heading; below this a robot only dithers


class Place(NamedTuple):
    """What a follower means to keep: its handle on a point of the leader's frame."""

    c_x: float  # m, leader's frame, forward
    c_y: float  # m, leader's frame, left
    handle: float  # m, ahead of the follower's centre


class Demand(NamedTuple):
    """The law's answer, and the error that led to it."""

    v: float  # m/s
    w: float  # rad/s
    z1: float  # m, forward in the follower's frame
    z2: float  # m, left


def formation_law(pose: tuple[float, float, float], leader: LeaderState, place: Place, k1: float, k2: float) -> Demand:
    """Speeds for a follower at ``pose`` (x m, y m, yaw rad) with gains ``k1``, ``k2`` in 1/s; nothing is limited here."""
    x, y, th = pose
    c_x, c_y, handle = place
    cos_f, sin_f, cos_l, sin_l = math.cos(th), math.sin(th), math.cos(leader.th), math.sin(leader.th)
    e_x = leader.x + cos_l * c_x - sin_l * c_y - x - handle * cos_f
    e_y = leader.y + sin_l * c_x + cos_l * c_y - y - handle * sin_f
    z1 = e_x * cos_f + e_y * sin_f
    z2 = e_y * cos_f - e_x * sin_f
    cos_b, sin_b = cos_l * cos_f + sin_l * sin_f, sin_l * cos_f - cos_l * sin_f  # of thb = th_l - th_f
    ahead, across = leader.v - leader.w * c_y, leader.w * c_x
    u1 = ahead * cos_b - across * sin_b
    u2 = ahead * sin_b + across * cos_b
    return Demand(u1 + k1 * z1, (u2 + k2 * z2) / handle, z1, z2)


class LeaderFollower(Agent):
    """Keep ``distance`` and ``bearing_deg`` to ``leader``; stand still until it is heard, stop when it falls silent.

    Noted at every tick: ``status`` (``waiting``, ``following``, ``leader lost``), ``age_s`` of the report in use, the error
    ``z1``, ``z2`` that the follower believes it has (m), and, once there is one, the number of the leader's messages that could
    not be used, ``refused``.

    Args:
        leader: name of the vehicle to follow; it must report itself (a `Trajectory`, or a follower with ``broadcast``).
        distance: rho_d, m.
        bearing_deg: phi_d, degrees: where the leader is to be seen; positive: on the left, so the follower is right-behind.
        handle: ell, m; default: L = distance cos(bearing), as in the thesis, which needs L > 0.
        k1: gain along the follower's heading, 1/s.
        k2: gain across it, 1/s; stable only below 2/T - v_l/ell at period T.
        estimator: ``hold``, ``dr``, ``module:Class`` or an object with ``predict(report, age_s)``.
        max_speed: limit of the commanded speed, m/s; default: none but the vehicle's own.
        max_reverse: fastest commanded reverse, m/s.
        max_yaw_rate: limit of the commanded yaw rate, rad/s; default: none but the vehicle's own.
        horizon_s: how long ``dr`` trusts the last reported speeds, s.
        fade_s: time in which it lets them fade after that, and in which this vehicle stops when the leader is lost, s.
        timeout_s: age of the newest report at which the leader counts as lost, s.
        clock_bound_s: how far ahead the leader's clock may be, s; a report from further in the future is refused.
        broadcast: report the own pose and measured speed at every tick, for vehicles that follow this one (a chain).
    """

    def __init__(
        self,
        leader: str,
        distance: Positive = 1.0,
        bearing_deg: float = 0.0,
        *,
        handle: Positive | None = None,
        k1: NonNegative = 0.8,
        k2: NonNegative = 0.5,
        estimator: str | Estimator = "dr",
        max_speed: Positive | None = None,
        max_reverse: NonNegative = 0.1,
        max_yaw_rate: Positive | None = None,
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        timeout_s: Positive = 3.0,
        clock_bound_s: NonNegative = 0.0,
        broadcast: bool = False,
    ) -> None:
        bearing = math.radians(bearing_deg)
        ahead, left = distance * math.cos(bearing), distance * math.sin(bearing)  # L, L'
        if handle is None and ahead < SHORTEST_HANDLE_M:
            raise ValueError(
                f"distance = {distance} m at bearing_deg = {bearing_deg} does not put this vehicle behind its leader "
                f"(L = {ahead:.3g} m), and the handle is L unless given: give one, e.g. handle = 0.4 (m, > 0)"
            )
        ell = ahead if handle is None else handle
        self.leader, self.k1, self.k2 = leader, k1, k2
        self.place = Place(ell - ahead, -left, ell)
        self.follows = Follows(leader=leader, slot=(-ahead, -left), handle_m=ell)
        self.estimator = estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s)
        self.max_speed = math.inf if max_speed is None else max_speed
        self.max_reverse = max_reverse
        self.max_yaw_rate = math.inf if max_yaw_rate is None else max_yaw_rate
        self.fade_s, self.timeout_s, self.broadcast = fade_s, timeout_s, broadcast
        self._clock_bound_ns = seconds_to_ns(clock_bound_s)
        self._newest: Report | None = None
        self._refused = self._seq = 0
        self._v = self._w = 0.0  # the last command that answered a report

    def start(self, info: VehicleInfo) -> None:
        """Refuse a leader that does not take part."""
        others = [name for name in info.vehicles if name != info.name]
        if self.leader not in others:
            raise ValueError(
                f"leader = {self.leader!r} is not another vehicle of this run ({', '.join(others) or 'there is none'})"
            )

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report."""
        if self.broadcast:
            send_report(radio, self._seq, obs, *measured_speeds(obs))
            self._seq += 1
        self._listen(obs)
        if self._newest is None:
            self.note(status="waiting")
            return Velocity()
        age_s = max(0, obs.time_ns - self._newest.t_ns) / 1e9
        if age_s >= self.timeout_s:
            return self._slow_down(age_s)
        x, y, _ = obs.state.position
        leader = self.estimator.predict(self._newest, age_s)
        v, w, z1, z2 = formation_law((x, y, yaw_of(obs.state.attitude)), leader, self.place, self.k1, self.k2)
        self._v = max(-self.max_reverse, min(v, self.max_speed))
        self._w = max(-self.max_yaw_rate, min(w, self.max_yaw_rate))
        self.note(status="following", age_s=age_s, z1=z1, z2=z2)
        return Velocity(linear=(self._v, 0.0, 0.0), yaw_rate=self._w)

    def _listen(self, obs: Observation) -> None:
        """Keep the report that was valid last: late ones and copies change nothing, nonsense is counted."""
        for heard in obs.heard:
            if heard.message.sender != self.leader:
                continue
            report = parse(heard.message.body, obs.time_ns + self._clock_bound_ns)
            if report is None:
                self._refused += 1
            elif self._newest is None or report.t_ns > self._newest.t_ns:
                self._newest = report
        if self._refused:
            self.note(refused=self._refused)

    def _slow_down(self, age_s: float) -> Velocity:
        """Let the last command fade to a standstill, along its own arc."""
        left = max(0.0, 1.0 - (age_s - self.timeout_s) / self.fade_s)
        self.note(status="leader lost", age_s=age_s)
        return Velocity(linear=(self._v * left, 0.0, 0.0), yaw_rate=self._w * left)
