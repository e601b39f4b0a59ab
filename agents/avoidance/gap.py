"""Logic-based avoidance: go through the gap that leads on (Toh 2012, chapter 4).

A gap is a run of beams without a return within the look-ahead distance. Toh 2012, 4.1, with
half-open crossings, so that each edge of a gap is met once: beams ``P`` to ``N - 1`` are a gap where ``D(P-1) <= L < D(P)`` and
``D(N-1) > L >= D(N)``. (The printed (4-2) also marks beams between which nothing changes, and both of its cases count D = L.)
The width is the distance between the returns on both sides (law of cosines; (4-3) loses the root)::

    width = sqrt(a^2 + b^2 - 2 a b cos(delta)),   a = D(P-1),  b = D(N),  delta = (N - P + 1) step

These beams have passed the edges: the result is never less than the true width, and too large by less than a beam's spacing on
either side. With both sides taken at the look-ahead distance instead, doors look wider by 0.7 m on average. A gap at the border
of the field of view is closed there, at the look-ahead distance.
"""

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task
from vcmvsp.agents.avoidance.view import Point, View, free_m, lane_free, ways, wrapped
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array, NonNegative, Positive

QUARTER = 0.5 * math.pi + 1e-9  # rad: the beams at its ends belong to it


class Gaps(NamedTuple):
    """Gaps, the widest first; arrays of one length."""

    begin: Array  # (k,) P: the first beam that is free
    end: Array  # (k,) N: the beam after the last one; beyond the number of beams for a gap that reaches over the first one
    width: Array  # (k,) m
    bearing: Array  # (k,) rad, of its middle; in a full turn from -pi to pi


def gaps(ranges: Array, lookahead_m: float, first: float, step: float, cyclic: bool = False) -> Gaps:
    """The gaps in a scan.

    If all beams are free, the whole field of view is one gap. A gap of half a turn or more is as wide as the sum of the
    distances of both sides.

    Args:
        ranges: (n,) m, from 0 to inf; inf: no return.
        lookahead_m: L; a beam is free that gets further.
        first: bearing of the first beam, rad.
        step: angle between beams, rad.
        cyclic: whether the beams cover a full turn: the last is beside the first.
    """
    count, free = len(ranges), ranges > lookahead_m
    # A full turn is searched from a beam that is not free: no gap reaches over it.
    start = int(free.argmin()) if cyclic else 0
    fenced = np.zeros(count + 2, bool)
    fenced[1 : count + 1 - start], fenced[count + 1 - start : count + 1] = free[start:], free[:start]
    edges = np.flatnonzero(fenced[1:] != fenced[:-1]) + start
    begin, end = edges[::2], edges[1::2]
    if cyclic and not free[start]:
        turns = count * (begin >= count)
        begin, end = begin - turns, end - turns
        a, b, beams = ranges[begin - 1], ranges[end % count], end - begin + 1
    else:
        a = np.where(begin > 0, ranges[begin - 1], lookahead_m)
        b = np.where(end < count, ranges[end % count], lookahead_m)
        beams = np.minimum(end, count - 1) - np.maximum(begin - 1, 0)
    delta = beams * step
    # The law of cosines in a form that rounding cannot make negative.
    width = np.where(delta >= math.pi, a + b, np.sqrt((a - b) ** 2 + 4.0 * a * b * np.sin(0.5 * delta) ** 2))
    bearing = first + step * 0.5 * (begin + end - 1)
    if cyclic:
        bearing = wrapped(bearing)
    order = np.argsort(-width, kind="stable")
    return Gaps(begin[order], end[order], width[order], bearing[order])


def gaps_ahead(view: View, bearing: float, lookahead_m: float) -> tuple[Gaps, Array]:
    """Gaps within a quarter turn of a visible bearing, rad, and their assumed middles, (k,) rad.

    Everything beyond the border of the field of view counts as free. Otherwise a gap at the border grows while the vehicle
    turns towards it, its middle moves away, and the gap on the other side comes nearer. A gap that reaches beyond the quarter
    turn has its width in the whole view.
    """
    first, bearing = float(view.bearings[0]), view.near_middle(bearing)
    begin = math.ceil((bearing - first - QUARTER) / view.step)
    end = math.floor((bearing - first + QUARTER) / view.step) + 1
    if view.cyclic:
        unseen, ranges = 0, view.ranges.take(np.arange(begin, end), mode="wrap")
    else:
        unseen, ranges = max(-begin, 0), view.ranges[max(begin, 0) : end]
    candidates = gaps(ranges, lookahead_m, first + (begin + unseen) * view.step, view.step)
    width = _full_widths(view, candidates, begin + unseen, len(ranges), lookahead_m)
    order = np.argsort(-width, kind="stable")
    candidates = Gaps(candidates.begin[order], candidates.end[order], width[order], candidates.bearing[order])
    more = (candidates.end == len(ranges)) * (end - begin - unseen - len(ranges)) - (candidates.begin == 0) * unseen
    return candidates, candidates.bearing + 0.5 * view.step * more


