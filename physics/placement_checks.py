"""Checks before time 0 (names, sensors, instants, places, overlaps), and of the place of a movable during a run."""

from collections.abc import Collection, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Instants, RunInfo
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.scene_builder import TOUCHES_M, depth_m, outline
from vcmvsp.physics.sensors.motion import WheelOdometry
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec, flies
from vcmvsp.physics.world.world import Scene, World


class _Body(NamedTuple):
    name: str
    key: str  # in the scenario
    corners: Array
    bottom: float
    top: float


def check_names(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse equal names of bodies: contacts refer to names."""
    names = {spec.name for spec in vehicles}
    for key, things in (("world.movables", world.movables), ("world.moving", world.moving)):
        for each in things:
            if each.name in names:
                raise ScenarioError(f"{each.name!r} is also the name of another vehicle or body; use distinct names", key=key)
            names.add(each.name)


def check_sensors(vehicles: Sequence[VehicleSpec], external: Collection[str]) -> None:
    """Refuse sensors that do not fit their vehicles; wheel odometry on external ones: physics does not turn their wheels."""
    for spec in vehicles:
        for name, sensor in spec.sensors.items():
            problem = sensor.misfit(spec.model)
            if not problem and spec.name in external and isinstance(sensor, WheelOdometry):
                problem = "is an external vehicle without simulated wheels: leave this sensor out"
            if problem:
                raise ScenarioError(f"{spec.name} {problem}", key=f"vehicle.{spec.name}.sensors.{name}")


def check_lift(vehicles: Sequence[VehicleSpec], gravity: float) -> None:
    """Refuse quadrotors without enough lift to hover."""
    for spec in vehicles:
        if isinstance(spec.model, Quadrotor):
            try:
                spec.model.check_lift(gravity)
            except ValueError as error:
                raise ScenarioError(str(error), key=f"vehicle.{spec.name}") from error


def check_instants(run: RunInfo, rate_hz: float, fixes: Sequence[Instants]) -> None:
    """Refuse instants of the run and of ``fixes`` between two steps of physics."""
    step, end_ns = Ticks.rate(rate_hz), run.duration_ns
    needed = [("duration_s", f"the duration {end_ns / 1e9:.9g} s", step.hits(end_ns))]
    for each in (*run.instants, *fixes):
        period_ok = each.ticks.is_multiple_of(step)
        needed.append((each.key, f"the period {float(each.ticks.period) / 1e9:.9g} s", period_ok))
        needed.append((each.key, f"the offset {each.offset_ns / 1e9:.9g} s", step.hits(each.offset_ns)))
    for key, instant, fits in needed:
        if not fits:
            problem = f"{instant} is not a whole number of physics steps (1/{rate_hz:g} s); "
            raise ScenarioError(problem + "use a multiple, or set physics.rate_hz", key=key or "physics.rate_hz")


def check_places(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse start positions outside the world."""
    for spec in vehicles:
        problem, z = "", spec.position[2]
        if not np.isfinite([*spec.position, spec.heading]).all():
            problem = f"at {spec.position}, heading {spec.heading}: not finite"
        elif (beyond_m := world.outside(*spec.position[:2])) > 0.0:
            problem = f"{beyond_m:.3g} m outside the world ({world.name})"
        elif flies(spec.model) and z < 0.0:
            problem = f"{-z:.3g} m below the floor; z must not be negative"
        if problem:
            raise ScenarioError(f"{spec.name} starts {problem}", key=f"vehicle.{spec.name}.position")


def check_overlaps(world: World, vehicles: Sequence[VehicleSpec]) -> None:
    """Refuse vehicles and movables that overlap each other or a solid at the start: an engine throws them apart.

    Vehicles must not overlap moving obstacles either. Movables may, and so may other obstacles.
    """
    bodies = []
    for key, things in (("", world.moving), ("world.movables", world.movables)):
        for each in things:
            x, y, z, heading = each.pose(0.0)
            bodies.append(_Body(each.name, key, *outline(each.solid.hull, (x, y, z), heading)))
    movables, cars = len(world.moving), len(bodies)
    for spec in vehicles:
        hull = outline(spec.model.hull, spec.start, spec.heading)
        bodies.append(_Body(spec.name, f"vehicle.{spec.name}.position", *hull))
    middles = np.array([body.corners.mean(axis=0) for body in bodies]).reshape(-1, 2)
    radii = np.array([np.hypot(*(body.corners - middle).T).max() for body, middle in zip(bodies, middles, strict=True)])
    for number, body in enumerate(bodies[movables:], movables):
        apart = np.hypot(*(middles[:number] - middles[number]).T)
        first = 0 if number >= cars else movables
        near = first + np.flatnonzero(apart[first:] < radii[first:number] + radii[number])
        overlaps = [(bodies[k].name, depth_m(body[2:], bodies[k][2:])) for k in near.tolist()]
        if blocking := world.blocking(*body[2:]):
            overlaps.append((blocking[0].words, blocking[1]))
        for other, depth in overlaps:
            if depth > TOUCHES_M:
                raise ScenarioError(f"{body.name} and {other} overlap at the start, by {depth:.3g} m; move one", key=body.key)


def placed(world: World, obstacle: str, position: tuple[float, float], yaw: float) -> tuple[int, Vec3]:
    """Number of a movable, and its centre, m, when it stands upright at a position.

    Raises:
        ValueError: no movable has this name, or the world has no room for it there.
    """
    names = [each.name for each in world.movables]
    if obstacle in [each.name for each in world.moving]:
        raise ValueError(f"'{obstacle}' moves by its timetable; movable obstacles: {', '.join(sorted(names)) or 'none'}")
    if obstacle not in names:
        raise ValueError(unknown("movable", obstacle, names))
    number = names.index(obstacle)
    hull = world.movables[number].solid.hull
    if not all(map(isfinite, (*position, yaw))):
        raise ValueError(f"{obstacle}: position and yaw must be finite, not {position}, yaw {yaw}")
    if (beyond_m := world.outside(*position)) > 0.0:
        raise _refused(obstacle, position, f"the place is {beyond_m:.3g} m outside the world ({world.name})")
    place = (*position, 0.5 * hull.size[2])
    blocking = world.blocking(*outline(hull, place, yaw))
    if blocking is not None and blocking[1] > TOUCHES_M:
        raise _refused(obstacle, position, f"it would overlap {blocking[0].words} by {blocking[1]:.3g} m")
    return number, place


def check_free(scene: Scene, names: tuple[str, ...], row: int, place: Vec3, yaw: float, within_s: float) -> None:
    """Refuse a place (centre, m, and yaw, rad) of the body in ``row`` that another occupies; all bodies count as level.

    Bodies also occupy the room that they can reach ``within_s``.

    Raises:
        ValueError: with the name of the other body.
    """
    own = outline(scene.hulls[row], place, yaw)
    reach_m = (within_s * np.linalg.norm(scene.velocity, axis=1)).tolist()
    bodies = zip(scene.hulls, scene.position.tolist(), scene.attitude.tolist(), strict=True)
    for other, (hull, position, attitude) in enumerate(bodies):
        length, width, height = (side + 2.0 * reach_m[other] for side in hull.size)
        grown = outline(hull._replace(size=(length, width, height)), position, yaw_of(attitude))
        if other != row and depth_m(own, grown) > TOUCHES_M:
            raise _refused(names[row], place[:2], f"{names[other]} is there")


def _refused(obstacle: str, position: tuple[float, float], reason: str) -> ValueError:
    return ValueError(f"{obstacle} cannot stand at ({position[0]:g}, {position[1]:g}): {reason}")
