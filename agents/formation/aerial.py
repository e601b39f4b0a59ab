"""Leader and follower in the air: along way-points or straight on, and beside a leader known from radio reports only.

A ground vehicle moves along its heading, so a pose and two speeds describe it. An aerial vehicle moves in any direction:
its reports also hold ``vx vy vz z``; their ``v`` is the speed along the heading. So a ground vehicle can follow an aerial one
that flies along its heading, and an aerial vehicle can follow any ground vehicle.
"""

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import around
from vcmvsp.agents.formation.followers.follower import FormationFollower
from vcmvsp.agents.formation.leaders.leader import Leader
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.report import LeaderState, Report, plausible
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation, Slot
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import NonNegative, Positive, Vec3, Velocity

GAIN = 0.8  # 1/s, speed towards a point for each metre
YAW_GAIN = 1.0  # 1/s, yaw rate for each rad that the heading is off
KEYS = ("vx", "vy", "vz", "z")


class Flight(NamedTuple):
    """Estimated state of a reporting vehicle."""

    position: Vec3  # m, world; of one on wheels z is 0
    velocity: Vec3  # m/s, world
    yaw: float  # rad
    yaw_rate: float  # rad/s


class Airborne:
    """Estimator for ground and aerial senders: moves each coordinate of an aerial one by its own speed.

    The inner estimator sets how long an old speed counts; for a ground sender it makes the whole estimate. ``acc`` and ``plan``
    do not exist in the air: they act as ``dr``.
    """

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner

    def predict(self, report: Report, age_s: float) -> LeaderState:
        """Horizontal state of the sender ``age_s`` seconds after the report was valid: m, rad, m/s, rad/s, world."""
        if _aloft(report.body) is None:
            return self.inner.predict(report, age_s)
        (x, y, _), velocity, yaw, w = self.flight(report, age_s)
        return LeaderState(x, y, yaw, along(velocity, yaw), w)

    def flight(self, report: Report, age_s: float) -> Flight:
        """The state of the sender ``age_s`` seconds (>= 0) after the report was valid."""
        aloft = _aloft(report.body)
        if aloft is None:
            x, y, yaw, v, w = self.inner.predict(report, age_s)
            return Flight((x, y, 0.0), (v * math.cos(yaw), v * math.sin(yaw), 0.0), yaw, w)
        # A unit report of 1 m/s along x gives the time that speeds last and their remaining share.
        unit = Report(report.t_ns, LeaderState(0.0, 0.0, 0.0, 1.0, 0.0), {})
        lasted_s, _, _, share, _ = self.inner.predict(unit, age_s)
        (x, y, yaw, _, w), (vx, vy, vz, z) = report.state, aloft
        place = (x + vx * lasted_s, y + vy * lasted_s, z + vz * lasted_s)
        return Flight(place, (vx * share, vy * share, vz * share), wrap(yaw + w * lasted_s), w * share)


def check_flies(info: VehicleInfo) -> None:
    """Reject (ValueError) a vehicle on wheels, which would take a world velocity for a body velocity."""
    if info.body is not None and not info.body.flies:
        raise ValueError(f"{info.name} drives on wheels, but this agent is for vehicles that fly (point, quadrotor)")


def report_keys(obs: Observation, velocity: Vec3) -> dict[str, float]:
    """Additional keys of a report of a vehicle that moves at ``velocity`` m/s, world."""
    return dict(zip(KEYS, (*velocity, obs.state.position[2]), strict=True))


def along(velocity: Vec3, yaw: float) -> float:
    """Component of a velocity along a heading, m/s."""
    return velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw)


def limited(velocity: Vec3, most: float) -> Vec3:
    """The velocity, reduced to ``most`` m/s at most."""
    share = most / speed if (speed := math.hypot(*velocity)) > most else 1.0
    return velocity[0] * share, velocity[1] * share, velocity[2] * share


def _aloft(body: Mapping[str, Any]) -> tuple[float, float, float, float] | None:
    vx, vy, vz, z = values = [body.get(key) for key in KEYS]
    return (vx, vy, vz, z) if plausible(values) else None  # type: ignore[return-value]


Heading = Literal["keep", "course"]


