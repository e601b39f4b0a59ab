"""What stands around the vehicles, in the browser, and the camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Obstacle, Scenery
from vcmvsp.cosim.view.page.drawing import EDGE_RGB, FLOOR, FLOOR_DARK, SKY_DARK, TARGET_RGB, WHITE, Every, disc
from vcmvsp.cosim.view.page.state import Known

MOST_COLORS = 48  # of the solids; of more, similar ones become one
MARGIN_M, WIDE_M = 5.0, 40.0
FLOOR_Z_M = -0.01  # of what is drawn, so that what lies on it is seen
SUN = (0.4, -0.7, 1.0)
TARGET_M = 0.4  # radius of a target's mark
VIEW, NEAREST_M = 0.8, 7.0  # how far off the camera begins: of the diagonal of what it is to see, and at least


class Scene:
    """The surroundings; only what moves is told again."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server = server
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)  # light of all colours from everywhere would bleach the vehicles' own
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
        _add_solids(server, scenery)
        self._obstacles = {each.name: _add_obstacle(server, each) for each in scenery.obstacles}
        self._targets = {name: _add_target(server, name, x, y) for name, x, y in scenery.targets}

    def draw(self, known: Known) -> None:
        """Put obstacles and targets where they are, and floor under all vehicles."""
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
        """Let the floor reach this far, and far enough beyond it that it need not grow again soon."""
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
        """Floor and sky, for a light or a dark page: never so dark that a black vehicle is lost in it."""
        floor, sky = (FLOOR_DARK, SKY_DARK) if dark else (FLOOR, WHITE)
        self.floor.plane_color = floor
        self._server.scene.set_background_image(np.full((1, 1, 3), sky, np.uint8), format="png")

    def aim(self, known: Known) -> bool:
        """Let the camera begin where it sees all vehicles and what stands about them, also on pages that are open already.

        Returns:
            Whether it is known by now where the vehicles are.
        """
        seen = known.position[np.isfinite(known.position).all(axis=1)]
        found = len(seen) > 0 or not known.names
        west, south, east, north = self._extent
        if len(known.scenery.vertices) or not len(seen):
            seen = np.concatenate([seen, [(west, south, 0.0), (east, north, 0.0)]])
        low, high = seen.min(axis=0), seen.max(axis=0)
        distance = max(VIEW * float(np.linalg.norm(high - low)), NEAREST_M)
        middle = 0.5 * (low + high)
        cameras: list[Any] = [self._server.initial_camera, *(each.camera for each in self._server.get_clients().values())]
        for camera in cameras:
            camera.position = middle + distance * np.array([-0.25, -0.6, 0.6])
            camera.look_at = middle  # after the position, which takes it along
        return found


def extent_of(scenery: Scenery) -> tuple[float, float, float, float]:
    """West, south, east and north edge of the floor that is drawn, m."""
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
    """Few colours, (k, 3) uint8, and which of them each of (t, 3) has, (t,): those of the triangles, or near to them."""
    step = 1
    while True:
        coarse = np.minimum(colors.astype(np.int64) // step * step + step // 2, 255).astype(np.uint8)
        kinds, which = np.unique(coarse, axis=0, return_inverse=True)
        if len(kinds) <= MOST_COLORS:
            return kinds, which.reshape(-1)
        step *= 2


def _add_solids(server: viser.ViserServer, scenery: Scenery) -> None:
    """All that stands still: a mesh per colour, for a mesh in the browser has but one."""
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
NEAR_M, FAR_M = 2.0, 12.0  # between which the camera begins
HAND_S = 0.4  # after a hand has left the camera, it goes along again
SETTLES_S = 0.5  # until a page says where its camera is by now
TURNED = 0.02  # of the distance: a hand was on it
LEAST_M = 0.005  # a vehicle that goes less far takes no camera along


@dataclass
class _Page:
    """The camera of a page: where it is as seen from the vehicle, m, and when it may be looked at and moved, s."""

    offset: Array
    looked_at_s: float
    moved_s: float


class Follower:
    """Keeps each page's camera where it is as seen from the vehicle, except where a hand turns it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._pages: dict[int, _Page] = {}
        self._often = Every(PERIOD_S)

    def draw(self, place: Array, now_s: float) -> None:
        """Go along with a vehicle that is here, m."""
        if not np.isfinite(place).all() or not self._often.due(now_s):
            return
        clients = self._server.get_clients()
        self._pages = {number: page for number, page in self._pages.items() if number in clients}
        for number, client in clients.items():
            offset = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            page = self._pages.get(number)
            if page is None:
                distance = max(float(np.linalg.norm(offset)), LEAST_M)
                offset = offset * (min(max(distance, NEAR_M), FAR_M) / distance)
                page = self._pages[number] = _Page(offset, looked_at_s=now_s + SETTLES_S, moved_s=now_s)
            elif now_s >= page.looked_at_s and np.linalg.norm(offset - page.offset) > TURNED * np.linalg.norm(page.offset):
                page.offset, page.moved_s = offset, now_s + HAND_S
            if now_s >= page.moved_s and np.linalg.norm(place - np.asarray(client.camera.look_at)) > LEAST_M:
                with client.atomic():
                    client.camera.position = place + page.offset
                    client.camera.look_at = place

    def release(self) -> None:
        """Let all cameras be."""
        self._pages.clear()
