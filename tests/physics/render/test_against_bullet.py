"""A second judge: the silhouettes that PyBullet's own software renderer sees."""

import numpy as np
import pybullet
import pytest

from tests.physics.render.test_depth import a_color, towards
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder
from vcmvsp.physics.world.world import World

WIDTH, HEIGHT, FOCAL = 160, 120, 120.0


@pytest.mark.parametrize("seed", range(3))
def test_silhouettes_and_depths_agree_with_tiny_renderer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids: list[AnySolid] = []
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for number in range(25):
            (x, y), height = rng.uniform(-8, 8, 2).tolist(), float(rng.uniform(0.5, 4))
            if number % 3:
                size, yaw = (*rng.uniform(0.5, 3, 2).tolist(), height), float(rng.uniform(0, 6))
                solids.append(Box(center=(x, y, height / 2), size=size, yaw_rad=yaw, color=a_color(rng)))
                shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": [0.5 * edge for edge in size]}
            else:
                radius, yaw = float(rng.uniform(0.3, 1)), 0.0
                solids.append(Cylinder(center=(x, y, height / 2), radius=radius, height=height, color=a_color(rng)))
                shape = {"shapeType": pybullet.GEOM_CYLINDER, "radius": radius, "length": height}
            visual = pybullet.createVisualShape(physicsClientId=client, **shape)
            turn = pybullet.getQuaternionFromEuler([0, 0, yaw])
            pybullet.createMultiBody(0, -1, visual, [x, y, height / 2], turn, physicsClientId=client)
        eye, aim = np.array([*rng.uniform(-14, -10, 2), rng.uniform(2, 6)]), np.zeros(3)
        near, far = 0.1, 100.0
        fov = 2 * np.degrees(np.arctan(0.5 * HEIGHT / FOCAL))
        _, _, _, depth, body = pybullet.getCameraImage(
            WIDTH,
            HEIGHT,
            pybullet.computeViewMatrix(eye.tolist(), aim.tolist(), [0, 0, 1]),
            pybullet.computeProjectionMatrixFOV(fov, WIDTH / HEIGHT, near, far),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=client,
        )
    finally:
        pybullet.disconnect(client)
    view = View(eye, towards(eye, aim), WIDTH, HEIGHT, FOCAL)
    bare = render(World(), view, depth=True)
    picture = render(World(solids=tuple(solids)), view, depth=True)
    assert picture.depth_m is not None
    assert bare.depth_m is not None
    ours, theirs = picture.depth_m < bare.depth_m, np.reshape(body, (HEIGHT, WIDTH)) >= 0
    assert theirs.mean() > 0.1
    assert (ours != theirs).mean() < 0.02  # it fills pixels by another rule along edges
    metres = far * near / (far - (far - near) * np.reshape(depth, (HEIGHT, WIDTH)))
    both = ours & theirs
    assert np.median(np.abs(metres - picture.depth_m)[both]) < 0.05
