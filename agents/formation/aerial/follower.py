"""Aerial follower: keeps a place beside a leader that it knows from radio reports only."""

import math
from typing import Any, Literal

from vcmvsp.agents.avoidance.steering import around
from vcmvsp.agents.formation.aerial.flight import GAIN, YAW_GAIN, Airborne, Flight, along, check_flies, limited, told
from vcmvsp.agents.formation.followers.follower import FormationFollower
from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.team.shape import Formation, Slot
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Positive, Vec3, Velocity


class AerialFollower(FormationFollower):
    """Keep a place beside ``leader``, or in a ``formation``; hover before the first report and after the last.

    Velocity ``v = v_slot + gain (slot - p)``: the slot lies in the leader's frame, turned by its heading alone, and moves with
    it, so the error decays with ``exp(-gain t)`` for any motion of the leader. A leader on wheels has height 0. The estimators
    ``acc`` and ``plan`` act as ``dr``.

    Notes, besides those of every `FormationFollower`, the estimated error ``error_m`` at every tick.

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
            raise ValueError("slot says where to be beside a leader; a formation does so itself: give just one of them")
        if formation is None and above:
            raise ValueError("above needs a formation; beside a leader, slot has a height")
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
        """Refuse wheels; find the leader or the place in the team."""
        check_flies(info)
        super().start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Follow the newest report, around what stands in the way."""
        newest, velocity = self._hear(obs), obs.state.velocity
        speed, yaw_rate = along(velocity, obs.state.yaw), obs.state.angular_velocity[2]
        self._tell(obs, radio, speed, yaw_rate, **told(obs, velocity))
        age_s = self._age_s(obs.time_ns, newest)
        lead = None if newest is None or age_s >= self.timeout_s else self._airborne.flight(newest, age_s)
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
        left = max(0.0, 1.0 - (now_ns - self._fading_ns) / 1e9 / self.fade_s)
        return self._last[0] * left, self._last[1] * left, self._last[2] * left
