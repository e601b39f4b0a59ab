"""The circle around the reference point of a vehicle, and the lane that it sweeps, hold all of it."""

import math

import pytest

from vcmvsp.physics.vehicles.models import Point
from vcmvsp.physics.vehicles.specification import body_of
from vcmvsp.physics.world.solids import Hull


@pytest.mark.parametrize(
    ("hull", "width", "radius"),
    [
        (Hull((0.5, 0.5, 0.2), kind="cylinder"), 0.5, 0.25),
        (Hull((0.5, 0.5, 0.2), (0.3, 0.4, 0.0), "cylinder"), 1.3, 0.75),
        (Hull((0.6, 0.4, 0.2)), 0.4, math.hypot(0.3, 0.2)),
        (Hull((0.6, 0.4, 0.2), (-0.1, 0.05, 0.0)), 0.5, math.hypot(0.4, 0.25)),
    ],
)
def test_a_hull_beside_the_reference_point_counts(hull: Hull, width: float, radius: float) -> None:
    class Placed(Point):
        @property
        def hull(self) -> Hull:
            return placed

    placed = hull
    body = body_of(Placed())
    assert (body.width_m, body.radius_m) == pytest.approx((width, radius))
