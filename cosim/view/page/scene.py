"""The surroundings of the vehicles in the browser, and the camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Obstacle, Scenery
from vcmvsp.cosim.view.page.drawing import EDGE_RGB, FLOOR, FLOOR_DARK, SKY_DARK, TARGET_RGB, WHITE, Every, disc
from vcmvsp.cosim.view.page.state import Known

MOST_COLORS = 48  # of the solids; with more, similar colours are merged
MARGIN_M, WIDE_M = 5.0, 40.0
FLOOR_Z_M = -0.01  # of the drawn floor, so that objects on it are visible
SUN = (0.4, -0.7, 1.0)
FACING_UP = (0.0, 1.0, 0.0, 0.0)  # a picture is visible from -z of its node, with rows along -y: half a turn about x
ASLANT, FROM_ABOVE = np.array([-0.25, -0.6, 0.6]), np.array([-0.12, -0.38, 0.8])  # directions to the initial camera
TARGET_M = 0.4  # radius of a target's marker
VIEW, NEAREST_M = 0.8, 7.0  # initial camera distance: share of the visible diagonal, and minimum


class Scene:
    """The surroundings of the vehicles; only movable objects are updated."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)  # uniform ambient light would bleach the vehicles' colours
        server.scene.configure_default_lights(enabled=False)
        server.scene.add_light_ambient("/light/sky", intensity=1.6)
        server.scene.add_light_directional("/light/sun", intensity=2.2, position=SUN, cast_shadow=False)
        west, south, east, north = self._extent = extent_of(scenery)
        size = max(east - west, north - south)
        server.initial_camera.far = max(1000.0, 10.0 * size)
        cell = 1.0 if size <= WIDE_M else 10.0
        self.floor = server.scene.add_grid(
            "/floor",
            width=east - west,
            height=north - south,
            cell_size=cell,
            section_size=5.0 * cell,
            cell_color=(205, 208, 212),
            section_color=(165, 170, 176),
            fade_distance=1e5,
            fade_from="origin",
            shadow_opacity=0.0,
            plane_color=FLOOR,
            plane_opacity=1.0,
            position=(0.5 * (west + east), 0.5 * (south + north), FLOOR_Z_M),
        )
        if scenery.floor is not None:
            (x, y), (width, height) = scenery.floor.centre, scenery.floor.size
            server.scene.add_image(
                "/painted",
                scenery.floor.pixels,
                width,
                height,
                format="jpeg",
                position=(x, y, 0.5 * FLOOR_Z_M),
                wxyz=FACING_UP,
                cast_shadow=False,
                receive_shadow=False,
            )
        server.scene.add_frame("/axes", axes_length=1.0, axes_radius=0.02, origin_radius=0.03)  # x east, y north: 1 m each
        _add_solids(server, scenery)
        self._obstacles = {each.name: _add_obstacle(server, each) for each in scenery.obstacles}
        self._targets = {name: _add_target(server, name, x, y) for name, x, y in scenery.targets}

    def draw(self, known: Known) -> None:
        """Update obstacles and targets, and extend the floor under all vehicles."""
        seen = known.position[np.isfinite(known.position).all(axis=1), :2]
        if len(seen):
            self._widen(*seen.min(axis=0).tolist(), *seen.max(axis=0).tolist())
        for name, (x, y, z, yaw) in known.now.obstacles.items():
            if handle := self._obstacles.get(name):
                handle.position, handle.wxyz = (x, y, z), quaternion_from_yaw(yaw)
        for name, (x, y) in known.now.targets.items():
            if handle := self._targets.get(name):
                handle.position = (x, y, 0.0)

    def _widen(self, west: float, south: float, east: float, north: float) -> None:
        """Extend the floor to these limits, with a margin so that it need not grow again soon."""
        low, high = self._extent[:2], self._extent[2:]
        if low[0] <= west and low[1] <= south and east <= high[0] and north <= high[1]:
            return
        more = MARGIN_M + 0.25 * max(high[0] - low[0], high[1] - low[1])
        west, south = min(low[0], west - more), min(low[1], south - more)
        east, north = max(high[0], east + more), max(high[1], north + more)
        self._extent = west, south, east, north
        self.floor.width, self.floor.height = east - west, north - south
        self.floor.position = (0.5 * (west + east), 0.5 * (south + north), FLOOR_Z_M)

    def darken(self, dark: bool) -> None:
        """Set floor and sky for a light or a dark page: never so dark that a black vehicle is invisible."""
        floor, sky = (FLOOR_DARK, SKY_DARK) if dark else (FLOOR, WHITE)
        self.floor.plane_color = floor
        self._server.scene.set_background_image(np.full((1, 1, 3), sky, np.uint8), format="png")

    def aim(self, known: Known, *, near: bool = False) -> bool:
        """Set the initial camera to show all vehicles and their surroundings, also on open pages.

        Args:
            near: show the vehicles alone, as large as possible.

        Returns:
            Whether the positions of the vehicles are known yet.
        """
        seen = known.position[np.isfinite(known.position).all(axis=1)]
        found = len(seen) > 0 or not known.names
        west, south, east, north = self._extent
        if (len(known.scenery.vertices) and not near) or not len(seen):
            seen = np.concatenate([seen, [(west, south, 0.0), (east, north, 0.0)]])
        low, high = seen.min(axis=0), seen.max(axis=0)
        distance = max(VIEW * float(np.linalg.norm(high - low)), NEAREST_M)
        middle = 0.5 * (low + high)
        toward = FROM_ABOVE if len(known.scenery.vertices) else ASLANT  # over walls between camera and vehicles
        cameras: list[Any] = [self._server.initial_camera, *(each.camera for each in self._server.get_clients().values())]
        for camera in cameras:
            camera.position = middle + distance * toward
            camera.look_at = middle  # after the position, which moves it
        return found


