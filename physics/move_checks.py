"""Where an operator may put a movable while a run goes on: on the floor, inside the world, and inside nothing else."""

from math import isfinite

import numpy as np

from vcmvsp.cosim.config.messages import unknown
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.movables import TOUCHES_M, depth_m, outline
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import World


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
    hull = world.movables[number].solid.hull
    if not all(map(isfinite, (*position, yaw))):
        raise ValueError(f"{obstacle} needs a finite place, not {position}, yaw {yaw}")
    if (beyond_m := world.outside(*position)) > 0.0:
        raise _refused(obstacle, position, f"that is {beyond_m:.3g} m outside the world ({world.name})")
    place = (*position, 0.5 * hull.size[2])
    found = world.blocking(*outline(hull, place, yaw))
    if found is not None and found[1] > TOUCHES_M:
        raise _refused(obstacle, position, f"it would reach {found[1]:.3g} m into {found[0].words}")
    return number, place


def check_free(scene: Scene, names: tuple[str, ...], row: int, place: Vec3, yaw: float, within_s: float) -> None:
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
        if depth_m(mine, theirs) > TOUCHES_M:
            raise _refused(names[row], place[:2], f"{names[other]} is there")


def _grown(hull: Hull, by_m: float) -> Hull:
    length, width, height = (side + 2.0 * by_m for side in hull.size)
    return hull._replace(size=(length, width, height))


def _refused(obstacle: str, position: tuple[float, float], why: str) -> ValueError:
    return ValueError(f"{obstacle} cannot stand at ({position[0]:g}, {position[1]:g}): {why}")
