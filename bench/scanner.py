"""Range scanners beside Bullet's own rays, among the same buildings and vehicles, in one run.

``python -m bench.scanner`` prints the table. CPU seconds of this process, medians of pairs: compare the ratios.
"""

import math
import platform

import numpy as np

from bench.measure import Row, cpu, in_turn, table
from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.bullet import p as pybullet  # imported there without its greeting
from vcmvsp.physics.raycast.caster import caster_of
from vcmvsp.physics.sensors.range_scanner import Lms, RangeScanner, Ring, true_ranges
from vcmvsp.physics.world.solids import Box, Hull
from vcmvsp.physics.world.world import Scene, World

ROUNDS = 7
AREA_M = 120.0  # edge of the town for any number of buildings: the more, the smaller
VEHICLES = 60
ROBOT = Hull(size=(0.5, 0.4, 0.2), offset=(0.0, 0.0, 0.1))
TILT = 1e-3  # rad: a wheeled robot is never quite level


def rows() -> list[Row]:
    """All rows."""
    found = []
    for buildings in (100, 500, 2000):
        scene = town(buildings)
        rays = BulletRays(scene)
        found.append(_row(f"512 beams, half a turn, 20 m, {buildings} boxes, one scan", Lms(), scene, rays, 1, 0.7))
        found.append(_row(f"512 beams, {buildings} boxes, {VEHICLES} scans due at once", Lms(), scene, rays, VEHICLES, 0.2))
        found.append(_row(f"32 beams, full turn, 6 m, {buildings} boxes, one scan", _LOW_RING, scene, rays, 1, math.inf))
        found.append(_row(f"32 beams, {buildings} boxes, 100 scans due at once", _LOW_RING, scene, rays, 100, 0.8))
        rays.close()
    return found


_LOW_RING = Ring(position=(0.0, 0.0, 0.1))  # as low as the other: it meets the same robots


def _row(name: str, sensor: RangeScanner, scene: Scene, rays: "BulletRays", at_once: int, limit: float) -> Row:
    """One scan of every vehicle in turn (100 of the smaller: some twice), or all of them in one call."""
    places = [k % VEHICLES for k in range(max(at_once, VEHICLES))]

    def ours() -> float:
        work = [places]
        if at_once == 1:
            work = [[row] for row in places]
        return cpu(lambda: [true_ranges([sensor] * len(each), scene, each) for each in work]) / len(places)

    directions = [rays.prepare(sensor, row) for row in places]

    def other() -> float:
        return cpu(lambda: [rays.cast(each) for each in directions]) / len(places)

    our_s, other_s, ratio = in_turn(ours, other, ROUNDS)
    demand = f"<= {limit:g}x" if limit < math.inf else "-"
    return Row(
        f"{name}; beside rayTestBatch", f"{1e6 * our_s:.0f} us", f"{1e6 * other_s:.0f} us", ratio, demand, ratio <= limit
    )


def town(buildings: int) -> Scene:
    """Lots in rows, a building on each, turned a little; robots between them."""
    rng = np.random.default_rng(buildings)
    side = math.ceil(math.sqrt(buildings))
    lot = AREA_M / side
    solids = []
    for number in range(buildings):
        i, j = divmod(number, side)
        length, width = (lot * rng.uniform(0.3, 0.6, 2)).tolist()
        height, yaw = rng.uniform((3.0, -0.3), (20.0, 0.3)).tolist()
        place = ((i + 0.5) * lot - 0.5 * AREA_M, (j + 0.5) * lot - 0.5 * AREA_M, 0.5 * height)
        solids.append(Box(center=place, size=(length, width, height), yaw_rad=yaw))
    world = World(solids=tuple(solids))
    caster = caster_of(world)
    free: list[tuple[float, float, float]] = []
    while len(free) < VEHICLES:
        x, y = rng.uniform(-0.5 * AREA_M, 0.5 * AREA_M, 2).tolist()
        if not caster.inside((x, y, 0.1)):
            free.append((x, y, 0.0))
    yaw, lean = rng.uniform(-3.0, 3.0, VEHICLES), rng.normal(0.0, TILT, (2, VEHICLES))
    attitude = np.column_stack([np.cos(0.5 * yaw), 0.5 * lean[0], 0.5 * lean[1], np.sin(0.5 * yaw)])
    zeros = np.zeros((VEHICLES, 3))
    return Scene(
        now_ns=0,
        world=world,
        vehicles=tuple(f"car{k}" for k in range(VEHICLES)),
        hulls=(ROBOT,) * VEHICLES,
        position=np.array(free),
        velocity=zeros,
        attitude=attitude / np.sqrt((attitude**2).sum(axis=1, keepdims=True)),
        angular_velocity=zeros,
        acceleration=zeros,
        wheels=np.full((VEHICLES, 2), np.nan),
    )


class BulletRays:
    """The same town in Bullet: all buildings as one mesh, each robot a box."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._client = scene, pybullet.connect(pybullet.DIRECT)
        vertices, triangles = scene.world.mesh()
        mesh = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=triangles.ravel().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self._client,
        )
        floor = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=self._client)
        half = [0.5 * size for size in ROBOT.size]
        robot = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
        for shape in (mesh, floor):
            pybullet.createMultiBody(0.0, shape, physicsClientId=self._client)
        for x, y, z in (scene.position + np.array(ROBOT.offset)).tolist():
            pybullet.createMultiBody(1.0, robot, basePosition=[x, y, z], physicsClientId=self._client)

    def prepare(self, sensor: RangeScanner, row: int) -> tuple[list[list[float]], list[list[float]]]:
        """Beams of a scan from 0.5 m outside of the robot's middle, so that it does not see itself."""
        origin, ahead, left, _ = (self._scene.rotation(row) @ sensor.mount).T
        cos, sin = sensor.circle
        toward: Array = np.outer(cos, ahead) + np.outer(sin, left)
        start = origin + self._scene.position[row]
        return (start + 0.5 * toward).tolist(), (start + sensor.range_max * toward).tolist()

    def cast(self, beams: tuple[list[list[float]], list[list[float]]]) -> int:
        """All beams in one call."""
        return len(pybullet.rayTestBatch(*beams, physicsClientId=self._client))

    def close(self) -> None:
        """Disconnect."""
        pybullet.disconnect(self._client)


if __name__ == "__main__":
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    print(table(rows()))
