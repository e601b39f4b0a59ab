"""Video of a reconnaissance mission: a map with vehicles, trails and viewed areas, beside the camera pictures."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.mission import Target
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.recording.foxglove import corners_of, label_of
from vcmvsp.cosim.recording.mission_log import FRAMES, MissionLog, surest_map
from vcmvsp.cosim.types import Array, ProbabilityMap, Sightings
from vcmvsp.cosim.util.palette import COMMANDERS, PROBABILITY, TARGET, rgb, rgb_of
from vcmvsp.cosim.util.pictures import decoded, write_film

FPS = 10
QUICKER = 4  # least speed-up of the video, which has at most `FRAMES` frames
MAP_PX, SIDE_PX = 640, 480  # width of the map, which is square, and of the pictures beside it
MARGIN_PX = 30
GLIMPSE_NS = 3 * SECOND_NS  # areas seen within this time are tinted
MOST_PICTURES = 6
DARK, PALE, LINE = (45, 45, 45), (255, 255, 255), (110, 110, 110)
FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX

T = TypeVar("T")
Color = tuple[int, ...]  # blue, green, red (OpenCV order)


def write_video(path: Path, log: MissionLog, moved: Motion, targets: Sequence[Target], outlines: Sequence[Array]) -> None:
    """Write an MP4 file (`cosim.util.pictures`)."""
    write_film(path, frames(log, moved, targets, outlines), FPS)


def frames(log: MissionLog, moved: Motion, targets: Sequence[Target], outlines: Sequence[Array]) -> Iterator[Array]:
    """The video frames, (MAP_PX, MAP_PX + SIDE_PX, 3) uint8, blue, green, red."""
    step_ns = max(round(QUICKER / FPS * SECOND_NS), -(-log.end_ns // (FRAMES - 1)))
    above, beside = _Above(log, moved, targets, outlines), _Beside(log)
    for now_ns in range(0, log.end_ns + 1, step_ns):
        yield np.hstack((above.at(now_ns), beside.at(now_ns)))


class _Above:
    def __init__(self, log: MissionLog, moved: Motion, targets: Sequence[Target], outlines: Sequence[Array]) -> None:
        self._log, self._moved, self._targets = log, moved, targets
        self._low, self._scale = _frame_of(log, moved)
        self._outlines = [self._px(outline) for outline in outlines]
        self._trails = self._px(np.moveaxis(moved.position[:2], 0, -1))  # (m, n, 2)
        self._is_known: Array = np.isfinite(moved.position[:2].sum(axis=0))
        self._base = _paper()
        self._base_of: tuple[int, ...] | None = None  # number of maps of each vehicle in the cached background

    def at(self, now_ns: int) -> Array:
        import cv2

        picture = self._ground(now_ns).copy()
        until = bisect_right(self._moved.time_ns, now_ns)
        for target in self._targets:
            place = self._point(self._px(np.array(target.place(now_ns / SECOND_NS))))
            cv2.circle(picture, place, 7, DARK, -1, cv2.LINE_AA)
            cv2.circle(picture, place, 5, _bgr(rgb(TARGET)), -1, cv2.LINE_AA)
            _say(picture, target.name, (place[0] + 14, place[1] + 4), DARK)  # clear of a vehicle above it
        for name in self._log.vehicles:
            if name in self._moved.names and until:
                self._vehicle(picture, name, until)
        _say(picture, f"{now_ns / SECOND_NS:.1f} s", (10, 20), DARK, 0.6)
        return picture

    def _vehicle(self, picture: Array, name: str, until: int) -> None:
        import cv2

        column, color = self._moved.column(name), _bgr(rgb_of(self._log.vehicles.index(name)))
        trail = self._trails[:until, column][self._is_known[:until, column]]
        if not len(trail):
            return
        cv2.polylines(picture, [trail], False, color, 1, cv2.LINE_AA)
        yaw = self._moved.yaw[until - 1, column]
        if np.isfinite(yaw):
            c, s = np.cos(yaw), np.sin(yaw)
            body = np.array([(11.0, 0.0), (-8.0, 6.0), (-8.0, -6.0)]) @ np.array([(c, -s), (-s, -c)])  # rows count downwards
            cv2.fillConvexPoly(picture, (trail[-1] + body).round().astype(np.int32), color, cv2.LINE_AA)
        x, y = trail[-1].tolist()
        _say(picture, name, (x + 10, y - 8), color)

    def _ground(self, now_ns: int) -> Array:
        import cv2

        newest = tuple(bisect_right(maps, now_ns, key=lambda each: each[0]) for maps in self._log.maps.values())
        if newest != self._base_of:
            self._base_of, self._base = newest, _paper()
            grid, surest = surest_map(self._log, now_ns)
            if grid is not None:
                self._paint(grid, self._tinted(PROBABILITY_BGR[surest], now_ns, surest.shape))
            cv2.polylines(self._base, self._outlines, True, LINE, 1, cv2.LINE_AA)
        return self._base

    def _tinted(self, cells: Array, now_ns: int, shape: tuple[int, ...]) -> Array:
        for name, maps in self._log.maps.items():
            before, now = (_newest(maps, time_ns) for time_ns in (now_ns - GLIMPSE_NS, now_ns))
            if now is not None and now.seen.shape == shape and (before is None or before.seen.shape == shape):
                fresh = now.seen if before is None else now.seen & ~before.seen
                color = np.array(_bgr(rgb_of(self._log.vehicles.index(name))))
                cells[fresh] = (0.65 * cells[fresh] + 0.35 * color).astype(np.uint8)
        return cells

    def _paint(self, grid: ProbabilityMap, cells: Array) -> None:
        import cv2

        rows, columns = cells.shape[:2]
        west, north = self._point(self._px(np.array([grid.left, grid.bottom + rows * grid.cell_m])))
        east, south = self._point(self._px(np.array([grid.left + columns * grid.cell_m, grid.bottom])))
        large = cv2.resize(cells[::-1], (max(east - west, 1), max(south - north, 1)), interpolation=cv2.INTER_NEAREST)
        top, left = max(north, 0), max(west, 0)
        part = large[top - north : MAP_PX - north, left - west : MAP_PX - west]
        self._base[top : top + part.shape[0], left : left + part.shape[1]] = part

    def _px(self, places: Array) -> Array:
        along = MARGIN_PX + (places - self._low) * self._scale
        along[..., 1] = MAP_PX - along[..., 1]
        return np.nan_to_num(along, nan=-1e4).clip(-1e4, 1e4).round().astype(np.int32)

    def _point(self, place: Array) -> tuple[int, int]:
        x, y = place.tolist()
        return x, y


class _Beside:
    def __init__(self, log: MissionLog) -> None:
        self._log = log
        pictures_of = {}
        for name in log.vehicles:
            pictures_of[name] = [each for each in log.sightings.get(name, ()) if each[1].jpeg]
        chosen = sorted(pictures_of, key=lambda name: not pictures_of[name])[:MOST_PICTURES]
        self._pictures_of = {name: pictures for name, pictures in pictures_of.items() if name in chosen}
        count = len(self._pictures_of)
        self._columns = 1 if count <= 2 else 2
        self._height, self._width = MAP_PX // -(-max(count, 1) // self._columns), SIDE_PX // self._columns
        self._cache: dict[str, tuple[int, Array]] = {}

    def at(self, now_ns: int) -> Array:
        picture = np.full((MAP_PX, SIDE_PX, 3), 20, np.uint8)
        for place, (name, pictures) in enumerate(self._pictures_of.items()):
            top, left = place // self._columns * self._height, place % self._columns * self._width
            cell = picture[top : top + self._height, left : left + self._width]
            newest = bisect_right(pictures, now_ns, key=lambda each: each[0]) - 1
            if newest >= 0:
                small = self._picture(name, newest, pictures[newest][1])
                y, x = 24 + (cell.shape[0] - 24 - small.shape[0]) // 2, (cell.shape[1] - small.shape[1]) // 2
                cell[y : y + small.shape[0], x : x + small.shape[1]] = small
            commander = _newest(self._log.noted.of(name, "commander"), now_ns) or ""
            color = _bgr(rgb(COMMANDERS[commander])) if commander in COMMANDERS else PALE
            _say(cell, f"{name}  {commander}", (6, 17), color, 0.5)
        return picture

    def _picture(self, name: str, number: int, sightings: Sightings) -> Array:
        import cv2

        if self._cache.get(name, (-1,))[0] != number:
            scale = min((self._width - 4) / sightings.width, (self._height - 28) / sightings.height)
            quick = cv2.IMREAD_REDUCED_COLOR_2 if scale < 0.75 else cv2.IMREAD_COLOR
            pixels = decoded(sightings.jpeg, quick)
            size = max(int(sightings.width * scale), 1), max(int(sightings.height * scale), 1)
            small = np.zeros((size[1], size[0], 3), np.uint8) if pixels is None else cv2.resize(pixels, size)
            for each in sightings.found:
                corners = ((np.array(corners_of(each)) + 0.5) * scale).round().astype(np.int32)
                cv2.polylines(small, [corners], True, DARK, 3, cv2.LINE_AA)
                cv2.polylines(small, [corners], True, _bgr(rgb(TARGET)), 1, cv2.LINE_AA)
                (x, y), low = corners.min(axis=0).tolist(), int(corners[:, 1].max())
                _say(small, label_of(each), (max(x, 2), y - 5 if y > 17 else low + 14), _bgr(rgb(TARGET)), shade=DARK)
            self._cache[name] = number, small
        return self._cache[name][1]


def _paper() -> Array:
    return np.full((MAP_PX, MAP_PX, 3), 235, np.uint8)


def _frame_of(log: MissionLog, moved: Motion) -> tuple[Array, float]:
    """The south-west corner (m) and the scale (px/m) of a picture that contains all maps and tracks."""
    corners = [moved.position[:2].reshape(2, -1).T]
    for maps in log.maps.values():
        for _, each in maps[:1]:
            low, size = np.array([each.left, each.bottom]), each.cell_m * np.array(each.seen.shape[::-1])
            corners.append(np.array([low, low + size]))
    places = np.concatenate(corners)
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return np.zeros(2), 1.0
    low, high = places.min(axis=0), places.max(axis=0)
    side = max(float((high - low).max()), 1e-3)
    return 0.5 * (low + high - side), (MAP_PX - 2 * MARGIN_PX) / side


def _newest(history: Sequence[tuple[int, T]], now_ns: int) -> T | None:
    count = bisect_right(history, now_ns, key=lambda each: each[0])
    return history[count - 1][1] if count else None


def _say(
    picture: Array, words: str, place: tuple[int, int], color: Color, size: float = 0.42, shade: Color | None = None
) -> None:
    import cv2

    x, y = place
    if shade is not None:  # outline of the same stroke width: wider strokes change the spacing
        for right, down in ((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)):
            cv2.putText(picture, words, (x + right, y + down), FONT, size, shade, 1, cv2.LINE_AA)
    cv2.putText(picture, words, place, FONT, size, color, 1, cv2.LINE_AA)


def _bgr(color: tuple[float, ...]) -> Color:
    return tuple(round(255 * part) for part in reversed(color))


_STOPS = np.array([_bgr(rgb(code)) for code in PROBABILITY]).T
_PARTS = [np.interp(np.arange(256), np.linspace(0.0, 255.0, len(PROBABILITY)), part) for part in _STOPS]
PROBABILITY_BGR: Array = np.stack(_PARTS, axis=1).round().astype(np.uint8)  # for map values 0 to 255
