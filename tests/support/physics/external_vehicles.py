"""Vehicles that a test moves, and runs of the physics that shows them."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from tests.support.physics.physics_stepper import stepped
from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.federate import Event, Instants, RunInfo
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import VehicleState, Velocity
from vcmvsp.physics.federate import Physics
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec

TENTH = (Instants(Ticks.every(0.1)),)
Course = Callable[[float], VehicleState]


class Courses:
    """Each vehicle's state as a function of time, s; notes when it was asked."""

    def __init__(self, **courses: Course) -> None:
        self.names, self._courses = tuple(courses), courses
        self.asked: list[int] = []

    def states(self, now_ns: int) -> list[VehicleState]:
        self.asked.append(now_ns)
        return [course(now_ns / SECOND_NS) for course in self._courses.values()]


def straight(x: float, v: float = 0.0, *, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Course:
    """Along x at v m/s."""
    return lambda t: VehicleState(position=(x + v * t, y, z), velocity=(v, 0.0, 0.0), attitude=quaternion_from_yaw(yaw))


def spec(
    name: str, x: float = 0.0, y: float = 0.0, *, model: Vehicle | None = None, z: float = 0.0, **rest: Any
) -> VehicleSpec:
    return VehicleSpec(name=name, model=model or P2DX(), position=(x, y, z), **rest)


def run(
    physics: Physics,
    commands: Iterable[tuple[float, str, float, float]] = (),
    seconds: float = 2.0,
    instants: Sequence[Instants] = TENTH,
    seed: int = 1,
    *,
    paced: bool = False,
) -> list[Event]:
    """All that is published; commands are (from when, s; vehicle; v, m/s; w, rad/s)."""
    names, end_ns = tuple(each.name for each in physics.vehicles), seconds_to_ns(seconds)
    info = RunInfo(scenario="test", seed=seed, duration_ns=end_ns, vehicles=names, instants=tuple(instants), paced=paced)
    told = [
        Event(f"{name}/command", seconds_to_ns(at_s), Velocity(linear=(v, 0.0, 0.0), yaw_rate=w))
        for at_s, name, v, w in commands
    ]
    return [event for events in stepped(physics, info, told) for event in events]


def values(events: Sequence[Event], key: str) -> list[Any]:
    return [event.value for event in events if event.key == key]
