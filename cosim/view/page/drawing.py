"""Drawing helpers of the control station: colours, shapes of unit size, and nodes that draw many shapes at once.

A hundred vehicles cost the browser as few messages as three.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.palette import OKABE_ITO, rgb

Mesh = tuple[Array, Array]  # vertices (v, 3) float32 and triangles (t, 3) uint32, counter-clockwise seen from outside
TINY = 1e-6  # scale of an invisible shape
WEAKEST_DBM, STRONGEST_DBM = -95.0, -40.0
"""Range of the colours of links."""
LIGHTEST = 200  # of the 255 steps of viridis: the yellow beyond is invisible on a light floor
WHITE = (255, 255, 255)
SUN = (0.4, -0.7, 1.0)  # direction of the light's source
SKY = (205, 224, 242)  # paler than that of the cameras, for curves and names before it
FLOOR, FLOOR_DARK, SKY_DARK = (236, 238, 240), (150, 154, 160), (84, 88, 94)
TARGET_RGB, EDGE_RGB, LOST_RGB, STOPPED_RGB = (240, 228, 66), (38, 38, 38), (220, 30, 30), (220, 30, 30)
CHOSEN_RGB = (255, 140, 0)
NO_SHADOW: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


_SRGB = np.arange(256) / 255.0
_LIGHT = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
_LIGHT = (255.0 * _LIGHT).round().astype(np.uint8)


class Every:
    """Limits an action to once per period."""

    def __init__(self, period_s: float) -> None:
        self._period_s, self._next_s = period_s, -math.inf

    def due(self, now_s: float) -> bool:
        """Whether the period has passed."""
        if now_s < self._next_s:
            return False
        self._next_s = now_s + self._period_s
        return True


def colors_of(count: int) -> Array:
    """Colours of the vehicles, as in the figures: (count, 3) uint8."""
    palette = np.rint(255.0 * np.array([rgb(code) for code in OKABE_ITO])).astype(np.uint8)
    return palette[np.arange(count) % len(palette)]


def css_of(row: int, *, dark: bool = False) -> str:
    """CSS colour of a vehicle's curve; black becomes white on a dark page."""
    code = OKABE_ITO[row % len(OKABE_ITO)]
    return "#ffffff" if dark and code == "#000000" else code


def rssi_colors(rssi_dbm: Array) -> Array:
    """Colours of received powers, weak is dark and strong is light: (n,) dBm -> (n, 3) uint8."""
    share = (rssi_dbm - WEAKEST_DBM) / (STRONGEST_DBM - WEAKEST_DBM)
    return _viridis()[np.clip(np.nan_to_num(share) * LIGHTEST, 0, LIGHTEST).astype(np.uint8)]


def linear(colors: Array) -> Array:
    """Convert sRGB colours to linear light, uint8, as the browser needs them in batched nodes."""
    return _LIGHT[colors]


def rotated(attitude: Array, vectors: Array) -> Array:
    """Rotate vectors by quaternions (w, x, y, z): (n, 4), (n, 3) -> (n, 3)."""
    w, axis = attitude[:, :1], attitude[:, 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return np.asarray(vectors + w * twice + np.cross(axis, twice))


def box(low: tuple[float, float, float] = (-0.5, -0.5, -0.5), high: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Mesh:
    """A box between two corners."""
    x0, y0, z0 = low
    x1, y1, z1 = high
    return prism(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), z0, z1)


def prism(outline: Array, bottom: float, top: float) -> Mesh:
    """An extruded convex outline, (k, 2), counter-clockwise."""
    k = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(k, z)]) for z in (bottom, top)])
    sides = [face for i in range(k) for face in ((i, (i + 1) % k, k + (i + 1) % k), (i, k + (i + 1) % k, k + i))]
    caps = [face for i in range(1, k - 1) for face in ((0, i + 1, i), (k, k + i, k + i + 1))]
    return vertices.astype(np.float32), np.array(sides + caps, np.uint32)


def robot() -> Mesh:
    """The body of a differential-drive robot of unit size: a hull between the wheels, narrower ahead, with a deck on it."""
    hull = np.array([(0.5, -0.16), (0.5, 0.16), (0.34, 0.36), (-0.42, 0.36), (-0.5, 0.26), (-0.5, -0.26), (-0.42, -0.36)])
    hull = np.concatenate([hull, [(0.34, -0.36)]])
    return joined([prism(hull, -0.34, 0.3), prism(0.84 * hull, 0.3, 0.5)])


def wheel() -> Mesh:
    """A wheel of diameter 1 and width 1 that rolls ahead."""
    vertices, faces = prism(0.5 * _circle(20), -0.5, 0.5)
    x, y, z = vertices.T
    return np.column_stack([x, -z, y]), faces


