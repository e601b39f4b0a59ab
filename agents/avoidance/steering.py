"""Avoidance of one vehicle: a method, two levels of nearness, and checks of scans.

Level 1 begins where a method first considers obstacles, level 2 where a vehicle must brake for them: from there on its
approach speed is at most proportional to the remaining distance. Along one beam the distance then decays to ``keep_m``, and a
vehicle whose speed lags by tau does not overshoot, if ``approach`` <= 1/(4 tau).
"""

import math
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vcmvsp.agents.avoidance.method import Decision, Mode, Settings, Task, body_of, saturated
from vcmvsp.agents.avoidance.view import Point, ScanReader, View, free_m
from vcmvsp.cosim.agent import Body, Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Array, Vec3, Velocity, Waypoint

SPARE_M = 0.03  # margin at rest before the distance to keep
AROUND_M = 0.3  # beyond the distance to keep: latest begin of level 2
RELEASE_M, RELEASE_S = 0.15, 0.5  # additional distance, and its duration, that end level 2
BESIDE_M = 0.05  # on wheels: obstacles that the body passes at this distance do not count
REVERSE = 0.1  # m/s: on wheels, the fastest way back at level 2
EXACT = 1e-9  # m/s, of limits
ROUNDS = 64  # limit of the search for the nearest velocity, which takes a few
ARRIVAL = 0.8  # 1/s: greatest speed towards a way-point per remaining distance
TURN_GAIN, TURN = 1.0, 1.0  # 1/s, rad/s: towards the heading of a way-point
VANISHED_S = 0.5  # duration of doubt after all near returns vanished at once
UNSEEN = 0.1  # m/s: on wheels, greatest speed outside the field of view
BLIND = Decision((0.0, 0.0), 0.0, "blind")


class ObstacleLevels:
    """Level of nearness, 0, 1 or 2, of obstacles to a vehicle that keeps ``keep_m`` from them; updated once a tick."""

    def __init__(self, settings: Settings, body: Body, latency_s: float = 0.0) -> None:
        self.level, self.keep_m = 0, settings.clearance_m(body)
        self._settings, self._latency_s, self._flies = settings, latency_s, body.flies
        self._lane_m = min(self.keep_m, 0.5 * body.width_m + BESIDE_M)  # half of it
        self._clear_ns: int | None = None  # since when it is far enough from everything to leave level 2

    def update(self, now_ns: int, nearest_m: float, speed: float) -> int:
        """Level for the nearest obstacle at ``nearest_m``, m, and a present or commanded ``speed``, m/s."""
        self.level = 2 if self._is_second(now_ns, nearest_m, speed) else int(nearest_m < self._settings.reach_m)
        return self.level

    def limited(self, view: View, velocity: Point) -> Point:
        """Velocity within the limit of the level, m/s, body frame; unchanged below level 2."""
        if self.level < 2:
            return velocity
        if self._flies:
            return limited_flight(velocity, view, self.keep_m, self._settings.approach)
        return limited_drive(velocity[0], view, self.keep_m, self._lane_m, self._settings.approach), 0.0

    def _is_second(self, now_ns: int, nearest_m: float, speed: float) -> bool:
        if self._settings.level < 2:
            return False
        begins_m = second_m(speed, self.keep_m, self._settings.braking, self._latency_s)
        if nearest_m < begins_m:
            self._clear_ns = None
            return True
        if self.level < 2:
            return False
        if nearest_m <= begins_m + RELEASE_M:
            self._clear_ns = None
        elif self._clear_ns is None:
            self._clear_ns = now_ns
        return self._clear_ns is None or now_ns - self._clear_ns < seconds_to_ns(RELEASE_S)


def second_m(speed: float, keep_m: float, braking: float, latency_s: float = 0.0) -> float:
    """Distance at which level 2 begins, m: the distance to keep plus 0.3 m, or the stopping distance if that is longer."""
    return keep_m + max(AROUND_M, speed * latency_s + speed * speed / (2.0 * braking))


def limited_flight(velocity: Point, view: View, keep_m: float, approach: float) -> Point:
    """Velocity nearest to the given one that approaches no return too fast; both in m/s, body frame.

    Beam i with a return D_i allows ``v . u_i <= approach max(0, D_i - keep_m - 0.03)``. What all beams allow is convex and
    holds 0; so the nearest point of it is never longer than the given velocity and never against it, and motion along a wall
    goes on. Found by adding the beam that is violated most to the one or two that hold, until none is violated; each time the
    nearest point gets further from the given velocity, so that it ends (the dual method of Goldfarb and Idnani, A numerically
    stable dual method for solving strictly convex quadratic programs, Mathematical Programming 27, 1983, in two dimensions).
    """
    finite = np.isfinite(view.ranges)
    if not finite.any() or not math.isfinite(velocity[0] + velocity[1]):
        return velocity
    units, most = view.units[finite], approach * np.maximum(view.ranges[finite] - keep_m - SPARE_M, 0.0)
    allowed = velocity
    holding: list[int] = []
    for _ in range(ROUNDS):
        excess = units @ allowed - most
        worst = int(excess.argmax())
        if excess[worst] <= EXACT:
            return allowed
        if worst in holding:
            break
        allowed, holding = _nearest(velocity, units, most, [*holding, worst])
    towards = units @ allowed  # rounding is left over
    share = float(np.min(most / np.maximum(towards, EXACT), initial=1.0, where=towards > most))
    return allowed[0] * share, allowed[1] * share


