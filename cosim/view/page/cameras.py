"""The cameras of the pages: all vehicles, or one of them, in the picture."""

import math
from dataclasses import dataclass

import numpy as np
import viser

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.page.drawing import Every

START = np.array([-0.25, -0.6, 0.6]) / math.sqrt(0.25**2 + 2 * 0.6**2)  # direction of the initial camera, from what it shows
FAR = 4.0  # largest distance drawn, at least, of that of the camera
FILL, NEAREST_M = 0.75, 4.0  # share of the picture that all vehicles take at first, and smallest distance of the camera
INNER = 0.92  # share of the picture that vehicles may take later: a vehicle at its edge is half outside
PERIOD_S, OVERVIEW_S = 0.06, 0.5  # of following, and of looking for vehicles outside the picture
NEAR_M, FAR_M = 2.0, 12.0  # limits of the initial distance from a vehicle
HAND_S = 0.4  # time after the user's last camera input before following resumes
SETTLES_S = 0.5  # time until a page reports its camera
TURNED = 0.02  # of the distance: a larger change is user input
LEAST_M = 0.005  # smaller movements of a vehicle do not move a camera


class Overview:
    """Keeps all vehicles in the picture of a page until its user moves the camera."""

    def __init__(self, server: viser.ViserServer, west: float, south: float, east: float, north: float) -> None:
        self._server = server
        self._shown = np.array([(west, south, 0.0), (east, north, 0.0)])
        self._cameras: dict[int, tuple[Array, float]] = {}  # as set, by page: place and look-at; s, until the page reports it
        self._often = Every(OVERVIEW_S)

    def aim(self, places: Array, now_s: float) -> None:
        """Show these places, (n, 3) m, on open pages and at first on later ones; without any the floor."""
        self.fit(places, now_s)
        initial = self._server.initial_camera
        middle, distance = fitted(self._shown, START, initial.fov, 1.0)
        initial.far = max(initial.far, FAR * distance)
        initial.position = middle + distance * START
        initial.look_at = middle

    def fit(self, places: Array, now_s: float) -> None:
        """Show these places, (n, 3) m, on the open pages, from the direction of the initial camera."""
        if len(places):
            self._shown = places
        for number, client in self._server.get_clients().items():
            self._set(number, client, now_s)

    def draw(self, places: Array, now_s: float) -> None:
        """Enlarge each picture that lacks one of these places, (n, 3) m, to what it showed and all places."""
        if not len(places) or not self._often.due(now_s):
            return
        initial, clients = self._server.initial_camera, self._server.get_clients()
        start = np.concatenate([initial.position, initial.look_at]), now_s
        self._cameras = {number: self._cameras.get(number, start) for number in clients}
        for number, client in clients.items():
            camera, (set_to, settled_s) = client.camera, self._cameras[number]
            moved_m = np.linalg.norm(np.concatenate([camera.position, camera.look_at]) - set_to)
            is_moved = moved_m > TURNED * np.linalg.norm(camera.position - camera.look_at)
            if now_s < settled_s or is_moved or in_picture(places, camera):
                continue
            self._shown = np.concatenate([self._shown, places])
            self._set(number, client, now_s)

    def _set(self, number: int, client: viser.ClientHandle, now_s: float) -> None:
        camera = client.camera
        known_size = camera.update_timestamp and camera.image_height
        fov, aspect = (camera.fov, camera.aspect) if known_size else (self._server.initial_camera.fov, 1.0)
        middle, distance = fitted(self._shown, START, fov, aspect)
        position = middle + distance * START
        with client.atomic():
            camera.far = max(camera.far, self._server.initial_camera.far, FAR * distance)
            camera.position = position
            camera.look_at = middle  # after the position, which moves it
        self._cameras[number] = np.concatenate([position, middle]), now_s + SETTLES_S


def fitted(places: Array, back: Array, fov: float, aspect: float) -> tuple[Array, float]:
    """Point to look at, (3,) m, and distance, m, of a camera that has these places, (n, 3) m, in its picture.

    Args:
        back: unit vector from the point to the camera.
        fov: vertical field of view, rad.
        aspect: width of the picture by its height.
    """
    axes = _axes(back)
    slopes = FILL * math.tan(0.5 * fov) * np.array([aspect, 1.0])
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    for _ in range(4):  # from a distance that shows all of them, then centred on their projection
        seen = (places - middle) @ axes
        distance = max(float((np.abs(seen[:, :2]) / slopes + seen[:, 2:]).max()), NEAREST_M)
        ahead = seen[:, :2] / (distance - seen[:, 2:])
        middle = middle + distance * axes[:, :2] @ (0.5 * (ahead.min(axis=0) + ahead.max(axis=0)))
    seen = (places - middle) @ axes
    return middle, max(float((np.abs(seen[:, :2]) / slopes + seen[:, 2:]).max()), NEAREST_M)


def in_picture(places: Array, camera: viser.CameraHandle) -> bool:
    """Whether all places, (n, 3) m, are in the picture of an upright camera, and not at its edge."""
    back = camera.position - camera.look_at
    seen = (places - camera.position) @ _axes(back / np.linalg.norm(back))
    slopes = INNER * math.tan(0.5 * camera.fov) * np.array([camera.aspect, 1.0])
    return bool((np.abs(seen[:, :2]) <= -seen[:, 2:] * slopes).all())


def _axes(back: Array) -> Array:
    """Axes of an upright camera, columns right, up and back; ``back`` is a unit vector from what it shows to the camera."""
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back])


@dataclass
class _Page:
    """Camera of a page: position relative to the vehicle, m, and earliest times to read and move it, s."""

    offset: Array
    looked_at_s: float
    moved_s: float


class Follower:
    """Keeps each page's camera at a constant position relative to what it follows, unless the user turns it."""

    def __init__(self, server: viser.ViserServer, farthest_m: float = FAR_M) -> None:
        self._server, self._farthest_m = server, farthest_m
        self._pages: dict[int, _Page] = {}
        self._often = Every(PERIOD_S)

    def draw(self, place: Array, now_s: float) -> None:
        """Move the cameras with what is at this position, m."""
        if not np.isfinite(place).all() or not self._often.due(now_s):
            return
        clients = self._server.get_clients()
        self._pages = {number: page for number, page in self._pages.items() if number in clients}
        for number, client in clients.items():
            offset = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            page = self._pages.get(number)
            if page is None:
                distance = max(float(np.linalg.norm(offset)), LEAST_M)
                offset = offset * (min(max(distance, NEAR_M), self._farthest_m) / distance)
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
