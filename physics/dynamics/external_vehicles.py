"""Vehicles that something else than physics moves (`cosim.federate.ExternalMotion`), as rows of an engine.

They are asked for at every instant at which physics looks, once. From there on they go straight on as fast as they went, and go
on turning about the vertical, until they are asked for again; nothing in the simulation changes that.
"""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import ExternalMotion
from vcmvsp.cosim.types import Array, Vec3, VehicleState
from vcmvsp.physics.engine.interface import Bodiless, Motion, side_by_side, still
from vcmvsp.physics.sensors.wheel_odometry import WheelOdometry
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.scene import rotations

_UNIT = 1e-3  # by which the length of a quaternion may differ from 1


class Reflected(Bodiless):
    """How they move.

    Args:
        outside: who says it.
        vehicles: those of them that are named there, in the scenario's order; where they are before anybody was asked.
    """

    def __init__(self, outside: ExternalMotion, vehicles: Sequence[VehicleSpec]) -> None:
        self._outside, self.names = outside, tuple(spec.name for spec in vehicles)
        if self.names != tuple(outside.names):
            raise ValueError(f"of vehicles moved from outside, {outside.names}, the run has {self.names}, in this order")
        positions = np.array([spec.start for spec in vehicles], float).reshape(-1, 3)
        self._told = still(positions, np.array([spec.heading for spec in vehicles], float))
        self._yaw_rate = np.zeros(len(vehicles))  # rad/s, about the vertical
        self._asked_ns: int | None = None
        self._told_ns = self._now_ns = 0

    def ask(self, now_ns: int) -> None:
        """Have it said how they move now; asking again for the same instant asks nobody."""
        if now_ns == self._asked_ns:
            return
        states = self._outside.states(now_ns)
        self._check(now_ns, states)
        before, n = self._told, len(self.names)
        velocity, spin = _rows(states, "velocity", 3), _rows(states, "angular_velocity", 3)
        gain = np.zeros((n, 3))
        if self._asked_ns is not None:
            gain = (velocity - before.velocity) / ((now_ns - self._asked_ns) / SECOND_NS)
        self._told = before._replace(
            position=_rows(states, "position", 3),
            velocity=velocity,
            attitude=_rows(states, "attitude", 4),
            angular_velocity=spin,
            acceleration=gain,
        )
        self._yaw_rate = (rotations(self._told.attitude)[:, 2] * spin).sum(axis=1)
        self._asked_ns = self._told_ns = now_ns

    def at(self, now_ns: int) -> tuple[Motion, Array]:
        """How they move at a time since they were asked for, and their yaw rates (n,) about the vertical, rad/s."""
        told, span_s = self._told, (now_ns - self._told_ns) / SECOND_NS
        if span_s == 0.0:
            return told, self._yaw_rate  # to the last bit
        half = 0.5 * span_s * self._yaw_rate
        c, s = np.cos(half), np.sin(half)
        w, x, y, z = told.attitude.T
        attitude = side_by_side(c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
        return told._replace(position=told.position + span_s * told.velocity, attitude=attitude), self._yaw_rate

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Physics does not command them."""
        raise NotImplementedError

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Physics does not command them."""
        raise NotImplementedError

    def advance(self, to_ns: int) -> None:
        """Let them go on to ``to_ns``."""
        self._now_ns = to_ns

    def read(self) -> Motion:
        """How they move now: as it was said, if they were asked for now. They have no wheels that physics knows of."""
        return self.at(self._now_ns)[0]

    def _check(self, now_ns: int, states: Sequence[VehicleState]) -> None:
        at = f"at {now_ns / SECOND_NS:.9g} s"
        if len(states) != len(self.names):
            problem = f"{len(states)} states were told of the {len(self.names)} vehicles moved from outside, {at}"
            raise FederateError("physics", problem)
        for name, state in zip(self.names, states, strict=True):
            numbers = (*state.position, *state.velocity, *state.attitude, *state.angular_velocity)
            if not np.isfinite(numbers).all():
                raise FederateError("physics", f"the state that was told of {name} {at} is not finite: {state}")
            if not abs(float(np.linalg.norm(state.attitude)) - 1.0) < _UNIT:
                raise FederateError("physics", f"the attitude that was told of {name} {at} is no rotation: {state.attitude}")


def check_shown(vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse sensors that count the turns of wheels which physics does not turn."""
    for spec in vehicles:
        for name, sensor in spec.sensors.items():
            if isinstance(sensor, WheelOdometry):
                problem = f"{spec.name} is not moved by physics, which cannot count its wheels' turns: leave this sensor out"
                raise ScenarioError(problem, key=f"vehicle.{spec.name}.sensors.{name}")


def _rows(states: Sequence[VehicleState], name: str, width: int) -> Array:
    return np.array([getattr(each, name) for each in states], float).reshape(-1, width)
