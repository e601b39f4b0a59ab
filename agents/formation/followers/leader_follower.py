"""Ground follower: keeps a place beside a leader known from radio reports only (the law: `followers.laws`)."""

import math
from typing import Any, Literal

from vcmvsp.agents.avoidance.method import body_of
from vcmvsp.agents.formation.followers.follower import FormationFollower
from vcmvsp.agents.formation.followers.laws import FollowerPlace, formation_law, point_of
from vcmvsp.agents.formation.reports.report import LeaderState, Report, accelerations, lead_of, measured_speeds
from vcmvsp.agents.formation.team.passage import VisibleMembers
from vcmvsp.agents.formation.team.shape import Formation, Passage, Slot
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import NonNegative, Positive, Velocity

Feed = Literal["parent", "leader", "none"]

SHORTEST_HANDLE_M = 0.01  # 1/ell amplifies every error of the heading; below this a robot oscillates
TEAM_HANDLE_M = 0.4  # serves slots on all sides of a parent


class LeaderFollower(FormationFollower):
    """Keep a place beside ``leader``, or in a ``formation``; stand still before the first report, stop after the last.

    Notes the estimated error ``z1``, ``z2`` (m) at every tick, besides the notes of every `FormationFollower`.

    Args:
        distance: rho_d, m.
        bearing_deg: phi_d, degrees: bearing of the leader; positive: on the left, so the follower is right-behind.
        handle: ell, m; default: L = distance cos(bearing), as in the thesis, which needs L > 0; in a formation 0.4 m.
        slot: in place of distance and bearing: place in the leader's frame, x forward and y left, m; behind: negative x.
        k1: gain along the follower's heading, 1/s.
        k2: gain across it, 1/s; stable only below 2/T - v_l/ell at period T.
        feed: source of the fed-forward speed: ``parent``; ``leader``, as relayed, with the parent's yaw rate; ``none``.
        feed_forward_s: seconds of the parent's acceleration that are added to the speed: the lag of the own servo.
        max_reverse: fastest commanded reverse, m/s.
        max_yaw_rate: limit of the commanded yaw rate, rad/s; default: none but the vehicle's own.
        following: estimator, max_speed, horizon_s, fade_s, timeout_s, heartbeat_s, clock_bound_s, broadcast, sending,
            avoidance, as of `FormationFollower`.
    """

    LEADS = "trajectory, route, teleop"

    def __init__(
        self,
        leader: str | None = None,
        distance: Positive = 1.0,
        bearing_deg: float = 0.0,
        *,
        handle: Positive | None = None,
        slot: Slot | None = None,
        formation: Formation | None = None,
        k1: NonNegative = 0.8,
        k2: NonNegative = 0.5,
        feed: Feed = "parent",
        feed_forward_s: NonNegative = 0.0,
        max_reverse: NonNegative = 0.1,
        max_yaw_rate: Positive | None = None,
        **following: Any,
    ) -> None:
        super().__init__(leader, formation=formation, **following)
        self.k1, self.k2, self.feed, self.feed_forward_s = k1, k2, feed, feed_forward_s
        self.max_reverse, self.max_yaw_rate = max_reverse, math.inf if max_yaw_rate is None else max_yaw_rate
        self._tells_a = feed_forward_s > 0.0 or "a" in getattr(self.estimator, "needs", ())
        self._lead: Report | None = None  # newest report of the team's leader, where its speed is fed forward
        self._before: tuple[int, float, float] | None = None  # at the last tick: time in ns, own measured speeds
        self._v = self._w = 0.0  # the last command that answered a report
        if formation is not None:
            if slot is not None:
                raise ValueError("slot and formation both define the place of this vehicle; leave one of them out")
            self._handle = TEAM_HANDLE_M if handle is None else handle
            return
        words = "" if slot is None else f"slot = {list(slot)} m"
        if slot is None:
            bearing = math.radians(bearing_deg)
            slot = (-distance * math.cos(bearing), -distance * math.sin(bearing))  # (-L, -L')
            words = f"distance = {distance} m at bearing_deg = {bearing_deg}"
        if handle is None and -slot[0] < SHORTEST_HANDLE_M:
            raise ValueError(
                f"{words} does not put this vehicle behind its leader "
                f"(L = {0.0 - slot[0]:.3g} m), and the default of handle is L: set it, e.g. handle = 0.4 (m, > 0)"
            )
        self._handle = -slot[0] if handle is None else handle
        self._keep(leader, slot)

    def _keep(self, leader: str | None, slot: Slot, handle_m: float = 0.0) -> None:
        self.place = FollowerPlace(self._handle + slot[0], slot[1], self._handle)
        super()._keep(leader, slot, self._handle)

    def start(self, info: VehicleInfo) -> None:
        """Find the leader or the place in the team, and the members that are no obstacles in the scan."""
        super().start(info)
        if self._steering is not None:
            self._visible = self._lookout or VisibleMembers(body_of(info), Passage())

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report, around obstacles."""
        v, w, leader = self._speeds_without_avoidance(obs, radio)
        if self._steering is not None:
            settings, mates = self._steering.settings, (self._listening, self.estimator)
            obs = self._visible.without_members(obs, *mates, settings.scanner)
            decision = (
                self._steering.limit(obs, (v, w))
                if leader is None
                else self._steering.drive(obs, (v, w), point_of(leader, self.place), (leader.x, leader.y))
            )
            v = self._visible.behind_members(obs, decision.velocity[0], *mates, settings.approach)
            w = decision.yaw_rate
            self.note(**self._steering.notes)
        if leader is not None:
            self._v, self._w = v, w
        return Velocity(linear=(v, 0.0, 0.0), yaw_rate=w)

    def _speeds_without_avoidance(self, obs: Observation, radio: Radio) -> tuple[float, float, LeaderState | None]:
        """Speeds without avoidance, m/s and rad/s; while it follows, also the leader's motion."""
        newest = self._hear(obs)
        if self.feed == "leader":
            self._take_lead(obs.clock_ns, newest)
        self._report(obs, radio)
        age_s = self._age_s(obs.clock_ns, newest)
        if newest is None or age_s >= self.timeout_s:
            return *self._fade(obs.time_ns, 0.0 if newest is None else age_s - self.timeout_s), None
        (x, y, _), yaw = obs.state.position, yaw_of(obs.state.attitude)
        leader = self._fed(self.estimator.predict(newest, age_s), obs.clock_ns)
        v, w, z1, z2 = formation_law((x, y, yaw), leader, self.place, self.k1, self.k2)
        if self.feed_forward_s:
            trust = max(0.0, min(1.0, 1.0 - (age_s - self.horizon_s) / self.fade_s))
            v += trust * self.feed_forward_s * accelerations(newest)[0]
        v = max(-self.max_reverse, min(v, self.max_speed))
        w = max(-self.max_yaw_rate, min(w, self.max_yaw_rate))
        self._fading_ns = None
        self.note(z1=z1, z2=z2)
        return v, w, leader

    def _take_lead(self, now_ns: int, parent: Report | None) -> None:
        """Take the newest report of the team's leader, heard or relayed; outside a team, a parent that relays none leads."""
        relayed = None if parent is None else lead_of(parent, now_ns + seconds_to_ns(self._clock_bound_s))
        reports = [relayed or parent]
        if self._team is not None:
            reports = [relayed, self._listening.newest.get(self._team.members[0])]
        for report in reports:
            if report is not None and (self._lead is None or report.t_ns > self._lead.t_ns):
                self._lead = report

    def _fed(self, parent: LeaderState, now_ns: int) -> LeaderState:
        if self.feed == "none":
            return parent._replace(v=0.0, w=0.0)
        if self._lead is not None:
            age_s = max(0, now_ns - self._lead.t_ns) / 1e9
            if age_s < self.timeout_s:
                return parent._replace(v=self.estimator.predict(self._lead, age_s).v)
        return parent

    def _fade(self, now_ns: int, for_s: float) -> tuple[float, float]:
        """Reduce the last command to a standstill, along its own arc; ``for_s``: time since the fade began."""
        if self._team is not None:  # a lost member may become the leader: it continues to slow down
            since_ns = now_ns - seconds_to_ns(for_s)
            self._fading_ns = since_ns if self._fading_ns is None else min(since_ns, self._fading_ns)
            for_s = (now_ns - self._fading_ns) / 1e9
        share = max(0.0, 1.0 - for_s / self.fade_s)
        return self._v * share, self._w * share

    def _report(self, obs: Observation, radio: Radio) -> None:
        more: dict[str, Any] = {}
        v, w = measured_speeds(obs) if self._broadcast or self._tells_a else (0.0, 0.0)
        if self._tells_a:
            before_ns, before_v, before_w = self._before or (obs.time_ns, v, w)
            dt = max(1, obs.time_ns - before_ns) / 1e9
            more["a"], more["al"] = (v - before_v) / dt, (w - before_w) / dt
            self._before = obs.time_ns, v, w
        if self._lead is not None:
            more["lead"] = [self._lead.t_ns, *self._lead.state]
        self._tell(obs, radio, v, w, **more)
