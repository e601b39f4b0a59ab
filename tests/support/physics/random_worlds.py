"""Random worlds and scenes for the tests of beams."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tests.support.physics.sensor_scenes import scene_of
from vcmvsp.physics.raycast.sweep import in_frames, meet
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Hull, Mesh, Prism
from vcmvsp.physics.world.world import Scene, World

Floats = NDArray[np.float64]

L_SHAPE = ((0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0), (1.0, 2.5), (0.0, 2.5))


def solids(rng: np.random.Generator, *, size: float = 30.0, count: int = 40) -> tuple[AnySolid, ...]:
    """Boxes, cylinders, non-convex prisms, pyramids and loose triangles; they may touch and overlap."""
    found: list[AnySolid] = []
    for number in range(count):
        x, y = rng.uniform(-0.5 * size, 0.5 * size, 2).tolist()
        lift = float(rng.choice([0.0, 0.0, rng.uniform(0.0, 3.0)]))
        a, b, height = rng.uniform(0.3, 4.0, 3).tolist()
        yaw = float(rng.choice([0.0, 0.5 * math.pi, rng.uniform(-4.0, 4.0)]))
        match number % 6:
            case 0 | 1 | 2:
                found.append(Box(center=(x, y, lift + 0.5 * height), size=(a, b, height), yaw_rad=yaw))
            case 3:
                found.append(Cylinder(center=(x, y, lift + 0.5 * height), radius=0.5 * a, height=height))
            case 4:
                c, s = math.cos(yaw), math.sin(yaw)
                outline = tuple((x + c * u - s * v, y + s * u + c * v) for u, v in L_SHAPE)
                found.append(Prism(outline=outline, bottom=lift, height=height))
            case _:
                found.append(Mesh(triangles=pyramid(x, y, lift, a, height) + rng.normal(0.0, 0.3, (1, 1, 3))))
    return tuple(found)


def pyramid(x: float, y: float, z: float, width: float, height: float) -> Floats:
    """Its four sides, (4, 3, 3) m."""
    base = np.array([(x + u * width, y + v * width, z) for u, v in ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))])
    tip = np.array((x, y, z + height))
    return np.array([(base[k], base[(k + 1) % 4], tip) for k in range(4)])


def attitudes(rng: np.random.Generator, count: int, tilt: float) -> Floats:
    """Quaternions of any yaw, with tilts of this standard deviation, rad; (n, 4)."""
    half = 0.5 * rng.uniform(-math.pi, math.pi, count)
    lean = 0.5 * tilt * rng.standard_normal((2, count))
    angle = np.hypot(lean[0], lean[1])
    w1, z1, w2 = np.cos(half), np.sin(half), np.cos(angle)
    x2, y2 = np.sinc(angle / np.pi) * lean
    return np.stack([w1 * w2, w1 * x2 - z1 * y2, w1 * y2 + z1 * x2, z1 * w2], axis=1)


def scene(
    world: World,
    position: Sequence[Sequence[float]] | Floats = ((0.0, 0.0, 0.0),),
    attitude: Floats | None = None,
    hulls: Sequence[Hull] | None = None,
) -> Scene:
    """Vehicles at rest, level and facing east by default."""
    return scene_of(*position, t=5e-9, attitude=attitude, world=world, hulls=hulls, hull=Hull(size=(0.4, 0.3, 0.2)))


def beyond_box(box: Box, points: Floats) -> Floats:
    """How far places (n, 3) m lie beyond the faces of a box along its length, width and height, (n, 3) m."""
    x, y, z = (points - np.array(box.center)).T
    c, s = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
    return np.abs(np.column_stack([c * x + s * y, c * y - s * x, z])) - 0.5 * np.array(box.size)


def hulls(rng: np.random.Generator, count: int) -> tuple[Hull, ...]:
    """Boxes and cylinders, some of them off the reference point."""
    found = []
    for k in range(count):
        a, b, c = rng.uniform(0.2, 1.5, 3).tolist()
        offset = (float(rng.uniform(-0.2, 0.2)), 0.0, 0.5 * c)
        kind: Literal["box", "cylinder"] = "box" if k % 2 else "cylinder"
        found.append(Hull(size=(a, a if kind == "cylinder" else b, c), offset=offset, kind=kind))
    return tuple(found)


def beams(ahead: Floats, left: Floats, first: float, step: float, count: int) -> Floats:
    """Directions of a scanner's beams, (n, 3)."""
    angle = first + step * np.arange(count)
    return np.asarray(np.outer(np.cos(angle), ahead) + np.outer(np.sin(angle), left))


def cast_bodies(scene: Scene, origins: Floats, directions: Floats, own: int = -1) -> Floats:
    """Range of each beam until it meets a body; 0 m inside of one; ``own``: row that beams pass through."""
    hulls = scene.placed_hulls
    bodies = np.delete(np.arange(len(hulls.radius)), [own] if own >= 0 else [])
    beam, body = np.repeat(np.arange(len(origins)), len(bodies)), np.tile(bodies, len(origins))
    start, toward = in_frames(hulls, body, np.stack([(origins[beam] - hulls.centre[body]).T, directions[beam].T], axis=1))
    distance = np.full(len(origins), np.inf)
    np.minimum.at(distance, beam, meet(hulls, body, start, toward))
    return distance
