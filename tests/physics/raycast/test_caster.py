"""Single beams among solids: by hand, by symmetry, and independent of the index."""

import math

import numpy as np
import pybullet
import pytest

from tests.support.physics.random_worlds import L_SHAPE, Floats, attitudes, beams, hulls, scene, solids
from vcmvsp.physics.raycast.caster import Caster, caster_of
from vcmvsp.physics.sensors.range_scanner import RangeScanner, true_ranges
from vcmvsp.physics.world.solids import AnySolid, Box, Mesh, Prism, Shapes, shapes_of
from vcmvsp.physics.world.world import Scene, World

pytestmark = pytest.mark.slow

WALL = Box(center=(5.0, 0.0, 1.0), size=(0.2, 4.0, 2.0))
INF = math.inf


def range_of(among: tuple[AnySolid, ...], start: tuple[float, ...], toward: tuple[float, ...], reach: float = INF) -> float:
    direction = np.array(toward) / math.hypot(*toward)
    (distance,) = Caster(shapes_of(among)).cast(np.array(start), direction[None], reach)
    return float(distance)


def test_reach_is_inclusive() -> None:
    assert range_of((WALL,), (0, 0, 1), (1, 0, 0), 4.9) == pytest.approx(4.9)
    assert range_of((WALL,), (0, 0, 1), (1, 0, 0), 4.89) == INF
    assert range_of((WALL,), (5, 0, 1), (0, 0, 1)) == 0.0  # starts inside


def test_without_beams_or_solids_there_are_no_hits() -> None:
    assert Caster(shapes_of((WALL,))).cast(np.zeros(3), np.empty((0, 3))).shape == (0,)
    assert range_of((), (0, 0, 1), (1, 0, 0)) == INF


def test_nothing_passes_between_solids_that_touch() -> None:
    row = tuple(Box(center=(5.0, 0.3 * k, 1.0), size=(0.2, 0.3, 2.0)) for k in range(-5, 6))
    angle = np.concatenate([np.linspace(-0.25, 0.25, 5001), [math.atan2(0.15 + 0.3 * k, 4.9) for k in range(-4, 4)]])
    beams = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    found = Caster(shapes_of(row)).cast(np.array((0.0, 0.0, 1.0)), beams)
    assert found == pytest.approx(4.9 / np.cos(angle), rel=1e-12)


@pytest.mark.parametrize(
    ("start", "toward", "expected"),
    [
        ((0.0, 0.0, 1.5), (1, 0, 0), 4.9),
        ((1.5, 3.0, 0.5), (0, -1, 0), 2.0),
        ((-1.0, 0.0, 1.0), (-1, 0, 0), 1.0),
        ((0.0, -1.0, 1.0), (0, 0, 1), INF),
    ],
    ids=["box", "prism", "mesh", "nothing"],
)
def test_every_kind_of_solid_is_hit(start: tuple[float, ...], toward: tuple[float, ...], expected: float) -> None:
    among = (WALL, Prism(outline=L_SHAPE, height=1.0), Mesh(triangles=np.array([[(-2.0, -1, 0), (-2, 1, 0), (-2, 0, 2)]])))
    assert range_of(among, start, toward) == pytest.approx(expected)


def test_inside_is_behind_all_faces() -> None:
    caster = Caster(shapes_of((*(Prism(outline=L_SHAPE, bottom=1.0, height=1.0),), WALL)))
    assert [caster.inside(p) for p in ((0.5, 2, 1.5), (2.5, 0.5, 1.5), (5, 0, 1), (5.1, 2.0, 2.0))] == [True] * 4
    assert [caster.inside(p) for p in ((2, 2, 1.5), (0.5, 2, 0.5), (0.5, 2, 2.1), (5.2, 0, 1), (99, 0, 1))] == [False] * 5


def test_one_caster_for_each_world() -> None:
    world = World(solids=(WALL,))
    assert caster_of(world) is caster_of(world)
    assert caster_of(World(solids=(WALL,))) is not caster_of(world)


def random_beams(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    directions = rng.normal(0.0, (1.0, 1.0, 0.3), (count, 3))
    directions[::7, 2] = 0.0
    directions[::31, :2] = 0.0
    directions[::31, 2] = -1.0
    directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True))
    return np.column_stack([rng.uniform(-15.0, 15.0, (count, 2)), rng.uniform(0.01, 6.0, count)]), directions


def one_by_one(caster: Caster, origins: Floats, directions: Floats, reach: float = INF) -> Floats:
    return np.array([caster.cast(o, d[None], reach)[0] for o, d in zip(origins, directions, strict=True)])


@pytest.mark.parametrize("reach", [2.0, 12.0, INF])
def test_the_index_changes_no_range(reach: float) -> None:
    rng = np.random.default_rng(3)
    shapes = shapes_of(solids(rng))
    origins, directions = random_beams(rng, 200)
    expected = one_by_one(Caster(shapes, 1000.0), origins, directions, reach)
    assert np.isfinite(expected).sum() > 10
    for cell_m in (0.7, 3.0, None):
        assert np.array_equal(one_by_one(Caster(shapes, cell_m), origins, directions, reach), expected)


