"""Ground follower: keeps a place beside a leader that it knows from radio reports only.

The control law and its geometry are in `agents.formation.followers.leader_follower_law`, the topology of a team in
`agents.formation.team.team`.
"""

import math
from typing import Any

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.settings import body_of
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.agents.formation.followers.feed_forward import Feed, FeedForward
from vcmvsp.agents.formation.followers.leader_follower_law import FollowerPlace, formation_law, point_of
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.report import LeaderState, accelerations, measured_speeds
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.formation import Formation, Passage
from vcmvsp.agents.formation.team.membership import Membership
from vcmvsp.agents.formation.team.passage import scanners
from vcmvsp.agents.formation.team.visible_members import VisibleMembers
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Follows, NonNegative, Positive, Velocity

SHORTEST_HANDLE_M = 0.01  # 1/ell amplifies every error of the heading; below this a robot only dithers
TEAM_HANDLE_M = 0.4  # serves slots on all sides of a parent


class LeaderFollower(Agent):
    """Keep a place beside ``leader``, or in a ``formation``; stand still before the first report, stop after the last.

    Notes at every tick: ``status`` (``waiting``, ``following``, ``leader lost``; ``leading`` in a team without a living
    ancestor), ``age_s`` of the report in use, the estimated error ``z1``, ``z2`` (m) and, from the first one on, the number of
    unusable messages, ``refused``. In a team also, when they change, ``parent`` (empty for a leading member) and ``shape``.

    Args:
        leader: name of the leader, which must report itself (a `Trajectory`, or a follower with ``broadcast``). Not with a
            formation.
        distance: rho_d, m.
        bearing_deg: phi_d, degrees: bearing of the leader; positive: on the left, so the follower is right-behind.
        handle: ell, m; default: L = distance cos(bearing), as in the thesis, which needs L > 0; in a formation 0.4 m.
        slot: in place of distance and bearing: place in the leader's frame, x forward and y left, m; behind: negative x.
        formation: shape and topology of the team.
        k1: gain along the follower's heading, 1/s.
        k2: gain across it, 1/s; stable only below 2/T - v_l/ell at period T.
        estimator: ``hold``, ``dr``, ``acc``, ``plan``, ``module:Class``, ``file.py:Class`` or an object with
            ``predict(report, age_s)``.
        feed: source of the fed-forward speed: ``parent``; ``leader``, as relayed, with the parent's yaw rate; ``none``.
        feed_forward_s: seconds of the parent's acceleration that are added to the speed: the lag of the own servo.
        max_speed: limit of the commanded speed, m/s; default: none but the vehicle's own.
        max_reverse: fastest commanded reverse, m/s.
        max_yaw_rate: limit of the commanded yaw rate, rad/s; default: none but the vehicle's own.
        horizon_s: how long ``dr`` uses the last reported speeds, and the feed-forward the acceleration, s.
        fade_s: time in which they fade to zero after that, and in which this vehicle stops without a leader, s.
        timeout_s: age of the newest report at which the leader counts as lost, s.
        heartbeat_s: in a formation: silence after which a parent is replaced by its own parent, s (`heartbeat_for`).
        clock_bound_s: largest lead of the leader's clock, s; reports from further in the future are rejected.
        broadcast: report the own pose and measured speed to followers. Default: in a formation with children, a heartbeat or
            changes of shape; otherwise no.
        sending: when it reports.
        avoidance: method of avoidance on the way to its place; default: none.
    """

    def __init__(
        self,
        leader: str | None = None,
        distance: Positive = 1.0,
        bearing_deg: float = 0.0,
        *,
        handle: Positive | None = None,
        slot: tuple[float, float] | None = None,
        formation: Formation | None = None,
        k1: NonNegative = 0.8,
        k2: NonNegative = 0.5,
        estimator: str | Estimator = "dr",
        feed: Feed = "parent",
        feed_forward_s: NonNegative = 0.0,
        max_speed: Positive | None = None,
        max_reverse: NonNegative = 0.1,
        max_yaw_rate: Positive | None = None,
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        timeout_s: Positive = 3.0,
        heartbeat_s: Positive | None = None,
        clock_bound_s: NonNegative = 0.0,
        broadcast: bool | None = None,
        sending: Sending | None = None,
        avoidance: Avoidance | None = None,
    ) -> None:
        self.formation, self.k1, self.k2 = formation, k1, k2
        self.estimator = estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s)
        self.feed_forward_s = feed_forward_s
        self._feeding = FeedForward(feed, self.estimator, timeout_s, clock_bound_s)
        self.max_speed = math.inf if max_speed is None else max_speed
        self.max_reverse = max_reverse
        self.max_yaw_rate = math.inf if max_yaw_rate is None else max_yaw_rate
        self.horizon_s, self.fade_s, self.timeout_s = horizon_s, fade_s, timeout_s
        self._tells_a = feed_forward_s > 0.0 or "a" in getattr(self.estimator, "needs", ())
        self._steering = None if avoidance is None else AvoidanceSteering(avoidance)
        self.sensors = scanners(avoidance, formation) or self.sensors
        self._before: tuple[int, float, float] | None = None  # at the last tick: time in ns, own measured speeds
        self._v = self._w = 0.0  # the last command that answered a report
        self._fading_ns: int | None = None  # in a team: since when that fades
        self.leader = leader
        self._member = Membership(
            leader,
            formation,
            keep=self._keep,
            estimator=self.estimator,
            broadcast=broadcast,
            sending=sending,
            heartbeat_s=heartbeat_s,
            clock_bound_s=clock_bound_s,
        )
        if formation is not None:
            if slot is not None:
                raise ValueError("slot says where to be, but the formation does so already; leave one of them out")
            self._handle = TEAM_HANDLE_M if handle is None else handle
            return
        if slot is None:
            bearing = math.radians(bearing_deg)
            slot = (-distance * math.cos(bearing), -distance * math.sin(bearing))  # (-L, -L')
            words = f"distance = {distance} m at bearing_deg = {bearing_deg}"
        else:
            words = f"slot = {list(slot)} m"
        if handle is None and -slot[0] < SHORTEST_HANDLE_M:
            raise ValueError(
                f"{words} does not put this vehicle behind its leader "
                f"(L = {0.0 - slot[0]:.3g} m), and the handle is L unless given: give one, e.g. handle = 0.4 (m, > 0)"
            )
        self._handle = -slot[0] if handle is None else handle
        self._keep(leader, slot)

    def start(self, info: VehicleInfo) -> None:
        """Refuse a leader that does not take part, and a formation that does not fit; find the place in it."""
        self._member.start(info, "trajectory, route, teleop")
        if self._steering is not None:
            self._steering.start(info)
            self._visible = self._member.lookout or VisibleMembers(body_of(info), Passage())
        self.note(**self._member.notes)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report, around what stands in the way."""
        v, w, leader = self._wanted(obs, radio)
        if self._steering is not None:
            settings, mates = self._steering.settings, (self._member.listening, self.estimator)
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

    def _wanted(self, obs: Observation, radio: Radio) -> tuple[float, float, LeaderState | None]:
        """Speeds without avoidance, m/s and rad/s; while it follows, also the leader's motion."""
        newest, team = self._member.hear(obs), self._member.team
        if self._member.notes:
            self.note(**self._member.notes)
        lead = () if team is None else (self._member.listening.newest.get(team.members[0]),)
        self._feeding.hear(obs.time_ns, newest, *lead)
        self._tell(obs, radio)
        if newest is None or self.leader is None:
            self.note(status="waiting" if self.leader else "leading")
            return *self._fade(obs.time_ns, 0.0), None
        age_s = max(0, obs.time_ns - newest.t_ns) / 1e9
        if age_s >= self.timeout_s:
            self.note(status="leader lost", age_s=age_s)
            return *self._fade(obs.time_ns, age_s - self.timeout_s), None
        x, y, _ = obs.state.position
        leader = self._feeding.fed(self.estimator.predict(newest, age_s), obs.time_ns)
        v, w, z1, z2 = formation_law((x, y, yaw_of(obs.state.attitude)), leader, self.place, self.k1, self.k2)
        if self.feed_forward_s:
            trust = max(0.0, min(1.0, 1.0 - (age_s - self.horizon_s) / self.fade_s))
            v += trust * self.feed_forward_s * accelerations(newest)[0]
        v = max(-self.max_reverse, min(v, self.max_speed))
        w = max(-self.max_yaw_rate, min(w, self.max_yaw_rate))
        self._fading_ns = None
        self.note(status="following", age_s=age_s, z1=z1, z2=z2)
        return v, w, leader

    def _fade(self, now_ns: int, for_s: float) -> tuple[float, float]:
        """Reduce the last command to a standstill, along its own arc; ``for_s``: time since the fade began."""
        if self._member.team is not None:  # a lost member may become the leader: it continues to slow down
            since_ns = now_ns - seconds_to_ns(for_s)
            self._fading_ns = since_ns if self._fading_ns is None else min(since_ns, self._fading_ns)
            for_s = (now_ns - self._fading_ns) / 1e9
        left = max(0.0, 1.0 - for_s / self.fade_s)
        return self._v * left, self._w * left

    def _keep(self, leader: str | None, slot: tuple[float, float]) -> None:
        """Set the place to keep: ``slot`` (m) in the frame of ``leader``; None: no leader."""
        self.leader = leader
        self.place = FollowerPlace(self._handle + slot[0], slot[1], self._handle)
        self.follows = None if leader is None else Follows(leader=leader, slot=slot, handle_m=self._handle)

    def _tell(self, obs: Observation, radio: Radio) -> None:
        """Report pose, motion and the shape of the team."""
        if not (self._member.broadcast or self._tells_a):
            self._member.answer(radio)
            return
        v, w = measured_speeds(obs)
        more: dict[str, Any] = {}
        if self._tells_a:
            before_ns, before_v, before_w = self._before or (obs.time_ns, v, w)
            dt = max(1, obs.time_ns - before_ns) / 1e9
            more["a"], more["al"] = (v - before_v) / dt, (w - before_w) / dt
            self._before = obs.time_ns, v, w
        if (lead := self._feeding.lead) is not None:
            more["lead"] = [lead.t_ns, *lead.state]
        self._member.tell(obs, radio, v, w, **more)
