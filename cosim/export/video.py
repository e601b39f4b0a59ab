"""Video of a run: the team from above with its trails and links, and below it the formation error of each follower.

Where the team is small in its world the picture moves with it. The recording is the only input. Short runs play in real time;
long ones have `MOST_FRAMES` frames, and the video shows the speed-up.
"""

import math
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.metrics.formation import formation_errors
from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.recording.foxglove import FrameTransforms, SceneEntity, SceneUpdate, TriangleListPrimitive
from vcmvsp.cosim.recording.recorded_run import Source, Values
from vcmvsp.cosim.tables.schema import NOT_LOST, Placement
from vcmvsp.cosim.types import Array, Follows, FrameReport, VehicleState
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.palette import rgb_of
from vcmvsp.cosim.util.pictures import write_film

FPS = 20
MOST_FRAMES = 1800
LONGER_PX, MARGIN_PX, CAPTION_PX = 960, 40, 28
FOLLOWING_PX = 600  # height of the map that moves with the team
CURVE_PX, AXIS_PX = 150, 60  # height of the curves, and width of their labels
LEAST_M = 2.0  # least extent of the world along each side
TEAM_M, TEAM = 5.0, 1.5  # the moving map shows this much, and more than the team by this factor
SMALL = 0.6  # the map moves with a team that is smaller than this share of the world
SMOOTH_S = 2.0  # over which the movement of the map is averaged
FARTHEST_M = 1e8  # distance from the origin up to which places are shown
TRAIL_NS = 20 * SECOND_NS
LINK_NS = SECOND_NS // 2  # display time of a frame
MOST_LINKS = 150  # links displayed at once, the newest ones
FEW = 12  # up to this many vehicles, received frames are displayed, too
NAMED = 30  # vehicles with names beside them, at most
SHOWN = ("radio/frame", "world/moving", "world/solids")  # topics, besides the states
PAPER, DARK, FAINT, GRID = (245, 245, 245), (45, 45, 45), (200, 200, 200), (225, 225, 225)  # blue, green, red (OpenCV order)
LOST, RECEIVED = (31, 18, 193), (150, 150, 40)
PALE = 0.5  # blend of the world's colours with the paper's, so that movement stands out
FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX


def write_video(source: Source, path: Path, progress: Callable[[float], None]) -> None:
    """Write an MP4 file (`cosim.util.pictures`).

    Raises:
        UsageError: the recording contains no vehicle.
        OSError: the file cannot be written.
    """
    film = _Film(source)

    def frames() -> Iterator[Array]:
        for number, frame in enumerate(film.frames(), 1):
            yield frame
            progress(number / film.count)

    write_film(path, frames(), FPS)


