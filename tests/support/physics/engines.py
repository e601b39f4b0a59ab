"""Engines with bodies, with and without a federate."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import pytest

from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.mujoco.engine import MujocoEngine
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, MujocoPhysics, Physics
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec
from vcmvsp.physics.world.world import World

OPEN: list[Any] = []  # engines to close at the end of a test
ENGINES = [BulletPhysics, MujocoPhysics] if find_spec("pybullet") else [MujocoPhysics]
KINDS = pytest.mark.parametrize("kind", [KinematicPhysics, BulletPhysics, MujocoPhysics])


def engine(
    *vehicles: tuple[Vehicle, Vec3],
    headings: Sequence[float] = (),
    world: World | None = None,
    hz: float = 120.0,
    kind: type[Physics] = ENGINES[0],
) -> Any:
    """Vehicles with their start positions, m, and headings, rad (0.0)."""
    specs = []
    for row, (model, position) in enumerate(vehicles):
        heading = headings[row] if headings else 0.0
        specs.append(VehicleSpec(name=str(row), model=model, position=position, heading=heading))
    settings: dict[str, Any] = {"world": world or World(), "vehicles": specs, "rate_hz": hz, "gravity": 9.81}
    if kind is MujocoPhysics:
        OPEN.append(MujocoEngine(**settings))
    else:
        from vcmvsp.physics.dynamics.bullet.engine import BulletEngine

        OPEN.append(BulletEngine(**settings, iterations=50))
    return OPEN[-1]
