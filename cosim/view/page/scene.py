"""The surroundings of the vehicles in the browser."""

import math
from typing import Any

import numpy as np
import viser

from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Obstacle, Scenery
from vcmvsp.cosim.view.page.drawing import EDGE_RGB, SKY, SKY_DARK, SUN, TARGET_RGB, Every, disc
from vcmvsp.cosim.view.page.floor import DrawnFloor
from vcmvsp.cosim.view.page.state import PageState

MOST_COLORS = 48  # of the solids; with more, similar colours are merged
VEIL, VEIL_S = 0.22, 0.3  # opacity of solids before vehicles, and period of looking for them
MOST_VEILED, MOST_RAYS = 20_000, 24  # triangles of a world in which solids are looked for, and vehicles looked at
AXES_RGB = ((200, 40, 40), (30, 140, 50), (40, 70, 200))
TARGET_M = 0.4  # radius of a target's marker


class Scene:
    """The surroundings of the vehicles; only movable objects are updated."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)  # uniform ambient light would bleach the vehicles' colours
        server.scene.configure_default_lights(enabled=False)
        server.scene.add_light_ambient("/light/sky", intensity=1.6)
        server.scene.add_light_directional("/light/sun", intensity=2.2, position=SUN, cast_shadow=False)
        self.floor = DrawnFloor(server, scenery)
        server.initial_camera.far = max(1000.0, 10.0 * self.floor.size_m)
        self._axes_of = self.floor.extent
        _add_axes(server, self.floor)
        self._solids = Solids(server, scenery)
        self._obstacles = {each.name: _add_obstacle(server, each) for each in scenery.obstacles}
        self._targets = {name: _add_target(server, name, x, y) for name, x, y in scenery.targets}

    def draw(self, state: PageState, now_s: float) -> None:
        """Update obstacles, targets and veils, and extend the floor under all vehicles."""
        places = state.position[np.isfinite(state.position).all(axis=1), :2]
        if len(places):
            self.floor.widen(*places.min(axis=0).tolist(), *places.max(axis=0).tolist())
            if self.floor.extent != self._axes_of:
                self._axes_of = self.floor.extent
                _add_axes(self._server, self.floor)
        self._solids.draw(state.position, now_s)
        for name, (x, y, z, yaw) in state.now.obstacles.items():
            if handle := self._obstacles.get(name):
                handle.position, handle.wxyz = (x, y, z), quaternion_from_yaw(yaw)
        for name, (x, y) in state.now.targets.items():
            if handle := self._targets.get(name):
                handle.position = (x, y, 0.0)

    def darken(self, dark: bool) -> None:
        """Set floor and sky for a light or a dark page: never so dark that a black vehicle is invisible."""
        self.floor.darken(dark)
        sky = SKY_DARK if dark else SKY
        self._server.scene.set_background_image(np.full((1, 1, 3), sky, np.uint8), format="png")


def by_color(colors: Array) -> tuple[Array, Array]:
    """A palette, (k, 3) uint8, with colours equal or near to those of the triangles, (t, 3), and its indices, (t,)."""
    step = 1
    while True:
        coarse = np.minimum(colors.astype(np.int64) // step * step + step // 2, 255).astype(np.uint8)
        kinds, which = np.unique(coarse, axis=0, return_inverse=True)
        if len(kinds) <= MOST_COLORS:
            return kinds, which.reshape(-1)
        step *= 2


class Solids:
    """The static solids: those between a camera and a vehicle become translucent.

    Two meshes per colour, because a browser mesh has a single colour and opacity.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server, self._often = server, Every(VEIL_S)
        self._vertices, self._faces = np.asarray(scenery.vertices), np.asarray(scenery.triangles).astype(np.int64)
        kinds, self._color = by_color(np.asarray(scenery.colors))
        self._solid = solids_of(self._faces, len(self._vertices))
        self._veiled = np.zeros(len(self._faces), bool)
        self._nodes = [self._pair(index, *color.tolist()) for index, color in enumerate(kinds) if len(self._faces)]

    def draw(self, places: Array, now_s: float) -> None:
        """Make the solids before these places, (n, 3) m, translucent."""
        if not 0 < len(self._faces) <= MOST_VEILED or not self._often.due(now_s):
            return
        places = places[np.isfinite(places).all(axis=1)]
        corners = self._vertices[self._faces].astype(float)
        hit, above = np.zeros(len(self._faces), bool), np.array((0.0, 0.0, 0.1))  # the floor is none of them
        for client in self._server.get_clients().values():
            if client.camera.update_timestamp:
                for place in places[:: max(1, math.ceil(len(places) / MOST_RAYS))]:
                    hit |= crossed(corners, np.asarray(client.camera.position, float), place + above)
        veiled = np.isin(self._solid, self._solid[hit])
        changed = np.unique(self._color[veiled != self._veiled])
        self._veiled = veiled
        for index in changed.tolist():
            for node, mask in zip(self._nodes[index], (~veiled, veiled), strict=True):
                faces = self._faces[mask & (self._color == index)]
                node.visible = len(faces) > 0
                if len(faces):
                    used, numbers = np.unique(faces, return_inverse=True)
                    node.vertices = self._vertices[used]
                    node.faces = numbers.reshape(-1, 3).astype(np.uint32)

    def _pair(self, index: int, red: int, green: int, blue: int) -> tuple[viser.MeshHandle, viser.MeshHandle]:
        used, numbers = np.unique(self._faces[self._color == index], return_inverse=True)
        look: dict[str, Any] = {"color": (red, green, blue), "flat_shading": True, "side": "double"}
        content = self._vertices[used], numbers.reshape(-1, 3)
        opaque = self._server.scene.add_mesh_simple(f"/world/{index}", *content, **look)
        veil = self._server.scene.add_mesh_simple(f"/veils/{index}", *content, opacity=VEIL, visible=False, **look)
        return opaque, veil


