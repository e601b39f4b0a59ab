"""Estimators of a leader's present state from its newest report; all implement `Estimator.predict`.

A report is always old: by the air time and the period at least, and by losses and delays. The attribute ``needs`` of an
estimator lists content of reports besides pose and speeds, ``"a"`` (accelerations) and ``"plan"``; leaders then send it.
"""

import math
from collections.abc import Mapping
from typing import Any, Protocol

from vcmvsp.agents.formation.reports.report import LeaderState, Report, accelerations, plan_of
from vcmvsp.cosim.config.binding import call, parameters, unknown
from vcmvsp.cosim.config.registry import find
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Positive


class Estimator(Protocol):
    """Predicts the leader's present state from its newest report and the report's age.

    A pure function: a vehicle uses one estimator for received and for sent reports.
    """

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """State of the leader ``age_s`` seconds (>= 0) after ``report`` was valid."""


class Hold:
    """The report as it is (Toh 2012): wrong by the leader's speed times the age."""

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported state, at any age."""
        return report.state


class DeadReckoning:
    """Constant speeds: exact on straight lines and circles, for any age up to ``horizon_s``.

    Beyond the horizon both speeds fade linearly to zero within ``fade_s``, and the leader stays on its arc.
    """

    def __init__(self, horizon_s: float = 2.0, fade_s: float = 1.0) -> None:
        self.horizon_s, self.fade_s = horizon_s, fade_s

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported pose moved along the arc of the reported speeds."""
        return moved(report.state, age_s, self.horizon_s, self.fade_s)


class Acceleration(DeadReckoning):
    """The leader continues its last acceleration, which fades with ``decay_s``.

    After s seconds it has changed by ``tau (1 - e^(-s/tau))`` times the acceleration, tau being ``decay_s``. The pose moves
    along the arc of the mean of the reported and the predicted speeds. Better than `DeadReckoning` for smooth motion, worse for
    old reports of other motion. Beyond the horizon, speeds fade as there.

    Args:
        horizon_s: as of `DeadReckoning`.
        fade_s: as of `DeadReckoning`.
        decay_s: how fast an acceleration is forgotten, s.
        slowest: an acceleration takes the speed no lower than this, m/s; nor, where that is lower, than what was reported.
        fastest: nor higher than this, m/s.
        fastest_turn: nor the yaw rate beyond this, rad/s, to either side.
    """

    needs = ("a",)

    def __init__(
        self,
        horizon_s: float = 2.0,
        fade_s: float = 1.0,
        *,
        decay_s: Positive = 1.0,
        slowest: float = -0.1,
        fastest: float = 0.6,
        fastest_turn: Positive = 0.8,
    ) -> None:
        super().__init__(horizon_s, fade_s)
        self.decay_s, self.slowest, self.fastest, self.fastest_turn = decay_s, slowest, fastest, fastest_turn

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported pose moved along the arc of the mean speeds."""
        a, al = accelerations(report)
        if a == 0.0 == al:
            return super().predict(report, age_s)
        x, y, th, v, w = report.state
        trusted_s = min(age_s, self.horizon_s)
        gain_s = -self.decay_s * math.expm1(-trusted_s / self.decay_s)
        v_then = max(min(v, self.slowest), min(v + gain_s * a, max(v, self.fastest)))
        w_then = max(min(w, -self.fastest_turn), min(w + gain_s * al, max(w, self.fastest_turn)))
        x, y, th = arc((x, y, th), 0.5 * (v + v_then), 0.5 * (w + w_then), trusted_s)
        return moved(LeaderState(x, y, th, v_then, w_then), age_s - trusted_s, 0.0, self.fade_s)


class PlanPrediction(Acceleration):
    """The reported plan: exact while the plan lasts and the leader follows it.

    After the plan its last speeds count as constant, with a horizon that begins there. A report without a valid plan is
    predicted as by `Acceleration`.
    """

    needs = ("plan",)

    _report: Report | None = None  # of the last prediction
    _plan: tuple[float, list[tuple[float, float]]] | None  # of that report
    _poses: list[tuple[float, float, float]]  # at the start of each of its speeds, computed on demand

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported pose moved along the arcs of the plan."""
        if report is not self._report:
            self._report, self._plan, self._poses = report, plan_of(report), [report.state[:3]]
        if self._plan is None:
            return super().predict(report, age_s)
        dt, speeds = self._plan
        step = min(int(age_s / dt + 1e-6), len(speeds) - 1)  # index of the present speeds
        while len(self._poses) <= step:
            self._poses.append(arc(self._poses[-1], *speeds[len(self._poses) - 1], dt))
        (x, y, th), (v, w), rest_s = self._poses[step], speeds[step], age_s - step * dt
        return moved(LeaderState(x, y, th, v, w), rest_s, dt + self.horizon_s, self.fade_s)


ESTIMATORS: Mapping[str, type[Estimator]] = {"hold": Hold, "dr": DeadReckoning, "acc": Acceleration, "plan": PlanPrediction}


def estimator_of(kind: Any, *, horizon_s: float, fade_s: float) -> Estimator:
    """Build the estimator that a scenario or a caller names.

    Args:
        kind: one of `ESTIMATORS`, ``"module:Class"``, ``"file.py:Class"``, a table with such a ``kind`` and other parameters
            of its class, or an object with `predict`.
        horizon_s: given to a class that takes it, unless the table does so.
        fade_s: the same.

    Raises:
        ValueError: an unknown name, or something without `predict`.
    """
    if not isinstance(kind, str | Mapping):
        if not hasattr(kind, "predict"):
            names = ", ".join(ESTIMATORS)
            raise ValueError(f"estimator {kind!r} has no method predict(report, age_s); use {names} or an object with it")
        return kind
    content = {"kind": kind} if isinstance(kind, str) else dict(kind)
    name = content.pop("kind", None)
    if not isinstance(name, str):
        raise ScenarioError(f"must be a string, one of {', '.join(ESTIMATORS)}", key="estimator.kind")
    if name not in ESTIMATORS and ":" not in name:
        also = "; or give module:Class or file.py:Class with a method predict(report, age_s)"
        raise ValueError(unknown("estimator", name, ESTIMATORS) + also)
    estimator_class: type[Estimator] = ESTIMATORS[name] if name in ESTIMATORS else find("estimator", name, key="estimator")
    offered = {"horizon_s": horizon_s, "fade_s": fade_s}
    common = {name: value for name, value in offered.items() if name in parameters(estimator_class)}
    return call(estimator_class, common | content, key="estimator")


def moved(state: LeaderState, age_s: float, horizon_s: float, fade_s: float) -> LeaderState:
    """Motion in ``age_s`` at constant speeds that fade to zero within ``fade_s`` after ``horizon_s``.

    The speeds are ``(v, w) (1 - s/F)`` at s seconds after the horizon. Since they fade in proportion, the vehicle stays on its
    arc, and the distance has a closed form: that of ``s - s^2 / (2 F)`` seconds at full speed.
    """
    x, y, th, v, w = state
    share = 1.0
    if age_s > horizon_s:
        faded_s = min(age_s - horizon_s, fade_s)
        share = 1.0 - faded_s / fade_s
        age_s = horizon_s + 0.5 * faded_s * (1.0 + share)  # = s - s^2 / (2 F), the mean speed times s
    x, y, th = arc((x, y, th), v, w, age_s)
    return LeaderState(x, y, th, v * share, w * share)
