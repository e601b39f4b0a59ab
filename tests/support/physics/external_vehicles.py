"""Vehicles that a test moves."""

from collections.abc import Callable
from typing import Any

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import VehicleState
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec
from vcmvsp.physics.world.solids import Hull

Course = Callable[[float], VehicleState]


class Courses:
    """State of each vehicle as a function of time, s; records the times of its calls."""

    def __init__(self, **courses: Course) -> None:
        self.names, self._courses = tuple(courses), courses
        self.call_times_ns: list[int] = []

    def states(self, now_ns: int) -> list[VehicleState]:
        self.call_times_ns.append(now_ns)
        return [course(now_ns / SECOND_NS) for course in self._courses.values()]


def straight(x: float, v: float = 0.0, *, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Course:
    """Along x at v m/s."""
    return lambda t: VehicleState(position=(x + v * t, y, z), velocity=(v, 0.0, 0.0), attitude=quaternion_from_yaw(yaw))


def spec(
    name: str, x: float = 0.0, y: float = 0.0, *, model: Vehicle | None = None, z: float = 0.0, **rest: Any
) -> VehicleSpec:
    return VehicleSpec(name=name, model=model or P2DX(), position=(x, y, z), **rest)


class Boat:
    """A vehicle class that no engine of physics can move."""

    radius_m, height_m, hull = 0.3, 0.3, Hull((0.6, 0.6, 0.3))