def _full_widths(view: View, candidates: Gaps, begin: int, count: int, lookahead_m: float) -> Array:
    """Widths, m, of gaps among ``count`` beams from beam ``begin`` on; cut gaps are measured whole.

    A gap of half a turn or more is no door, so its width is not used.
    """
    cut = np.flatnonzero((candidates.begin == 0) | (candidates.end == count))
    if not len(cut):
        return candidates.width
    width, every = candidates.width.copy(), len(view.ranges)
    whole = gaps(view.ranges, lookahead_m, 0.0, view.step, view.cyclic)
    for each in cut.tolist():
        inside = (begin + int(candidates.begin[each]) - whole.begin) % every < whole.end - whole.begin
        index = inside.argmax()
        if (whole.end[index] - whole.begin[index] + 1) * view.step < math.pi:
            width[each] = min(width[each], float(whole.width[index]))
    return width


STILL, PATIENCE_S = 0.02, 3.0  # m/s; s: slower for this time, longer than half a turn takes, it makes no progress
TIE = 1e-6  # rad per rad: less than that is rounding
CREEP = 0.2  # lowest share of the speed while it turns towards a gap


class Gap(Settings, frozen=True, kw_only=True, tag="gap"):
    """Keep to the task while the lane to its aim is free; otherwise go through the gap that leads on."""

    REACH = "lookahead_m"

    lookahead_m: Positive = 1.2  # what is further away does not matter: more than it takes to stop, m
    top: Annotated[int, msgspec.Meta(ge=1)] = 3  # how many gaps are considered, the widest; the only one of use may be the next
    margin_m: NonNegative = 0.06  # room on either side of the body: gaps must be wider than both together, lanes are as wide, m
    gain: Positive = 1.5  # 1/s: yaw rate per rad that a gap lies aside
    max_yaw_rate: Positive = 1.2  # on its way to a gap, rad/s
    turn_rate: Positive = 0.6  # of turning on the spot where there is no gap, rad/s

    def default_keep_m(self, body: Body) -> float:
        """Default of ``keep_m``: half of a lane, and enough to turn on the spot."""
        return max(0.5 * body.width_m + self.margin_m, body.radius_m)

    def method(self, body: Body, period_s: float) -> Method:
        """Method of this kind for one vehicle."""
        return GapMethod(self, body, period_s)