def _nearest(velocity: Point, units: Array, most: Array, beams: list[int]) -> tuple[Point, list[int]]:
    """The velocity nearest to the given one that all beams allow, and the at most three beams that limit it."""
    limits = [(*units[i].tolist(), float(most[i])) for i in beams]
    x, y = velocity
    tried: list[tuple[Point, list[int]]] = [((0.0, 0.0), beams[-1:])]
    for (a, b, m), beam in zip(limits, beams, strict=True):
        over = a * x + b * y - m
        if over > 0.0:
            tried.append(((x - over * a, y - over * b), [beam]))
        for (c, d, n), other in zip(limits, beams, strict=True):
            cross = a * d - b * c
            if beam < other and abs(cross) > EXACT:
                tried.append((((m * d - n * b) / cross, (n * a - m * c) / cross), [beam, other]))

    def is_allowed(candidate: tuple[Point, list[int]]) -> bool:
        vx, vy = candidate[0]
        return all(a * vx + b * vy <= m + EXACT for a, b, m in limits)

    return min(filter(is_allowed, tried), key=lambda each: math.dist(each[0], velocity))


def limited_drive(v: float, view: View, keep_m: float, lane_m: float, approach: float) -> float:
    """Limited forward speed of a vehicle on wheels, m/s; it has the sign of ``v``.

    The vehicle cannot move sideways: returns count if they lie less than ``lane_m`` beside the line straight ahead (behind, for
    a negative v). The remaining distance ends where a disc of radius ``keep_m`` touches one. Walls beside the vehicle do not
    count.
    """
    if v == 0.0:
        return v
    sign = math.copysign(1.0, v)
    left_m = free_m(view, (sign, 0.0), keep_m, sys.float_info.max, lane_m)
    fastest = min(abs(v), approach * max(0.0, left_m - SPARE_M))
    return sign * (min(fastest, REVERSE) if v < 0.0 else fastest)


