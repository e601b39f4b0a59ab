"""What is refused before time 0: equal names, unfit sensors and instants, bodies outside the world or inside each other."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Instants, RunInfo
from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.movables import TOUCHES_M, depth_m, outline
from vcmvsp.physics.vehicles.quadrotor import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec, flies
from vcmvsp.physics.world.world import World


class _Body(NamedTuple):
    name: str
    key: str  # in the scenario
    corners: Array
    bottom: float
    top: float


def check_names(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse bodies of one name: contacts tell names."""
    taken = {spec.name for spec in vehicles}
    for key, things in (("world.movables", world.movables), ("world.moving", world.moving)):
        for each in things:
            if each.name in taken:
                raise ScenarioError(f"{each.name!r} is the name of another vehicle or body too; names must differ", key=key)
            taken.add(each.name)


def check_sensors(vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse sensors that vehicles cannot carry."""
    for spec in vehicles:
        for name, sensor in spec.sensors.items():
            if problem := sensor.misfit(spec.model):
                raise ScenarioError(f"{spec.name} {problem}", key=f"vehicle.{spec.name}.sensors.{name}")


def check_lift(vehicles: Sequence[VehicleSpec], gravity: float) -> None:
    """Refuse quadrotors that cannot carry themselves."""
    for spec in vehicles:
        if isinstance(spec.model, Quadrotor):
            try:
                spec.model.check_lift(gravity)
            except ValueError as error:
                raise ScenarioError(str(error), key=f"vehicle.{spec.name}") from error


def check_instants(run: RunInfo, rate_hz: float, fixes: Sequence[Instants]) -> None:
    """Refuse instants between two steps of physics, naming both numbers: those of the run, and those of ``fixes``."""
    step, end_ns = Ticks.rate(rate_hz), run.duration_ns
    needed = [("duration_s", f"the duration {end_ns / 1e9:.9g} s", step.hits(end_ns))]
    for each in (*run.instants, *fixes):
        period_ok = each.ticks.is_multiple_of(step)
        needed.append((each.key, f"the period {float(each.ticks.period) / 1e9:.9g} s", period_ok))
        needed.append((each.key, f"the offset {each.offset_ns / 1e9:.9g} s", step.hits(each.offset_ns)))
    for key, what, fits in needed:
        if not fits:
            problem = f"{what} is not a whole number of physics steps (1/{rate_hz:g} s); "
            raise ScenarioError(problem + "use a multiple, or set physics.rate_hz", key=key or "physics.rate_hz")


def check_places(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse vehicles that start where the world is not."""
    for spec in vehicles:
        key = f"vehicle.{spec.name}.position"
        if not np.isfinite([*spec.position, spec.heading]).all():
            raise ScenarioError(f"{spec.name} starts at {spec.position}, heading {spec.heading}: not finite", key=key)
        if (beyond := world.outside(*spec.position[:2])) > 0.0:
            raise ScenarioError(f"{spec.name} starts {beyond:.3g} m outside the world ({world.name})", key=key)
        if flies(spec.model) and spec.position[2] < 0.0:
            raise ScenarioError(
                f"{spec.name} starts {-spec.position[2]:.3g} m below the floor; z must not be negative", key=key
            )


def check_overlaps(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse vehicles and movables that start inside each other or inside a solid: an engine would fling them apart.

    Vehicles may not start inside a moving obstacle either; movables may, and so may other obstacles.
    """
    bodies = []
    for key, things in (("", world.moving), ("world.movables", world.movables)):
        for each in things:
            x, y, z, heading = each.pose(0.0)
            bodies.append(_Body(each.name, key, *outline(each.solid.hull, (x, y, z), heading)))
    movables, cars = len(world.moving), len(bodies)
    bodies += [
        _Body(spec.name, f"vehicle.{spec.name}.position", *outline(spec.model.hull, spec.start, spec.heading))
        for spec in vehicles
    ]
    circles = np.array([_circle(body.corners) for body in bodies]).reshape(-1, 3)
    for number in range(movables, len(bodies)):
        body = bodies[number]
        x, y, radius = circles[number]
        apart = np.hypot(circles[:number, 0] - x, circles[:number, 1] - y)
        first = 0 if number >= cars else movables
        for k in (first + np.flatnonzero(apart[first:] < circles[first:number, 2] + radius)).tolist():
            other = bodies[k]
            depth = depth_m(body[2:], other[2:])
            if depth > TOUCHES_M:
                _refuse(body, other.name, depth)
        if (found := world.blocking(body.corners, body.bottom, body.top)) is not None and found[1] > TOUCHES_M:
            _refuse(body, found[0].words, found[1])


def _refuse(body: _Body, what: str, depth_m: float) -> None:
    problem = f"{body.name} and {what} overlap at the start, by {depth_m:.3g} m; move one"
    raise ScenarioError(problem, key=body.key)


def _circle(corners: Array) -> tuple[float, float, float]:
    middle = corners.mean(axis=0)
    return float(middle[0]), float(middle[1]), float(np.hypot(*(corners - middle).T).max())
