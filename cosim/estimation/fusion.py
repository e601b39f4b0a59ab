"""Fusion of a robot's odometry with positions that arrive late, contain outliers and have no heading.

`Fusion` is an extended Kalman filter (`kalman_filter`) over a short log. Input is inserted into the log at its time, and the
filter runs again from there (rewind and replay): a late position counts as if it were in time, and the estimate does not
depend on the order of arrival. A position between two odometry reports divides the motion between them in proportion. Input
older than the log is rejected.

- **Heading.** Without a start the heading is unknown (variance pi^2/3) until the robot has moved far enough
  (`kalman_filter.aligned`); until then the estimate is the last position.
- **Gate.** A position with an improbable innovation (chi-square, 2 degrees of freedom) is rejected. If ``restart_after``
  consecutive rejected positions agree with each other and with odometry, the estimate restarts from them, heading unknown.
- **Silence of odometry.** The last speeds hold for ``coast_s``, then the robot is assumed to stand; the uncertainty grows.
  Later odometry replaces this assumption.

Errors of positions are assumed to be independent: for a receiver with a slowly wandering error sigma must cover it, and the
covariance is then too small for averages over less than its correlation time. Times are arguments, in ns of one clock. They
must not lie in the future: the log would move past input that is still to come.
"""

import bisect
import math
from typing import Literal

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.estimation import kalman_filter
from vcmvsp.cosim.estimation.kalman_filter import (
    MeasuredPosition,
    OdometryMotion,
    OdometryNoise,
    corrected,
    grown,
    innovation,
    moved,
)
from vcmvsp.cosim.types import Array, Count, NonNegative, Positive, Probability, Vec3, frozen

Outcome = Literal["accepted", "gated", "collected", "restarted", "late"]


class Verdict(msgspec.Struct, frozen=True):
    """Result for a position: ``collected`` while the heading is unknown; ``late`` if it is older than the log."""

    outcome: Outcome
    nis: float | None = None  # squared Mahalanobis length of the innovation; None without an estimate


class FusedPose(msgspec.Struct, frozen=True, kw_only=True):
    """Estimate at an instant."""

    time_ns: int
    x: float  # m
    y: float  # m
    heading: float  # rad, in (-pi, pi]; meaningless unless known
    covariance: Array  # (3, 3) of x, y, heading: m^2, m rad, rad^2
    heading_known: bool
    v: float  # m/s, from the newest odometry
    w: float  # rad/s, from the newest odometry
    age_s: float  # since the last accepted position was measured; inf: none yet
    scale: float  # see `kalman_filter`
    veer: float  # rad/m
    bias: float  # rad/s
    accepted: int  # accepted positions
    gated: int  # rejected positions
    restarts: int  # restarts from rejected positions


class _FilterState(msgspec.Struct, frozen=True):
    """State of the filter at an instant."""

    mean: Array | None  # (6,); None while the heading is unknown
    covariance: Array
    items: kalman_filter.Items = ()  # since the first collected or gated position
    position_ns: int | None = None
    accepted: int = 0
    gated: int = 0
    restarts: int = 0


class _OdometryInterval(msgspec.Struct, frozen=True):
    """Odometry from ``start_ns`` to the time of its node."""

    start_ns: int
    distance_m: float
    turn_rad: float


class _LogEntry(msgspec.Struct, eq=False):
    """An input of the log, and the filter state after it."""

    time_ns: int
    belief: _FilterState
    what: _OdometryInterval | MeasuredPosition | None = None

    def key(self) -> tuple[float, ...]:
        """Order in the log; independent of the order of arrival, also at equal times."""
        what = self.what
        place = (1, what.x, what.y) if isinstance(what, MeasuredPosition) else (0, 0.0, 0.0)
        return self.time_ns, *place