def test_many_beams_from_one_place_equal_single_beams() -> None:
    rng = np.random.default_rng(4)
    among = solids(rng)
    caster = Caster(shapes_of(among))
    over_a_box = np.array([*next(each for each in among if isinstance(each, Box)).center[:2], 9.0])
    for place in (over_a_box, np.array([0.3, -1.0, 1.0]), np.array([40.0, 0.0, 2.0])):
        _, directions = random_beams(rng, 400)
        together = caster.cast(place, directions)
        assert np.array_equal(together, one_by_one(caster, np.tile(place, (400, 1)), directions))
        assert np.isfinite(together).sum() > 4


def triangle_ranges(shapes: Shapes, origins: Floats, directions: Floats) -> Floats:
    """Ranges to all faces of prisms as triangles, for all beams, by three linear equations each."""
    vertices, triangles = shapes.mesh()
    best = np.full(len(origins), INF)
    for a, b, c in vertices[triangles]:
        system = np.stack(
            [np.broadcast_to(b - a, directions.shape), np.broadcast_to(c - a, directions.shape), -directions], axis=-1
        )
        flat = np.abs(np.linalg.det(system)) < 1e-12
        system[flat] = np.eye(3)
        u, v, t = np.linalg.solve(system, (origins - a)[:, :, None])[:, :, 0].T
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0) & ~flat
        best[hit] = np.minimum(best[hit], t[hit])
    return best


def test_prisms_against_their_own_triangles() -> None:
    rng = np.random.default_rng(8)
    shapes = shapes_of(solids(rng, count=24))
    origins, directions = random_beams(rng, 900)
    caster = Caster(shapes)
    outside = np.array([not caster.inside((x, y, z)) for x, y, z in origins.tolist()])
    origins, directions = origins[outside], directions[outside]
    found, expected = one_by_one(caster, origins, directions), triangle_ranges(shapes, origins, directions)
    assert 150 < np.isfinite(expected).sum() < len(expected) - 150
    assert found == pytest.approx(expected, abs=1e-9)


REACH, BEAMS, BODIES, POSES = 15.0, 60, 10, 50


def load(among: Scene, client: int) -> None:
    vertices, triangles = among.world.mesh()
    floor = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    lists = {"vertices": vertices.tolist(), "indices": triangles.ravel().tolist()}
    concave = pybullet.GEOM_FORCE_CONCAVE_TRIMESH
    solid = pybullet.createCollisionShape(pybullet.GEOM_MESH, **lists, flags=concave, physicsClientId=client)
    for shape in (floor, solid):
        pybullet.createMultiBody(0.0, shape, physicsClientId=client)
    for row in range(1, len(among.vehicles)):
        length, width, height = among.hulls[row].size
        kind = pybullet.GEOM_BOX if among.hulls[row].kind == "box" else pybullet.GEOM_CYLINDER
        size = {"radius": 0.5 * length, "height": height, "halfExtents": [0.5 * length, 0.5 * width, 0.5 * height]}
        shape = pybullet.createCollisionShape(kind, **size, physicsClientId=client)
        centre = among.position[row] + among.rotation(row) @ np.array(among.hulls[row].offset)
        w, x, y, z = among.attitude[row].tolist()
        pybullet.createMultiBody(0.0, shape, basePosition=centre.tolist(), baseOrientation=[x, y, z, w], physicsClientId=client)


def bullet_ranges(start: Floats, toward: Floats, client: int) -> Floats:
    answers = pybullet.rayTestBatch(start.tolist(), (start + REACH * toward).tolist(), physicsClientId=client)
    share = np.array([each[2] for each in answers])
    return np.where(np.array([each[0] for each in answers]) >= 0, REACH * share, np.inf)


@pytest.mark.parametrize(("tilt", "pitch"), [(0.0, 0.0), (0.002, 0.0), (0.3, 0.0), (0.3, 0.6)])
def test_ranges_as_in_bullet(tilt: float, pitch: float) -> None:
    """Fewer than one beam in a thousand deviates by more than 1 cm: beams that graze an edge."""
    sensor = RangeScanner(beams=BEAMS, field_of_view=5.0, range_max=REACH, pitch=pitch)
    off = total = met = 0
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        world = World(solids=solids(rng))
        place = np.column_stack([rng.uniform(-14.0, 14.0, (BODIES + 1, 2)), rng.uniform(0.05, 4.0, BODIES + 1)])
        hull, attitude = hulls(rng, BODIES + 1), attitudes(rng, BODIES + 1, tilt)
        client = pybullet.connect(pybullet.DIRECT)
        load(scene(world, place, attitude, hull), client)
        poses = 0
        while poses < POSES:
            place[0], attitude[0] = (*rng.uniform(-14.0, 14.0, 2), rng.uniform(0.1, 4.0)), attitudes(rng, 1, tilt)[0]
            among = scene(world, place.copy(), attitude.copy(), hull)
            (found,) = true_ranges([sensor], among, [0])
            if not found.all() or caster_of(world).inside((place[0, 0], place[0, 1], place[0, 2])):
                continue  # inside a solid: the two definitions differ
            origin, ahead, left, _ = (among.rotation(0) @ sensor.mount).T
            toward = beams(ahead, left, sensor.first, sensor.angle_step, BEAMS)
            expected = bullet_ranges(np.broadcast_to(origin + place[0], toward.shape), toward, client)
            same = (found == expected) | (np.abs(np.minimum(found, 1e3) - np.minimum(expected, 1e3)) <= 0.01)
            off, total, met, poses = off + int((~same).sum()), total + BEAMS, met + int(np.isfinite(found).sum()), poses + 1
        pybullet.disconnect(client)
    assert met > 0.3 * total
    assert off < 0.001 * total
