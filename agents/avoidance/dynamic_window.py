"""Dynamic window: the best of the speeds that can be reached within a period and still allow a stop.

D. Fox, W. Burgard, S. Thrun, The dynamic window approach to collision avoidance, IEEE Robotics and Automation Magazine 4 (1),
1997, with the returns of a scan for obstacles.
"""

import math
from typing import Annotated, Any

import msgspec
import numpy as np

from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task
from vcmvsp.agents.avoidance.view import Point, View, wrapped
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.frames import arc, rotate2, wrap
from vcmvsp.cosim.types import Array, NonNegative, Positive

STRAIGHTEST = 1e-9  # 1/m: smaller curvatures count as straight
STILL = 1e-6  # m/s: slower counts as on the spot
LEAST_SPEED = 0.01  # m/s: a slower vehicle makes no progress
SPARE_M = 0.05  # distance left after stopping; nearer, where it could only creep, the vehicle turns

Grid = Annotated[int, msgspec.Meta(ge=2, le=101)]


class DynamicWindow(Settings, frozen=True, kw_only=True, tag="dynamic_window"):
    """Dynamic window (Fox, Burgard, Thrun 1997) for vehicles on wheels: the best speeds that still allow a stop.

    The task's command passes unchanged while the straight way to its aim is free within the look-ahead distance and the vehicle
    can stop on its own arc. Otherwise the method picks, from the speeds that are reachable within a period, those with the best
    score. A pair of speeds is admissible if braking along its arc ends 5 cm before anything is nearer than ``keep_m``. The
    score adds the heading towards the aim at rest, the clearance of the arc and the speed, each between 0 and 1.

    Without admissible speeds the vehicle turns on the spot until the way ahead is free. It then drives in that direction until
    the aim is free or, if the aim is out of view, for the look-ahead distance: the paper leaves this case to a planner.
    The method passes obstacles closely and oscillates before wide walls.
    """

    REACH = "lookahead_m"

    lookahead_m: Positive = 1.2  # clearances beyond this count as equal
    acceleration: Positive = 0.5  # m/s2: how far the window reaches in speed
    turn_acceleration: Positive = 1.05  # rad/s2: and in rate of turning; 60 degrees/s2
    max_yaw_rate: Positive = 1.2  # rad/s
    heading_weight: NonNegative = 0.8  # of heading for the aim
    clearance_weight: NonNegative = 0.1  # of the distance to what stands on its way
    velocity_weight: NonNegative = 0.1  # of going fast
    speeds: Grid = 5  # of them in the window
    turns: Grid = 11  # rates of turning in the window
    turn_rate: Positive = 0.6  # rad/s, where there is no way ahead

    def method(self, body: Body, period_s: float) -> Method:
        """Method for a vehicle on wheels; `ValueError`: the vehicle flies, so it does not move along arcs."""
        if body.flies:
            raise ValueError('avoidance.kind = "dynamic_window" is for vehicles on wheels; choose another kind for flying ones')
        return _DynamicWindow(self, self.clearance_m(body), period_s)


def clearances(points: Array, curvatures: Array, keep: float) -> Array:
    """Free distance of a disc on each arc until it touches a point, (m,) m along the arc of its centre; inf: no contact.

    The disc of radius ``keep`` starts at the origin along x, on circles of these ``curvatures``, (m,) 1/m, positive to the
    left; ``points`` are (n, 2) m. Points inside the disc count as touched at once if they lie ahead of its centre; points
    behind the centre do not count.

    For a point at the distance q from the centre of a circle of radius R, the disc touches it within the angle D of the nearest
    approach, ``4 R q sin(D/2)^2 = keep^2 - (q - R)^2``; the computation holds for R of any size.
    """
    curvatures = np.where(np.abs(curvatures) < STRAIGHTEST, STRAIGHTEST, curvatures)
    distance = np.hypot(points[:, 0], points[:, 1])
    order = np.argsort(distance, kind="stable")
    distance, (x, y) = distance[order], points[order].T
    excess = 0.5 * (distance * distance - keep * keep)
    blocks = (excess < 0.0) & (x >= 0.0)
    single = np.float32  # exact enough to find the touched points, and twice as fast
    apart = np.multiply.outer(curvatures.astype(single), excess.astype(single))
    np.subtract(y.astype(single), apart, out=apart)
    touched = np.abs(apart, out=apart) < keep  # |R - keep| < q < R + keep, multiplied out
    if len(distance) and excess[0] < 0.0:
        touched |= blocks
    free_m = np.full(len(curvatures), math.inf)
    if not touched.any():
        return free_m

    def until(row: Array, column: Array) -> Array:
        way = _until_touch(x[column], y[column], excess[column], curvatures[row], keep)
        return np.where(blocks[column], 0.0, way)

    rows = np.flatnonzero(touched.any(axis=1))
    nearest = touched[rows].argmax(axis=1)
    free_m[rows] = until(rows, nearest)
    # An arc to a point is no shorter than its chord: only points nearer than the result so far can be touched earlier.
    within = np.searchsorted(distance, free_m + keep)
    columns = int(within.max(initial=0, where=np.isfinite(free_m)))
    earlier = touched[:, :columns] & (np.arange(columns) < within[:, None])
    row, column = np.divmod(np.flatnonzero(earlier), max(columns, 1))  # quicker than `nonzero` in two dimensions
    if len(row):
        firsts = np.flatnonzero(np.diff(row, prepend=-1))
        free_m[row[firsts]] = np.minimum(free_m[row[firsts]], np.minimum.reduceat(until(row, column), firsts))
    return free_m


