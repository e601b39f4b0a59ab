"""Where the leader is now, given where it was: estimators behind one verb, `Estimator.predict`.

A report is always old: by the air time and the period at least, by every loss and delay on top.
"""

from typing import Any, Protocol

from agents.formation.report import LeaderState, Report
from cosim.frames import arc
from cosim.registry import find, is_file_kind
from cosim.table import unknown


class Estimator(Protocol):
    """From the newest report and its age to the leader's present state."""

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """State of the leader ``age_s`` seconds (>= 0) after ``report`` was valid."""


class Hold:
    """The report as it is (Toh 2012): wrong by the leader's speed times the age."""

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported state, whatever its age."""
        return report.state


class DeadReckoning:
    """The leader has kept its speeds: exact on straight lines and circles, for any age up to ``horizon_s``.

    Beyond the horizon both speeds fade linearly to zero within ``fade_s``: ``(v, w) (1 - s/F)`` at s seconds after it. Since
    they fade in proportion, the leader stays on its arc, and the way it goes has a closed form: that of ``s - s^2 / (2 F)``
    seconds at full speed.
    """

    def __init__(self, horizon_s: float = 2.0, fade_s: float = 1.0) -> None:
        self.horizon_s, self.fade_s = horizon_s, fade_s

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """The reported pose moved along the arc of the reported speeds."""
        x, y, th, v, w = report.state
        left = 1.0
        if age_s > self.horizon_s:
            faded_s = min(age_s - self.horizon_s, self.fade_s)
            left = 1.0 - faded_s / self.fade_s
            age_s = self.horizon_s + 0.5 * faded_s * (1.0 + left)  # = s - s^2 / (2 F), the mean speed times s
        x, y, th = arc((x, y, th), v, w, age_s)
        return LeaderState(x, y, th, v * left, w * left)


ESTIMATORS = ("hold", "dr")


def estimator_of(kind: Any, *, horizon_s: float, fade_s: float) -> Estimator:
    """The estimator that a scenario or a caller names: ``"hold"``, ``"dr"``, ``"module:Class"``, or an object with `predict`.

    Raises:
        ValueError: an unknown name, or something without `predict`.
    """
    if kind == "hold":
        return Hold()
    if kind == "dr":
        return DeadReckoning(horizon_s, fade_s)
    if isinstance(kind, str) and ":" not in kind:
        raise ValueError(unknown("estimator", kind, ESTIMATORS) + "; or give module:Class with a method predict(report, age_s)")
    if isinstance(kind, str) and is_file_kind(kind):
        raise ValueError(f"estimator {kind!r}: a file cannot be named here; install it as a module, and give module:Class")
    estimator: Estimator = find("estimator", kind, key="estimator")() if isinstance(kind, str) else kind
    if not hasattr(estimator, "predict"):
        raise ValueError(
            f"estimator {kind!r} has no method predict(report, age_s); allowed are {', '.join(ESTIMATORS)} or such an object"
        )
    return estimator