def nose() -> Mesh:
    """An arrowhead on top of a body of unit size, pointing ahead."""
    return prism(np.array([(0.42, 0.0), (0.05, 0.24), (0.05, -0.24)]), 0.5, 0.56)


def disc(corners: int = 32, thickness: float = 0.02) -> Mesh:
    """A flat disc of radius 1 on the floor."""
    return prism(_circle(corners), 0.0, thickness)


def ring(corners: int = 48, width: float = 0.12) -> Mesh:
    """A flat ring of radius 1 about the z axis, a little above the floor."""
    circle = _circle(corners)
    vertices = np.concatenate([circle, (1.0 + width) * circle])
    i, j = np.arange(corners), (np.arange(corners) + 1) % corners
    faces = np.concatenate([np.column_stack([i, corners + i, corners + j]), np.column_stack([i, corners + j, j])])
    return np.column_stack([vertices, np.full(2 * corners, 0.02)]).astype(np.float32), faces.astype(np.uint32)


def quadrotor() -> Mesh:
    """A quadrotor of unit size: two crossed arms, a hub, and four rotors."""
    hub = box((-0.16, -0.12, -0.4), (0.16, 0.12, 0.4))
    across = box((-0.5, -0.025, -0.1), (0.5, 0.025, 0.1))
    arms = [_moved(across, angle, (0.0, 0.0)) for angle in (0.25 * math.pi, 0.75 * math.pi)]
    rotor = prism(0.19 * _circle(16), 0.28, 0.5)
    rotors = [_moved(rotor, 0.0, (0.31 * x, 0.31 * y)) for x in (-1, 1) for y in (-1, 1)]
    return joined([hub, *arms, *rotors])


def joined(meshes: list[Mesh]) -> Mesh:
    """Merge meshes into one."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [triangles + np.uint32(start) for (_, triangles), start in zip(meshes, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _circle(corners: int) -> Array:
    angles = np.arange(corners) * (math.tau / corners)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _moved(mesh: Mesh, angle: float, by: tuple[float, float]) -> Mesh:
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)], np.float32)
    return (mesh[0] @ turn.T + np.array([*by, 0.0], np.float32)).astype(np.float32), mesh[1]


@cache
def _viridis() -> Array:
    """The viridis colour map, (256, 3) uint8."""
    import cv2

    levels = np.arange(256, dtype=np.uint8).reshape(-1, 1)
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1])


def pixel_m(server: viser.ViserServer, places: Array) -> Array:
    """Height of a pixel at these places, (n, 3) m, on the page where it is largest, (n,) m; 0: no page is open."""
    largest = np.zeros(len(places))
    for client in server.get_clients().values():
        camera = client.camera
        if camera.update_timestamp and camera.image_height:
            slope = 2.0 * math.tan(0.5 * camera.fov) / camera.image_height
            largest = np.maximum(largest, slope * np.linalg.norm(places - camera.position, axis=1))
    return largest


class Batch:
    """One shape drawn ``count`` times with individual colours, (count, 3) uint8; ``clicked`` receives an index."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        mesh: Mesh,
        colors: Array,
        *,
        opacity: float | None = None,
        clicked: Callable[[int], None] | None = None,
    ) -> None:
        count = len(colors)
        self.nodes: list[viser.BatchedMeshHandle] = []
        if not count:
            return
        vertices, faces = mesh
        handle = server.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            batched_wxyzs=np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
            batched_positions=np.zeros((count, 3)),
            batched_scales=np.full((count, 3), TINY),
            batched_colors=linear(colors),
            opacity=opacity,
            flat_shading=True,
            lod="off",
            cast_shadow=False,
        )
        self.nodes.append(handle)
        if clicked is not None:
            take = clicked

            @handle.on_click
            def _(event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
                if event.instance_index is not None:
                    take(event.instance_index)

    def put(self, position: Array, wxyz: Array, scale: Array) -> None:
        """Set positions, (count, 3) m, rotations, (count, 4), and sizes, (count, 3), of all instances; `TINY`: invisible."""
        for node in self.nodes:
            node.batched_positions, node.batched_wxyzs, node.batched_scales = position, wxyz, scale


class Segments:
    """A fixed number of line segments; unused ones have zero length; colours (count, 2, 3) uint8."""

    def __init__(self, server: viser.ViserServer, name: str, colors: Array, width_px: float) -> None:
        self.nodes: list[viser.LineSegmentsHandle] = []
        if len(colors):
            look: dict[str, Any] = {"thickness": width_px, "thickness_units": "screen"}
            self.nodes.append(server.scene.add_line_segments(name, np.zeros((len(colors), 2, 3)), linear(colors), **look))

    def put(self, points: Array, colors: Array | None = None) -> None:
        """Set the ends of all segments, (count, 2, 3) m, and new colours if given."""
        for node in self.nodes:
            node.points = points
            if colors is not None:
                node.colors = linear(colors)
