"""Recording of a camera: detections, sometimes pictures with their pixels, and a mosaic of the ground."""

from typing import Annotated

import cv2
import msgspec
import numpy as np

from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.probability_map import Rectangle
from vcmvsp.agents.reconnaissance.watch import STEEPEST, WatchFrame
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, Mosaic, Positive, Sightings, frozen

NOTHING_NS = seconds_to_ns(5.0)  # period of recorded pictures without a target
QUALITY = 80  # of JPEG, in percent


class PictureRecording:
    """Selects the pictures of one camera for the recording, those with a target in them every ``picture_s`` seconds."""

    def __init__(self, camera: str, picture_s: float) -> None:
        self._camera, self._every_ns = camera, seconds_to_ns(picture_s)
        self._kept_ns: int | None = None  # time of the last recorded picture

    def of(self, frame: WatchFrame) -> Sightings | None:
        """Record of a picture; None: it is not recorded."""
        wait_ns = self._every_ns if frame.sightings else max(self._every_ns, NOTHING_NS)
        keep = self._kept_ns is None or frame.time_ns - self._kept_ns >= wait_ns
        if not (keep or frame.sightings):
            return None
        jpeg = b""
        if keep:
            self._kept_ns, picture = frame.time_ns, cv2.cvtColor(frame.image.pixels, cv2.COLOR_RGB2BGR)
            jpeg = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1].tobytes()
        return Sightings(
            sensor=self._camera,
            time_ns=frame.time_ns,
            width=frame.nadir.width,
            height=frame.nadir.height,
            found=frame.sightings,
            jpeg=jpeg,
        )


MOST_CELLS = 4_000_000  # 12 MB
EVERY_NS = seconds_to_ns(1.0)  # period of pictures in the mosaic


class Mosaicking(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Area and resolution of a mosaic of the ground."""

    area: Rectangle  # left, bottom, right, top, m, world
    cell_m: Positive = 0.25  # edge of a pixel of it
    every_s: Annotated[float, msgspec.Meta(ge=1)] = 10.0  # period of display


class Sheet:
    """A growing mosaic of the ground; `ScenarioError`: the area has no cells, or too many."""

    def __init__(self, settings: Mosaicking) -> None:
        (left, bottom, right, top), cell = settings.area, settings.cell_m
        if not (right > left and top > bottom):
            raise ScenarioError("right must be greater than left, and top greater than bottom", key="area")
        columns, rows = max(1, round((right - left) / cell)), max(1, round((top - bottom) / cell))
        if columns * rows > MOST_CELLS:
            words = f"gives {columns * rows / 1e6:.0f} million cells; use larger ones (at most {MOST_CELLS / 1e6:.0f} million)"
            raise ScenarioError(f"{cell:g} m {words}", key="cell_m")
        self._left, self._bottom, self._cell_m = left, bottom, cell
        self._every_ns = seconds_to_ns(settings.every_s)
        self._pixels = np.zeros((rows, columns, 3), np.uint8)
        self._laid_ns: int | None = None  # time of the newest picture in the mosaic
        self._shown_ns: int | None = None

    def lay(self, frame: WatchFrame) -> None:
        """Add a picture if one is due and it shows no horizon."""
        if self._laid_ns is not None and frame.time_ns - self._laid_ns < EVERY_NS:
            return
        corners = frame.nadir.footprint()
        if frame.nadir.upright < STEEPEST or corners is None:
            return
        self._laid_ns = frame.time_ns
        self._warp(frame.image.pixels, frame.nadir, np.array(corners))

    def due_mosaic(self, now_ns: int) -> Mosaic | None:
        """The present mosaic; None: it is not due, or still empty."""
        if self._laid_ns is None or (self._shown_ns is not None and now_ns - self._shown_ns < self._every_ns):
            return None
        self._shown_ns = now_ns
        return Mosaic(left=self._left, bottom=self._bottom, cell_m=self._cell_m, pixels=frozen(self._pixels))

    def _warp(self, picture: Array, nadir: Nadir, corners: Array) -> None:
        """Draw a picture onto the sheet; ``corners``, (4, 2) m on the ground, run counter-clockwise from its upper left."""
        rows, columns = self._pixels.shape[:2]
        on_sheet = (corners - (self._left, self._bottom)) / self._cell_m  # in cells, from the corner of the first
        low = np.maximum(np.floor(on_sheet.min(axis=0)), 0.0).astype(int)
        high = np.minimum(np.ceil(on_sheet.max(axis=0)), (columns, rows)).astype(int)
        if (low >= high).any():
            return
        finer = self._cell_m * nadir.focal_px / nadir.height_m  # pixels of the picture for each cell
        if finer > 1.0:  # averaged first: a cell shows all of its ground
            size = [max(1, round(edge / finer)) for edge in (nadir.width, nadir.height)]
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        height, width = picture.shape[:2]
        edges = np.array([(0, 0), (0, height), (width, height), (width, 0)], np.float32) - np.float32(0.5)
        turn = cv2.getPerspectiveTransform(edges, (on_sheet - low - 0.5).astype(np.float32))
        part = self._pixels[low[1] : high[1], low[0] : high[0]]
        warped = cv2.warpPerspective(picture, turn, part.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = np.zeros(part.shape[:2], np.uint8)
        cv2.fillConvexPoly(inside, np.rint((on_sheet - low - 0.5) * 16.0).astype(np.int32), 1, cv2.LINE_8, 4)
        np.copyto(part, warped, where=inside[:, :, None] > 0)
