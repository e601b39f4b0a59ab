"""Beams against the hulls of vehicles and other bodies: boxes and cylinders in any attitude."""

from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.scene import Scene, rotation_columns
from vcmvsp.physics.world.solids import Hull

_NEVER_ZERO = 1e-300  # added to what is divided by: changes nothing but a zero


class Hulls(NamedTuple):
    """Hulls of all bodies of a scene, in the world."""

    centre: Array  # (b, 3) m, world
    rotation: Array  # (3, 3, b), world_from_body
    half: Array  # (3, b) m, half the size
    round: Array  # (b,) bool, whether it is a cylinder
    radius: Array  # (b,) m, of a sphere around it


class _Sizes(NamedTuple):
    hulls: tuple[Hull, ...]
    half: Array
    offset: Array  # (3, b)
    round: Array
    radius: Array


_last: list[_Sizes] = []  # of the scene before: the bodies of a run stay the same


def hulls_of(scene: Scene) -> Hulls:
    """The hulls of a scene, computed once."""
    cached: Hulls | None = scene.cache.get("raycast hulls")
    if cached is None:
        sizes = _sizes_of(scene.hulls)
        rotation = rotation_columns(scene.attitude.T)
        centre = scene.position + (rotation * sizes.offset).sum(axis=1).T
        cached = Hulls(centre, rotation, sizes.half, sizes.round, sizes.radius)
        scene.cache["raycast hulls"] = cached
    return cached


def _sizes_of(hulls: tuple[Hull, ...]) -> _Sizes:
    if not _last or _last[0].hulls is not hulls:
        size = np.array([hull.size for hull in hulls]).reshape(-1, 3).T
        offset = np.array([hull.offset for hull in hulls]).reshape(-1, 3).T
        around = np.array([hull.kind == "cylinder" for hull in hulls], bool)
        across = np.where(around, size[0] ** 2, size[0] ** 2 + size[1] ** 2)
        _last[:] = [_Sizes(hulls, 0.5 * size, offset, around, 0.5 * np.sqrt(across + size[2] ** 2))]
    return _last[0]


def in_frames(hulls: Hulls, body: Array, vectors: Array) -> tuple[Array, ...]:
    """World vectors (3, v, q), v for each of q bodies, in the frames of these bodies: v arrays of (3, q)."""
    turned = (hulls.rotation[:, :, None, body] * vectors[:, None]).sum(axis=0)
    return tuple(turned[:, k] for k in range(vectors.shape[1]))


def meet(hulls: Hulls, body: Array, start: Array, toward: Array) -> Array:
    """Lengths of q beams up to one body each, m; 0: from inside; inf: no hit.

    Args:
        hulls: the bodies.
        body: (q,) rows.
        start: (3, q) m, from the centre of the hull, in the body's frame.
        toward: (3, q), the same frame, unit vectors.
    """
    half = hulls.half[:, body]
    with np.errstate(over="ignore"):
        per_metre = 1.0 / (toward + _NEVER_ZERO)
        centre, reach = start * per_metre, half * np.abs(per_metre)
        enter, leave = -centre - reach, reach - centre
        (rounds,) = np.nonzero(hulls.round[body])
        if rounds.size:
            enter[:2, rounds], leave[:2, rounds] = _barrel(start[:, rounds], toward[:, rounds], half[0, rounds])
    first, last = enter.max(axis=0), leave.min(axis=0)
    return np.where((first <= last) & (last >= 0.0), np.maximum(first, 0.0), np.inf)


def _barrel(start: Array, toward: Array, radius: Array) -> tuple[Array, Array]:
    """Entry and exit (q,) of lines in endless cylinders around z; without a hit, the exit is before the entry."""
    (x, y, _), (dx, dy, _) = start, toward
    square, cross = dx * dx + dy * dy + _NEVER_ZERO, x * dy - y * dx
    beside = (square == _NEVER_ZERO) & (x * x + y * y > radius * radius)  # along the axis
    root = np.where(beside, -1.0, square * radius * radius - cross * cross)
    middle, half = -(x * dx + y * dy) / square, np.sqrt(np.maximum(root, 0.0)) / square
    return np.where(root < 0.0, np.inf, middle - half), np.where(root < 0.0, -np.inf, middle + half)