class AvoidanceSteering:
    """Avoidance of one vehicle, called once a tick.

    A vehicle without a valid scan stands still: no reading of its scanner, one that is too old or invalid
    (`agents.avoidance.view.view_of`), one with changed beams, or 0 on every beam. A scanner fault is assumed where
    something was near (level 1 or 2) and all returns vanish at once: for half a second the vehicle is then no faster than
    before. With 0 on one beam it is no faster than before or than its task. Exceptions of a method are not caught. On
    wheels the speed is at most 0.1 m/s in directions that the scanner does not cover.

    Attributes:
        notes: changes of the last tick, for `cosim.agent.Agent.note`: ``mode``, ``level``.
        level: 0; 1: near enough for the method; 2: so near that the speed is limited.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self._make = settings, settings.maker()
        self._looking = ScanReader(settings.scanner, settings.stale_s)
        self.sensors = (settings.scanner,)

    def start(self, info: VehicleInfo) -> None:
        """Take scanner and body of the vehicle; `ValueError`: one is missing, or the method does not suit the vehicle."""
        self._looking.start(info, "avoidance.scanner")
        body = body_of(info)
        try:
            self._method = self._make(body, info.period_s)
        except ScenarioError as error:  # of a user-defined method, which is built only here
            raise ValueError(str(error)) from error
        self._levels, self._flies = ObstacleLevels(self.settings, body, info.latency_s), body.flies
        self._was_near = False  # whether the last valid scan with returns had something near
        self._empty_ns: int | None = None  # since when all returns are gone
        self._speed, self._now = 0.0, (0.0, 0.0)  # m/s; m/s ahead and rad/s: as last commanded
        self._note: dict[str, float | str | bool] = {}
        self.notes: dict[str, float | str | bool] = {}
        self.level = 0

    def steer(self, obs: Observation, task: Task) -> Decision:
        """Decision of a tick in place of the task's motion."""
        return self._steered(obs, task, lambda view: self._method.decide(view, task._replace(now=self._now)))

    def drive(
        self, obs: Observation, speeds: tuple[float, float], aim: Point | None = None, leader: Point | None = None
    ) -> Decision:
        """Steered speeds of a vehicle on wheels, m/s and rad/s; ``aim`` and ``leader`` are m, world."""
        v, w = speeds
        return self.steer(
            obs, Task((v, 0.0), w, _in_body_frame(obs, aim), _in_body_frame(obs, leader), self.settings.max_speed)
        )

    def limit(self, obs: Observation, speeds: tuple[float, float]) -> Decision:
        """Limited speed of a vehicle on wheels without a destination that is not yet at rest."""
        task = Task((speeds[0], 0.0), speeds[1])
        return self._steered(obs, task, lambda _: Decision(task.velocity, task.yaw_rate, "task"))

    def _steered(self, obs: Observation, task: Task, decide: Callable[[View], Decision]) -> Decision:
        """Limited decision, with changes noted; a blind vehicle stands."""
        view = self._looking.look(obs)
        decision = BLIND
        if view is not None and view.ranges.any():
            decision = self._limited(obs, view, decide(view), math.hypot(*task.velocity))
        self._speed, self._now = math.hypot(*decision.velocity), (decision.velocity[0], decision.yaw_rate)
        now: dict[str, float | str | bool] = {"mode": decision.mode, "level": self.level}
        self.notes = {name: value for name, value in now.items() if value != self._note.get(name)}
        self._note = now
        return decision

    def _limited(self, obs: Observation, view: View, decision: Decision, requested: float) -> Decision:
        """The decision with the speed limit near obstacles; ``requested`` is the speed of the task, m/s."""
        x, y, _ = obs.state.velocity
        fastest = max(requested, math.hypot(*decision.velocity), math.hypot(x, y))
        self.level = self._levels.update(obs.time_ns, view.nearest_m, fastest)
        velocity = self._levels.limited(view, decision.velocity)
        if not self._flies and velocity[0] and not view.sees(0.0 if velocity[0] > 0.0 else math.pi):
            velocity = saturated(velocity, UNSEEN)
        if self._is_doubtful(obs.time_ns, view):
            self.level = max(self.level, 1)
            velocity = saturated(velocity, self._speed)
        elif view.nearest_m == 0.0:
            velocity = saturated(velocity, max(self._speed, requested))
        return decision._replace(velocity=velocity)

    def _is_doubtful(self, now_ns: int, view: View) -> bool:
        """Whether something was near and all returns vanished at once, a short time ago."""
        is_empty = view.nearest_m == math.inf
        if not is_empty:
            self._was_near, self._empty_ns = self.level > 0, None
        elif self._was_near:
            self._empty_ns = now_ns if self._empty_ns is None else self._empty_ns
            self._was_near = now_ns - self._empty_ns < seconds_to_ns(VANISHED_S)
        return is_empty and self._was_near


class SteeredMotion(NamedTuple):
    """Command of a vehicle in the air."""

    velocity: Vec3  # m/s, world
    yaw_rate: float  # rad/s
    mode: Mode


def around(
    steering: AvoidanceSteering | None,
    obs: Observation,
    requested: Vec3,
    yaw_rate: float,
    aim: Point | None = None,
    leader: Point | None = None,
) -> SteeredMotion:
    """Velocity (m/s, world) and yaw rate (rad/s) of an aerial vehicle, led around obstacles.

    ``aim`` and ``leader`` are m, world. Obstacles are avoided sideways: the climb does not change, unless the vehicle has
    no valid scan and stands still.
    """
    if steering is None:
        return SteeredMotion(requested, yaw_rate, "task")
    yaw = obs.state.yaw
    task = Task(
        rotate2(requested[0], requested[1], -yaw),
        yaw_rate,
        _in_body_frame(obs, aim),
        _in_body_frame(obs, leader),
        steering.settings.max_speed,
    )
    decision = steering.steer(obs, task)
    climb = 0.0 if decision.mode == "blind" else requested[2]
    return SteeredMotion((*rotate2(*decision.velocity, yaw), climb), decision.yaw_rate, decision.mode)


def _in_body_frame(obs: Observation, place: Point | None) -> Point | None:
    """A world point in the body frame, m."""
    if place is None:
        return None
    (x, y, _), yaw = obs.state.position, obs.state.yaw
    return rotate2(place[0] - x, place[1] - y, -yaw)


def velocity_to(obs: Observation, waypoint: Waypoint, speed: float) -> Velocity:
    """The velocity, world, that leads straight to a way-point, at its speed or else at ``speed``, m/s."""
    x, y, z = (to - at for to, at in zip(waypoint.position, obs.state.position, strict=True))
    distance = math.hypot(x, y, z)
    share = min(ARRIVAL, (waypoint.speed or speed) / distance) if distance > 0.0 else 0.0
    turn = 0.0 if waypoint.yaw is None else TURN_GAIN * wrap(waypoint.yaw - obs.state.yaw)
    return Velocity(linear=(share * x, share * y, share * z), yaw_rate=max(-TURN, min(turn, TURN)))
