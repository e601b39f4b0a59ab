"""Large faces, drawn row by row with NumPy: quicker than triangles pixel by pixel."""

from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.triangles import Triangles
from vcmvsp.physics.render.view import View

LARGE_PX = 6000  # a triangle in a rectangle of so many pixels is drawn here: about where both ways take as long


class Buffers(NamedTuple):
    """Buffers of a picture, (height, width) each."""

    color: Array  # int32, see `packed`
    number: Array | None  # int32: one plus the number of the triangle; 0: floor or sky
    depth: Array  # float32, from 0 (at ``near``) to 1 (at ``far``): a linear function of one over the depth, as in OpenGL
    near: float  # m
    far: float


def draw_large(buffers: Buffers, corner: Array, triangles: Triangles, source: Array, view: View) -> Array:
    """Draw all faces with a large triangle; returns the other triangles, (n,) int.

    Args:
        buffers: changed.
        corner: triangles in the camera's frame, (t, 3, 3) m, all in front of it.
        triangles: before clipping.
        source: number of each in ``triangles``, (t,).
        view: of the camera.
    """
    height, width = buffers.depth.shape
    scale = view.focal_px / corner[:, :, 2]
    u, v = corner[:, :, 0] * scale + 0.5 * width, corner[:, :, 1] * scale + 0.5 * height
    large = _length(u, width) * _length(v, height) > LARGE_PX
    if not large.any():
        return np.arange(len(corner))
    face = triangles.face[source]
    whole = np.isin(face, face[large])
    some = np.flatnonzero(whole)
    some = some[np.argsort(face[some], kind="stable")]
    first = np.flatnonzero(np.diff(face[some], prepend=face[some[0]] - 1))
    left, right = _ends(u[some], v[some], first, width, height)
    one = source[some[first]]
    _fill(buffers, left, right, _planes(buffers, triangles.plane[one], view), triangles.color[one], one)
    return np.flatnonzero(~whole)


def _length(ends: Array, edge: int) -> Array:
    """Extent of the corners of each triangle along a picture's edge, (t,) px."""
    a, b, c = np.clip(ends, 0.0, edge).T
    length: Array = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    return length


def _ends(u: Array, v: Array, first: Array, width: int, height: int) -> tuple[Array, Array]:
    """First columns with their middle in a face, and the columns behind the last, row by row, (f, height) int16."""
    middle = np.arange(height) + 0.5
    u0, v0, u1, v1 = (each[:, :, None] for each in (u, v, np.roll(u, -1, axis=1), np.roll(v, -1, axis=1)))
    crossing = (v0 <= middle) != (v1 <= middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        column = u0 + (middle - v0) * ((u1 - u0) / (v1 - v0))
    left = np.minimum.reduceat(np.where(crossing, column, np.inf).min(axis=1), first)
    right = np.maximum.reduceat(np.where(crossing, column, -np.inf).max(axis=1), first)
    ends = np.ceil(np.clip([left, right], 0.0, width) - 0.5).astype(np.int16)
    return ends[0], ends[1]


def _planes(buffers: Buffers, plane: Array, view: View) -> tuple[Array, Array]:
    """Depth buffer of each face as a sum of a value for each row, (f, height), and for each column, (f, width)."""
    normal, (near, far) = plane[:, :3], buffers[3:]
    inverse = (normal @ view.rotation) / (plane[:, 3] - normal @ view.eye)[:, None]  # of a ray's right, down, ahead: 1/m
    inverse *= -far * near / (far - near)
    rows = inverse[:, 1:2] * view.rows() + (inverse[:, 2:] + far / (far - near))
    columns = inverse[:, :1] * view.columns()
    return rows.astype(np.float32), columns.astype(np.float32)


def _fill(buffers: Buffers, left: Array, right: Array, planes: tuple[Array, Array], color: Array, number: Array) -> None:
    """Draw one face after the other in front of the present content."""
    every = np.arange(buffers.depth.shape[1], dtype=np.int16)
    for i, value in enumerate(color.astype(np.int32)):
        rows = np.flatnonzero(left[i] < right[i])
        if not len(rows):
            continue
        top, bottom = int(rows[0]), int(rows[-1]) + 1
        begin, end = left[i, top:bottom, None], right[i, top:bottom, None]
        west, east = int(begin.min()), int(end.max())
        part, columns = np.s_[top:bottom, west:east], every[west:east]
        depth = planes[0][i, top:bottom, None] + planes[1][i, west:east]
        nearer = depth < buffers.depth[part]
        nearer &= columns >= begin
        nearer &= columns < end
        mask = nearer.view(np.uint8)
        cv2.copyTo(depth, mask, buffers.depth[part])
        cv2.copyTo(np.full(depth.shape, value), mask, buffers.color[part])
        if buffers.number is not None:
            cv2.copyTo(np.full(depth.shape, number[i] + 1, np.int32), mask, buffers.number[part])
