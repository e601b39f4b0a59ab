"""Sensor data and maps in the browser: scans as fans, pictures, and maps and mosaics on the floor."""

import math
from collections.abc import Collection, Mapping

import numpy as np
import viser
from viser.transforms import SO3

from vcmvsp.cosim.recording.foxglove import corners_of
from vcmvsp.cosim.types import Array, Image, Mosaic, ProbabilityMap, Scan, Sightings
from vcmvsp.cosim.util import pictures
from vcmvsp.cosim.util.palette import PROBABILITY, rgb
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.drawing import NO_SHADOW, TARGET_RGB, Every, colors_of, rotated
from vcmvsp.cosim.view.page.state import PageState

GROUNDS = MAP, MOSAIC, NOTHING = "map of targets", "mosaic", "nothing"
OVER_FLOOR_M = 0.01
WIDEST_PX = 512  # of a picture in the panel
EXAMINED = ", examined"  # behind the name of a camera whose picture was searched for targets
FRUSTUM = 3.0  # size of a camera's pyramid, of the diagonal of its vehicle
FAN_OPACITY, WIDEST_RAD = 0.2, 0.26  # of the free space of a scan; largest drawn width of a beam, rad
MAP_ALPHA = 110  # of 255


class Scans:
    """The newest scan of each scanner, at the pose of its measurement: returns as points, free space as a translucent fan."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server = server
        self._colors = colors_of(len(scenery.vehicles))
        self._nodes: dict[str, viser.PointCloudHandle] = {}
        self._fans: dict[str, viser.MeshHandle] = {}
        self._drawn_scans: dict[str, Scan] = {}

    def draw(self, state: PageState, names: tuple[str, ...]) -> None:
        """Draw new scans of the wanted sensors (vehicle/sensor) and hide the others."""
        for key, node in self._nodes.items():
            node.visible = self._fans[key].visible = key in names and key in state.now.scans
        for key in names:
            scan, row = state.now.scans.get(key), state.row.get(key.partition("/")[0])
            if scan is None or row is None or self._drawn_scans.get(key) is scan:
                continue
            self._drawn_scans[key] = scan
            points = points_of(scan, state.position[row], state.attitude[row])
            vertices, faces = fan_of(scan, state.position[row], state.attitude[row])
            if key in self._nodes:
                self._nodes[key].points = points
                self._fans[key].vertices, self._fans[key].faces = vertices, faces
            else:
                red, green, blue = self._colors[row].tolist()
                self._nodes[key] = self._server.scene.add_point_cloud(
                    f"/scans/{key}", points, (red, green, blue), point_size=0.06, point_shape="circle", precision="float32"
                )
                self._fans[key] = self._server.scene.add_mesh_simple(
                    f"/fans/{key}",
                    vertices,
                    faces,
                    color=(red, green, blue),
                    opacity=FAN_OPACITY,
                    side="double",
                    **NO_SHADOW,
                )


class Pictures:
    """The newest pictures of the wanted cameras, and the newest picture searched for targets: in the panel and in the scene.

    Create it in the context of its container.
    """

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server, self._frusta = server, Frusta(server, scenery)
        self._folder = server.gui.add_folder(None)
        self._nodes: dict[str, viser.GuiImageHandle] = {}
        self._drawn_pictures: dict[str, Image | Sightings] = {}
        self._often = Every(0.15)

    def draw(self, state: PageState, chosen: str, names: tuple[str, ...], now_s: float) -> None:
        """Show new pictures of the chosen vehicle."""
        if self._often.due(now_s):
            self._renew(state, chosen, names)
        self._frusta.draw(state)

    def _renew(self, state: PageState, chosen: str, names: tuple[str, ...]) -> None:
        pictures: dict[str, Image | Sightings] = {key: state.now.images[key] for key in names if key in state.now.images}
        sightings = state.now.sightings.get(chosen)
        if sightings is not None and sightings.jpeg:
            pictures[f"{chosen}/{sightings.sensor}{EXAMINED}"] = sightings
        for key, node in self._nodes.items():
            node.visible = key in pictures
        self._frusta.show({key.partition(EXAMINED)[0] for key in pictures})
        for key, picture in pictures.items():
            if self._drawn_pictures.get(key) is not picture and (pixels := _pixels(picture)) is not None:
                self._drawn_pictures[key] = picture
                self._put(key, pixels)

    def _put(self, key: str, pixels: Array) -> None:
        self._frusta.put(key.partition(EXAMINED)[0], pixels)
        if key in self._nodes:
            self._nodes[key].image = pixels
        else:
            with self._folder:
                self._nodes[key] = self._server.gui.add_image(pixels, label=key, format="jpeg", jpeg_quality=80)


class Frusta:
    """The pyramids that cameras see, at their present poses, with their newest pictures."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._server, self._colors = server, colors_of(len(scenery.vehicles))
        crafts = list(enumerate(scenery.vehicles))
        self._lenses = {f"{each.name}/{name}": (row, lens) for row, each in crafts for name, lens in each.cameras.items()}
        self._size_m = [FRUSTUM * math.hypot(*each.size) for each in scenery.vehicles]
        self._nodes: dict[str, viser.CameraFrustumHandle] = {}

    def put(self, key: str, pixels: Array) -> None:
        """Show a new picture of a camera (vehicle/sensor)."""
        if key in self._nodes:
            self._nodes[key].image = pixels
        elif key in self._lenses:
            row, lens = self._lenses[key]
            red, green, blue = self._colors[row].tolist()
            self._nodes[key] = self._server.scene.add_camera_frustum(
                f"/cameras/{key}",
                lens.field_of_view,
                lens.aspect,
                scale=self._size_m[row],
                thickness=2.0,
                thickness_units="screen",
                color=(red, green, blue),
                image=pixels,
                format="jpeg",
                jpeg_quality=80,
                **NO_SHADOW,
            )

    def show(self, keys: Collection[str]) -> None:
        """Show the pyramids of these cameras and hide the others."""
        for key, node in self._nodes.items():
            node.visible = key in keys

    def draw(self, state: PageState) -> None:
        """Move the visible pyramids with their vehicles."""
        for key, node in self._nodes.items():
            row, lens = self._lenses[key]
            if node.visible and np.isfinite(state.position[row]).all():
                turn = SO3(state.attitude[row])
                node.position = state.position[row] + turn.apply(np.array(lens.mount))
                node.wxyz = (turn @ SO3.from_matrix(np.array(lens.body_from_camera))).wxyz


