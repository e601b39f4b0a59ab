"""Surfaces of solids: facets and exposed edges."""

import numpy as np
import pytest

from vcmvsp.cosim.util.surfaces import BODY, SHEET, SKIN, Surfaces
from vcmvsp.physics.raycast.surfaces import surfaces_of
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Prism

L_SHAPE = Prism(outline=((0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)), height=2.0)
HOUSE = Box(center=(0.0, 0.0, 3.0), size=(8.0, 10.0, 6.0), yaw_rad=0.3)


@pytest.mark.parametrize(
    ("solid", "facets", "edges"),
    [
        (HOUSE, 5, 8),  # no floor facet, no edges on the ground
        (L_SHAPE, 6 + 3, 6 + 5),  # the roof in its convex parts; no edge in the inner corner
        (Box(center=(0.0, 0.0, 1.0), size=(4.0, 0.2, 2.0)), 1, 3),
        (Box(center=(0.0, 0.0, 3.0), size=(4.0, 5.0, 0.2)), 1, 4),
    ],
)
def test_number_of_facets_and_edges(solid: AnySolid, facets: int, edges: int) -> None:
    found = surfaces_of([solid], 0.5, ground=True)
    roofs = len(solid.uprights()) if isinstance(solid, Prism) else 1
    assert (len(found.offset), len(found.angle)) == (facets - 3 + roofs if isinstance(solid, Prism) else facets, edges)


def test_normals_point_outwards_and_angles_are_outer() -> None:
    found = surfaces_of([HOUSE, L_SHAPE], 0.5, ground=True)
    middles = np.array([found.corner[a:b].mean(axis=0) for a, b in zip(found.first, found.first[1:], strict=False)])
    of_house = found.solid == 0
    assert ((found.normal * (middles - HOUSE.center)).sum(axis=1)[of_house] > 0.0).all()
    assert found.angle == pytest.approx(np.full(len(found.angle), 1.5))


def test_boxes_side_by_side_are_one_wall() -> None:
    """The four edges and the two roof edges at the joint do not count."""
    halves = [Box(center=(x, 0.0, 3.0), size=(4.0, 10.0, 6.0)) for x in (-2.0, 2.0)]
    found = surfaces_of(halves, 0.5, ground=True)
    whole = surfaces_of([Box(center=(0.0, 0.0, 3.0), size=(8.0, 10.0, 6.0))], 0.5, ground=True)

    def length(surfaces: Surfaces) -> float:
        return float(np.linalg.norm(surfaces.end - surfaces.start, axis=1).sum())

    assert length(found) == pytest.approx(length(whole), abs=1e-4)


def test_an_edge_ends_where_it_meets_a_lower_house() -> None:
    tall, low = Box(center=(0.0, 0.0, 5.0), size=(4.0, 4.0, 10.0)), Box(center=(4.0, 0.0, 2.0), size=(4.0, 4.0, 4.0))
    found = surfaces_of([tall, low], 0.5, ground=True)
    upright = np.abs((found.end - found.start)[:, 2]) > 1e-3
    lowest = sorted(np.minimum(found.start, found.end)[upright, 2].tolist())
    assert lowest == pytest.approx([0.0, 0.0, 0.0, 0.0, 4.0, 4.0], abs=1e-5)


def test_passages() -> None:
    post = Cylinder(center=(0.0, 0.0, 1.0), radius=0.1, height=2.0)
    wall = Box(center=(5.0, 0.0, 1.0), size=(4.0, 0.2, 2.0))
    found = surfaces_of([HOUSE, post, wall], 0.5, ground=True)
    assert [set(found.passage[found.solid == k].tolist()) for k in range(3)] == [{BODY}, {SKIN}, {SHEET}]
    assert found.stops.tolist() == [True, False, False]
    assert found.thickness_m[found.solid == 2].tolist() == [0.2]
