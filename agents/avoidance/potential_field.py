"""Potential field: near obstacles repel a vehicle; its velocity is the sum of the task's velocity and all repulsions.

A return at x metres along a beam repels with (Toh 2012, section 3.2; R the reach, r the core)::

    F(x) = (R - x) / (x - r)    for x < R, and not at all beyond

which is unbounded at the core and attracts inside it. From 5 cm before the core inwards it is therefore constant: with R = 1.2
and r = 0.6 m it is at most 11, and always repels. With n beams i in a full turn, of directions u_i::

    F = -(32 / n) sum F(x_i) u_i,        command = saturated(task + g F + tang side h rot90(g F))

The thesis has 32 beams; with the factor the repulsion depends on the angle that an obstacle fills, not on the scanner's
resolution. With less than a full turn the factor is 32 times the angle from beam to beam as a part of the turn: visible
obstacles repel as they do in a full turn.

As printed, without the last term, a field permanently stops a vehicle that drives straight at an obstacle. With h = max(0,
-cos(F, task)) and the sign of rot90(F) . task as the side (1 in a tie), that term leads past the obstacle on the nearer side.
The side is chosen on entering the field and kept until nothing is in reach: a vehicle that chooses at every tick oscillates on
the spot.

* In the air the sum is the velocity, and the yaw rate is the task's. A hovering vehicle is repelled, too: to the edge of the
  reach, or to where repulsions balance.
* On wheels the sum is the velocity of a hand point as far ahead of the axle as the body reaches, since an axle cannot move
  sideways (Toh 2012, (3-4)); the velocity of the task there is (v, w times that distance). The vehicle reverses no faster than
  its task, and drives ahead no faster than its task did since an obstacle is near: obstacles behind do not accelerate it. Where
  the sum points backwards, the vehicle turns on the spot, to one side, until the sum points less than 60 degrees aside. Where
  it cannot turn fast enough, it drives more slowly on the same arc. A standing vehicle, v = w = 0, remains standing.

Without obstacles in reach the task is unchanged. Limits of the method: a vehicle does not enter a passage hardly wider than the
reach (with these defaults 1.2 m is closed and 1.6 m open), and a fast vehicle enters the core: at 3 m/s with a lag of 0.5 s it
comes nearer than 0.2 m. Speed limits prevent that.
"""

import math

from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task, saturated
from vcmvsp.agents.avoidance.view import Point, View
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array, NonNegative, Positive

BEAMS = 32  # in a full turn, of the scanner that the gain was tuned with (Toh 2012)
EDGE_M = 0.05  # distance from the core below which the repulsion is constant
LEADS_ON = 0.5  # cosine of the bearing of the sum that ends a turn on the spot
TIE = 1e-9  # of the greatest that it could be: less to one side than that is rounding


class PotentialField(Settings, frozen=True, kw_only=True, tag="potential_field"):
    """Potential field: obstacles within reach repel the vehicle, nearer ones more strongly."""

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
        """Default of ``keep_m``: the core, or the body and 5 cm if that is more."""
        return max(self.core, super().default_keep_m(body))

    def method(self, body: Body, period_s: float) -> Method:
        """Method of this kind for one vehicle."""
        return _Field(self, body)


def repulsion(view: View, reach_m: float, core_m: float) -> tuple[float, float, float]:
    """Sum of all repulsions, x forward and y left, and of their magnitudes (0: nothing in reach)."""
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
    """State of one vehicle in the field."""

    def __init__(self, settings: PotentialField, body: Body) -> None:
        self._settings = settings
        self._flies, self._hand_m = body.flies, body.radius_m
        self._side = 0  # side of obstacles that it passes: 1 on its left, -1 on its right; 0: in no field
        self._cruise = 0.0  # m/s ahead: the greatest speed of the task since it is in the field
        self._turn = 0  # direction of a turn on the spot: 1 left, -1 right; 0: none

    def decide(self, view: View, task: Task) -> Decision:
        """Motion from the task and all repulsions."""
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