class AerialRoute(Leader):
    """Fly from point to point, each in a straight line, slow down towards the last one, and stay there.

    Speed towards a point at a distance d: ``min(speed, 0.8 d)``. Without a way it flies in one direction at its start height.

    The course is the direction of the line from point to point; on a vertical line the former course holds.

    Noted: ``point``, the number of the next one, whenever it changes, and ``status`` ``arrived``.

    Args:
        way: points, x, y, z, m, world; default: none.
        course_deg: in place of a way: the direction of flight, degrees counter-clockwise from east.
        loop: after the last point, fly to the first again.
        speed: m/s.
        arrive_m: a point is reached from this near.
        heading: ``keep`` that of the start, or turn to the ``course``.
        yaw_rate: fastest turning, rad/s.
        estimator: ``hold`` or ``dr``, as of every `Leader`: reports in the air hold nothing for others.
        avoidance: as of every `Leader`; it sees level, and so gets around things level.
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
            raise ScenarioError(f"{estimator!r} is for vehicles on wheels; choose 'hold' or 'dr'", key="estimator")
        airborne = Airborne(inner)
        super().__init__(
            estimator=airborne, sending=sending, formation=formation, avoidance=avoidance, clock_bound_s=clock_bound_s
        )
        if bool(way) == (course_deg is not None):
            raise ValueError("set either way (at least one point) or course_deg (fly on without end)")
        self.way, self.loop, self.speed, self.arrive_m = way, loop, speed, arrive_m
        self.course_deg, self.heading, self.yaw_rate = course_deg, heading, yaw_rate
        self._next = 0
        self._from: Vec3 | None = None  # where the line to the next point begins
        self._hold: tuple[float, float] | None = None  # height of the start, m, and the heading to keep, rad

    def start(self, info: VehicleInfo) -> None:
        """Reject a ground vehicle; find the team."""
        check_flies(info)
        super().start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Fly on and report the motion from now on."""
        before = None if self._hold is None else self._next
        self._from = self._from or obs.state.position
        height, yaw = self._hold or (obs.state.position[2], obs.state.yaw)
        target = self._along_the_way(obs) if self.way else self._on(obs, height)
        arrived = self.way and self._next == len(self.way)
        if self.heading == "course" and not arrived:
            yaw = self._course(self._from, yaw)
        self._hold = height, yaw
        w = max(-self.yaw_rate, min(YAW_GAIN * wrap(yaw - obs.state.yaw), self.yaw_rate))
        velocity, w, _ = around(self._steering, obs, target, w, self.aim(obs))
        if self._steering is not None:
            self.note(**self._steering.notes)
        if self.way and self._next != before:
            self.note(point=self._next)
            if arrived:
                self.note(status="arrived")
        more: dict[str, Any] = {} if self._team is None else self._lead(self._team, obs)
        self._reporter.tell(radio, obs, along(velocity, obs.state.yaw), w, **more, **report_keys(obs, velocity))
        return Velocity(linear=velocity, yaw_rate=w)

    def aim(self, obs: Observation) -> tuple[float, float] | None:
        """Horizontal position of the next point of the way, x, y, m, world; None: there is no next point."""
        return self.way[self._next][:2] if self._next < len(self.way) else None

    def _along_the_way(self, obs: Observation) -> Vec3:
        position = obs.state.position
        for _ in self.way:  # at most once round
            if self._next == len(self.way) or math.dist(position, self.way[self._next]) > self.arrive_m:
                break
            self._from = self.way[self._next]
            self._next = (self._next + 1) % len(self.way) if self.loop else self._next + 1
        x, y, z = self.way[min(self._next, len(self.way) - 1)]
        return limited((GAIN * (x - position[0]), GAIN * (y - position[1]), GAIN * (z - position[2])), self.speed)

    def _course(self, begin: Vec3, before: float) -> float:
        """Heading of the present line, rad; the former one if the line is vertical."""
        if not self.way:
            return math.radians(self.course_deg or 0.0)
        x, y = (end - start for end, start in zip(self.way[self._next][:2], begin[:2], strict=True))
        return math.atan2(y, x) if math.hypot(x, y) > self.arrive_m else before

    def _on(self, obs: Observation, height: float) -> Vec3:
        course = math.radians(self.course_deg or 0.0)
        climb = max(-self.speed, min(GAIN * (height - obs.state.position[2]), self.speed))
        return self.speed * math.cos(course), self.speed * math.sin(course), climb


