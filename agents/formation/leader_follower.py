"""The follower: keeps a place beside a leader of which it knows only what the radio brings.

The law itself, with its geometry, is in `agents.formation.law`.
"""

import math

from agents.formation.law import Place, formation_law
from agents.formation.prediction import Estimator, estimator_of
from agents.formation.report import Report, measured_speeds, parse, send_report
from cosim.agent import Agent, Observation, Radio, VehicleInfo
from cosim.clock import seconds_to_ns
from cosim.frames import yaw_of
from cosim.types import Follows, NonNegative, Positive, Velocity

SHORTEST_HANDLE_M = 0.01  # 1/ell amplifies every error of the heading; below this a robot only dithers


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
