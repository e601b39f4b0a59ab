"""What all leaders have in common: they move as they like, and tell those who follow where they are and what they are about.

A leader of your own says how it moves, and need not care about the rest::

    class Waltz(Leader):
        def speeds(self, obs):
            return 0.3, 0.5 * math.sin(obs.time_s)
"""

from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

from agents.formation.formation import Formation
from agents.formation.listening import Listening
from agents.formation.prediction import Estimator, estimator_of
from agents.formation.sending import Reporter, Sending
from agents.formation.team import Team
from cosim.agent import Agent, Observation, Radio, VehicleInfo
from cosim.clock import seconds_to_ns
from cosim.frames import rotate2
from cosim.types import NonNegative, Positive, Velocity

Extra = Literal["a", "plan"]

PLAN = 20  # speeds that a plan tells besides those of now


class Leader(Agent):
    """Moves by `speeds`, reports itself at every tick, and leads a formation where it has one.

    Args:
        tell: what reports hold besides pose and speeds, whatever the estimator: ``a`` (accelerations), ``plan``.
        estimator: of those who follow; what it needs is told, and sending when needed reckons with it.
        horizon_s: of that estimator, s.
        fade_s: of that estimator, s.
        sending: when reports are sent; default: at every tick.
        formation: the team that this vehicle leads, and when it changes its shape; default: none.
    """

    def __init__(
        self,
        *,
        tell: tuple[Extra, ...] = (),
        estimator: str | Estimator = "dr",
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        sending: Sending | None = None,
        formation: Formation | None = None,
    ) -> None:
        self.estimator = estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s)
        wanted = {*tell, *getattr(self.estimator, "needs", ())}
        self._tells_a, self._tells_plan = "a" in wanted, "plan" in wanted
        self._reporter = Reporter(sending, self.estimator)
        self._formation = formation
        self._team: Team | None = None
        self._period_s = self.period
        self._last: tuple[float, float] | None = None  # the speeds of the tick before

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """How fast to move from now on: forward, m/s, and turning, rad/s."""
        raise NotImplementedError

    def ahead(self, count: int) -> Sequence[tuple[float, float]] | None:
        """The speeds of the ``count`` ticks to come, those of now not among them; None where it makes no plans."""
        return None

    def start(self, info: VehicleInfo) -> None:
        """Note the period, and who is led."""
        self._period_s = info.period_s
        if self._formation is None:
            return
        team = self._team = Team(self._formation, info.vehicles, info.name)
        if team.parent is not None:
            raise ValueError(
                f"formation: {info.name} does not lead this team, {team.ancestors[-1]} does; name it first in members"
            )
        self._reporter.start(team.children)
        self._changes = deque((seconds_to_ns(at_s), shape) for at_s, shape in self._formation.changes)
        self._listening = Listening(team.members, 0.0)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Move, and tell all how this vehicle moves from now on."""
        v, w = self.speeds(obs)
        more: dict[str, Any] = {} if self._team is None else self._lead(self._team, obs)
        if self._tells_a:
            last_v, last_w = self._last or (v, w)
            more["a"], more["al"] = (v - last_v) / self._period_s, (w - last_w) / self._period_s
            self._last = v, w
        if self._tells_plan and (plan := self.ahead(PLAN)):
            more["plan"], more["dt"] = [speed for pair in plan for speed in pair], self._period_s
        self._reporter.tell(radio, obs, v, w, **more)
        return Velocity(linear=(v, 0.0, 0.0), yaw_rate=w)

    def _lead(self, team: Team, obs: Observation) -> dict[str, Any]:
        """Change the shape when it is time to; what followers must be told of it."""
        if self._changes:
            self._listening.take(obs)
            while self._changes and obs.time_ns >= self._changes[0][0]:
                _, shape = self._changes.popleft()
                team.change(shape, self._places(obs))
                self._reporter.start(team.children)
                self.note(shape=shape)
        return dict(team.fields())

    def _places(self, obs: Observation) -> dict[str, tuple[float, float]]:
        """Where the members are whose reports came in, as estimated: m in this vehicle's frame, x forward, y left."""
        (x, y, _), yaw, places = obs.state.position, obs.state.yaw, {}
        for name, report in self._listening.newest.items():
            then = self.estimator.predict(report, max(0, obs.time_ns - report.t_ns) / 1e9)
            places[name] = rotate2(then.x - x, then.y - y, -yaw)
        return places


def towards(value: float, target: float, step: float) -> float:
    """The value on its way to the target, changed by ``step`` at most."""
    return value + max(-step, min(target - value, step))
