"""Quadrotors in free air: rotors, autopilot and rigid body, without contacts and without an engine for contacts."""

from collections.abc import Callable, Sequence

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.engine import BodyMotion, FleetEngine, flown
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.dynamics.wind import Floats
from vcmvsp.physics.vehicles.models import Quadrotor


class FreeFlightEngine(FleetEngine):
    """Moves n quadrotors through everything, otherwise as in Bullet to the last bit.

    Args:
        models, positions, headings: of the quadrotors.
        wind: wind at a time, ns, (n, 3) or (3,) m/s, world; the same object as long as it does not change.
        rate_hz: steps a second.
        gravity: m/s2, downwards.
    """

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
        super().__init__(rate_hz)
        self.fleet = QuadrotorFleet(models, positions, headings, gravity)
        self._flyer_of, self._wind = range(len(models)), wind

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, world, and a yaw rate, rad/s."""
        self.fleet.set_velocity(row, linear, yaw_rate)

    def command_all(self, linear: Floats, yaw_rate: Floats) -> None:
        """`command` for all vehicles: velocities (n, 3) m/s, world, and yaw rates (n,) rad/s."""
        for row, (velocity, rate) in enumerate(zip(linear.tolist(), yaw_rate.tolist(), strict=True)):
            self.fleet.set_velocity(row, velocity, rate)

    def advance(self, to_ns: int) -> None:
        """Advance to the step nearest to ``to_ns``."""
        until = self._step_at(to_ns)
        self.fleet.fly_in([self._wind(self._ticks.at(number)) for number in range(self._step, until)], self._step_s)
        self._step = max(until, self._step)

    def read(self) -> BodyMotion:
        """Motion of every quadrotor."""
        return flown(self.fleet, self._step_s)
