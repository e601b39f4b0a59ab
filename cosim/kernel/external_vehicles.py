"""Vehicles that something else than physics moves: real robots, or a recording of them. Physics shows them, and no more.

They stand in the world as bodies of infinite mass: others bump into them, scanners and cameras see them, the radio reckons
with where they are; nothing that happens in the simulation moves them.
"""

from collections.abc import Sequence
from typing import Protocol

from vcmvsp.cosim.federate import Federate
from vcmvsp.cosim.types import VehicleState


class Outside(Protocol):
    """Knows how those vehicles move."""

    names: tuple[str, ...]  # of the vehicles, in the scenario's order

    def states(self, now_ns: int) -> Sequence[VehicleState]:
        """How they move at this instant, in the order of ``names``: asked after the federate that speaks for them has stepped.

        Times that are asked for never go back, and asking for one again gives the same. Between two instants physics goes on
        with the velocities of the former.
        """


class Vehicles(Federate, Outside, Protocol):
    """Speaks for such vehicles in a run: gives their estimates and readings, takes their commands."""
