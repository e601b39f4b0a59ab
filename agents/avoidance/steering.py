"""Has a vehicle get around things on the way that its task takes: a method, two levels of speed, and no trust in bad scans."""

import math
from typing import NamedTuple

from vcmvsp.agents.avoidance.levels import ObstacleLevels
from vcmvsp.agents.avoidance.method import Decision, Mode, Point, Task, saturated
from vcmvsp.agents.avoidance.settings import Settings, body_of
from vcmvsp.agents.avoidance.view import ScanReader, View
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Vec3

VANISHED_S = 0.5  # all that was near is gone at once: so long that is not believed
UNSEEN = 0.1  # m/s: on wheels, to where the scanner does not look
BLIND = Decision((0.0, 0.0), 0.0, "blind")


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
        self.notes: dict[str, float | str | bool] = {}
        self.level = 0

    def start(self, info: VehicleInfo) -> None:
        """Take the scanner and the body of the vehicle.

        Raises:
            ValueError: the scanner is missing, the size of the vehicle is unknown, or the method does not suit it.
        """
        self._looking.start(info, "avoidance.scanner")
        body = body_of(info)
        try:
            self._method = self._make(body, info.period_s)
        except ScenarioError as error:  # of a method of one's own, which is built only here
            raise ValueError(str(error)) from error
        self._levels, self._flies = ObstacleLevels(self.settings, body, info.latency_s), body.flies
        self._was_near = False  # something, in the last scan that was good and not empty
        self._empty_ns: int | None = None  # since when all of that is gone
        self._speed, self._now = 0.0, (0.0, 0.0)  # m/s; m/s ahead and rad/s: as last commanded
        self._told: dict[str, float | str | bool] = {}
        self.notes, self.level = {}, 0

    def steer(self, obs: Observation, task: Task) -> Decision:
        """What to do at a tick instead of what the task would do."""
        view = self._looking.look(obs)
        if view is None or not view.ranges.any():
            return self._told_of(BLIND)
        decision = self._method.decide(view, task._replace(now=self._now))
        return self._told_of(self._limited(obs, view, decision, math.hypot(*task.velocity)))

    def drive(
        self, obs: Observation, speeds: tuple[float, float], aim: Point | None = None, leader: Point | None = None
    ) -> Decision:
        """The same for a vehicle on wheels: speeds in m/s and rad/s; ``aim`` and ``leader`` are m, world."""
        v, w = speeds
        return self.steer(obs, Task((v, 0.0), w, _seen(obs, aim), _seen(obs, leader), self.settings.max_speed))

    def limit(self, obs: Observation, speeds: tuple[float, float]) -> Decision:
        """For a vehicle on wheels that is to go nowhere, but has not come to rest: only its speed is limited."""
        v, w = speeds
        view = self._looking.look(obs)
        if view is None or not view.ranges.any():
            return self._told_of(BLIND)
        return self._told_of(self._limited(obs, view, Decision((v, 0.0), w, "task"), abs(v)))

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

    def _told_of(self, decision: Decision) -> Decision:
        """Note the changes of a decision; returns it."""
        self._speed, self._now = math.hypot(*decision.velocity), (decision.velocity[0], decision.yaw_rate)
        now: dict[str, float | str | bool] = {"mode": decision.mode, "level": self.level}
        self.notes = {name: value for name, value in now.items() if value != self._told.get(name)}
        self._told = now
        return decision


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
        rotate2(requested[0], requested[1], -yaw), yaw_rate, _seen(obs, aim), _seen(obs, leader), steering.settings.max_speed
    )
    decision = steering.steer(obs, task)
    climb = 0.0 if decision.mode == "blind" else requested[2]
    return SteeredMotion((*rotate2(*decision.velocity, yaw), climb), decision.yaw_rate, decision.mode)


def _seen(obs: Observation, place: Point | None) -> Point | None:
    """A world point in the body frame, m."""
    if place is None:
        return None
    (x, y, _), yaw = obs.state.position, obs.state.yaw
    return rotate2(place[0] - x, place[1] - y, -yaw)