class AerialFollower(FormationFollower):
    """Keep a place beside ``leader``, or in a ``formation``; hover before the first report and after the last.

    Velocity ``v = v_slot + gain (slot - p)``: the slot lies in the leader's frame, turned by its heading alone, and moves with
    it, so the error decays with ``exp(-gain t)`` for any motion of the leader. A leader on wheels has height 0. The estimators
    ``acc`` and ``plan`` act as ``dr``.

    Notes the estimated error ``error_m`` at every tick, besides the notes of every `FormationFollower`.

    Args:
        slot: place in the leader's frame, x forward, y left, z up, m; needed with ``leader``.
        above: in a formation: height above the parent, m.
        gain: 1/s.
        heading: ``keep`` that of the start, or take that of the ``leader``.
        max_yaw_rate: limit of the commanded yaw rate, rad/s.
        following: estimator, max_speed, horizon_s, fade_s, timeout_s, heartbeat_s, clock_bound_s, broadcast, sending,
            avoidance, as of `FormationFollower`.
    """

    LEADS = "aerial_route"

    def __init__(
        self,
        leader: str | None = None,
        slot: Vec3 | None = None,
        *,
        formation: Formation | None = None,
        above: float = 0.0,
        gain: Positive = GAIN,
        heading: Literal["keep", "leader"] = "keep",
        max_yaw_rate: Positive = 1.0,
        **following: Any,
    ) -> None:
        super().__init__(leader, formation=formation, **following)
        if (slot is None) == (formation is None):
            raise ValueError("slot and formation both define the place of the vehicle: leave one of them out")
        if formation is None and above:
            raise ValueError("above needs a formation; without one, set the height in slot")
        x, y, self.above = (0.0, 0.0, above) if slot is None else slot
        self.gain, self.heading, self.max_yaw_rate = gain, heading, max_yaw_rate
        self._yaw: float | None = None  # of the start
        self._last: Vec3 = (0.0, 0.0, 0.0)  # the last command that answered a report
        self._keep(leader, (x, y))

    def _wrapped(self, estimator: Estimator) -> Estimator:
        self._airborne = Airborne(estimator)
        return self._airborne

    def _keep(self, leader: str | None, slot: Slot, handle_m: float = 0.0) -> None:
        self.slot = slot
        super()._keep(leader, slot)

    def start(self, info: VehicleInfo) -> None:
        """Refuse a ground vehicle; find the leader or the place in the team."""
        check_flies(info)
        super().start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report, around obstacles."""
        newest, velocity = self._hear(obs), obs.state.velocity
        speed, yaw_rate = along(velocity, obs.state.yaw), obs.state.angular_velocity[2]
        self._tell(obs, radio, speed, yaw_rate, **report_keys(obs, velocity))
        age_s = self._age_s(obs.clock_ns, newest)
        lead = None if newest is None or age_s >= self.timeout_s else self._airborne.flight(newest, age_s)
        if lead is None:
            decision = around(self._steering, obs, self._faded(obs.time_ns), self._turning(obs, None))
        else:
            place, velocity = self._place(lead)
            errors = [target - own for target, own in zip(place, obs.state.position, strict=True)]
            self.note(error_m=math.hypot(*errors))
            vx, vy, vz = (v + self.gain * error for v, error in zip(velocity, errors, strict=True))
            decision = around(self._steering, obs, (vx, vy, vz), self._turning(obs, lead), place[:2], lead.position[:2])
        # Limited last: a potential field adds repulsions to this velocity, which must grow with the distance to the place.
        velocity = limited(decision.velocity, self.max_speed)
        if lead is not None:
            self._last, self._fading_ns = velocity, None
        if self._steering is not None:
            self.note(**self._steering.notes)
        return Velocity(linear=velocity, yaw_rate=decision.yaw_rate)

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        """Receive reports and send none, so that this vehicle has no followers while it does something else."""
        self._hear(obs)
        self._last, self._fading_ns = obs.state.velocity, None  # without a leader it stops from its present motion

    def _place(self, lead: Flight) -> tuple[Vec3, Vec3]:
        """The place to keep, m, and its velocity, m/s, world; it rotates with the leader's heading."""
        (x, y, z), (vx, vy, vz), w = lead.position, lead.velocity, lead.yaw_rate
        slot_x, slot_y = rotate2(*self.slot, lead.yaw)
        return (x + slot_x, y + slot_y, z + self.above), (vx - w * slot_y, vy + w * slot_x, vz)

    def _turning(self, obs: Observation, lead: Flight | None) -> float:
        """Yaw rate towards the heading to keep, rad/s."""
        if self._yaw is None:
            self._yaw = obs.state.yaw
        rate = 0.0
        if self.heading == "leader" and lead is not None:
            self._yaw, rate = lead.yaw, lead.yaw_rate
        return max(-self.max_yaw_rate, min(rate + YAW_GAIN * wrap(self._yaw - obs.state.yaw), self.max_yaw_rate))

    def _faded(self, now_ns: int) -> Vec3:
        self._fading_ns = now_ns if self._fading_ns is None else self._fading_ns
        share = max(0.0, 1.0 - (now_ns - self._fading_ns) / 1e9 / self.fade_s)
        return self._last[0] * share, self._last[1] * share, self._last[2] * share
