"""Potential field: near obstacles repel a vehicle; its velocity is the sum of the task's velocity and all repulsions.

A return at x metres along a beam repels with (Toh 2012, section 3.2; R the reach, r the core)::

    F(x) = (R - x) / (x - r)    for x < R, and not at all beyond

which has no bound at the core and pulls inside it. From 5 cm before the core on inwards it therefore counts as there: with
R = 1.2 and r = 0.6 m it is never more than 11, and always away. With n beams i in a full turn, of directions u_i::

    F = -(32 / n) sum F(x_i) u_i,        command = saturated(task + g F + tang side h rot90(g F))

32 beams are those of the thesis; the factor makes the push that of the angle which something fills, not of the scanner's
resolution. So with less than a full turn it is 32 times the angle from beam to beam as a part of the turn: what is seen pushes
as it does in a full turn, what is not seen does not push.

As printed, without the last term, a field stops whatever runs straight into it, for ever. With h = max(0, -cos(F, task)) and
the sign of rot90(F) . task as its side (1 in a tie) that term leads past what pushes on the nearer side. The side is chosen on
entering the field and kept until nothing is in reach any more: a vehicle that chooses anew at every tick trembles on the spot.

* In the air the sum is the velocity, and the yaw rate is the task's. A vehicle that hovers is pushed as well, to the edge of
  the reach, where nothing pushes it, or to where pushes balance.
* On wheels the sum is the velocity of a hand point as far ahead of the axle as the body reaches, for an axle cannot go sideways
  and its hand can (Toh 2012, (3-4)); of the task, that is (v, w times that distance). It goes no faster back than its task
  does, and ahead than its task has had it go since something is near: what is behind does not drive it on. Where the sum points
  backwards it turns on the spot, to one side, until that leads ahead, less than 60 degrees aside. It goes slower rather than
  elsewhere where it cannot turn so fast. A standing vehicle, v = w = 0, remains standing.

Nothing in reach leaves the task as it is. Two things a field does not do: enter a passage that is hardly wider than the reach
(with these defaults 1.2 m is closed and 1.6 m open), whose jambs push back together; and keep its core free when it is driven
into fast: at 3 m/s with a lag of 0.5 s a vehicle comes nearer than 0.2 m. Limits of the speed are for that.
"""

import math

from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task, saturated
from vcmvsp.agents.avoidance.view import Point, View
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array, NonNegative, Positive

BEAMS = 32  # in a full turn, of the scanner that the gain was tuned with (Toh 2012)
EDGE_M = 0.05  # from the core to where the push grows no further
LEADS_ON = 0.5  # cosine of how far aside the sum may point for a turn on the spot to end
TIE = 1e-9  # of the greatest that it could be: less to one side than that is rounding


class PotentialField(Settings, frozen=True, kw_only=True, tag="potential_field"):
    """What is near pushes, the nearer the harder."""

    reach: Positive = 1.2  # m: what is farther away does not push
    core: NonNegative = 0.6  # m: so near the push would be without bound; at least 5 cm less than the reach
    gain: Positive = 0.1  # m/s per unit of push; one beam of 32 pushes with 1 in the middle between core and reach
    tang: NonNegative = 1.0  # how strongly it is led around what it runs straight into; 0: not at all, it stops there
    max_yaw_rate: Positive = 1.2  # on wheels, on the move, rad/s
    turn_rate: Positive = 0.6  # on wheels, on the spot, rad/s

    def __post_init__(self) -> None:
        if self.reach <= self.core + EDGE_M:
            raise ValueError(f"reach must be greater than core + {EDGE_M:g} m = {self.core + EDGE_M:g} m, not {self.reach:g} m")

    def default_keep_m(self, body: Body) -> float:
        """The core, or the body and 5 cm where that is more."""
        return max(self.core, super().default_keep_m(body))

    def method(self, body: Body, period_s: float) -> Method:
        """The field of a vehicle."""
        return _Field(self, body)


def repulsion(view: View, reach_m: float, core_m: float) -> tuple[float, float, float]:
    """The push of all that is seen: x forward, y left, and if all pushed the same way (0: nothing in reach)."""
    pushing = view.ranges < reach_m
    ranges = view.ranges[pushing]
    if not len(ranges):
        return 0.0, 0.0, 0.0
    each: Array = ranges.clip(core_m + EDGE_M)
    each = (reach_m - each) / (each - core_m)
    weight = BEAMS * view.step / math.tau
    x, y = (each @ view.units[pushing]).tolist()
    return -weight * x, -weight * y, weight * float(each.sum())


class _Field:
    """One vehicle in the field."""

    def __init__(self, settings: PotentialField, body: Body) -> None:
        self._settings = settings
        self._flies, self._hand_m = body.flies, body.radius_m
        self._side = 0  # on which it goes around what pushes: 1 keeps that on its left, -1 on its right; 0: in no field
        self._cruise = 0.0  # m/s ahead: the greatest speed of the task since it is in the field
        self._turn = 0  # which way it turns on the spot: 1 left, -1 right; 0: it does not

    def decide(self, view: View, task: Task) -> Decision:
        """The task's way and all pushes, added up."""
        settings, (vx, vy), w = self._settings, task.velocity, task.yaw_rate
        x, y, most = repulsion(view, settings.reach, settings.core)
        if most == 0.0:
            self._side, self._turn, self._cruise = 0, 0, max(vx, 0.0)
            return Decision(task.velocity, w, "task")
        push, most = (settings.gain * x, settings.gain * y), settings.gain * most
        if self._flies:
            return Decision(saturated(self._sum((vx, vy), push, most), task.max_speed), w, "avoid")
        self._cruise = max(self._cruise, vx)
        if vx == 0.0 and w == 0.0:
            return Decision(task.velocity, w, "task")
        hand = self._sum((vx, w * self._hand_m), push, most)
        return self._on_wheels(saturated(hand, task.max_speed), vx)

    def _sum(self, task: Point, push: Point, most: float) -> Point:
        """Sum of task and repulsions, m/s; ``most``: its value if all repulsions had one direction."""
        (tx, ty), (px, py) = task, push
        speed, strength = math.hypot(tx, ty), math.hypot(px, py)
        if speed == 0.0:
            return push
        if self._side == 0:
            across = px * ty - py * tx
            self._side = -1 if across < -TIE * most * speed else 1
        if strength <= TIE * most:
            return task
        against = max(0.0, -(px / strength * (tx / speed) + py / strength * (ty / speed)))
        around = self._settings.tang * self._side * against
        return tx + px - around * py, ty + py + around * px

    def _on_wheels(self, hand: Point, task_v: float) -> Decision:
        """Speeds for this velocity of the hand point, no faster than the task's, ahead or back."""
        ux, uy = hand
        if task_v > 0.0 and (ux <= 0.0 or (self._turn and ux < LEADS_ON * math.hypot(ux, uy))):
            if self._turn == 0:  # towards where it is to go; from straight behind, past the side that it is to pass
                self._turn = -self._side if abs(uy) <= TIE * abs(ux) else int(math.copysign(1, uy))
            return Decision((0.0, 0.0), self._turn * self._settings.turn_rate, "turn")
        self._turn = 0
        v, w = max(min(task_v, 0.0), min(ux, self._cruise)), uy / self._hand_m
        slower = min(1.0, self._settings.max_yaw_rate / abs(w)) if w else 1.0
        return Decision((v * slower, 0.0), w * slower, "avoid")
