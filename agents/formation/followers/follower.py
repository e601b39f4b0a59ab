"""Common part of followers on the ground and in the air: parent and place, received and own reports."""

import math
from typing import Any, ClassVar

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.report import Report, ReportReceiver
from vcmvsp.agents.formation.reports.sending import Reporter, Sending, acknowledge
from vcmvsp.agents.formation.team.passage import Lookout, scanners
from vcmvsp.agents.formation.team.shape import Formation, Slot
from vcmvsp.agents.formation.team.team import Team, check_silence
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Follows, NonNegative, Positive


class FormationFollower(Agent):
    """A vehicle with a place beside a single leader, or in a team; subclasses define how it keeps that place.

    Notes at every tick ``status`` (``waiting``, ``following``, ``leader lost``; ``leading`` in a team without a living
    ancestor), ``age_s`` of the report in use and, from the first one on, the number of unusable messages, ``refused``. In a
    team also, when they change, ``parent`` (empty for a leading member) and ``shape``.

    Args:
        leader: name of the leader, which must report itself (one that leads, or a follower with ``broadcast``). Not with a
            formation.
        formation: shape and topology of the team.
        estimator: ``hold``, ``dr``, ``acc``, ``plan``, ``module:Class``, ``file.py:Class`` or an object with
            ``predict(report, age_s)``.
        max_speed: limit of the commanded speed, m/s; default: none but the vehicle's own.
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

    LEADS: ClassVar[str]  # kinds of agents that lead, for the message to the first member of a team

    def __init__(
        self,
        leader: str | None = None,
        *,
        formation: Formation | None = None,
        estimator: str | Estimator = "dr",
        max_speed: Positive | None = None,
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        timeout_s: Positive = 3.0,
        heartbeat_s: Positive | None = None,
        clock_bound_s: NonNegative = 0.0,
        broadcast: bool | None = None,
        sending: Sending | None = None,
        avoidance: Avoidance | None = None,
    ) -> None:
        self.leader, self.formation = leader, formation
        self.estimator = self._wrapped(estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s))
        self.max_speed = math.inf if max_speed is None else max_speed
        self.horizon_s, self.fade_s, self.timeout_s, self._clock_bound_s = horizon_s, fade_s, timeout_s, clock_bound_s
        self._steering = None if avoidance is None else AvoidanceSteering(avoidance)
        self.sensors = scanners(avoidance, formation) or self.sensors
        self._broadcast_always, self._broadcast = broadcast, bool(broadcast)
        self._heartbeat_ns = None if heartbeat_s is None else seconds_to_ns(heartbeat_s)
        self._reporter = Reporter(sending, self.estimator)
        self._listening = ReportReceiver(() if leader is None else (leader,), clock_bound_s)
        self._team: Team | None = None
        self._lookout: Lookout | None = None  # for passages of the team
        self._reports: list[Report] = []  # of the last tick
        self._newest: Report | None = None  # of the parent
        self._fading_ns: int | None = None  # since when the last command that answered a report fades
        check_silence(self._reporter.sending, formation, heartbeat_s)
        if formation is not None:
            if leader is not None:
                raise ValueError(
                    f"leader = {leader!r} and formation both define the leader of this vehicle; leave one of them out"
                )
            if broadcast is False and formation.passage is not None and formation.passage.policy == "all-clear":
                raise ValueError("broadcast = false, but passage.policy = 'all-clear' needs reports; leave broadcast out")
        elif leader is None:
            raise ScenarioError("is missing; set the name of a vehicle, or a formation", key="leader")
        elif heartbeat_s is not None:
            raise ValueError("heartbeat_s needs a formation, which defines the succession")

    def _wrapped(self, estimator: Estimator) -> Estimator:
        return estimator

    def _keep(self, leader: str | None, slot: Slot, handle_m: float = 0.0) -> None:
        """Set the place to keep: ``slot`` (m) in the frame of ``leader``; None: no leader."""
        self.leader = leader
        self.follows = None if leader is None else Follows(leader=leader, slot=slot, handle_m=handle_m)

    def start(self, info: VehicleInfo) -> None:
        """Refuse a leader that is not in the run, and an unsuitable formation; find the place in the team."""
        if self.formation is not None:
            self._join(self.formation, info)
        elif self.leader not in (others := [name for name in info.vehicles if name != info.name]):
            among = ", ".join(others) or "none"
            raise ValueError(f"leader = {self.leader!r} is not another vehicle of this run; other vehicles: {among}")
        if self._steering is not None:
            self._steering.start(info)

    def _join(self, formation: Formation, info: VehicleInfo) -> None:
        team = self._team = Team(formation, info.vehicles, info.name)
        if team.parent is None:
            raise ValueError(
                f"{team.name} is the first member of the formation and leads it: give it a leader agent "
                f"({self.LEADS}), or put another vehicle first in formation.members"
            )
        self._listening = ReportReceiver((name for name in team.members if name != team.name), self._clock_bound_s)
        if formation.passage is not None:
            self._lookout = Lookout(formation.passage, team, info)
        self._settle(team, team.parent)
        self.note(shape=team.shape, parent=team.parent)

    def _hear(self, obs: Observation) -> Report | None:
        """Once a tick: take over a newer shape and replace a dead parent; returns the newest report of the parent."""
        self._reports = self._listening.take(obs)
        if self._team is not None:
            self._keep_up(self._team, obs.time_ns)
        if self._listening.refused:
            self.note(refused=self._listening.refused)
        self._newest = None if self.leader is None else self._listening.newest.get(self.leader)
        return self._newest

    def _age_s(self, now_ns: int, newest: Report | None) -> float:
        """Age of the report in use; inf: there is none. Noted with the status."""
        if newest is None:
            self.note(status="waiting" if self.leader else "leading")
            return math.inf
        age_s = max(0, now_ns - newest.t_ns) / 1e9
        self.note(status="leader lost" if age_s >= self.timeout_s else "following", age_s=age_s)
        return age_s

    def _tell(self, obs: Observation, radio: Radio, v: float, w: float, **more: Any) -> None:
        """Once a tick: report the own speeds, m/s and rad/s, where others need them; acknowledge the parent's report."""
        if self._broadcast:
            if self._team is not None:
                more.update(self._team.fields)
            if self._lookout is not None:
                more["cl"] = int(self._lookout.is_free(obs, self._listening, self.estimator, self._lookout.passage.clear_m))
            self._reporter.tell(radio, obs, v, w, **more)
        newest = self._newest
        if newest is not None and self.leader is not None and "ak" in newest.body and newest in self._reports:
            acknowledge(radio, newest, self.leader)

    def _keep_up(self, team: Team, now_ns: int) -> None:
        before, heartbeat_ns = team.changed, self._heartbeat_ns
        if self._lookout is not None:
            for shape in team.due(now_ns):
                team.wide = shape
        for report in self._reports:
            team.take(report.body)
        parent = team.parent
        if heartbeat_ns is not None:
            parent = team.whom(lambda name: self._listening.silent_ns(name, now_ns) < heartbeat_ns)
        if team.changed != before:
            self.note(shape=team.shape)
        if parent != self.leader:
            self.note(parent=parent or "")
        if team.changed != before or parent != self.leader:
            self._settle(team, parent)

    def _settle(self, team: Team, parent: str | None) -> None:
        self._keep(parent, (0.0, 0.0) if parent is None else team.beside(parent))
        if self._broadcast_always is None:
            changes = team.changed > 0 or bool(team.formation.changes)  # assignment of places needs the positions of all
            varies = changes or team.formation.passage is not None
            self._broadcast = bool(team.children) or self._heartbeat_ns is not None or varies
        self._reporter.start(team.children)
