"""A follower's relations to others: its parent and place, its received and its own reports."""

from collections.abc import Callable
from typing import Any

from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.received import ReportReceiver
from vcmvsp.agents.formation.reports.report import Report
from vcmvsp.agents.formation.reports.sending import Reporter, Sending, acknowledge
from vcmvsp.agents.formation.team.formation import Formation
from vcmvsp.agents.formation.team.passage import Lookout
from vcmvsp.agents.formation.team.shape import Slot
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError

Keep = Callable[[str | None, Slot], None]


class Membership:
    """A follower's part in a team, or beside a single leader.

    Args:
        leader: single leader; None in a formation.
        formation: of the team.
        keep: called in a team before the first tick and at every change, with the parent and the place in its frame, m; None:
            no parent.
        estimator: of the present states of others.
        broadcast: whether it reports itself; None: where others need its reports.
        sending: when it reports.
        heartbeat_s: silence after which a parent is replaced by its own parent, s.
        clock_bound_s: largest lead of other clocks, s.

    Attributes:
        leader: present parent; None: none.
        team: None beside a single leader.
        lookout: for passages of the team.
        listening: received reports.
        broadcast: whether it reports itself.
        notes: changes of the last tick, for `cosim.agent.Agent.note`: ``shape``, ``parent``, ``refused``.

    Raises:
        ValueError, ScenarioError: arguments that do not fit together.
    """

    def __init__(
        self,
        leader: str | None,
        formation: Formation | None,
        *,
        keep: Keep,
        estimator: Estimator,
        broadcast: bool | None,
        sending: Sending | None,
        heartbeat_s: float | None,
        clock_bound_s: float,
    ) -> None:
        self.leader, self.formation, self.estimator = leader, formation, estimator
        self._keep, self._broadcast_always, self.broadcast = keep, broadcast, bool(broadcast)
        self._heartbeat_ns = None if heartbeat_s is None else seconds_to_ns(heartbeat_s)
        self._clock_bound_s = clock_bound_s
        self._reporter = Reporter(sending, estimator)
        self.listening = ReportReceiver(() if leader is None else (leader,), clock_bound_s)
        self.team: Team | None = None
        self.lookout: Lookout | None = None
        self.notes: dict[str, str | int] = {}
        self._reports: list[Report] = []  # of the last tick
        self._newest: Report | None = None  # of the parent
        check_silence(self._reporter.sending, formation, heartbeat_s)
        if formation is not None:
            if leader is not None:
                raise ValueError(
                    f"leader = {leader!r}, but the formation says whom this vehicle follows; leave one of them out"
                )
            if broadcast is False and formation.passage is not None and formation.passage.policy == "all-clear":
                raise ValueError("broadcast = false, but who passes a passage all-clear must say so; leave it out")
        elif leader is None:
            raise ScenarioError("is missing; it must be the name of a vehicle, unless there is a formation", key="leader")
        elif heartbeat_s is not None:
            raise ValueError("heartbeat_s needs a formation, which says whom to follow instead")

    def start(self, info: VehicleInfo, leads: str) -> None:
        """Find the place in the formation; reject an unknown leader or a formation that does not fit.

        Args:
            info: of the vehicle.
            leads: kinds of leading agents, for the message to the first member of a team.
        """
        if self.formation is None:
            others = [name for name in info.vehicles if name != info.name]
            if self.leader not in others:
                raise ValueError(
                    f"leader = {self.leader!r} is not another vehicle of this run ({', '.join(others) or 'there is none'})"
                )
            return
        team = self.team = Team(self.formation, info.vehicles, info.name)
        if team.parent is None:
            raise ValueError(
                f"{team.name} is the first member of the formation and leads it: give it an agent that leads "
                f"({leads}), or name another one first in formation.members"
            )
        self.listening = ReportReceiver((name for name in team.members if name != team.name), self._clock_bound_s)
        if self.formation.passage is not None:
            self.lookout = Lookout(self.formation.passage, team, info)
        self._settle(team, team.parent)
        self.notes = {"shape": team.shape, "parent": team.parent}

    def hear(self, obs: Observation) -> Report | None:
        """Once a tick: take over a newer shape and replace a dead parent; returns the newest report of the parent."""
        self._reports, self.notes = self.listening.take(obs), {}
        if self.team is not None:
            self._keep_up(self.team, obs.time_ns)
        if self.listening.refused:
            self.notes["refused"] = self.listening.refused
        self._newest = None if self.leader is None else self.listening.newest.get(self.leader)
        return self._newest

    def tell(self, obs: Observation, radio: Radio, v: float, w: float, **more: Any) -> None:
        """Once a tick: report the own speeds, m/s and rad/s, where others need them; acknowledge the parent's report."""
        if self.broadcast:
            if self.team is not None:
                more.update(self.team.fields())
            if self.lookout is not None:
                more["cl"] = int(self.lookout.is_clear(obs, self.listening, self.estimator))
            self._reporter.tell(radio, obs, v, w, **more)
        self.answer(radio)

    def answer(self, radio: Radio) -> None:
        """Once a tick without `tell`: acknowledge the parent's report if it asks for that."""
        newest = self._newest
        if newest is not None and self.leader is not None and "ak" in newest.body and newest in self._reports:
            acknowledge(radio, newest, self.leader)

    def _keep_up(self, team: Team, now_ns: int) -> None:
        before, heartbeat_ns = team.changed, self._heartbeat_ns
        if self.lookout is not None:
            for shape in team.due(now_ns):
                team.wide = shape
        for report in self._reports:
            team.take(report.body)
        parent = team.parent
        if heartbeat_ns is not None:
            parent = team.whom(lambda name: self.listening.silent_ns(name, now_ns) < heartbeat_ns)
        if team.changed != before:
            self.notes["shape"] = team.shape
        if parent != self.leader:
            self.notes["parent"] = parent or ""
        if team.changed != before or parent != self.leader:
            self._settle(team, parent)

    def _settle(self, team: Team, parent: str | None) -> None:
        self.leader = parent
        self._keep(parent, (0.0, 0.0) if parent is None else team.beside(parent))
        if self._broadcast_always is None:
            changes = team.changed > 0 or bool(team.formation.changes)  # assignment of places needs the positions of all
            varies = changes or team.formation.passage is not None
            self.broadcast = bool(team.children) or self._heartbeat_ns is not None or varies
        self._reporter.start(team.children)


def check_silence(sending: Sending, formation: Formation | None, heartbeat_s: float | None = None) -> None:
    """Reject a longest silence of a sender that exceeds the time after which it counts as gone.

    Raises:
        ValueError: it does.
    """
    if sending.when == "always":
        return
    if heartbeat_s is not None and heartbeat_s <= sending.silence_s:
        raise ValueError(
            f"heartbeat_s = {heartbeat_s} s would take those for dead who have nothing to tell: it must be longer than the "
            f"silence that sending allows, silence_s = {sending.silence_s} s"
        )
    passage = None if formation is None else formation.passage
    if passage is not None and sending.silence_s >= passage.report_s:
        raise ValueError(
            f"sending.silence_s = {sending.silence_s} s lets reports become older than formation.passage.report_s = "
            f"{passage.report_s} s, after which they count for nothing: make silence_s shorter, or report_s longer"
        )
