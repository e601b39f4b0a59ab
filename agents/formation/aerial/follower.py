"""Aerial follower: keeps a place beside a leader that it knows from radio reports only."""

import math
from typing import Literal

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.steering import AvoidanceSteering, around
from vcmvsp.agents.formation.aerial.flight import GAIN, YAW_GAIN, Airborne, Flight, along, check_flies, limited, told
from vcmvsp.agents.formation.reports.prediction import Estimator, estimator_of
from vcmvsp.agents.formation.reports.report import Report
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.formation import Formation
from vcmvsp.agents.formation.team.membership import Membership
from vcmvsp.agents.formation.team.passage import scanners
from vcmvsp.agents.formation.team.shape import Slot
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Follows, NonNegative, Positive, Vec3, Velocity

STILL: Vec3 = (0.0, 0.0, 0.0)


class AerialFollower(Agent):
    """Keep a place beside ``leader``, or in a ``formation``; hover before the first report and after the last.

    Velocity ``v = v_slot + gain (slot - p)``: the slot lies in the leader's frame, turned by its heading alone, and moves with
    it, so the error decays with ``exp(-gain t)`` for any motion of the leader. A leader on wheels has height 0.

    Notes at every tick: ``status`` (``waiting``, ``following``, ``leader lost``; ``leading`` in a team without a living
    ancestor), ``age_s`` of the report in use, the estimated error ``error_m`` and, from the first one on, the number of
    unusable messages, ``refused``. In a team also, when they change, ``parent`` (empty for a leading member) and ``shape``.

    Args:
        leader: name of the leader, which must report itself. Not with a formation.
        slot: place in the leader's frame, x forward, y left, z up, m; needed with ``leader``.
        formation: shape and topology of the team.
        above: in a formation: height above the parent, m.
        gain: 1/s.
        heading: ``keep`` that of the start, or take that of the ``leader``.
        estimator: ``hold`` or ``dr``, ``module:Class``, ``file.py:Class`` or an object with ``predict(report, age_s)``.
        max_speed: limit of the commanded speed, m/s; default: none but the vehicle's own.
        max_yaw_rate: limit of the commanded yaw rate, rad/s.
        horizon_s: how long ``dr`` uses the last reported speeds, s.
        fade_s: time in which they fade to zero after that, and in which this vehicle stops without a leader, s.
        timeout_s: age of the newest report at which the leader counts as lost, s.
        heartbeat_s: in a formation: silence after which a parent is replaced by its own parent, s (`heartbeat_for`).
        clock_bound_s: largest lead of the leader's clock, s; reports from further in the future are rejected.
        broadcast: report itself to followers. Default: in a formation with children, a heartbeat or changes of shape;
            otherwise no.
        sending: when it reports.
        avoidance: method of avoidance on the way to its place; default: none.
    """

    def __init__(
        self,
        leader: str | None = None,
        slot: Vec3 | None = None,
        *,
        formation: Formation | None = None,
        above: float = 0.0,
        gain: Positive = GAIN,
        heading: Literal["keep", "leader"] = "keep",
        estimator: str | Estimator = "dr",
        max_speed: Positive | None = None,
        max_yaw_rate: Positive = 1.0,
        horizon_s: NonNegative = 2.0,
        fade_s: Positive = 1.0,
        timeout_s: Positive = 3.0,
        heartbeat_s: Positive | None = None,
        clock_bound_s: NonNegative = 0.0,
        broadcast: bool | None = None,
        sending: Sending | None = None,
        avoidance: Avoidance | None = None,
    ) -> None:
        self.formation, self.above, self.gain, self.heading = formation, above, gain, heading
        self.estimator = Airborne(estimator_of(estimator, horizon_s=horizon_s, fade_s=fade_s))
        self.max_speed = math.inf if max_speed is None else max_speed
        self.max_yaw_rate, self.fade_s, self.timeout_s = max_yaw_rate, fade_s, timeout_s
        self._member = Membership(
            leader,
            formation,
            keep=self._keep_beside,
            estimator=self.estimator,
            broadcast=broadcast,
            sending=sending,
            heartbeat_s=heartbeat_s,
            clock_bound_s=clock_bound_s,
        )
        if (slot is None) == (formation is None):
            raise ValueError("slot says where to be beside a leader; a formation does so itself: give just one of them")
        if formation is None and above:
            raise ValueError("above needs a formation; beside a leader, slot has a height")
        self._steering = None if avoidance is None else AvoidanceSteering(avoidance)
        self.sensors = scanners(avoidance, formation) or self.sensors
        self._yaw: float | None = None  # of the start
        self._last: Vec3 = STILL  # the last command that answered a report
        self._fading_ns: int | None = None  # since when that fades
        self._keep(leader, slot or STILL)

    def start(self, info: VehicleInfo) -> None:
        """Refuse wheels, a leader that does not take part, and a formation that does not fit; find the place in it."""
        check_flies(info)
        if self._steering is not None:
            self._steering.start(info)
        self._member.start(info, "aerial_route")
        self.note(**self._member.notes)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report, around what stands in the way."""
        newest, velocity = self._member.hear(obs), obs.state.velocity
        self.note(**self._member.notes)
        speed, yaw_rate = along(velocity, obs.state.yaw), obs.state.angular_velocity[2]
        self._member.tell(obs, radio, speed, yaw_rate, **told(obs, velocity))
        lead = self._estimate(obs, newest)
        if lead is None:
            decision = around(self._steering, obs, self._faded(obs.time_ns), self._turning(obs, None))
        else:
            place, velocity = self._place(lead)
            off = [there - here for there, here in zip(place, obs.state.position, strict=True)]
            self.note(error_m=math.hypot(*off))
            vx, vy, vz = (v + self.gain * error for v, error in zip(velocity, off, strict=True))
            decision = around(self._steering, obs, (vx, vy, vz), self._turning(obs, lead), place[:2], lead.position[:2])
        # Limited last, as a field adds up its pushes and the way to go: in that sum, what is far off its place hurries more.
        velocity = limited(decision.velocity, self.max_speed)
        if lead is not None:
            self._last, self._fading_ns = velocity, None
        if self._steering is not None:
            self.note(**self._steering.notes)
        return Velocity(linear=velocity, yaw_rate=decision.yaw_rate)

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        """Receive reports and send none, so that this vehicle has no followers while it does something else."""
        self._member.hear(obs)
        self.note(**self._member.notes)
        self._last, self._fading_ns = obs.state.velocity, None  # without a leader it stops from its present motion

    def _estimate(self, obs: Observation, newest: Report | None) -> Flight | None:
        """Estimated state of the leader now; None while it is unknown."""
        if newest is None:
            self.note(status="waiting" if self.leader else "leading")
            return None
        age_s = max(0, obs.time_ns - newest.t_ns) / 1e9
        lost = age_s >= self.timeout_s
        self.note(status="leader lost" if lost else "following", age_s=age_s)
        return None if lost else self.estimator.flight(newest, age_s)

    def _place(self, lead: Flight) -> tuple[Vec3, Vec3]:
        """The place to keep, m, and its velocity, m/s, world; it rotates with the leader's heading."""
        (x, y, z), (vx, vy, vz), w = lead.position, lead.velocity, lead.yaw_rate
        slot_x, slot_y = rotate2(self.slot[0], self.slot[1], lead.yaw)
        return (x + slot_x, y + slot_y, z + self.slot[2]), (vx - w * slot_y, vy + w * slot_x, vz)

    def _turning(self, obs: Observation, lead: Flight | None) -> float:
        """Yaw rate towards the heading to keep, rad/s."""
        if self._yaw is None:
            self._yaw = obs.state.yaw
        rate = 0.0
        if self.heading == "leader" and lead is not None:
            self._yaw, rate = lead.yaw, lead.yaw_rate
        return max(-self.max_yaw_rate, min(rate + YAW_GAIN * wrap(self._yaw - obs.state.yaw), self.max_yaw_rate))

    def _faded(self, now_ns: int) -> Vec3:
        """The last command before the leader was lost, reduced with time, m/s."""
        self._fading_ns = now_ns if self._fading_ns is None else self._fading_ns
        left = max(0.0, 1.0 - (now_ns - self._fading_ns) / 1e9 / self.fade_s)
        return self._last[0] * left, self._last[1] * left, self._last[2] * left

    def _keep(self, leader: str | None, slot: Vec3) -> None:
        """Set the place to keep: ``slot`` (m) in the frame of ``leader``; None: no leader."""
        self.leader, self.slot = leader, slot
        self.follows = None if leader is None else Follows(leader=leader, slot=slot[:2])

    def _keep_beside(self, parent: str | None, slot: Slot) -> None:
        self._keep(parent, STILL if parent is None else (*slot, self.above))