class _Film:
    def __init__(self, source: Source) -> None:
        self._vehicles = source.vehicles
        self._ways: dict[str, list[tuple[int, tuple[float, float, float]]]] = {}  # ns; x, y m, yaw rad
        self._lost: list[tuple[int, str, str]] = []  # time, sender, receiver
        self._received: list[tuple[int, str, str]] = []
        self._follows: list[Placement] = []
        self._obstacles: list[tuple[int, FrameTransforms]] = []
        self._outlines: dict[str, Array] = {}  # of obstacles in their own frames, (k, 2) m
        self._corners: Array = np.empty((0, 3, 3))  # of triangles, (t, 3, 3) m
        self._colors: Array = np.empty((0, 3), np.uint8)
        self._end_ns = 0
        self._read(source)
        self._arrays: dict[str, tuple[tuple[int, ...], Array]] = {}
        for name, way in self._ways.items():
            times, poses = zip(*way, strict=True)
            self._arrays[name] = times, np.array(poses)
        if not any(_is_shown(poses[:, :2]).any() for _, poses in self._arrays.values()):
            raise UsageError("--mp4: the recording contains no vehicle")
        self.step_ns = max(SECOND_NS // FPS, -(-self._end_ns // MOST_FRAMES))
        self.count = self._end_ns // self.step_ns + 1
        self._errors = self._formation_errors()
        self._lay_out()
        self._base = self._ground() if len(self._middles) == 1 else None

    def frames(self) -> Iterator[Array]:
        """The video frames, (height, width, 3) uint8, blue, green, red."""
        for number in range(self.count):
            yield self._at(number * self.step_ns)

    def _read(self, source: Source) -> None:
        values = Values()
        for record in source.only(lambda topic, _: topic.endswith(("/state", "/follows")) or topic in SHOWN):
            self._end_ns = max(self._end_ns, record.time_ns)
            vehicle, _, subtopic = record.topic.partition("/")
            if subtopic == "state" and vehicle in self._vehicles:
                state: VehicleState = values.of(record)
                self._ways.setdefault(vehicle, []).append((record.time_ns, (*state.position[:2], state.yaw)))
            elif subtopic == "follows" and vehicle in self._vehicles:
                self._follows.append(Placement(record.time_ns, vehicle, read_json(record.data, Follows)))
            elif record.topic == "radio/frame":
                self._take_frame(values.of(record))
            elif record.topic == "world/moving":
                self._obstacles.append((record.time_ns, values.of(record)))
            elif record.topic == "world/solids":
                self._take_solids(values.of(record))
        self._lost.sort()
        self._received.sort()

    def _take_frame(self, report: FrameReport) -> None:
        few = len(self._vehicles) <= FEW
        for receiver, outcome in zip(report.receivers, report.outcome, strict=True):
            if outcome not in NOT_LOST:
                self._lost.append((report.sent_ns, report.sender, receiver))
            elif few and outcome == NOT_LOST[0]:
                self._received.append((report.sent_ns, report.sender, receiver))

    def _formation_errors(self) -> dict[str, tuple[Array, Array]]:
        """Times, ns, and error, m, of each vehicle that follows another."""
        names = tuple(name for name in self._vehicles if name in self._arrays)
        times = np.unique(np.concatenate([time_ns for time_ns, _ in self._arrays.values()]))
        position, yaw = np.full((3, len(times), len(names)), np.nan), np.full((len(times), len(names)), np.nan)
        for column, (time_ns, poses) in enumerate(self._arrays[name] for name in names):
            rows = times.searchsorted(time_ns)
            position[0, rows, column], position[1, rows, column], yaw[rows, column] = poses.T
        placements = [each for each in self._follows if each.vehicle in names and each.follows.leader in (None, *names)]
        errors = formation_errors(Motion(times, names, position, yaw), placements)
        finite = {name: np.isfinite(error_m) for name, error_m in errors.items()}
        return {name: (times[seen], errors[name][seen]) for name, seen in finite.items() if seen.any()}

    def _take_solids(self, scene: SceneUpdate) -> None:
        """Store the static triangles sorted by height, so that higher ones are drawn later, and the outlines of obstacles."""
        self._outlines = {entity.frame_id: _outline(entity) for entity in scene.entities if entity.cubes or entity.cylinders}
        parts = [part for entity in scene.entities for part in entity.triangles]
        if parts:
            corners, colors = np.concatenate(list(map(_corners, parts))), np.concatenate(list(map(_colors, parts)))
            order = np.argsort(corners[:, :, 2].max(axis=1), kind="stable")
            self._corners, self._colors = corners[order], colors[order]

    def _lay_out(self) -> None:
        """Choose scale and middles of the map: of all tracks and the world, or for each frame of a small team."""
        room = max((float(np.hypot(*outline.T).max()) for outline in self._outlines.values()), default=0.0)
        positions = [(each.translation.x, each.translation.y) for _, update in self._obstacles for each in update.transforms]
        corners = [(x + side * room, y + side * room) for x, y in positions for side in (-1.0, 1.0)]
        ways = [poses[:, :2] for _, poses in self._arrays.values()]
        places = np.concatenate([*ways, self._corners[..., :2].reshape(-1, 2), np.array(corners).reshape(-1, 2)])
        places = places[_is_shown(places)]
        low, high = places.min(axis=0), places.max(axis=0)
        extent, (middles, team) = np.maximum(high - low, LEAST_M), self._team()
        team = np.maximum(TEAM * team, TEAM_M)
        if team.max() < SMALL * extent.max():
            self._middles, width, height = middles, float(LONGER_PX), float(FOLLOWING_PX)
            self._scale = min((width - 2 * MARGIN_PX) / team[0], (height - 2 * MARGIN_PX) / team[1])  # px/m
        else:
            self._middles = 0.5 * (low + high)[None]
            self._scale = (LONGER_PX - 2 * MARGIN_PX) / float(extent.max())
            width, height = (extent * self._scale + 2 * MARGIN_PX).tolist()
        self._width, self._height = 2 * round(0.5 * width), 2 * round(0.5 * height) + CAPTION_PX  # even, for video codecs
        self._middle = self._middles[0]

    def _team(self) -> tuple[Array, Array]:
        """Middle of the team at each frame, (n, 2) m, averaged over time, and the largest extent about it, (2,) m."""
        time_ns = np.arange(self.count) * self.step_ns
        rows = [(at, poses, np.searchsorted(at, time_ns, "right") - 1) for at, poses in self._arrays.values()]
        places = np.stack([poses[row.clip(0), :2] for _, poses, row in rows])
        places[~np.isfinite(places) | (np.abs(places) > FARTHEST_M)] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # instants at which no vehicle is known
            low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
        middle = 0.5 * (low + high)
        is_known = np.isfinite(middle).all(axis=1)
        if not is_known.any():  # no frame shows a vehicle
            return middle, np.full(2, np.inf)
        frames = np.arange(self.count)
        middle = np.column_stack([np.interp(frames, frames[is_known], middle[is_known, axis]) for axis in (0, 1)])
        wide = max(1, round(SMOOTH_S * SECOND_NS / self.step_ns))
        padded = np.pad(middle, ((wide, wide), (0, 0)), "edge")
        sums = np.cumsum(padded, axis=0)
        smooth = (sums[2 * wide :] - sums[: -2 * wide]) / (2 * wide)
        return smooth, 2.0 * np.nanmax(np.maximum(np.abs(high - smooth), np.abs(low - smooth)), axis=0)

    def _px(self, places: Array) -> Array:
        """Convert positions (..., 2) m to picture coordinates, px."""
        along = (places.clip(-FARTHEST_M, FARTHEST_M) - self._middle) * self._scale * (1.0, -1.0)  # rows count downwards
        along += (0.5 * self._width, 0.5 * (self._height + CAPTION_PX))
        return np.nan_to_num(along, nan=-1e4).clip(-1e4, 1e4).round().astype(np.int32)

    def _ground(self) -> Array:
        """The world and a scale, in the present window."""
        import cv2

        picture = np.full((self._height, self._width, 3), PAPER, np.uint8)
        corners = self._px(self._corners[..., :2])
        size = np.array((self._width, self._height))
        is_visible = ((corners.max(axis=1) >= 0) & (corners.min(axis=1) < size)).all(axis=1)
        length_m = _round(self._width / self._scale / 5)
        if len(self._middles) > 1:  # lines tell that the picture moves
            half = 0.5 * size / self._scale
            for axis, other in ((0, 1), (1, 0)):
                first, last = np.floor((self._middle + np.array((-half, half))) / length_m)[:, axis]
                for number in np.arange(first, last + 1.0):
                    ends = np.empty((2, 2))
                    ends[:, axis], ends[:, other] = number * length_m, self._middle[other] + half[other] * np.array((-1.5, 1.5))
                    cv2.polylines(picture, [self._px(ends)], False, GRID, 1)
        for triangle, color in zip(corners[is_visible], self._colors[is_visible].tolist(), strict=True):
            cv2.fillConvexPoly(picture, triangle, color, cv2.LINE_AA)
        left, row = MARGIN_PX // 2, self._height - 12
        right = left + round(length_m * self._scale)
        cv2.line(picture, (left, row), (right, row), DARK, 2)
        _write(picture, f"{length_m:g} m", (right + 8, row + 4))
        return picture

    def _at(self, now_ns: int) -> Array:
        import cv2

        self._middle = self._middles[min(now_ns // self.step_ns, len(self._middles) - 1)]
        picture = self._ground() if self._base is None else self._base.copy()
        self._draw_obstacles(picture, now_ns)
        places = {name: self._place(name, now_ns) for name in self._arrays}
        for links, color in ((self._received, RECEIVED), (self._lost, LOST)):
            for (sender, receiver), strength in self._newest(links, now_ns).items():
                if sender in places and receiver in places:
                    shade = [round(strength * part + (1.0 - strength) * back) for part, back in zip(color, PAPER, strict=True)]
                    cv2.line(picture, self._point(places[sender]), self._point(places[receiver]), shade, 1, cv2.LINE_AA)
        for name in places:
            self._draw_vehicle(picture, name, now_ns)
        cv2.rectangle(picture, (0, 0), (self._width, CAPTION_PX), FAINT, -1)
        quicker = self.step_ns * FPS / SECOND_NS
        pace = "" if self.step_ns == SECOND_NS // FPS else f"   {quicker:.3g} x as fast as it was"
        received = "   green: received frames" if self._received else ""
        _write(picture, f"{now_ns / SECOND_NS:.1f} s{pace}{received}   red: lost frames", (10, 19), 0.5)
        return np.concatenate([picture, self._curves(now_ns)]) if self._errors else picture

    def _curves(self, now_ns: int) -> Array:
        """Formation error over time, up to now in the colours of the followers."""
        import cv2

        picture = np.full((CURVE_PX, self._width, 3), PAPER, np.uint8)
        top_m = _above(max(float(error_m.max()) for _, error_m in self._errors.values()))
        left, right, top, bottom = AXIS_PX, self._width - MARGIN_PX // 2, 24, CURVE_PX - 22
        span = np.array([(right - left) / max(self._end_ns, 1), (top - bottom) / top_m])
        for name, (time_ns, error_m) in self._errors.items():
            points = (np.array((left, bottom)) + np.column_stack([time_ns, error_m]) * span).round().astype(np.int32)
            cv2.polylines(picture, [points], False, FAINT, 1, cv2.LINE_AA)
            color = _bgr(rgb_of(self._vehicles.index(name)))
            cv2.polylines(picture, [points[: np.searchsorted(time_ns, now_ns, "right")]], False, color, 1, cv2.LINE_AA)
        cv2.line(picture, (left, bottom), (right, bottom), DARK, 1)
        cv2.line(picture, (left, bottom), (left, top), DARK, 1)
        now = left + round(now_ns * span[0])
        cv2.line(picture, (now, bottom), (now, top), DARK, 1)
        _write(picture, "formation error", (left, 14))
        _write(picture, f"{top_m:g} m", (8, top + 6))
        _write(picture, "0", (left - 14, bottom))
        _write(picture, f"{self._end_ns / SECOND_NS:g} s", (right - 44, CURVE_PX - 6))
        return picture

    def _newest(self, links: list[tuple[int, str, str]], now_ns: int) -> dict[tuple[str, str], float]:
        """The links with a recent frame, the newest last, and its freshness, 0 to 1."""
        span_ns, freshness = max(LINK_NS, self.step_ns), dict[tuple[str, str], float]()
        for number in range(bisect_right(links, now_ns, key=lambda each: each[0]) - 1, -1, -1):
            sent_ns, sender, receiver = links[number]
            if sent_ns <= now_ns - span_ns or len(freshness) == MOST_LINKS:
                break
            freshness.setdefault((sender, receiver), 1.0 - 0.8 * (now_ns - sent_ns) / span_ns)
        return dict(reversed(freshness.items()))

    def _place(self, name: str, now_ns: int) -> Array:
        time_ns, poses = self._arrays[name]
        return poses[max(0, bisect_right(time_ns, now_ns) - 1)]

    def _draw_vehicle(self, picture: Array, name: str, now_ns: int) -> None:
        import cv2

        time_ns, poses = self._arrays[name]
        number, color = self._vehicles.index(name), _bgr(rgb_of(self._vehicles.index(name)))
        first, last = bisect_right(time_ns, now_ns - TRAIL_NS), bisect_right(time_ns, now_ns)
        trail = poses[first:last, :2]
        cv2.polylines(picture, [self._px(trail[_is_shown(trail)])], False, color, 1, cv2.LINE_AA)
        x, y, yaw = self._place(name, now_ns).tolist()
        if not np.isfinite([x, y, yaw]).all():
            return
        middle = self._px(np.array([x, y]))
        c, s = np.cos(yaw), np.sin(yaw)
        body = np.array([(11.0, 0.0), (-8.0, 6.0), (-8.0, -6.0)]) @ np.array([(c, -s), (-s, -c)])
        cv2.fillConvexPoly(picture, (middle + body).round().astype(np.int32), color, cv2.LINE_AA)
        if len(self._vehicles) <= NAMED or number == 0:
            _write(picture, name, (int(middle[0]) + 10, int(middle[1]) - 8))

    def _draw_obstacles(self, picture: Array, now_ns: int) -> None:
        import cv2

        newest = bisect_right(self._obstacles, now_ns, key=lambda each: each[0]) - 1
        for each in self._obstacles[newest][1].transforms if newest >= 0 else ():
            at, turn = np.array([each.translation.x, each.translation.y]), each.rotation
            yaw = yaw_of((turn.w, turn.x, turn.y, turn.z))
            c, s = math.cos(yaw), math.sin(yaw)
            outline = at + self._outlines.get(each.child_frame_id, np.zeros((1, 2))) @ np.array([(c, s), (-s, c)])
            cv2.fillConvexPoly(picture, self._px(outline), FAINT, cv2.LINE_AA)
            cv2.polylines(picture, [self._px(outline)], True, DARK, 1, cv2.LINE_AA)
            x, y = self._point(at)
            _write(picture, each.child_frame_id.partition("/")[2], (x + 10, y + 4))

    def _point(self, place: Array) -> tuple[int, int]:
        x, y = self._px(place[:2]).tolist()
        return x, y


def _is_shown(places: Array) -> Array:
    """Whether each of n places (n, 2) m is known, and near enough for a picture, (n,) bool."""
    near: Array = np.abs(places) < FARTHEST_M
    return near[:, 0] & near[:, 1]


def _outline(entity: SceneEntity) -> Array:
    """Outline of a box or a cylinder from above, (k, 2) m."""
    if entity.cubes:
        size = entity.cubes[0].size
        return 0.5 * np.array([(size.x, size.y), (-size.x, size.y), (-size.x, -size.y), (size.x, -size.y)])
    angles = np.arange(24) * (math.tau / 24)
    return 0.5 * entity.cylinders[0].size.x * np.column_stack((np.cos(angles), np.sin(angles)))


def _corners(part: TriangleListPrimitive) -> Array:
    points = np.array([(point.x, point.y, point.z) for point in part.points]).reshape(-1, 3)
    return points[np.array(part.indices, np.int64)].reshape(-1, 3, 3)


def _colors(part: TriangleListPrimitive) -> Array:
    color = (1.0 - PALE) * np.array(_bgr((part.color.r, part.color.g, part.color.b))) + PALE * np.array(PAPER)
    return np.tile(color.astype(np.uint8), (len(part.indices) // 3, 1))


def _round(length: float) -> float:
    """The largest of 1, 2, 5, 10, ... that does not exceed a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step for step in (1, 2, 5) if step * power <= length) * power)


def _above(number: float) -> float:
    """The least of 1, 2, 5, 10, ... that is not below a number above 0; 0.001 at least."""
    number = max(number, 0.001)
    below = _round(number)
    return below if below >= number else _round(2.5 * below * (1.0 + 1e-9))


def _write(picture: Array, words: str, place: tuple[int, int], size: float = 0.42) -> None:
    import cv2

    cv2.putText(picture, words, place, FONT, size, DARK, 1, cv2.LINE_AA)


def _bgr(color: tuple[float, ...]) -> tuple[int, ...]:
    return tuple(round(255 * part) for part in reversed(color))
