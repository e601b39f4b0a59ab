"""Occlusion culling: omits pieces that one building hides completely."""

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.triangles import ScenePieces
from vcmvsp.physics.render.view import View

_FEWEST = 48  # pieces: of fewer it is quicker to draw all
_BLOCKS = 8  # buildings tested as occluders
_GAP_M = 0.05  # a nearer building is no occluder: part of it may be clipped
_MARGIN_M = 0.001


def shown(pieces: ScenePieces, near: Array, view: View) -> Array:
    """The pieces (numbers) among ``near`` that no single building hides.

    The shadow of a convex body is convex, so a piece is hidden if the corners of its bounding box are. Behind a building on the
    floor the lower corners are hidden where the upper ones are, as the eye is above the floor. A corner is hidden if its line
    to the eye passes through the building: between two places, below the roof at one.
    """
    if len(near) < _FEWEST:
        return near
    number, where = _blocks(pieces, near, view)
    if not len(number):
        return near
    (low, high), eye = (pieces.low[near], pieces.high[near]), view.eye
    corners = np.concatenate([[low[:, 0], high[:, 0], high[:, 0], low[:, 0]], [low[:, 1], low[:, 1], high[:, 1], high[:, 1]]])
    plan = corners.reshape(2, -1).T - eye[:2]  # (4 n, 2): the four corners of each behind those of all
    speed = np.einsum("pc,kec->ekp", plan, pieces.walls[number, :, :2])  # to the outside of each wall, along each line
    speed[speed == 0.0] = -1e-300  # a line along a wall: it is outside all the way, or never
    when = where.T[:, :, None] / speed
    enter = np.where(speed < 0.0, when, 0.0).max(axis=0)
    leave = np.where(speed > 0.0, when, 1.0).min(axis=0)
    rise = np.tile(high[:, 2], 4) - eye[2]
    lowest = eye[2] + np.minimum(enter * rise, leave * rise)
    through = (leave > enter + 1e-6) & (lowest < pieces.high[number, 2][:, None] - _MARGIN_M)
    hidden = through.reshape(len(number), 4, len(near)).all(axis=1).any(axis=0)
    visible: Array = near[~hidden]
    return visible


def _blocks(pieces: ScenePieces, near: Array, view: View) -> tuple[Array, Array]:
    """The widest buildings in the picture among those higher than the eye.

    Also returns how far inside each of their four walls the eye is, (k, 4) m.
    """
    blocks = near[pieces.block[near] & (pieces.high[near, 2] > view.eye[2])]
    away = pieces.center[blocks, :2] - view.eye[:2]
    wide = pieces.radius[blocks] ** 2 / ((away * away).sum(axis=1) + 1e-9)
    blocks = blocks[np.argsort(-wide, kind="stable")[:_BLOCKS]]
    walls = pieces.walls[blocks]
    where = walls[:, :, 2] - walls[:, :, :2] @ view.eye[:2]
    outside = where.min(axis=1) < -_GAP_M
    return blocks[outside], where[outside]
