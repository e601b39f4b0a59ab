"""Drawings of worlds: scale, positions, and every built-in world."""

import cv2
import numpy as np
import pytest

from vcmvsp.cosim.config import registry
from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.world_picture import draw_world, extent, png
from vcmvsp.physics.world.floor import GroundPicture
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh
from vcmvsp.physics.world.world import Movable, Moving, World, Zone

pytestmark = pytest.mark.slow

RED = (230, 20, 20)


def red(picture: Array) -> Array:
    return (picture[:, :, 0] > 120) & (picture[:, :, 1] < 60) & (picture[:, :, 2] < 60)


def test_a_map_is_to_scale_with_north_up() -> None:
    """Two boxes of 2 m, 10 m apart, one to the north-east of the other: their places on the map give the scale."""
    boxes = (
        Box(center=(0, 0, 1), size=(2, 2, 2), color=RED),
        Box(center=(8, 6, 1), size=(2, 2, 2), color=RED),
    )
    above = draw_world(World(solids=boxes), width=900, height=600).above
    count, _, stats, centers = cv2.connectedComponentsWithStats(red(above).astype(np.uint8))
    assert count == 3
    (x1, y1), (x2, y2) = sorted(centers[1:].tolist())
    scale = np.hypot(x2 - x1, y2 - y1) / 10.0
    assert (x2 - x1) / scale == pytest.approx(8.0, abs=0.05)
    assert (y1 - y2) / scale == pytest.approx(6.0, abs=0.05)
    assert stats[1:, cv2.CC_STAT_WIDTH] / scale == pytest.approx([2.0, 2.0], abs=0.1)


def test_the_higher_of_two_is_above_the_lower_one() -> None:
    lower = Box(center=(0, 0, 0.5), size=(4, 4, 1), color=(0, 0, 200))
    higher = Box(center=(0, 0, 1.5), size=(1, 1, 1), color=RED)
    for solids in ((lower, higher), (higher, lower)):
        above = draw_world(World(solids=solids), width=300, height=200).above
        assert red(above).sum() > 50


def test_bodies_are_drawn_where_they_are() -> None:
    world = World(
        movables=(Movable(name="crate", solid=Box(center=(3, 0, 0.5), size=(1, 1, 1), color=RED), mass_kg=1.0),),
        moving=(
            Moving(
                name="door",
                solid=Cylinder(center=(0, 0, 0), radius=0.5, height=1, color=(20, 230, 20)),
                times_s=(0.0, 10.0),
                way=((-3, -2, 0.5, 0), (-3, 2, 0.5, 0)),
            ),
        ),
        zones=(Zone(center=(0, 0), size=(1, 2), friction=0.1),),
    )

    def green_row(time_s: float) -> float:
        above = draw_world(world, width=600, height=400, time_s=time_s).above.astype(int)
        assert red(above).any()
        rows, _ = np.nonzero((above[:, :, 1] > 180) & (above[:, :, 0] < 60))
        return float(rows.mean())

    assert green_row(0.0) > green_row(5.0) > green_row(10.0)


def test_all_of_a_world_is_in_the_oblique_picture() -> None:
    towers = tuple(Box(center=(x, y, z), size=(0.4, 0.4, 0.4), color=RED) for x in (-6, 6) for y in (-4, 4) for z in (0.2, 4.8))
    oblique = draw_world(World(solids=towers, bounds=(-6.2, -4.2, 6.2, 4.2)), width=600, height=400).oblique
    mask = red(oblique)
    assert cv2.connectedComponents(mask.astype(np.uint8))[0] - 1 == 8
    assert not np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any()


def test_extent_is_that_of_solids_bounds_and_ground() -> None:
    triangle = Mesh(triangles=np.array([[[0.0, 0, 0], [1, 0, 0], [0, 20, 7]]]))
    world = World(
        solids=(triangle,), bounds=(-30.0, -1.0, 2.0, 2.0), ground=GroundPicture(size=(4.0, 8.0), center=(10.0, 0.0), marks=())
    )
    assert np.array(extent(world)).tolist() == [[-30.0, -1.0, 0.0], [2.0, 20.0, 7.0]]


def test_the_map_has_the_path_of_moving_bodies() -> None:
    solid = Box(center=(0, 0, 0), size=(2, 1, 1))
    cart = Moving(name="cart", solid=solid, times_s=(0, 9), way=((0, 0, 0.5, 0), (30, 0, 0.5, 0)))
    assert np.array(extent(World(moving=(cart,)))).tolist() == [[-3.0, -3.0, 0.0], [31.0, 3.0, 1.0]]


def test_png_keeps_every_pixel() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    decoded = cv2.imdecode(np.frombuffer(png(picture), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert (decoded[:, :, ::-1] == picture).all()


@pytest.mark.parametrize(
    "kind", ["empty", "laboratory", "recreation-centre", "urban", "corridor", "gates", "gates-offset", "pillar"]
)
def test_every_built_in_world_can_be_drawn_and_is_not_one_colour(kind: str) -> None:
    world = registry.find("world", kind)().build()
    for picture in draw_world(world, width=300, height=200):
        assert picture.shape == (200, 300, 3)
        assert picture.reshape(-1, 3).std(axis=0).max() > 3.0
