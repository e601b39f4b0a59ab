"""Scanners against the rays of Bullet, an engine of its own, in random poses of random worlds."""

import numpy as np
import pybullet
import pytest

from tests.support.physics.random_worlds import Floats, attitudes, beams, hulls, scene, solids
from vcmvsp.physics.raycast.caster import caster_of
from vcmvsp.physics.sensors.range_scanner import RangeScanner, true_ranges
from vcmvsp.physics.world.world import Scene, World

REACH, BEAMS, BODIES, POSES = 15.0, 60, 10, 50


def load(among: Scene, client: int) -> None:
    vertices, triangles = among.world.mesh()
    floor = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    solid = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=vertices.tolist(),
        indices=triangles.ravel().tolist(),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    for shape in (floor, solid):
        pybullet.createMultiBody(0.0, shape, physicsClientId=client)
    for row in range(1, len(among.vehicles)):
        length, width, height = among.hulls[row].size
        kind = pybullet.GEOM_BOX if among.hulls[row].kind == "box" else pybullet.GEOM_CYLINDER
        shape = pybullet.createCollisionShape(
            kind,
            radius=0.5 * length,
            height=height,
            halfExtents=[0.5 * length, 0.5 * width, 0.5 * height],
            physicsClientId=client,
        )
        centre = among.position[row] + among.rotation(row) @ np.array(among.hulls[row].offset)
        w, x, y, z = among.attitude[row].tolist()
        pybullet.createMultiBody(0.0, shape, basePosition=centre.tolist(), baseOrientation=[x, y, z, w], physicsClientId=client)


def bullet_ranges(start: Floats, toward: Floats, client: int) -> Floats:
    answers = pybullet.rayTestBatch(start.tolist(), (start + REACH * toward).tolist(), physicsClientId=client)
    share = np.array([each[2] for each in answers])
    return np.where(np.array([each[0] for each in answers]) >= 0, REACH * share, np.inf)


@pytest.mark.parametrize(("tilt", "pitch"), [(0.0, 0.0), (0.002, 0.0), (0.3, 0.0), (0.3, 0.6)])
def test_a_thousand_poses(tilt: float, pitch: float) -> None:
    """Of all beams less than one in a thousand are off by more than 1 cm: those that graze an edge."""
    sensor = RangeScanner(beams=BEAMS, field_of_view=5.0, range_max=REACH, pitch=pitch)
    off = total = met = 0
    for seed in range(5):
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
                continue  # inside something: there the two mean different things
            origin, ahead, left, _ = (among.rotation(0) @ sensor.mount).T
            toward = beams(ahead, left, sensor.first, sensor.angle_step, BEAMS)
            expected = bullet_ranges(np.broadcast_to(origin + place[0], toward.shape), toward, client)
            same = (found == expected) | (np.abs(np.minimum(found, 1e3) - np.minimum(expected, 1e3)) <= 0.01)
            off, total, met, poses = off + int((~same).sum()), total + BEAMS, met + int(np.isfinite(found).sum()), poses + 1
        pybullet.disconnect(client)
    assert met > 0.3 * total
    assert off < 0.001 * total