class Ground:
    """A vehicle's map of targets or its mosaic, as a picture on the floor."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.kind = MAP
        self._node: viser.ImageHandle | None = None
        self._drawn_ground: object = None
        self._frame: tuple[float, ...] = ()
        self._often = Every(0.5)

    def draw(self, state: PageState, chosen: str, now_s: float) -> None:
        """Draw the map or mosaic of the chosen vehicle if it is new."""
        layers: dict[str, Mapping[str, ProbabilityMap | Mosaic]] = {MAP: state.now.maps, MOSAIC: state.now.mosaics}
        ground = layers.get(self.kind, {}).get(chosen)
        if self._node is not None:
            self._node.visible = ground is not None
        if ground is None or ground is self._drawn_ground or not self._often.due(now_s):
            return
        self._drawn_ground = ground
        pixels = np.ascontiguousarray(painted(ground)[::-1])  # row 0 is the south edge
        rows, columns = pixels.shape[:2]
        frame = ground.left, ground.bottom, columns * ground.cell_m, rows * ground.cell_m
        if self._node is not None and frame == self._frame:
            self._node.image = pixels
            return
        left, bottom, width, height = self._frame = frame
        # A picture has its rows along -y of the node and is visible from -z: half a turn about x puts it on the floor.
        self._node = self._server.scene.add_image(
            "/ground",
            pixels,
            width,
            height,
            format="png",
            position=(left + 0.5 * width, bottom + 0.5 * height, OVER_FLOOR_M),
            wxyz=(0.0, 1.0, 0.0, 0.0),
            **NO_SHADOW,
        )


def points_of(scan: Scan, position: Array, attitude: Array) -> Array:
    """End points of the beams with a return, (k, 3) m, world, for a scanner at this pose."""
    (beams,) = np.nonzero(np.isfinite(scan.ranges))
    ranges, angles = np.asarray(scan.ranges, float)[beams], scan.angle_min + scan.angle_step * beams
    ends = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(beams))])
    return np.asarray(position + rotated(np.broadcast_to(attitude, (len(ends), 4)), ends), np.float32)


def fan_of(scan: Scan, position: Array, attitude: Array) -> tuple[Array, Array]:
    """Free space seen by a scan at this pose: vertices (2 n + 1, 3) m, world, and triangles (n, 3), one wedge per beam.

    A wedge ends at the return or, without one, at the maximum range; below the minimum range it is empty.
    """
    count = len(scan.ranges)
    ranges = np.clip(np.nan_to_num(np.asarray(scan.ranges, float), posinf=scan.range_max, neginf=0.0), 0.0, scan.range_max)
    half = 0.5 * min(abs(scan.angle_step), WIDEST_RAD)
    angles = (scan.angle_min + scan.angle_step * np.arange(count))[:, None] + (-half, half)
    ends = ranges[:, None, None] * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=2)
    local = np.concatenate([np.zeros((1, 3)), ends.reshape(-1, 3)])
    vertices = position + rotated(np.broadcast_to(attitude, (len(local), 4)), local)
    first = 1 + 2 * np.arange(count)
    faces = np.column_stack([np.zeros(count, int), first, first + 1])
    return np.asarray(vertices, np.float32), np.asarray(faces, np.uint32)


def painted(ground: ProbabilityMap | Mosaic) -> Array:
    """A map or a mosaic as (rows, columns, 4) uint8, RGBA; unseen cells of a mosaic are transparent."""
    if isinstance(ground, Mosaic):
        return np.dstack([ground.pixels, np.uint8(255) * ground.pixels.any(axis=2)])
    stops = np.array([rgb(code) for code in PROBABILITY]) * 255.0
    levels = np.arange(256) / 255.0
    table = np.column_stack([np.interp(levels, np.linspace(0.0, 1.0, len(stops)), stops[:, part]) for part in range(3)])
    colors = table.round().astype(np.uint8)[ground.probability]
    return np.dstack([colors, np.full(colors.shape[:2], MAP_ALPHA, np.uint8)])


def _pixels(picture: Image | Sightings) -> Array | None:
    """A picture for the panel, at most `WIDEST_PX` wide; None if unreadable."""
    import cv2

    if isinstance(picture, Image):
        pixels = np.asarray(picture.pixels)
    else:
        decoded = pictures.decoded(picture.jpeg, cv2.IMREAD_COLOR)
        if decoded is None:
            return None
        pixels = np.ascontiguousarray(decoded[..., ::-1])
        for each in picture.found:
            corners = np.round(np.array(corners_of(each))).astype(np.int32)
            cv2.polylines(pixels, [corners], isClosed=True, color=TARGET_RGB, thickness=2)
    height, width = pixels.shape[:2]
    if width > WIDEST_PX:
        size = WIDEST_PX, max(1, math.floor(height * WIDEST_PX / width))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    return pixels
