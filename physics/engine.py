"""What the physics federate asks of an engine. Bullet and plain kinematics are two; another would fit behind the same verbs."""

from collections.abc import Sequence
from typing import Protocol

from cosim.types import Odometry, VehicleState


class Engine(Protocol):
    """Moves some vehicles; they are numbered in the order in which the engine was given them."""

    def command(self, vehicle: int, v: float, w: float) -> None:
        """From now on move at ``v`` m/s forward and ``w`` rad/s."""

    def advance(self, to_ns: int) -> None:
        """Move on to ``to_ns``."""

    def read(self) -> list[tuple[VehicleState, Odometry]]:
        """The true state and the wheels' account of every vehicle, now."""

    def touching(self) -> Sequence[tuple[int, int | None]]:
        """Pairs of vehicles that touch now, the smaller number first; None stands for the world."""

    def close(self) -> None:
        """Release everything."""
