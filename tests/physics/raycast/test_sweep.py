"""Scan planes against single beams: equal to 1e-9 m for any grouping of scanners."""

import math

import numpy as np
import pytest

from tests.support.physics.random_worlds import Floats, attitudes, beams, cast_bodies, hulls, scene, solids
from vcmvsp.physics.raycast.caster import Caster, caster_of
from vcmvsp.physics.raycast.sweep import sweep
from vcmvsp.physics.sensors.range_scanner import RangeScanner, fan_of, true_ranges
from vcmvsp.physics.world.solids import Box, Hull, Mesh
from vcmvsp.physics.world.world import Scene, World

pytestmark = pytest.mark.slow

INF = math.inf


def sensors_of(rng: np.random.Generator, count: int, pitches: tuple[float, ...]) -> list[RangeScanner]:
    return [
        RangeScanner(
            beams=int(rng.integers(1, 150)),
            field_of_view=float(rng.choice([0.8, math.pi, 5.5, 6.2832])),
            range_max=float(rng.uniform(3.0, 20.0)),
            position=tuple(rng.uniform(-0.4, 0.4, 3).tolist()),
            yaw=float(rng.uniform(-3.0, 3.0)),
            pitch=float(rng.choice(pitches)),
        )
        for _ in range(count)
    ]


def one_by_one(sensor: RangeScanner, among: Scene, row: int) -> Floats:
    origin, ahead, left, _ = (among.rotation(row) @ sensor.mount).T
    toward = beams(ahead, left, sensor.first, sensor.angle_step, sensor.beams)
    place = origin + among.position[row]
    with np.errstate(divide="ignore"):
        floor = np.where((toward[:, 2] < 0.0) & (place[2] > 0.0), place[2] / -toward[:, 2], INF)
    solid = caster_of(among.world).cast(place, toward, sensor.range_max)
    nearest = np.minimum(np.minimum(floor, solid), cast_bodies(among, np.broadcast_to(place, toward.shape), toward, row))
    return np.where(nearest <= sensor.range_max, nearest, INF)


def random_scene(seed: int, tilt: float, vehicles: int = 12) -> tuple[Scene, np.random.Generator]:
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-14.0, 14.0, (vehicles, 2)), rng.uniform(0.05, 4.0, vehicles)])
    world = World(solids=solids(rng))
    return scene(world, place, attitudes(rng, vehicles, tilt), hulls(rng, vehicles)), rng


@pytest.mark.parametrize("tilt", [0.0, 1e-3, 0.2, 2.0])
@pytest.mark.parametrize("pitches", [(0.0,), (0.3, -1.2, 1.5708)])
def test_a_plane_of_beams_equals_single_beams(tilt: float, pitches: tuple[float, ...]) -> None:
    met = 0
    for seed in range(4):
        among, rng = random_scene(seed, tilt)
        sensors = sensors_of(rng, len(among.vehicles), pitches)
        for row, (sensor, found) in enumerate(zip(sensors, true_ranges(sensors, among, range(12)), strict=True)):
            assert found == pytest.approx(one_by_one(sensor, among, row), abs=1e-9)
            met += int(np.isfinite(found).sum())
    assert met > 800


def test_grouping_changes_no_bit() -> None:
    among, rng = random_scene(5, 0.1)
    level = scene(among.world, among.position, attitudes(rng, 12, 0.0), among.hulls)
    half = scene(among.world, among.position, np.where(np.arange(12)[:, None] % 2, among.attitude, level.attitude), among.hulls)
    for each in (among, level, half):
        sensors = sensors_of(rng, 12, (0.0, 0.4, 1.5708))
        together = true_ranges(sensors, each, range(12))
        for row, (sensor, found) in enumerate(zip(sensors, together, strict=True)):
            assert np.array_equal(found, true_ranges([sensor], each, [row])[0])
        backwards = true_ranges(sensors[::-1], each, range(11, -1, -1))[::-1]
        assert all(np.array_equal(a, b) for a, b in zip(together, backwards, strict=True))


def test_a_level_scanner_beside_a_tilted_one_sees_no_floor() -> None:
    sensor = RangeScanner(beams=16, field_of_view=6.2832, range_max=20.0)
    nose_down = np.array([[1.0, 0.0, 0.0, 0.0], [math.cos(0.1), 0.0, math.sin(0.1), 0.0]])
    small = [Hull(size=(0.01, 0.01, 0.01))] * 2
    level, tilted = true_ranges([sensor] * 2, scene(World(), [(0.0, 0.0, 1.0), (0.0, 30.0, 1.0)], nose_down, small), [0, 1])
    assert level.tolist() == [math.inf] * 16
    assert tilted[0] == pytest.approx(1.0 / math.sin(0.2))
    assert tilted[8] == math.inf


def test_more_beams_than_a_batch() -> None:
    among, _ = random_scene(6, 0.05)
    sensor = RangeScanner(beams=3000, field_of_view=math.pi, range_max=15.0)
    for row, found in enumerate(true_ranges([sensor] * 12, among, range(12))):
        assert np.array_equal(found, true_ranges([sensor], among, [row])[0])


def test_cells_of_any_size() -> None:
    among, rng = random_scene(7, 0.1)
    sensors = sensors_of(rng, 12, (0.0, 0.3))
    shapes, fan, bodies = among.world.shapes, fan_of(sensors, among, range(12)), among.placed_hulls
    expected = np.concatenate(sweep(Caster(shapes, 500.0), fan, bodies))
    for cell_m in (0.5, 2.0, None):
        assert np.array_equal(np.concatenate(sweep(Caster(shapes, cell_m), fan, bodies)), expected)


