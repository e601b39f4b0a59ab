"""Camera pictures from random positions over a scenario's world, and the detection rates of its detector on them.

World, camera, targets and map cells are those of the scenario; no run is needed.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.assembly.parts import recognition
from vcmvsp.cosim.assembly.parts.recognition import Grid, Rectangle, of_picture
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw, wrap
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario.schema import VehicleTable
from vcmvsp.cosim.types import Array, Image, Positive, Sighting, VehicleState

STEEPEST = math.radians(5.0)  # largest tilt
ROOM_M = 0.5  # minimum distance of a vehicle to solids
TRIES = 1000  # attempts to find a free position
HIDDEN = 0.02  # of the distance: anything nearer hides a target
CELL_M = 2.0  # if the scenario gives none
MOST_CELLS = 10_000_000
Area = tuple[float, float, float, float]  # left, bottom, right, top, m


class InSight(NamedTuple):
    """A search target with its centre in a picture."""

    name: str
    place: tuple[float, float]  # m, world
    size_m: float
    pixel: tuple[float, float]  # u, v of its middle
    angle: float  # rad, rotation in the picture, counter-clockwise
    visible: float  # visible share
    looked: bool  # whether its centre lies in the area that the detector examined
    cell: int | None  # of the map; None: outside


class Snapshot(NamedTuple):
    """A picture, its targets and its detections."""

    pixels: Array  # (h, w, 3) uint8
    targets: tuple[InSight, ...]
    sightings: tuple[Sighting, ...]
    cells: Array  # (n,) cells of the map that were looked at
    hits: Array  # (n,) bool: a target was recognised there


class Snapshots:
    """Takes pictures with a vehicle's camera from random positions.

    Args:
        scenario: name, file or content of a scenario.
        vehicle: carrier of the camera; default: the first vehicle with a detector.
        height_m: height of the vehicle, world; default: search height.
        cell_m: side of a map cell; default: as in its search.
        seed: seed of the positions; the scenario's seed determines the world.
        settings: keys of the scenario with new values.

    Raises:
        ScenarioError: unknown vehicle, no search targets, or none of them in the world.
    """

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any],
        *,
        vehicle: str | None = None,
        height_m: float | None = None,
        cell_m: float | None = None,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        parsed, self._source = scenarios.load(scenario, settings=settings)
        self._scenario, self._seed = parsed, seed
        table_, key = self._camera_vehicle(vehicle)
        self.vehicle = table_.name
        params = self._params(table_)
        search, self.table = _search_of(params)
        self._start_watch(table_, params["watching"], key)
        self.world, _ = worlds.build(parsed.world, self._source, seed=parsed.seed)
        self.height_m = self._height(height_m, search, table_, key)
        self.area = self._area(search)
        self.cell_m = float(self._search_value(search, "cell_m", Positive, CELL_M)) if cell_m is None else cell_m
        self._grid = self._cells()
        names = self._watch.names
        self._targets = [each for each in self.world.targets if each.name in names]
        if not self._targets:
            problem = f"no target of {self.vehicle} ({', '.join(names)}) is in this world: add one"
            raise ScenarioError(problem, key="world.targets", source=self._source.of("world"))

    def take(self, number: int, of: int) -> Snapshot:
        """Picture ``number`` of ``of``, reproducible; every other one contains a target. Call in order."""
        rng = stream(self._seed, f"snapshots/{number}")
        time_s = self._scenario.duration_s * number / of
        state, time_ns = self._placed(rng, time_s, with_target=number % 2 == 0), seconds_to_ns(time_s)
        image = self._picture(state, time_ns, rng)
        obs = Observation(
            vehicle=self.vehicle,
            time_ns=time_ns,
            state=state,
            readings={self._camera_name: image},
            heard=ReceivedMessages.none(time_ns),
        )
        frame = self._watch.look(obs)
        assert frame is not None  # noqa: S101  the picture is new, and its pose is known
        cells, hits = of_picture(self._grid, frame)
        targets = [self._in_sight(each, frame, state, time_s) for each in self._targets]
        in_sight = tuple(each for each in targets if each is not None)
        return Snapshot(image.pixels, in_sight, frame.sightings, cells, hits)

    def _camera_vehicle(self, name: str | None) -> tuple[VehicleTable, str]:
        vehicles = {each.name: each for each in self._scenario.vehicle}
        if name is not None and name not in vehicles:
            raise ScenarioError(binding.unknown("vehicle", name, vehicles), key="vehicle", source=self._source.name)
        for each in [vehicles[name]] if name else vehicles.values():
            if self._params(each).get("watching") is not None:
                own = each.agent is not None and "watching" in each.agent.params
                return each, f"vehicle.{each.name}.agent.watching" if own else "agents.watching"
        problem = "is missing: set the camera and the targets to look for"
        key = f"vehicle.{name}.agent.watching" if name else "agents.watching"
        raise ScenarioError(problem, key=key, source=self._source.name)

    def _params(self, vehicle: VehicleTable) -> dict[str, Any]:
        if vehicle.agent is None:
            return {}
        return {**self._scenario.agents.defaults, **vehicle.agent.params}

    def _start_watch(self, vehicle: VehicleTable, content: object, key: str) -> None:
        with registry.looking_in(self._source.folder):
            settings: recognition.Watching = binding.convert(content, recognition.Watching, key=key, origin=self._source)
            try:
                self._watch = recognition.Watch(settings, key=key)
            except ScenarioError as error:
                raise self._source.error(error.problem, error.key) from error
        self._camera_name = settings.camera
        where = f"vehicle.{vehicle.name}.sensors"
        if settings.camera not in vehicle.sensors:
            problem = f"{binding.unknown('sensor', settings.camera, vehicle.sensors)} (of {vehicle.name})"
            raise self._source.error(problem, f"{key}.camera")
        sensor = {**vehicle.sensors[settings.camera], "depth": True}  # for occlusion tests
        self._camera: recognition.Camera
        self._camera, _ = registry.build("sensor", sensor, key=f"{where}.{settings.camera}", source=self._source)
        if not hasattr(self._camera, "focal_px"):
            raise self._source.error("must be a camera", f"{where}.{settings.camera}.kind")
        self._watch.start(VehicleInfo(name=vehicle.name, vehicles=(vehicle.name,), period_s=1.0, latency_s=0.0, seed=0))

    def _search_value(self, search: Mapping[str, Any], name: str, annotation: object, default: object) -> Any:
        if name not in search:
            return default
        return binding.convert(search[name], annotation, key=f"{self.table}.{name}", origin=self._source)

    def _height(self, height_m: float | None, search: Mapping[str, Any], vehicle: VehicleTable, key: str) -> float:
        if height_m is None:
            height_m = float(self._search_value(search, "height", float, vehicle.start[0][2]))
            if "height" not in search and not height_m > 0.0:
                problem = f"{self.vehicle} starts on the ground, and its search has no height: set one"
                raise ScenarioError(problem, key=f"vehicle.{self.vehicle}.position", source=self._source.name)
        mount, ground_m = self._watch.settings.mount, self._watch.settings.ground_m
        if not height_m + mount[2] > ground_m:
            problem = f"the camera of {self.vehicle}, at {height_m:g} m, is not above the ground, at {ground_m:g} m"
            raise ScenarioError(problem, key=f"{key}.ground_m", source=self._source.of(key))
        return height_m

    def _area(self, search: Mapping[str, Any]) -> Area:
        area = self._search_value(search, "area", tuple[float, float, float, float], self.world.bounds)
        if area is None:
            problem = f"is missing: {self.vehicle} has no search area, and the world has no bounds"
            raise ScenarioError(problem, key=f"{self.table}.area", source=self._source.name)
        left, bottom, right, top = map(float, area)
        if not (left < right and bottom < top):
            key, problem = f"{self.table}.area", f"must be left, bottom, right, top, not {binding.show(list(area))}"
            raise self._source.error(problem, key)
        return left, bottom, right, top

    def _cells(self) -> Grid:
        grid = Grid(Rectangle(*self.area), self.cell_m)
        if grid.rows * grid.columns > MOST_CELLS:
            problem = f"{self.cell_m:g} m gives more than {MOST_CELLS} cells in the area: use larger cells"
            raise ScenarioError(problem, key=f"{self.table}.cell_m", source=self._source.of(self.table))
        return grid

    def _placed(self, rng: np.random.Generator, time_s: float, *, with_target: bool) -> VehicleState:
        """A random pose in the area, clear of solids; with ``with_target``, a target lies anywhere in the picture."""
        left, bottom, right, top = self.area
        for _ in range(TRIES):
            yaw, direction = rng.uniform(-math.pi, math.pi, 2).tolist()
            half = 0.5 * rng.uniform(0.0, STEEPEST)
            tilt = math.cos(half), math.sin(half) * math.cos(direction), math.sin(half) * math.sin(direction), 0.0
            attitude = product(quaternion_from_yaw(yaw), tilt)
            x, y = float(rng.uniform(left, right)), float(rng.uniform(bottom, top))
            if with_target:
                target = self._targets[int(rng.integers(len(self._targets)))]
                across, down = (rng.uniform(0.0, 1.0, 2) * (self._camera.width - 1, self._camera.height - 1)).tolist()
                shift = self._over(attitude).ground_point((across, down))
                if shift is None:  # a wide-angle camera also sees the horizon
                    continue
                x, y = (coordinate - offset for coordinate, offset in zip(target.place(time_s), shift, strict=True))
            if not (left <= x <= right and bottom <= y <= top):
                continue
            corners = np.array([(x + i * ROOM_M, y + j * ROOM_M) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            if self.world.blocking(corners, self.height_m - ROOM_M, self.height_m + ROOM_M) is None:
                return VehicleState(position=(x, y, self.height_m), attitude=attitude)
        problem = f"no free place{' with a target in view' if with_target else ''} over the area at {self.height_m:g} m"
        raise self._source.error(problem, "world")

    def _over(self, attitude: Quaternion) -> recognition.Nadir:
        camera = self._camera
        state = VehicleState(position=(0.0, 0.0, self.height_m), attitude=attitude)
        mount = recognition.turned(attitude, self._watch.settings.mount)
        (x, y, z), (ahead, left, up) = state.position, mount
        place = (x + ahead, y + left, z + up)
        return recognition.Nadir(place, attitude, camera.focal_px, camera.width, camera.height, self._watch.settings.ground_m)

    def _picture(self, state: VehicleState, time_ns: int, rng: np.random.Generator) -> Image:
        (x, y, z), w = state.position, state.attitude
        scene = recognition.Scene(
            now_ns=time_ns,
            world=self.world,
            vehicles=(self.vehicle,),
            hulls=(recognition.Hull((0.1, 0.1, 0.1)),),
            position=np.array([[x, y, z]]),
            velocity=np.zeros((1, 3)),
            attitude=np.array([w]),
            angular_velocity=np.zeros((1, 3)),
            acceleration=np.zeros((1, 3)),
            wheels=np.full((1, 2), np.nan),
        )
        return self._camera.measure(scene, 0, rng)

    def _in_sight(
        self, target: recognition.PlacedTarget, frame: recognition.WatchFrame, state: VehicleState, time_s: float
    ) -> InSight | None:
        place = target.place(time_s)
        pixel, size = frame.nadir.pixel(place), (frame.nadir.width, frame.nadir.height)
        if pixel is None or not all(-0.5 <= at < edge - 0.5 for at, edge in zip(pixel, size, strict=True)):
            return None
        u, v = pixel
        ahead = target.yaw(time_s) + 0.5 * math.pi  # the upper edge points north at heading 0
        region = frame.looked
        return InSight(
            name=target.name,
            place=place,
            size_m=target.size_m,
            pixel=(u, v),
            angle=wrap(ahead - state.yaw),
            visible=_visible(target, frame, time_s),
            looked=region is not None and region[0] <= u <= region[2] and region[1] <= v <= region[3],
            cell=self._grid.at(*place),
        )


def _search_of(params: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    algorithms = params.get("algorithms")
    if isinstance(algorithms, Mapping):
        search = algorithms.get("search")
        return (search if isinstance(search, Mapping) else {}), "agents.algorithms.search"
    return params, "agents"


def _visible(target: recognition.PlacedTarget, frame: recognition.WatchFrame, time_s: float) -> float:
    """Unoccluded share of a target, from 25 of its points within the picture."""
    depth_m = frame.image.depth_m
    assert depth_m is not None  # noqa: S101  the camera is made so that it gives depths
    (x, y), yaw, nadir = target.place(time_s), target.yaw(time_s), frame.nadir
    axis = recognition.turned(nadir.attitude, (0.0, 0.0, -1.0))  # optical
    c, s = math.cos(yaw), math.sin(yaw)
    along = [target.size_m * (i - 2) * 0.24 for i in range(5)]
    free, total = 0, 0
    for a in along:
        for b in along:
            point = (x + c * a - s * b, y + s * a + c * b)
            pixel = nadir.pixel(point)
            if pixel is None:
                continue
            column, row = round(pixel[0]), round(pixel[1])
            if 0 <= column < nadir.width and 0 <= row < nadir.height:
                total += 1
                way = (point[0] - nadir.position[0], point[1] - nadir.position[1], nadir.ground_m - nadir.position[2])
                distance_m = sum((a * b for a, b in zip(axis, way, strict=True)), 0.0)
                free += bool(depth_m[row, column] >= (1.0 - HIDDEN) * distance_m)
    return free / total if total else 0.0


NEAR = 0.5  # in sides: maximum distance between a detection and its target
FREE = 0.99  # visible share from which a target counts as unoccluded
RINGS = ("middle third", "second third", "outer third")  # by distance from the centre of a picture to its corners
Z = 1.959964  # standard normal, two-sided 95 %


class Share(NamedTuple):
    """A count and its total."""

    part: int
    of: int

    @property
    def value(self) -> float:
        """The share; NaN for a total of zero."""
        return self.part / self.of if self.of else math.nan

    @property
    def mean(self) -> float:
        """Posterior mean with a flat prior: never 0 or 1, which a map cannot represent."""
        return (self.part + 1) / (self.of + 2)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
        if self.of == 0:
            return 0.0, 1.0
        n, share, z2 = self.of, self.value, Z * Z
        middle = (share + 0.5 * z2 / n) / (1.0 + z2 / n)
        reach = Z / (1.0 + z2 / n) * math.sqrt(share * (1.0 - share) / n + 0.25 * z2 / (n * n))
        low = middle - reach if self.part > 0 else 0.0
        high = middle + reach if self.part < self.of else 1.0
        return low, high

    def plus(self, *answers: bool) -> "Share":
        """The share with further answers."""
        return self.joined(Share(sum(answers), len(answers)))

    def joined(self, other: "Share") -> "Share":
        """The share of both totals together."""
        return Share(self.part + other.part, self.of + other.of)


NONE = Share(0, 0)


@dataclass
class Rates:
    """Detection rates over pictures; a look is a map cell within a picture."""

    p: Share = NONE  # share of looks at cells with a target that report one
    q: Share = NONE  # share of looks at cells without a target that report one
    precision: Share = NONE  # share of detections that are right
    recall: Share = NONE  # share of targets in view that are recognised, occluded ones included
    unoccluded: Share = NONE  # share of unoccluded targets that are recognised
    by_ring: dict[str, Share] = field(default_factory=lambda: dict.fromkeys(RINGS, NONE))  # recall by position in the picture
    angles: list[float] = field(default_factory=list)  # angle errors of recognised targets, rad
    places: list[float] = field(default_factory=list)  # position errors of recognised targets, m

    def add(self, snapshot: Snapshot) -> None:
        """Count a picture. A target outside the examined area counts only if it is recognised."""
        target_cells = [each.cell for each in snapshot.targets if each.cell is not None]
        has_target = np.isin(snapshot.cells, target_cells)
        self.p = self.p.plus(*snapshot.hits[has_target].tolist())
        self.q = self.q.plus(*snapshot.hits[~has_target].tolist())
        unmatched = list(snapshot.sightings)
        for target in snapshot.targets:
            near = [each for each in unmatched if math.dist(each.place, target.place) <= NEAR * target.size_m]
            match = next((each for each in near if each.target == target.name), None)
            if match is not None:
                unmatched.remove(match)
                self.precision = self.precision.plus(True)
                self.angles.append(abs(math.remainder(match.angle - target.angle, math.tau)))
                self.places.append(math.dist(match.place, target.place))
            if target.looked:
                self.recall = self.recall.plus(match is not None)
            if target.looked and target.visible >= FREE:
                self.unoccluded = self.unoccluded.plus(match is not None)
                ring = _ring(target, snapshot)
                self.by_ring[ring] = self.by_ring[ring].plus(match is not None)
        self.precision = self.precision.plus(*(False for _ in unmatched))

    def plain(self) -> Mapping[str, Any]:
        """The rates as numbers by name."""
        shares = {name: getattr(self, name) for name in ("p", "q", "precision", "recall", "unoccluded")}
        by_name = {name: _plain(each) for name, each in shares.items()}
        for name in ("p", "q"):
            by_name[name]["value"] = shares[name].mean
        return {**by_name, "by_ring": {name: _plain(each) for name, each in self.by_ring.items()}}


def _plain(share: Share) -> dict[str, Any]:
    return {"value": share.value if share.of else None, "interval": list(share.interval), "count": share.part, "of": share.of}


def _ring(target: InSight, snapshot: Snapshot) -> str:
    height, width = snapshot.pixels.shape[:2]
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    way = math.dist(target.pixel, middle) / math.hypot(*middle)
    return RINGS[min(int(3.0 * way), 2)]
