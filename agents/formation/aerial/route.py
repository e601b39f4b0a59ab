"""Aerial leader: along way-points, or straight on without end."""

import math
from typing import Any, Literal

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import around
from vcmvsp.agents.formation.aerial.flight import GAIN, YAW_GAIN, Airborne, along, check_flies, limited, told
from vcmvsp.agents.formation.leaders.leader import Leader
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import NonNegative, Positive, Vec3, Velocity

Heading = Literal["keep", "course"]


class AerialRoute(Leader):
    """Fly from point to point, each in a straight line, slow down towards the last one, and stay there.

    Towards a point at a distance d: ``min(speed, 0.8 d)``. With no way it flies on in one direction at its first height.

    The course is that of the line from point to point; where that leads up or down, it is that of before.

    Noted: ``point``, the number of the next one, whenever it changes, and ``status`` ``arrived``.

    Args:
        way: points, x, y, z, m, world; default: none.
        course_deg: in place of a way: the direction of flight, degrees counter-clockwise from east.
        loop: after the last point comes the first again.
        speed: m/s.
        arrive_m: a point is reached from this near.
        heading: ``keep`` that of the start, or turn to the ``course``.
        yaw_rate: fastest turning, rad/s.
        estimator: ``hold`` or ``dr``, as of every `Leader`: reports in the air hold nothing for others.
        horizon_s: as of every `Leader`.
        fade_s: as of every `Leader`.
        sending: as of every `Leader`.
        formation: as of every `Leader`.
        avoidance: as of every `Leader`; it sees level, and so gets around things level.
        clock_bound_s: as of every `Leader`.
    """

    def __init__(
        self,
        way: tuple[Vec3, ...] = (),
        *,
        course_deg: float | None = None,
        loop: bool = False,
        speed: Positive = 0.3,
        arrive_m: Positive = 0.1,
        heading: Heading = "keep",
        yaw_rate: Positive = 1.0,
        estimator: str | Estimator = "dr",
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        sending: Sending | None = None,
        formation: Formation | None = None,
        avoidance: Avoidance | None = None,
        clock_bound_s: NonNegative = 0.0,
    ) -> None:
        inner = estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s)
        if getattr(inner, "needs", ()):
            raise ScenarioError(f"{estimator!r} needs what no report in the air holds; take 'hold' or 'dr'", key="estimator")
        airborne = Airborne(inner)
        super().__init__(
            estimator=airborne, sending=sending, formation=formation, avoidance=avoidance, clock_bound_s=clock_bound_s
        )
        if bool(way) == (course_deg is not None):
            raise ValueError("give either a way of at least one point, or a course_deg to fly on for ever")
        self.way, self.loop, self.speed, self.arrive_m = way, loop, speed, arrive_m
        self.course_deg, self.heading, self.yaw_rate = course_deg, heading, yaw_rate
        self._next = 0
        self._from: Vec3 | None = None  # where the line to the next point begins
        self._kept: tuple[float, float] | None = None  # height of the start, m, and the heading to keep, rad

    def start(self, info: VehicleInfo) -> None:
        """Reject wheels; find the team."""
        check_flies(info)
        super().start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Fly on and report the motion from now on."""
        before = None if self._kept is None else self._next
        self._from = self._from or obs.state.position
        height, yaw = self._kept or (obs.state.position[2], obs.state.yaw)
        target = self._along_the_way(obs) if self.way else self._on(obs, height)
        arrived = self.way and self._next == len(self.way)
        if self.heading == "course" and not arrived:
            yaw = self._course(self._from, yaw)
        self._kept = height, yaw
        w = max(-self.yaw_rate, min(YAW_GAIN * wrap(yaw - obs.state.yaw), self.yaw_rate))
        velocity, w, _ = around(self._steering, obs, target, w, self.aim(obs))
        if self._steering is not None:
            self.note(**self._steering.notes)
        if self.way and self._next != before:
            self.note(point=self._next)
            if arrived:
                self.note(status="arrived")
        more: dict[str, Any] = {} if self._team is None else self._lead(self._team, obs)
        self._reporter.tell(radio, obs, along(velocity, obs.state.yaw), w, **more, **told(obs, velocity))
        return Velocity(linear=velocity, yaw_rate=w)

    def aim(self, obs: Observation) -> tuple[float, float] | None:
        """The next point, seen from above."""
        return self.way[self._next][:2] if self._next < len(self.way) else None

    def _along_the_way(self, obs: Observation) -> Vec3:
        here = obs.state.position
        for _ in self.way:  # at most once round
            if self._next == len(self.way) or math.dist(here, self.way[self._next]) > self.arrive_m:
                break
            self._from = self.way[self._next]
            self._next = (self._next + 1) % len(self.way) if self.loop else self._next + 1
        x, y, z = self.way[min(self._next, len(self.way) - 1)]
        return limited((GAIN * (x - here[0]), GAIN * (y - here[1]), GAIN * (z - here[2])), self.speed)

    def _course(self, begin: Vec3, before: float) -> float:
        """Heading of the present line, rad; the former one if the line is vertical."""
        if not self.way:
            return math.radians(self.course_deg or 0.0)
        x, y = (there - here for there, here in zip(self.way[self._next][:2], begin[:2], strict=True))
        return math.atan2(y, x) if math.hypot(x, y) > self.arrive_m else before

    def _on(self, obs: Observation, height: float) -> Vec3:
        course = math.radians(self.course_deg or 0.0)
        climb = max(-self.speed, min(GAIN * (height - obs.state.position[2]), self.speed))
        return self.speed * math.cos(course), self.speed * math.sin(course), climb