def _until_touch(x: Array, y: Array, excess: Array, curvature: Array, keep: float) -> Array:
    """As `clearances` for pairs of touching points and curvatures; ``excess`` is half of d^2 - keep^2."""
    aside = np.copysign(y, y * curvature)  # towards the centre of the circle
    radius = 1.0 / np.abs(curvature)
    from_centre = np.hypot(x, radius - aside)
    beyond = (2.0 * excess + keep * keep - 2.0 * radius * aside) / (from_centre + radius)  # q - R
    chord = 4.0 * radius * np.maximum(from_centre, STRAIGHTEST)
    half = np.sqrt(np.clip((keep * keep - beyond * beyond) / chord, 0.0, 1.0))
    angle = np.arctan2(x, radius - aside) - 2.0 * np.arcsin(half)
    return radius * np.where(angle < 0.0, angle + math.tau, angle)


class _DynamicWindow:
    """State of one vehicle: its commanded speeds and its detour."""

    def __init__(self, settings: DynamicWindow, keep: float, period_s: float) -> None:
        self._set, self._keep, self._period_s = settings, keep, period_s
        self._now = (0.0, 0.0)
        self._side = 0
        self._detour: float | None = None  # rad: the way that it has turned to
        self._gone_m = 0.0  # on it
        self._cruise = 0.0  # m/s, of the task, when it last had a speed

    def decide(self, view: View, task: Task) -> Decision:
        self._now = max(0.0, task.now[0]), task.now[1]
        if self._detour is not None:
            self._detour = wrap(self._detour - self._now[1] * self._period_s)
            self._gone_m += self._now[0] * self._period_s
        v, w = task.velocity[0], task.yaw_rate
        if abs(v) < STILL:
            v = 0.0
        elif v > 0.0:
            self._cruise = v
        top = task.max_speed if task.leader is not None else min(task.max_speed, self._cruise)
        if v < 0.0 or (v == 0.0 and (w == 0.0 or task.aim is None or top == 0.0)):  # it stands, turns on the spot, or goes back
            return Decision(task.velocity, w, "task")
        points = self._points(view, max(top, v, self._now[0]))
        if self._may_resume(view, task):
            if self._leads_on(points, task):
                if v:  # on the spot it could only turn back to the obstacle
                    self._side, self._detour = 0, None
                if not v or clearances(points, np.array([w / v]), self._keep)[0] >= self._stopping_m(v):
                    return Decision(task.velocity, w, "task")
            self._gone_m = 0.0
        speeds = self._around(points, top, task)
        if speeds is None:
            return self._turning(view, task)
        return Decision((speeds[0], 0.0), speeds[1], "avoid")

    def _around(self, points: Array, top: float, task: Task) -> tuple[float, float] | None:
        """The best speeds towards the aim, without one to the end of the task's own arc, or along the detour; None: turn."""
        far, (v, _), w = self._set.lookahead_m, task.velocity, task.yaw_rate
        if self._side and self._detour is None:
            if _straight(points, 0.0, self._keep) < far:
                return None
            self._detour, self._gone_m = 0.0, 0.0
        if self._detour is not None:
            aim = rotate2(far, 0.0, self._detour)
        else:
            aim = task.aim or arc((0.0, 0.0, 0.0), 1.0, w / v, far)[:2]
        best = self._best(points, top, aim)
        if best is None:
            self._detour = None
        return best

    def _points(self, view: View, fastest: float) -> Array:
        within = max(self._set.lookahead_m, self._stopping_m(fastest + self._set.acceleration * self._period_s)) + self._keep
        near = view.ranges < within
        return view.units[near] * np.maximum(view.ranges[near], 1e-6)[:, None]  # contacts have a direction, too

    def _stopping_m(self, v: Any) -> Any:
        """Distance to standstill from speeds v, m/s, after one more period, m."""
        return v * self._period_s + 0.5 * v * v / self._set.braking

    def _may_resume(self, view: View, task: Task) -> bool:
        """Whether no detour keeps the vehicle from its task."""
        if self._detour is None:
            return not self._side or task.velocity[0] > 0.0
        return self._gone_m >= self._set.lookahead_m or task.aim is None or view.sees(math.atan2(task.aim[1], task.aim[0]))

    def _leads_on(self, points: Array, task: Task) -> bool:
        """Whether the way to the aim is free as far as the look-ahead distance; without an aim, the task's own arc."""
        if task.aim is None:
            way = np.array([task.yaw_rate / task.velocity[0]])
            return bool(clearances(points, way, self._keep)[0] >= self._set.lookahead_m)
        distance, bearing = math.hypot(*task.aim), math.atan2(task.aim[1], task.aim[0])
        return _straight(points, bearing, self._keep) >= min(distance, self._set.lookahead_m)

    def _best(self, points: Array, top: float, aim: Point) -> tuple[float, float] | None:
        """The best admissible speeds of the window, m/s and rad/s; None if there are none."""
        reach, swing = self._set.acceleration * self._period_s, self._set.turn_acceleration * self._period_s
        v0, w0 = self._now
        v = np.linspace(max(0.0, v0 - reach), max(min(top, v0 + reach), v0 - reach, 0.0), self._set.speeds)
        limit = self._set.max_yaw_rate
        w = np.linspace(max(-limit, min(w0 - swing, limit)), min(limit, max(w0 + swing, -limit)), self._set.turns)
        v, w = v[v > LEAST_SPEED].repeat(len(w)), np.tile(w, int((v > LEAST_SPEED).sum()))
        if not len(v):
            return None
        free = clearances(points, w / v, self._keep)
        stopping = self._stopping_m(v)
        admissible = stopping + SPARE_M <= free
        if not admissible.any():
            return None
        score = (
            self._set.heading_weight * self._heading(v, w, stopping, aim)
            + self._set.clearance_weight * np.minimum(free / self._set.lookahead_m, 1.0)
            + self._set.velocity_weight * v / top
        )
        best = int(np.where(admissible, score, -math.inf).argmax())
        return float(v[best]), float(w[best])

    def _heading(self, v: Array, w: Array, way: Array, aim: Point) -> Array:
        """Heading error at rest as a score, (m,): 1 straight at the aim, 0 away from it."""
        turn = w * self._period_s + 0.5 * w * np.abs(w) / self._set.turn_acceleration
        chord = way * np.sinc(0.5 * turn / math.pi)
        x, y = aim[0] - chord * np.cos(0.5 * turn), aim[1] - chord * np.sin(0.5 * turn)
        off: Array = np.abs(wrapped(np.arctan2(y, x) - turn))
        return 1.0 - off / math.pi

    def _turning(self, view: View, task: Task) -> Decision:
        """Turn on the spot, always to one side, until there is a way straight ahead."""
        if not self._side and task.aim is not None and task.aim[0] < 0.0:  # the aim is behind
            self._side = 1 if task.aim[1] > 0.0 else -1
        elif not self._side:
            self._side = view.roomier_side(self._set.lookahead_m)
        return Decision((0.0, 0.0), self._side * self._set.turn_rate, "turn")


def _straight(points: Array, bearing: float, keep: float) -> float:
    """Clearance of a disc along a straight line, m: `clearances` without curvature."""
    ahead, left = math.cos(bearing), math.sin(bearing)
    x, y = points @ (ahead, left), points @ (-left, ahead)
    met = (np.abs(y) < keep) & (x >= 0.0)
    return float(np.maximum(x[met] - np.sqrt(keep * keep - y[met] ** 2), 0.0).min(initial=math.inf))
