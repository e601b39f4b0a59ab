"""Engines for vehicles that need no body."""

from collections.abc import Sequence

from vcmvsp.physics.dynamics.kinematic_aerial import AerialEngine
from vcmvsp.physics.dynamics.kinematic_ground import MotionEngine
from vcmvsp.physics.engine.interface import Engine
from vcmvsp.physics.vehicles.models import GroundVehicle, Point
from vcmvsp.physics.vehicles.quadrotor import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec


def riders(vehicles: Sequence[VehicleSpec], numbers: Sequence[int]) -> list[tuple[Engine, list[int]]]:
    """One engine on the ground and one in the air, each with the numbers of the vehicles that it moves, of those given."""
    found: list[tuple[Engine, list[int]]] = []
    ground = {n: model for n in numbers if isinstance(model := vehicles[n].model, GroundVehicle)}
    air = {n: model for n in numbers if isinstance(model := vehicles[n].model, Point | Quadrotor)}
    if ground:
        at = [vehicles[n].start for n in ground], [vehicles[n].heading for n in ground]
        sensed = any(spec.sensors for spec in vehicles)
        found.append((MotionEngine([*ground.values()], *at, sensed=sensed), [*ground]))
    if air:
        at = [vehicles[n].start for n in air], [vehicles[n].heading for n in air]
        found.append((AerialEngine([*air.values()], *at), [*air]))
    return found
