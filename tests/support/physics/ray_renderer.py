"""A slow reference renderer: one ray at a time against planes, as in textbooks."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.floor_and_sky import SKY
from vcmvsp.physics.render.renderer import NEAREST_M
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.world.solids import Cylinder, Hull, Mesh, color_of
from vcmvsp.physics.world.world import Scene, World


class Convex(NamedTuple):
    """All x with normals @ x <= offsets."""

    normals: Array
    offsets: Array
    color: tuple[int, int, int]


class Triangles(NamedTuple):
    """All triangles of a mesh."""

    corners: Array  # (t, 3, 3) m
    color: tuple[int, int, int]


class HitSurface(NamedTuple):
    color: Array  # levels
    depth: float  # m, along the optical axis


def things(world: World, scene: Scene | None = None, without: int = -1) -> list[Convex | Triangles]:
    found: list[Convex | Triangles] = []
    for solid in world.solids:
        if isinstance(solid, Mesh):
            found.append(Triangles(solid.triangles, color_of(solid)))
        for corners, bottom, top in solid.uprights():
            edges = np.roll(corners, -1, axis=0) - corners
            sides = np.column_stack([edges[:, 1], -edges[:, 0], np.zeros(len(edges))])
            sides /= np.linalg.norm(sides, axis=1)[:, None]
            normals = np.concatenate([sides, [[0, 0, 1], [0, 0, -1]]])
            offsets = np.append((sides[:, :2] * corners).sum(axis=1), [top, -bottom])
            found.append(Convex(normals, offsets, color_of(solid)))
    if scene is not None:
        for row, hull in enumerate(scene.hulls):
            if row != without:
                found.append(_hull(hull, scene.position[row], scene.rotation(row)))
    return found


def _hull(hull: Hull, position: Array, rotation: Array) -> Convex:
    if hull.kind == "box":
        local = np.concatenate([np.eye(3), -np.eye(3)])
        offsets = np.tile(0.5 * np.array(hull.size), 2)
    else:  # the camera's polygon has its corners on the circle
        sides = Cylinder(center=(0, 0, 0), radius=0.4, height=1).uprights()[0].corners.shape[0]
        angles = math.tau * (np.arange(sides) + 0.5) / sides
        local = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
        local = np.concatenate([local, [[0, 0, 1], [0, 0, -1]]])
        offsets = np.append(np.full(sides, 0.5 * hull.size[0] * math.cos(math.pi / sides)), 2 * [0.5 * hull.size[2]])
    normals = local @ rotation.T
    return Convex(normals, offsets + normals @ (position + rotation @ np.array(hull.offset)), hull.color)


def look(world: World, found: Sequence[Convex | Triangles], view: View, row: int, column: int) -> HitSurface:
    """Surface at the middle of a pixel."""
    ray = view.rotation @ np.array(
        [(column + 0.5 - view.width / 2) / view.focal_px, (row + 0.5 - view.height / 2) / view.focal_px, 1.0]
    )  # length 1 along the optical axis: distances along it are depths
    best, color, normal = math.inf, np.array(SKY, float), None
    if ray[2] < 0.0:
        best = -view.eye[2] / ray[2]
        color = np.array(world.ground.color, float)
    for thing in found:
        met = _enter(thing, view.eye, ray) if isinstance(thing, Convex) else _through(thing, view.eye, ray)
        if met is not None and NEAREST_M < met[0] < best:
            best, normal, color = met[0], met[1], np.array(thing.color, float)
    if normal is not None:
        sun = np.array(world.light.direction) / np.linalg.norm(world.light.direction)
        color = color * (world.light.ambient + (1 - world.light.ambient) * max(0.0, float(normal @ sun)))
    return HitSurface(color, best)


def _enter(thing: Convex, eye: Array, ray: Array) -> tuple[float, Array] | None:
    speed, gap = thing.normals @ ray, thing.offsets - thing.normals @ eye
    if ((speed == 0.0) & (gap < 0.0)).any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        when = gap / speed
    entering = np.where(speed < 0.0, when, -math.inf)
    last = int(entering.argmax())
    leave = np.where(speed > 0.0, when, math.inf).min()
    return (float(entering[last]), thing.normals[last]) if 0.0 < entering[last] <= leave else None


def _through(thing: Triangles, eye: Array, ray: Array) -> tuple[float, Array] | None:
    """First triangle that a ray meets, three linear equations each."""
    a, b, c = thing.corners.swapaxes(0, 1)
    system = np.stack([b - a, c - a, np.broadcast_to(-ray, a.shape)], axis=2)
    flat = np.abs(np.linalg.det(system)) < 1e-12
    system[flat] = np.eye(3)
    u, v, when = np.linalg.solve(system, (eye - a)[:, :, None])[:, :, 0].T
    met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (when > NEAREST_M) & ~flat
    if not met.any():
        return None
    first = int(np.where(met, when, math.inf).argmin())
    normal = np.cross(b[first] - a[first], c[first] - a[first])
    normal /= np.linalg.norm(normal)
    return float(when[first]), -normal if normal @ ray > 0.0 else normal
