"""Cameras beside PyBullet's own software renderer (``getCameraImage``), with equal worlds and views, in one run.

``python -m bench.camera`` prints more rows than the common table. CPU time of the process, medians of pairs.
"""

import math
import sys
from collections.abc import Sequence
from functools import partial

import numpy as np

from bench.measure import Row, cpu, in_turn, table
from vcmvsp.cosim.types import Array
from vcmvsp.physics.dynamics.bullet import p as pybullet  # imported there without its greeting
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

SIZES = ((160, 120), (320, 240), (640, 480))
BOXES = (100, 500, 2000)
KINDS = ("from 40 m straight down", "from 25 m ahead", "in a street")
ROUNDS = 3
VIEWS = 4
MOST = 0.2  # times the time of Bullet
REPEATS = 5  # of our pictures: the first of a kind meets cold processor caches
FOV = 1.2  # rad, horizontal
PITCH_M = 20.0  # of the street grid


def city(number: int) -> World:
    """A number of buildings on a grid."""
    rng, edge = np.random.default_rng(number), math.ceil(math.sqrt(number))
    boxes = []
    for n in range(number):
        x, y = PITCH_M * (n % edge - 0.5 * edge), PITCH_M * (n // edge - 0.5 * edge)
        (length, width), height = rng.uniform(6.0, 12.0, 2).tolist(), float(rng.uniform(4.0, 20.0))
        red, green, blue = rng.integers(60, 256, 3).tolist()
        boxes.append(
            Box(
                center=(x, y, 0.5 * height),
                size=(length, width, height),
                yaw_rad=float(rng.uniform(-0.2, 0.2)),
                color=(red, green, blue),
            )
        )
    return World(solids=tuple(boxes))


def crossings(number: int) -> list[tuple[float, float]]:
    """Street crossings of such a city, m, the central ones first."""
    edge = math.ceil(math.sqrt(number))
    at = [PITCH_M * (n + 0.5 - 0.5 * edge) for n in range(edge - 1)]
    return sorted(((x, y) for x in at for y in at), key=lambda place: math.hypot(*place))


def views(kind: str, number: int) -> list[tuple[Array, float, float]]:
    """Positions, headings and downward pitch, rad."""
    rng, places = np.random.default_rng(1), crossings(number)
    height, down = dict(zip(KINDS, ((40.0, 0.5 * math.pi), (25.0, 0.3), (2.0, 0.0)), strict=True))[kind]
    found = []
    for _ in range(VIEWS):
        x, y = places[int(rng.integers(len(places) // 2))]
        found.append((np.array([x, y, height]), float(rng.uniform(0.0, math.tau)), down))
    return found


def view_of(eye: Array, heading: float, down: float, width: int, height: int) -> View:
    """A view without roll."""
    c, s, cd, sd = math.cos(heading), math.sin(heading), math.cos(down), math.sin(down)
    rotation = np.array([[s, -c * sd, c * cd], [-c, -s * sd, s * cd], [0.0, -cd, -sd]])
    return View(eye, rotation, width, height, 0.5 * width / math.tan(0.5 * FOV), 500.0)


def ours_s(world: World, pictures: Sequence[View]) -> float:
    """CPU seconds a picture."""
    total_s = 0.0
    for view in pictures:
        total_s += min(cpu(partial(render, world, view)) for _ in range(REPEATS))
    return total_s / len(pictures)


def theirs_s(client: int, pictures: Sequence[View]) -> float:
    """The same pictures from Bullet, without shadows."""
    return sum(cpu(partial(_bullet_picture, client, view)) for view in pictures) / len(pictures)


def _bullet_picture(client: int, view: View) -> None:
    ahead, up = view.rotation[:, 2], -view.rotation[:, 1]
    look = pybullet.computeViewMatrix(view.eye.tolist(), (view.eye + ahead).tolist(), up.tolist())
    fov = math.degrees(2.0 * math.atan(0.5 * view.height / view.focal_px))
    lens = pybullet.computeProjectionMatrixFOV(fov, view.width / view.height, 0.1, view.reach_m)
    pybullet.getCameraImage(
        view.width,
        view.height,
        look,
        lens,
        shadow=0,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )


def bullet_of(world: World) -> int:
    """Bullet with the boxes and a floor to look at."""
    client: int = pybullet.connect(pybullet.DIRECT)
    floor = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=[1000, 1000, 0.01], physicsClientId=client)
    pybullet.createMultiBody(0, -1, floor, [0, 0, -0.01], physicsClientId=client)
    for box in world.solids:
        assert isinstance(box, Box)
        half_m = [0.5 * edge for edge in box.size]
        rgba = [*(level / 255 for level in box.color or ()), 1]
        shape = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half_m, rgbaColor=rgba, physicsClientId=client)
        turn = pybullet.getQuaternionFromEuler([0, 0, box.yaw_rad])
        pybullet.createMultiBody(0, -1, shape, box.center, turn, physicsClientId=client)
    return client


def rows(boxes: Sequence[int] = (500,), sizes: Sequence[tuple[int, int]] = (SIZES[0], SIZES[2])) -> list[Row]:
    """Every kind of view of these worlds, in these sizes."""
    found = []
    for number in boxes:
        print(f"measuring: pictures of {number} boxes ...", file=sys.stderr, flush=True)
        world = city(number)
        client = bullet_of(world)
        for kind in KINDS:
            found += [_row(kind, number, world, client, *size) for size in sizes]
        pybullet.disconnect(client)
    return found


def _row(kind: str, number: int, world: World, client: int, width: int, height: int) -> Row:
    pictures = [view_of(*each, width, height) for each in views(kind, number)]
    ours, other, ratio = in_turn(lambda: ours_s(world, pictures), lambda: theirs_s(client, pictures), ROUNDS)
    name = f"picture of {width} x {height} {kind}, {number} boxes; beside getCameraImage"
    return Row(name, f"{1e3 * ours:.2f} ms", f"{1e3 * other:.1f} ms", ratio, f"<= {MOST:g}x", ratio <= MOST)


if __name__ == "__main__":
    print(table(rows(BOXES, SIZES)))