class Fusion:
    """Fuses odometry with positions.

    Args:
        noise: uncertainty of odometry.
        start: x (m), y (m) and heading (rad) at the start; None: unknown.
        start_sigma_m: standard deviation of the start's x and y.
        start_sigma_rad: standard deviation of its heading.
        scale_sigma: standard deviation of the unknown scale error of distances; 0: no scale error.
        veer_sigma: rad/m, standard deviation of the unknown turn per metre; 0: none.
        bias_sigma: rad/s, standard deviation of the unknown turn per second (bias of a gyro); 0: none.
        gate: probability that a good position passes the gate.
        restart_after: consecutive rejected positions that agree and restart the estimate.
        heading_sigma_rad: required accuracy of the heading before the filter starts.
        coast_s: time for which the last speeds hold without odometry.
        history_s: length of the log: maximum lateness of input.
    """

    def __init__(
        self,
        *,
        noise: OdometryNoise | None = None,
        start: Vec3 | None = None,
        start_sigma_m: Positive = 0.05,
        start_sigma_rad: Positive = 0.05,
        scale_sigma: NonNegative = 0.0,
        veer_sigma: NonNegative = 0.0,
        bias_sigma: NonNegative = 0.0,
        gate: Probability = 0.999,
        restart_after: Count = 5,
        heading_sigma_rad: Positive = 0.2,
        coast_s: NonNegative = 0.5,
        history_s: Positive = 2.0,
    ) -> None:
        self._noise = noise or OdometryNoise()
        self._prior = np.diag([0.0, 0.0, 0.0, scale_sigma**2, veer_sigma**2, bias_sigma**2])
        self._gate, self._restart_after, self._heading_sigma = gate, max(restart_after, 2), heading_sigma_rad
        self._coast_ns, self._history_ns = seconds_to_ns(coast_s), seconds_to_ns(history_s)
        self._bound = kalman_filter.chi2_quantile(gate, 2)
        covariance = self._prior + np.diag([start_sigma_m**2, start_sigma_m**2, start_sigma_rad**2, 0.0, 0.0, 0.0])
        mean = None if start is None else np.array([*start, 0.0, 0.0, 0.0])
        self._begin = _FilterState(mean, covariance)
        self._nodes: list[_LogEntry] = []
        self._odometry_ns: int | None = None  # end of the newest odometry
        self._waiting = (0.0, 0.0)  # motion without a later time
        self._speed = (0.0, 0.0)  # m/s and rad/s
        self.late = 0  # positions older than the log

    def odometry(self, time_ns: int, distance_m: float, turn_rad: float) -> None:
        """Distance and turn of the robot since the last call; the first call only sets the time.

        For two wheels with paths l and r on an axle of length b, distance is (l + r) / 2 and turn (r - l) / b.
        """
        _check(distance_m, turn_rad)
        if self._odometry_ns is None:
            self._odometry_ns = time_ns
            self._insert(_LogEntry(time_ns, self._begin))
            return
        distance_m, turn_rad = distance_m + self._waiting[0], turn_rad + self._waiting[1]
        if time_ns <= self._odometry_ns:
            self._waiting = (distance_m, turn_rad)
            return
        odometry, self._waiting = _OdometryInterval(self._odometry_ns, distance_m, turn_rad), (0.0, 0.0)
        seconds = (time_ns - self._odometry_ns) / SECOND_NS
        self._speed, self._odometry_ns = (distance_m / seconds, turn_rad / seconds), time_ns
        self._insert(_LogEntry(time_ns, self._begin, odometry))

    def fix(self, time_ns: int, x: float, y: float, sigma_m: float) -> Verdict:
        """Position of the robot at that time, with standard deviation sigma_m of x and of y."""
        _check(x, y, sigma_m)
        if sigma_m <= 0.0:
            raise ValueError(f"sigma_m of a position must be positive, not {sigma_m}")
        return self._insert(_LogEntry(time_ns, self._begin, MeasuredPosition(x, y, sigma_m)))

    def estimate(self, now_ns: int) -> FusedPose | None:
        """Pose at an instant within or after the log; None: unknown, or before the log."""
        index = bisect.bisect_right(self._nodes, now_ns, key=lambda node: node.time_ns) - 1
        if index < 0:
            return None
        belief = self._moved(self._nodes[index].belief, index, now_ns)
        if belief.mean is None and not belief.items:
            return None
        mean, covariance = belief.mean, belief.covariance
        if mean is None:
            mean, covariance = kalman_filter.rough(belief.items, self._prior, self._noise)
        x, y, heading, scale, veer, bias = mean.tolist()
        holds = self._odometry_ns is not None and now_ns - self._odometry_ns <= self._coast_ns
        v, w = self._speed if holds else (0.0, 0.0)
        return FusedPose(
            time_ns=now_ns,
            x=x,
            y=y,
            heading=math.remainder(heading, math.tau),
            covariance=frozen(covariance[:3, :3]),
            heading_known=belief.mean is not None,
            v=v,
            w=w,
            age_s=math.inf if belief.position_ns is None else (now_ns - belief.position_ns) / SECOND_NS,
            scale=scale,
            veer=veer,
            bias=bias,
            accepted=belief.accepted,
            gated=belief.gated,
            restarts=belief.restarts,
        )

    def _insert(self, node: _LogEntry) -> Verdict:
        """Insert an entry, run the filter again from there, and drop entries older than the log."""
        nodes = self._nodes
        if not nodes:
            nodes.append(_LogEntry(node.time_ns, self._begin))
        if node.time_ns < nodes[0].time_ns:
            self.late += 1
            return Verdict("late")
        bisect.insort_right(nodes, node, lo=1, key=_LogEntry.key)
        since_ns = node.what.start_ns if isinstance(node.what, _OdometryInterval) else node.time_ns
        first = bisect.bisect_right(nodes, since_ns, lo=1, key=lambda each: each.time_ns)
        verdict = Verdict("late")
        for index in range(min(first, nodes.index(node)), len(nodes)):
            each = nodes[index]
            belief, what = self._moved(nodes[index - 1].belief, index - 1, each.time_ns), each.what
            if isinstance(what, MeasuredPosition):
                belief, outcome = self._corrected(belief, each.time_ns, what)
                verdict = outcome if each is node else verdict
            each.belief = belief
        oldest = bisect.bisect_right(nodes, nodes[-1].time_ns - self._history_ns, key=lambda each: each.time_ns) - 1
        del nodes[: max(oldest, 0)]
        return verdict

    def _moved(self, belief: _FilterState, index: int, until_ns: int) -> _FilterState:
        """Filter state after entry ``index``, moved to a time before the next entry, or after the last."""
        since_ns = self._nodes[index].time_ns
        if until_ns == since_ns:
            return belief
        motion = self._motion(index, since_ns, until_ns)
        items = kalman_filter.extended(belief.items, motion) if belief.items else ()
        if belief.mean is None:
            return msgspec.structs.replace(belief, items=items)
        mean, jacobian, added = moved(belief.mean, motion, self._noise)
        return msgspec.structs.replace(belief, mean=mean, covariance=grown(belief.covariance, jacobian, added), items=items)

    def _motion(self, index: int, since_ns: int, until_ns: int) -> OdometryMotion:
        """Motion from odometry, else from the last speeds as long as they hold."""
        seconds = (until_ns - since_ns) / SECOND_NS
        for node in self._nodes[index + 1 :]:
            if isinstance(odometry := node.what, _OdometryInterval):
                if odometry.start_ns > since_ns:
                    break
                share = (until_ns - since_ns) / (node.time_ns - odometry.start_ns)
                return OdometryMotion(odometry.distance_m * share, odometry.turn_rad * share, seconds)
        odometry_ns = until_ns if self._odometry_ns is None else self._odometry_ns
        coasting_s = max(min(until_ns, odometry_ns + self._coast_ns) - max(since_ns, odometry_ns), 0) / SECOND_NS
        return OdometryMotion(self._speed[0] * coasting_s, self._speed[1] * coasting_s, seconds, measured=False)

    def _corrected(self, belief: _FilterState, time_ns: int, position: MeasuredPosition) -> tuple[_FilterState, Verdict]:
        items = kalman_filter.trimmed((*belief.items, position))
        if belief.mean is None:
            return self._collected(belief, time_ns, items), Verdict("collected")
        difference, inverse, nis = innovation(belief.mean, belief.covariance, position)
        if nis <= self._bound:
            gain, covariance = corrected(belief.covariance, inverse, position)
            mean, count = belief.mean + gain @ difference, belief.accepted + 1
            state = _FilterState(mean, covariance, (), time_ns, count, belief.gated, belief.restarts)
            return state, Verdict("accepted", nis)
        items = kalman_filter.trimmed(items, self._restart_after)
        if kalman_filter.count(items) == self._restart_after:
            fit = kalman_filter.fitted(items, self._prior, self._noise)
            if fit.fits(self._gate):
                fresh = _FilterState(None, self._prior, (), None, belief.accepted, belief.gated, belief.restarts + 1)
                return self._collected(fresh, time_ns, items), Verdict("restarted", nis)
        return msgspec.structs.replace(belief, items=items, gated=belief.gated + 1), Verdict("gated", nis)

    def _collected(self, belief: _FilterState, time_ns: int, items: kalman_filter.Items) -> _FilterState:
        count = belief.accepted + 1
        start = kalman_filter.aligned(items, self._prior, self._noise, self._heading_sigma, self._gate)
        if start is None:
            return msgspec.structs.replace(belief, items=items, position_ns=time_ns, accepted=count)
        return _FilterState(start.mean, start.covariance, (), time_ns, count, belief.gated, belief.restarts)


def _check(*numbers: float) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"odometry and positions must be finite numbers, not {numbers}")
