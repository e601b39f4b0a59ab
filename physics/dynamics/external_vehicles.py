"""External vehicles: rows of an engine with motion from outside (`cosim.federate.ExternalMotion`).

Their states are requested once at every instant of a publication. In between they move on straight at their last velocities and
turn about the vertical; nothing in the simulation changes that.
"""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import ExternalMotion
from vcmvsp.cosim.types import Array, Vec3, VehicleState
from vcmvsp.physics.engine.interface import Bodiless, BodyMotion, side_by_side, still
from vcmvsp.physics.sensors.wheel_odometry import WheelOdometry
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.scene import rotations

_UNIT = 1e-3  # tolerance of the norm of a quaternion


class ExternalEngine(Bodiless):
    """Motion of the external vehicles.

    Args:
        source: of their states.
        vehicles: in the order of ``source.names``, with their poses before the first update.
    """

    def __init__(self, source: ExternalMotion, vehicles: Sequence[VehicleSpec]) -> None:
        self._source, self.names = source, tuple(spec.name for spec in vehicles)
        if self.names != tuple(source.names):
            raise ValueError(f"of vehicles moved from outside, {source.names}, the run has {self.names}, in this order")
        positions = np.array([spec.start for spec in vehicles], float).reshape(-1, 3)
        self._motion = still(positions, np.array([spec.heading for spec in vehicles], float))
        self._yaw_rate = np.zeros(len(vehicles))  # rad/s, about the vertical
        self._updated_ns: int | None = None
        self._now_ns = 0

    def update(self, now_ns: int) -> None:
        """Request the states of this instant; no effect in a second call at the same instant."""
        if now_ns == self._updated_ns:
            return
        states = self._source.states(now_ns)
        self._check(now_ns, states)
        velocity, spin = _rows(states, "velocity", 3), _rows(states, "angular_velocity", 3)
        acceleration = np.zeros_like(velocity)
        if self._updated_ns is not None:
            acceleration = (velocity - self._motion.velocity) / ((now_ns - self._updated_ns) / SECOND_NS)
        self._motion = self._motion._replace(
            position=_rows(states, "position", 3),
            velocity=velocity,
            attitude=_rows(states, "attitude", 4),
            angular_velocity=spin,
            acceleration=acceleration,
        )
        self._yaw_rate = (rotations(self._motion.attitude)[:, 2] * spin).sum(axis=1)
        self._updated_ns = now_ns

    def at(self, now_ns: int) -> tuple[BodyMotion, Array]:
        """Motion at a time since the last update, and yaw rates (n,) about the vertical, rad/s."""
        motion, span_s = self._motion, (now_ns - (self._updated_ns or 0)) / SECOND_NS
        if span_s == 0.0:
            return motion, self._yaw_rate  # to the last bit
        half = 0.5 * span_s * self._yaw_rate
        c, s = np.cos(half), np.sin(half)
        w, x, y, z = motion.attitude.T
        attitude = side_by_side(c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
        return motion._replace(position=motion.position + span_s * motion.velocity, attitude=attitude), self._yaw_rate

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Physics does not command external vehicles."""
        raise NotImplementedError

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Physics does not command external vehicles."""
        raise NotImplementedError

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""
        self._now_ns = to_ns

    def read(self) -> BodyMotion:
        """Motion now, without wheels: exactly the received states at the instant of an update."""
        return self.at(self._now_ns)[0]

    def _check(self, now_ns: int, states: Sequence[VehicleState]) -> None:
        at = f"at {now_ns / SECOND_NS:.9g} s"
        if len(states) != len(self.names):
            problem = f"{len(states)} states of the {len(self.names)} vehicles moved from outside, {at}"
            raise FederateError("physics", problem)
        for name, state in zip(self.names, states, strict=True):
            numbers = (*state.position, *state.velocity, *state.attitude, *state.angular_velocity)
            if not np.isfinite(numbers).all():
                raise FederateError("physics", f"the received state of {name} {at} is not finite: {state}")
            if not abs(float(np.linalg.norm(state.attitude)) - 1.0) < _UNIT:
                raise FederateError("physics", f"the received attitude of {name} {at} is no rotation: {state.attitude}")


def check_wheel_sensors(vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse wheel odometry on external vehicles: physics does not turn their wheels."""
    for spec in vehicles:
        for name, sensor in spec.sensors.items():
            if isinstance(sensor, WheelOdometry):
                problem = f"{spec.name} is not moved by physics, which cannot count its wheels' turns: leave this sensor out"
                raise ScenarioError(problem, key=f"vehicle.{spec.name}.sensors.{name}")


def _rows(states: Sequence[VehicleState], name: str, width: int) -> Array:
    return np.array([getattr(each, name) for each in states], float).reshape(-1, width)
