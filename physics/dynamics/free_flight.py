"""Quadrotors in free air: rotors, autopilot and rigid body, without contacts and without an engine for contacts."""

from collections.abc import Callable, Sequence
from itertools import groupby

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.engine import BodyMotion, FleetEngine, without_wheels
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.dynamics.wind import Floats
from vcmvsp.physics.vehicles.models import Quadrotor


class FreeFlightEngine(FleetEngine):
    """Moves n quadrotors through everything, otherwise as in Bullet to the last bit.

    Args:
        models, positions, headings: of the quadrotors.
        wind: wind at a time, ns, (n, 3) or (3,) m/s, world; the same object as long as it does not change.
        rate_hz: steps a second; ``advance`` goes to the nearest step.
        gravity: m/s2, downwards.
    """

    stepped = True

    def __init__(
        self,
        models: Sequence[Quadrotor],
        positions: Sequence[Vec3],
        headings: Sequence[float],
        *,
        wind: Callable[[int], Floats],
        rate_hz: float,
        gravity: float,
    ) -> None:
        self._fleet = QuadrotorFleet(models, positions, headings, gravity)
        self._wind = wind
        self._ticks, self._step, self._step_s = Ticks.rate(rate_hz), 0, 1.0 / rate_hz

    @property
    def fleet(self) -> QuadrotorFleet:
        """The quadrotors."""
        return self._fleet

    def expect(self, duration_ns: int, *, now: bool) -> None:
        """Compile the laws of quadrotors, if that pays or has to be done now."""
        self._fleet.expect(duration_ns / SECOND_NS / self._step_s, now=now)

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, world, and a yaw rate, rad/s."""
        self._fleet.set_velocity(row, linear, yaw_rate)

    def command_all(self, linear: Floats, yaw_rate: Floats) -> None:
        """`command` for all vehicles: velocities (n, 3) m/s, world, and yaw rates (n,) rad/s."""
        set_velocity = self._fleet.set_velocity
        for row, (velocity, rate) in enumerate(zip(linear.tolist(), yaw_rate.tolist(), strict=True)):
            set_velocity(row, velocity, rate)

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly to a position, m, and hover there."""
        self._fleet.set_waypoint(row, position, yaw, speed)

    def advance(self, to_ns: int) -> None:
        """Advance to the step nearest to ``to_ns``."""
        ticks = self._ticks
        until = (to_ns * ticks.per + ticks.ns // 2) // ticks.ns
        winds = [self._wind(ticks.at(number)) for number in range(self._step, until)]
        for _, group in groupby(winds, key=id):
            same = list(group)
            self._fleet.fly(len(same), self._step_s, same[0])
        self._step = max(until, self._step)

    def read(self) -> BodyMotion:
        """Motion of every quadrotor."""
        fleet = self._fleet
        acceleration = (fleet.velocity - fleet.velocity_before) / self._step_s
        state = fleet.position, fleet.velocity, fleet.attitude, fleet.rate, acceleration
        return without_wheels(*(np.array(each) for each in state))