def extent_of(scenery: Scenery) -> tuple[float, float, float, float]:
    """West, south, east and north edge of the drawn floor, m."""
    places = [np.asarray(scenery.vertices)[:, :2]] if len(scenery.vertices) else []
    places += [np.array([each.pose[:2]]) for each in scenery.obstacles]
    places += [np.array([(x, y)]) for _, x, y in scenery.targets]
    if scenery.bounds is not None:
        west, south, east, north = scenery.bounds
        places.append(np.array([(west, south), (east, north)]))
    if not places:
        return -20.0, -20.0, 20.0, 20.0
    every = np.concatenate(places)
    (west, south), (east, north) = every.min(axis=0) - MARGIN_M, every.max(axis=0) + MARGIN_M
    return float(west), float(south), float(east), float(north)


def by_color(colors: Array) -> tuple[Array, Array]:
    """A palette, (k, 3) uint8, with colours equal or near to those of the triangles, (t, 3), and its indices, (t,)."""
    step = 1
    while True:
        coarse = np.minimum(colors.astype(np.int64) // step * step + step // 2, 255).astype(np.uint8)
        kinds, which = np.unique(coarse, axis=0, return_inverse=True)
        if len(kinds) <= MOST_COLORS:
            return kinds, which.reshape(-1)
        step *= 2


def _add_solids(server: viser.ViserServer, scenery: Scenery) -> None:
    """Add the static solids: one mesh per colour, because a browser mesh has a single colour."""
    if not len(scenery.triangles):
        return
    kinds, which = by_color(np.asarray(scenery.colors))
    for index, color in enumerate(kinds):
        red, green, blue = color.tolist()
        used, faces = np.unique(scenery.triangles[which == index], return_inverse=True)
        server.scene.add_mesh_simple(
            f"/world/{index}",
            vertices=np.asarray(scenery.vertices)[used],
            faces=faces.reshape(-1, 3),
            color=(red, green, blue),
            flat_shading=True,
            side="double",
        )


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


PERIOD_S = 0.06
NEAR_M, FAR_M = 2.0, 12.0  # limits of the initial camera distance
HAND_S = 0.4  # time after the user's last camera input before following resumes
SETTLES_S = 0.5  # time until a page reports its camera
TURNED = 0.02  # of the distance: a larger change is user input
LEAST_M = 0.005  # smaller movements of a vehicle do not move a camera


@dataclass
class _Page:
    """Camera of a page: position relative to the vehicle, m, and earliest times to read and move it, s."""

    offset: Array
    looked_at_s: float
    moved_s: float


class Follower:
    """Keeps each page's camera at a constant position relative to the vehicle, unless the user turns it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._pages: dict[int, _Page] = {}
        self._often = Every(PERIOD_S)

    def draw(self, place: Array, now_s: float, furthest_m: float = FAR_M) -> None:
        """Move the cameras with a vehicle, or a team, at this position, m, at first from so far at most."""
        if not np.isfinite(place).all() or not self._often.due(now_s):
            return
        clients = self._server.get_clients()
        self._pages = {number: page for number, page in self._pages.items() if number in clients}
        for number, client in clients.items():
            offset = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            page = self._pages.get(number)
            if page is None:
                distance = max(float(np.linalg.norm(offset)), LEAST_M)
                offset = offset * (min(max(distance, NEAR_M), furthest_m) / distance)
                page = self._pages[number] = _Page(offset, looked_at_s=now_s + SETTLES_S, moved_s=now_s)
            elif now_s >= page.looked_at_s and np.linalg.norm(offset - page.offset) > TURNED * np.linalg.norm(page.offset):
                page.offset, page.moved_s = offset, now_s + HAND_S
            if now_s >= page.moved_s and np.linalg.norm(place - np.asarray(client.camera.look_at)) > LEAST_M:
                with client.atomic():
                    client.camera.position = place + page.offset
                    client.camera.look_at = place

    def release(self) -> None:
        """Stop following."""
        self._pages.clear()
