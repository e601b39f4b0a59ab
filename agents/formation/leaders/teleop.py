"""A leader that a person drives."""

from typing import Any

from vcmvsp.agents.formation.leaders.input_devices import KEYBOARD, Device, DeviceLostError, open_device
from vcmvsp.agents.formation.leaders.leader import Leader, towards
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.types import Count, NonNegative, Positive, Probability


class Teleop(Leader):
    """Drive by keyboard, gamepad or table; changes of speed are ramped.

    A person needs a run at wall pace (``vcmvsp run --realtime``). Notes at every tick ``asked_v`` and ``asked_w``, the
    requested speeds before the ramp, and ``status`` ``device lost`` after a loss of the device, which stops the vehicle for
    good. A table of the times and requested speeds repeats a drive.

    Args:
        device: ``keyboard`` (of the terminal: W A S D or the arrows, a quarter of the limit each; space stops), a joystick such
            as ``/dev/input/js0``, or a table ``FILE.csv`` with rows ``t_s,v,w``.
        speed: fastest, m/s.
        max_reverse: fastest reverse, m/s.
        yaw_rate: fastest turning, rad/s.
        acceleration: of the ramp, m/s2.
        yaw_acceleration: of the ramp, rad/s2.
        axes: of a joystick: numbers of the axes for speed and yaw rate.
        deadband: of a joystick: share of an axis about its middle that counts as zero.
        leading: tell, plan_ticks, estimator, horizon_s, fade_s, sending, formation, avoidance, clock_bound_s, as of `Leader`.
    """

    def __init__(
        self,
        device: str = KEYBOARD,
        *,
        speed: Positive = 0.3,
        max_reverse: NonNegative = 0.1,
        yaw_rate: Positive = 0.5,
        acceleration: Positive = 0.3,
        yaw_acceleration: Positive = 0.6,
        axes: tuple[Count, Count] = (1, 0),
        deadband: Probability = 0.1,
        **leading: Any,
    ) -> None:
        super().__init__(**leading)
        if deadband == 1.0:
            raise ValueError("deadband = 1 leaves nothing of the axis; it must be below 1")
        self.device, self.speed, self.max_reverse, self.yaw_rate = device, speed, max_reverse, yaw_rate
        self.acceleration, self.yaw_acceleration = acceleration, yaw_acceleration
        self.axes, self.deadband = axes, deadband
        self._device: Device | None = None
        self._v = self._w = 0.0

    def start(self, info: VehicleInfo) -> None:
        """Open the device."""
        super().start(info)
        limits = self.speed, self.yaw_rate
        self._device = open_device(self.device, limits=limits, axes=self.axes, deadband=self.deadband)

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """The requested speeds, ramped."""
        v = w = 0.0
        if self._device is not None:
            try:
                v, w = self._device.read(obs.time_s)
            except DeviceLostError:
                self.close()
        if self._device is None:
            self.note(status="device lost")
        v_limited = max(-self.max_reverse, min(v, self.speed))
        w_limited = max(-self.yaw_rate, min(w, self.yaw_rate))
        self.note(asked_v=v_limited, asked_w=w_limited)
        self._v = towards(self._v, v_limited, self.acceleration * self._period_s)
        self._w = towards(self._w, w_limited, self.yaw_acceleration * self._period_s)
        return self._v, self._w

    def close(self) -> None:
        """Close the device."""
        device, self._device = self._device, None
        if device is not None:
            device.close()