def solids_of(faces: Array, vertices: int) -> Array:
    """Number of the connected solid of each triangle, (t,)."""
    number = np.arange(vertices)
    while True:
        least = number[faces].min(axis=1)
        new = number.copy()
        for column in faces.T:
            np.minimum.at(new, column, least)
        if np.array_equal(new, number):
            return np.asarray(number[faces[:, 0]])
        number = new


def crossed(corners: Array, begin: Array, end: Array) -> Array:
    """Which triangles, (t, 3, 3) m, a straight line between two places crosses, (t,) bool (Moeller and Trumbore, 1997)."""
    along = end - begin
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(along, second)
    size = np.einsum("ij,ij->i", first, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        start = begin - corners[:, 0]
        u = np.einsum("ij,ij->i", start, normal) / size
        side = np.cross(start, first)
        v = side @ along / size
        share = np.einsum("ij,ij->i", second, side) / size
        return np.asarray((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (share > 0.0) & (share < 1.0))


def axis_m(size_m: float) -> float:
    """A round length, m, near a fifth of the size of the floor: the largest of ..., 1, 2, 5, 10, ... not above it."""
    wished = 0.2 * size_m * (1.0 + 1e-9)
    power = 10.0 ** math.floor(math.log10(wished))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= wished)


def _add_axes(server: viser.ViserServer, floor: DrawnFloor) -> None:
    """Axes of the world in the south-west corner of the floor, of a length that serves as scale."""
    west, south, *_ = floor.extent
    length = axis_m(floor.size_m)
    ends = length * np.eye(3)
    points = np.stack([np.zeros((3, 3)), ends], axis=1)
    colors = np.repeat(np.array(AXES_RGB, np.uint8)[:, None], 2, axis=1)
    where = (west, south, 0.02)
    server.scene.add_line_segments("/axes", points, colors, thickness=3.0, thickness_units="screen", position=where)
    for end, name in zip(ends, ("east", "north", "up"), strict=True):
        text = f"{name}, {length:g} m"
        server.scene.add_label(f"/axes/{name}", text, position=end, font_screen_scale=0.7, anchor="bottom-center")


def _add_obstacle(server: viser.ViserServer, obstacle: Obstacle) -> viser.SceneNodeHandle:
    x, y, z, yaw = obstacle.pose
    where: dict[str, Any] = {"position": (x, y, z), "wxyz": quaternion_from_yaw(yaw), "color": obstacle.color}
    name = f"/obstacles/{obstacle.name}"
    if obstacle.shape == "box":
        return server.scene.add_box(name, dimensions=obstacle.size, flat_shading=True, **where)
    return server.scene.add_cylinder(name, radius=0.5 * obstacle.size[0], height=obstacle.size[2], **where)


def _add_target(server: viser.ViserServer, name: str, x: float, y: float) -> viser.SceneNodeHandle:
    frame = server.scene.add_frame(f"/targets/{name}", show_axes=False, position=(x, y, 0.0))
    for part, radius, thickness, color in (("rim", 1.0, 0.02, EDGE_RGB), ("disc", 0.85, 0.04, TARGET_RGB)):
        vertices, faces = disc(thickness=thickness)
        server.scene.add_mesh_simple(
            f"/targets/{name}/{part}",
            vertices=vertices * np.array([TARGET_M * radius, TARGET_M * radius, 1.0]),
            faces=faces,
            color=color,
            flat_shading=True,
        )
    server.scene.add_label(
        f"/targets/{name}/name", name, position=(0.0, 0.0, 0.3), font_screen_scale=0.8, anchor="bottom-center"
    )
    return frame