class GapMethod:
    """State of one vehicle that drives through gaps.

    The lane leads to the task's aim, at most as far as the look-ahead distance. Without an aim, or with one out of view, it
    leads along the task's own motion; turning on the spot is always free. A vehicle on its way around an obstacle resumes its
    task only when it sees that the lane is free.

    Choice of the gap: a follower takes the gap nearest in bearing to its leader (Toh 2012, 4-4, 4-5: with the leader out of
    view, a gap at that border of the field of view). A vehicle with an aim takes the gap whose end, at the look-ahead
    distance, is nearest to the aim; a roaming one the gap nearest to its own direction. A full turn is first examined as
    half a turn around the goal's direction, because the middle of one gap around everything but a pillar leads straight back.

    Direction: the middle of the gap if a disc as wide as the lane passes there, else the nearest direction in the gap in which
    it passes. If it passes nowhere in the gap, the vehicle still approaches the middle to see better, until it makes no
    progress for three seconds; then it takes the nearest free direction anywhere, for the look-ahead distance.

    Without a gap or a direction the vehicle turns towards its leader or aim, or to the roomier side. It keeps that side
    until it has driven the look-ahead distance or nothing is near; otherwise it would turn back and forth forever.
    """

    def __init__(self, settings: Gap, body: Body, period_s: float) -> None:
        self._settings, self._flies, self._period_s = settings, body.flies, period_s
        # Half a lane is at least the distance to keep: otherwise the vehicle gets stuck at level 2.
        self._half_m = max(0.5 * body.width_m + settings.margin_m, settings.clearance_m(body))
        self._speed = 0.0  # of the task, when it last had one
        self._is_away = False  # from the task
        self._side = 0  # side of the turn on the spot: 1 left, -1 right, 0 none
        self._gone_m = 0.0  # since it last turned
        self._elsewhere = False  # it takes any free direction, after it found none in the chosen gap
        self._waited_s = 0.0  # time without progress on the way around an obstacle

    def decide(self, view: View, task: Task) -> Decision:
        """The decision of a tick."""
        speed, lookahead = math.hypot(*task.velocity), self._settings.lookahead_m
        self._speed = speed or self._speed
        self._gone_m += abs(task.now[0]) * self._period_s
        if self._gone_m >= lookahead or view.nearest_m > lookahead:
            self._side, self._elsewhere = 0, False
        self._waited_s = self._waited_s + self._period_s if abs(task.now[0]) < STILL else 0.0
        if self._waited_s > PATIENCE_S:
            self._elsewhere, self._gone_m, self._waited_s = True, 0.0, 0.0
        stands = not speed and (self._flies or not task.yaw_rate)
        self._is_away = not stands and not self._is_free(view, task)
        if stands:
            self._waited_s = 0.0
        if not self._is_away:
            return Decision(task.velocity, task.yaw_rate, "task")
        way = self._way(view, task)
        bearing = None if way is None else self._fitting(view, *way)
        if bearing is None or (math.cos(bearing) < CREEP and bearing * self._side < 0.0):
            self._side, self._gone_m, self._elsewhere = self._side or _side(view, task, lookahead), 0.0, True
            return Decision((0.0, 0.0), self._side * self._settings.turn_rate, "turn")
        return self._towards(bearing, view, task)

    def _is_free(self, view: View, task: Task) -> bool:
        lookahead = self._settings.lookahead_m
        if view.nearest_m > lookahead:
            return True
        if task.aim is not None and view.sees(aside := _bearing(task.aim)):
            return lane_free(view, aside, self._half_m, min(lookahead, math.hypot(*task.aim)))
        if task.aim is not None and self._is_away and not self._flies:
            return False
        if not any(task.velocity):
            return True
        return lane_free(view, _bearing(task.velocity), self._half_m, lookahead)

    def _way(self, view: View, task: Task) -> tuple[float, float] | None:
        """Bearing of the middle of the chosen gap, and its reach to either side, rad; None: no gap."""
        lookahead, first = self._settings.lookahead_m, float(view.bearings[0])
        goal_bearing = _bearing(task.leader or task.aim or task.velocity)
        if view.sees(goal_bearing):
            way = self._chosen(*gaps_ahead(view, goal_bearing, lookahead), goal_bearing, task, view.step)
            if way is not None:
                return way
        candidates = gaps(view.ranges, lookahead, first, view.step, view.cyclic)
        if view.cyclic:
            places = goal_bearing + (candidates.bearing - goal_bearing + math.pi) % math.tau - math.pi
        else:
            places, goal_bearing = candidates.bearing, view.near_middle(goal_bearing)
        return self._chosen(candidates, places, goal_bearing, task, view.step)

    def _chosen(
        self, candidates: Gaps, places: Array, goal_bearing: float, task: Task, step: float
    ) -> tuple[float, float] | None:
        """The best gap, with middles unwrapped to ``places``, rad; of equal ones the wider."""
        best: tuple[float, float, float] | None = None
        top, lookahead = self._settings.top, self._settings.lookahead_m
        columns = (candidates.width, candidates.bearing, places, 0.5 * step * (candidates.end - candidates.begin))
        for width, bearing, place, half in zip(*(each[:top].tolist() for each in columns), strict=True):
            if width <= 2.0 * self._half_m:
                break
            if task.aim is None or task.leader is not None:
                cost = abs(place - goal_bearing)
            else:
                cost = math.dist((lookahead * math.cos(place), lookahead * math.sin(place)), task.aim)
            if best is None or cost < best[0] - 1e-9:
                best = cost, bearing, half
        return None if best is None else best[1:]

    def _fitting(self, view: View, bearing: float, half: float) -> float | None:
        """The passable direction next to the middle of a gap, rad; None: there is none."""
        lookahead = self._settings.lookahead_m
        if free_m(view, (math.cos(bearing), math.sin(bearing)), self._half_m, lookahead) == math.inf:
            return bearing
        free = view.bearings[ways(view, self._half_m, lookahead)]
        aside, turn = wrapped(free - bearing), wrapped(free)
        if not self._elsewhere and not np.any(np.abs(aside) <= half):
            return bearing
        if not len(free):
            return None
        best = float(turn[int((np.abs(aside) + TIE * np.abs(turn)).argmin())])  # of equal ones, the smaller turn
        return best if abs(best) < math.pi - TIE else math.copysign(best, bearing)

    def _towards(self, bearing: float, view: View, task: Task) -> Decision:
        """The command towards a gap: a follower at full speed, to catch up; others at most at the task's speed."""
        own = task.max_speed if task.leader is not None else self._speed
        speed, aside, settings = min(own, task.max_speed), math.remainder(bearing, math.tau), self._settings
        if self._flies:
            return Decision((speed * math.cos(aside), speed * math.sin(aside)), task.yaw_rate, "avoid")
        w = max(-settings.max_yaw_rate, min(settings.gain * aside, settings.max_yaw_rate))
        ahead = math.cos(aside)
        if ahead < CREEP:
            ahead = CREEP if lane_free(view, 0.0, self._half_m, settings.lookahead_m) else 0.0
        return Decision((speed * ahead, 0.0), w, "avoid")


def _bearing(place: Point) -> float:
    return math.atan2(place[1], place[0])


def _side(view: View, task: Task, lookahead_m: float) -> int:
    place = task.leader or task.aim
    return int(math.copysign(1, place[1])) if place and place[1] else view.roomier_side(lookahead_m)