def rotated_world(boxes: list[tuple[float, float, float, float]], angle: float) -> World:
    """Boxes (x, y, length, width), 2 m high, rotated with the world by the angle; every other box by another half turn."""
    c, s = math.cos(angle), math.sin(angle)
    solids = [
        Box(center=(c * x - s * y, s * x + c * y, 1.0), size=(a, b, 2.0), yaw_rad=angle + math.pi * (k % 2))
        for k, (x, y, a, b) in enumerate(boxes)
    ]
    return World(solids=tuple(solids))


def facing(world: World, angle: float, y: float = 0.0) -> Scene:
    """A scanner 1 m above the origin, or beside it, facing along the angle."""
    place = (-math.sin(angle) * y, math.cos(angle) * y, 1.0)
    return scene(world, [place], np.array([[math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)]]))


@pytest.mark.parametrize("gap", [0.15, 0.45, 0.75, 1.05])
def test_nothing_passes_between_solids_that_touch(gap: float) -> None:
    opening = 2.0 * math.atan2(gap, 4.9)
    ends = RangeScanner(beams=2, field_of_view=opening, range_max=20.0)  # both beams hit an edge shared by two boxes
    many = RangeScanner(beams=301, field_of_view=opening, range_max=20.0)
    for angle in np.linspace(-3.0, 3.0, 50).tolist():
        row = rotated_world([(5.0, 0.3 * k, 0.2, 0.3) for k in range(-5, 6)], angle)
        two, all_of_them = (true_ranges([each], facing(row, angle), [0])[0] for each in (ends, many))
        assert two == pytest.approx(math.hypot(4.9, gap))
        assert all_of_them == pytest.approx(4.9 / np.cos(np.linspace(-0.5 * opening, 0.5 * opening, 301)))


def test_nothing_passes_between_triangles_that_touch() -> None:
    y = 0.3 * np.arange(-5, 6)
    low, high = (np.column_stack([np.full(11, 5.0), y, np.full(11, z)]) for z in (0.0, 2.0))
    sheet = np.concatenate([np.stack([low[:-1], high[1:], high[:-1]], axis=1), np.stack([low[:-1], low[1:], high[1:]], axis=1)])
    heights = np.linspace(0.1, 1.9, 400)
    elsewhere = Hull(size=(0.01, 0.01, 0.01), offset=(-5.0, 0.0, 0.0))
    view = scene(World(solids=(Mesh(triangles=sheet),)), [(0.0, 0.0, z) for z in heights], hulls=[elsewhere] * 400)
    for edge in y[:-1].tolist():
        at_edge = edge + 0.15 * heights  # y of an oblique edge shared by two triangles at this height
        yaws = np.arctan2(at_edge, 5.0).tolist()
        sensors = [RangeScanner(beams=3, field_of_view=0.02, range_max=20.0, yaw=yaw) for yaw in yaws]
        found = [ranges[1] for ranges in true_ranges(sensors, view, range(400))]
        assert found == pytest.approx(np.hypot(5.0, at_edge).tolist())


def test_a_beam_along_a_face_is_stable() -> None:
    sensor = RangeScanner(beams=3, field_of_view=0.02, range_max=20.0)
    for angle in np.linspace(-3.0, 3.0, 50).tolist():
        walls = rotated_world(
            [(4.0, 0.5, 6.0, 1.0), (9.0, 0.0, 1.0, 4.0)], angle
        )  # the first begins right of the scanner, at 1 m
        for sideways in (0.0, 1e-15, -1e-15, -1e-12):
            (found,) = true_ranges([sensor], facing(walls, angle, sideways), [0])
            assert found[0] == pytest.approx(8.5 / math.cos(0.01))
            assert found[1] in (pytest.approx(1.0), pytest.approx(8.5))
            assert found[2] == pytest.approx(1.0 / math.cos(0.01))


def surface(hull: Hull, points: Floats) -> Floats:
    """Signed measure of points in the frame of a hull: 0 on its surface, negative inside."""
    offset = np.abs(points - np.array(hull.offset))
    half = 0.5 * np.array(hull.size)
    if hull.kind == "cylinder":
        offset[:, 0], half[1] = np.hypot(offset[:, 0], offset[:, 1]), np.inf
    return (offset - half).max(axis=1)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
def test_beams_end_on_the_surface_and_not_before(kind: str) -> None:
    rng = np.random.default_rng(5)
    hull = hulls(rng, 2)[0 if kind == "cylinder" else 1]
    assert hull.kind == kind
    for attitude in (*np.eye(4)[[0] * 10], *attitudes(rng, 30, 1.5)):
        body = scene(World(), [(1.0, 2.0, 3.0)], attitude[None], [hull])
        directions = rng.normal(size=(100, 3))
        directions[::9] = 0.0, 0.0, -1.0  # along the axis of an upright hull
        directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True))
        origins = np.array([1.0, 2.0, 3.0]) - 3.0 * directions + rng.uniform(-1.0, 1.0, (100, 3))
        distance = cast_bodies(body, origins, directions)

        def local(along: Floats, body: Scene = body, origins: Floats = origins, directions: Floats = directions) -> Floats:
            return (origins + along[:, None] * directions - body.position[0]) @ body.rotation(0)

        hit = np.isfinite(distance)
        assert 4 < hit.sum() < 100
        outside = distance > 0.0
        end = local(np.where(hit, distance, 0.0))[hit & outside]
        assert np.abs(surface(hull, end)).max() < 1e-9
        for share in np.linspace(0.0, 0.999, 40):
            before = surface(hull, local(share * np.where(hit, distance, 8.0)))
            assert before[outside].min() > -1e-9
