"""Base class of leaders: reports pose, speeds and intentions to the followers; subclasses define the motion.

A subclass defines its speeds only::

    class Waltz(Leader):
        def speeds(self, obs):
            return 0.3, 0.5 * math.sin(obs.time_s)
"""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.report import ReportReceiver
from vcmvsp.agents.formation.reports.sending import Reporter, Sending
from vcmvsp.agents.formation.team.passage import Guide, places_of, scanners
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.agents.formation.team.team import Team, check_silence
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import NonNegative, Positive, Velocity

Extra = Literal["a", "plan"]

PlanTicks = Annotated[int, msgspec.Meta(ge=1, le=100)]


class Leader(Agent):
    """Moves by `speeds`, reports itself at every tick, and leads a formation if it has one.

    Args:
        tell: additional content of reports, for any estimator: ``a`` (accelerations), ``plan``.
        plan_ticks: length of a plan in ticks; followers that receive reports less often extrapolate.
        estimator: estimator of the followers; its inputs are reported, and event-triggered sending runs it.
        horizon_s: of that estimator, s.
        fade_s: of that estimator, s.
        sending: when reports are sent; default: at every tick.
        formation: the team that this vehicle leads, and its changes of shape; default: none.
        avoidance: method of avoidance; default: none.
        clock_bound_s: largest lead of the clocks of members, s; reports from further in the future are rejected.
    """

    def __init__(
        self,
        *,
        tell: tuple[Extra, ...] = (),
        plan_ticks: PlanTicks = 20,
        estimator: str | Estimator = "dr",
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        sending: Sending | None = None,
        formation: Formation | None = None,
        avoidance: Avoidance | None = None,
        clock_bound_s: NonNegative = 0.0,
    ) -> None:
        self.estimator = estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s)
        needs = {*tell, *getattr(self.estimator, "needs", ())}
        self._tells_a, self._plan_ticks = "a" in needs, plan_ticks if "plan" in needs else 0
        self._reporter = Reporter(sending, self.estimator)
        check_silence(self._reporter.sending, formation)
        self._formation, self._clock_bound_s = formation, clock_bound_s
        self._team: Team | None = None
        self._guide: Guide | None = None
        self._steering = None if avoidance is None else AvoidanceSteering(avoidance)
        self.sensors = scanners(avoidance, formation) or self.sensors
        self._period_s = self.period
        self._last: tuple[float, float] | None = None  # the speeds of the tick before

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """Speeds from now on: forward, m/s, and yaw rate, rad/s."""
        raise NotImplementedError

    def aim(self, obs: Observation) -> tuple[float, float] | None:
        """Destination of a leader that may be led around obstacles, m, world; None: none."""
        return None

    def led_astray(self, obs: Observation) -> None:
        """Called at every tick at which avoidance replaces the command of `speeds`."""

    def ahead(self, count: int) -> Sequence[tuple[float, float]] | None:
        """Speeds of the next ``count`` ticks, without the present one; None: the leader makes no plans."""
        return None

    def start(self, info: VehicleInfo) -> None:
        """Take the period and the team."""
        self._period_s = info.period_s
        if self._steering is not None:
            self._steering.start(info)
        if self._formation is None:
            return
        team = self._team = Team(self._formation, info.vehicles, info.name)
        if team.parent is not None:
            raise ValueError(
                f"formation: {info.name} does not lead this team, {team.ancestors[-1]} does; put it first in members"
            )
        self._reporter.start(team.children)
        self._believed: set[str] = set()  # members that reported newer shapes than the own
        self._listening = ReportReceiver(team.members, self._clock_bound_s)
        if self._formation.passage is not None:
            self._guide = Guide(self._formation.passage, team, info)
        self.note(shape=team.shape)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Move, and report the motion from now on."""
        v, w = self.speeds(obs)
        if self._steering is not None:
            decision = self._steering.drive(obs, (v, w), self.aim(obs))
            v, w = decision.velocity[0], decision.yaw_rate
            if decision.mode != "task":
                self.led_astray(obs)
            self.note(**self._steering.notes)
        more: dict[str, Any] = {} if self._team is None else self._lead(self._team, obs)
        if self._tells_a:
            last_v, last_w = self._last or (v, w)
            more["a"], more["al"] = (v - last_v) / self._period_s, (w - last_w) / self._period_s
            self._last = v, w
        if self._plan_ticks and (plan := self.ahead(self._plan_ticks)):
            more["plan"], more["dt"] = [speed for pair in plan for speed in pair], self._period_s
        self._reporter.tell(radio, obs, v, w, **more)
        return Velocity(linear=(v, 0.0, 0.0), yaw_rate=w)

    def _lead(self, team: Team, obs: Observation) -> dict[str, Any]:
        """Change the shape when it is due; returns the keys of the report for the followers."""
        if team.formation.changes or self._guide is not None:
            self._listening.take(obs)
        for shape in team.due(obs.time_ns):
            if self._guide is None:
                self._change(team, shape, obs)
            else:
                team.wide = shape
        self._go_on(team, obs)
        if self._guide is not None:
            outline = self._guide.shape(obs, self._listening, self.estimator)
            if outline != team.shape:
                self._change(team, outline, obs)
            self.note(**self._guide.notes)
        return dict(team.fields)

    def _go_on(self, team: Team, obs: Observation) -> None:
        """Take over the shape that members report from a run with another host, once from each member.

        Their newest shape number would otherwise outrank the next changes. Outside passages the own shape stays.
        """
        shape, wide = team.shape, team.wide
        newer = [
            name for name, report in self._listening.newest.items() if name not in self._believed and team.take(report.body)
        ]
        if not newer:
            return
        self._believed.update(newer)
        team.wide = wide
        if self._guide is None:
            self._change(team, shape, obs)
        else:
            self._reporter.start(team.children)
            self.note(shape=team.shape)

    def _change(self, team: Team, shape: str, obs: Observation) -> None:
        team.change(shape, places_of(obs, self._listening.newest, self.estimator))
        self._reporter.start(team.children)
        self.note(shape=shape)


def towards(value: float, target: float, step: float) -> float:
    """The value on its way to the target, changed by ``step`` at most."""
    return value + max(-step, min(target - value, step))
