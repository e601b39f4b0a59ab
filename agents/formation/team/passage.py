"""When a team makes itself narrow, as ``[agents.formation.passage]`` says, and what its members see of the lane that it needs.

The team needs a lane as wide as its wide shape, bodies included, and a margin on either side. Its leader calls the narrow shape
as soon as its own scan shows anything in that lane; when to change back, a policy says
(`agents.formation.team.passage_policy`).

Where the leader itself is lost, the team stays as it is: a member that leads in its place drives nowhere, and calls no shapes.

A lane is free up to a greater distance than that at which the narrow shape is called, so that noise does not switch to and fro.
What the scans show of members themselves does not count (`agents.formation.team.visible_members`).
"""

from collections.abc import Mapping

import numpy as np

from vcmvsp.agents.avoidance.settings import Settings
from vcmvsp.agents.avoidance.view import ScanReader
from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.received import ReportReceiver
from vcmvsp.agents.formation.reports.report import Report
from vcmvsp.agents.formation.team.formation import Formation, Passage
from vcmvsp.agents.formation.team.passage_policy import policy_of
from vcmvsp.agents.formation.team.shape import Slot
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.agents.formation.team.visible_members import VisibleMembers, moved_to
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.frames import rotate2

NAMED = 3  # most names in the note ``waits_for``


class Lookout(VisibleMembers):
    """The part of the team's lane that one vehicle sees.

    Raises:
        ValueError: the scanner is missing, or the size of the vehicle is unknown.
    """

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._looking = ScanReader(passage.scanner, passage.stale_s)
        self._looking.start(info, "formation.passage.scanner")
        if info.body is None:
            raise ValueError(f"formation.passage: nobody says how large {info.name} is, so its team's lane is not known")
        super().__init__(info.body, passage)
        self.passage, self.team = passage, team

    def is_clear(self, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> bool:
        """Whether a member is to say so."""
        return self.is_free(obs, listening, estimator, self.passage.clear_m)

    def is_free(self, obs: Observation, listening: ReportReceiver, estimator: Estimator, ahead_m: float) -> bool:
        """Whether nothing but members stands in the lane up to ``ahead_m``; a bad scan, or none, means that something may."""
        view = self._looking.look(obs)
        if view is None:
            return False
        across = [y for _, y in self.team.places(self.team.wide)]
        aside = 0.5 * self._body.width_m + self.passage.margin_m
        finite = np.isfinite(view.ranges)
        finite[self._of_members(view, obs, listening, estimator)] = False
        x, y = view.ranges[finite] * view.units[finite].T
        within = (y > min(across) - aside) & (y < max(across) + aside) & (x > -self.passage.behind_m) & (x < ahead_m)
        return not within.any()


class Guide:
    """Decides, for the leader, on the shape of the team at passages.

    Attributes:
        notes: changes of the last tick, for `cosim.agent.Agent.note`: ``lane``, ``narrow`` or ``free``, and ``waits_for``,
            up to
            three members for which a narrow team waits although the leader's lane is free.
    """

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._lookout, self._policy = Lookout(passage, team, info), policy_of(passage)
        self._names = tuple(name for name in team.members if name != team.name)
        self._told = {"lane": "", "waits_for": ""}
        self.notes: dict[str, str] = {}

    def shape(self, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> str:
        """The present shape or a new one; called once a tick."""
        passage, team = self._lookout.passage, self._lookout.team
        is_narrow = team.shape == passage.shape
        free = self._lookout.is_free(obs, listening, estimator, passage.free_m if is_narrow else passage.narrow_m)
        wide = self._policy.widens(obs.time_ns, free, self._names, listening) if is_narrow else free
        waits_for = self._policy.waits_for if is_narrow and free else ()
        now = {"lane": "free" if free else "narrow", "waits_for": ", ".join(waits_for[:NAMED])}
        self.notes = {name: value for name, value in now.items() if value != self._told[name]}
        self._told = now
        return team.wide if wide else passage.shape


def places_of(obs: Observation, reports: Mapping[str, Report], estimator: Estimator) -> dict[str, Slot]:
    """Estimated positions of the senders of reports: m in this vehicle's frame, x forward, y left."""
    (x, y, _), yaw, places = obs.state.position, obs.state.yaw, {}
    for name, report in reports.items():
        then = moved_to(obs, report, estimator)
        places[name] = rotate2(then.x - x, then.y - y, -yaw)
    return places


def scanners(avoidance: Settings | None, formation: Formation | None) -> tuple[str, ...]:
    """The names of the scanners that these look at."""
    passage = None if formation is None else formation.passage
    return tuple(dict.fromkeys(each.scanner for each in (avoidance, passage) if each is not None))
