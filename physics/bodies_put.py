"""Where an operator may put a movable while a run goes on: on the floor, inside the world, and inside nothing else."""

from math import isfinite

import numpy as np

from cosim.frames import yaw_of
from cosim.table import unknown
from cosim.types import Array, Vec3
from physics.bodies import hull_of, outline
from physics.polygons import overlap_m
from physics.scene import Hull, Scene
from physics.world import World

_TOUCHES_M = 1e-9  # bodies that only touch do not overlap


def placed(world: World, obstacle: str, position: tuple[float, float], yaw: float) -> tuple[int, Vec3]:
    """The number of a movable, and where its centre is when it stands there upright, m.

    Raises:
        ValueError: no movable has this name, or the world has no room for it there.
    """
    names = [each.name for each in world.movables]
    if obstacle in [each.name for each in world.moving]:
        raise ValueError(f"'{obstacle}' keeps to a time-table; what can be moved: {', '.join(sorted(names)) or 'nothing'}")
    if obstacle not in names:
        raise ValueError(unknown("movable", obstacle, names))
    number = names.index(obstacle)
    hull = hull_of(world.movables[number].solid)
    if not all(map(isfinite, (*position, yaw))):
        raise ValueError(f"{obstacle} needs a finite place, not {position}, yaw {yaw}")
    if (beyond_m := world.outside(*position)) > 0.0:
        raise _refused(obstacle, position, f"that is {beyond_m:.3g} m outside the world ({world.name})")
    place = (*position, 0.5 * hull.size[2])
    found = world.blocking(*outline(hull, place, yaw))
    if found is not None and found[1] > _TOUCHES_M:
        raise _refused(obstacle, position, f"it would reach {found[1]:.3g} m into {found[0].words}")
    return number, place


def check_free(scene: Scene, names: tuple[str, ...], row: int, place: Vec3, yaw: float, within_s: float = 0.0) -> None:
    """Refuse a place that another body takes; bodies are taken to be level.

    Args:
        scene: where all bodies are.
        names: theirs.
        row: of the body that is to be put there.
        place: of its centre, m.
        yaw: rad.
        within_s: bodies also take the room around them that they may reach so soon.

    Raises:
        ValueError: one does, and which.
    """
    mine = outline(scene.hulls[row], place, yaw)
    way_m = (within_s * np.linalg.norm(scene.velocity, axis=1)).tolist()
    for other, (hull, at, attitude) in enumerate(
        zip(scene.hulls, scene.position.tolist(), scene.attitude.tolist(), strict=True)
    ):
        if other == row:
            continue
        theirs = outline(_grown(hull, way_m[other]), at, yaw_of(attitude))
        depth_m = _depth_m(mine, theirs)
        if depth_m > _TOUCHES_M:
            raise _refused(names[row], place[:2], f"{names[other]} is there")


def _depth_m(a: tuple[Array, float, float], b: tuple[Array, float, float]) -> float:
    """How far one upright prism reaches into another."""
    return min(overlap_m(a[0], b[0]), min(a[2], b[2]) - max(a[1], b[1]))


def _grown(hull: Hull, by_m: float) -> Hull:
    length, width, height = (side + 2.0 * by_m for side in hull.size)
    return hull._replace(size=(length, width, height))


def _refused(obstacle: str, position: tuple[float, float], why: str) -> ValueError:
    return ValueError(f"{obstacle} cannot stand at ({position[0]:g}, {position[1]:g}): {why}")
