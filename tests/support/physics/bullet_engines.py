"""Bullet engines without a federate."""

from collections.abc import Sequence

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.bullet.engine import BulletEngine
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec
from vcmvsp.physics.world.world import World


def engine(
    *vehicles: tuple[Vehicle, Vec3], headings: Sequence[float] = (), world: World | None = None, hz: float = 120.0
) -> BulletEngine:
    """Vehicles with their start positions, m, and headings, rad (0.0)."""
    specs = []
    for row, (model, position) in enumerate(vehicles):
        heading = headings[row] if headings else 0.0
        specs.append(VehicleSpec(name=str(row), model=model, position=position, heading=heading))
    return BulletEngine(world=world or World(), vehicles=specs, rate_hz=hz, iterations=50, gravity=9.81)
