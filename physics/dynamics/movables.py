"""Motion of movables and moving obstacles without an engine; outlines of all bodies."""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.engine.interface import BodyMotion, still
from vcmvsp.physics.world.polygons import overlap_m
from vcmvsp.physics.world.solids import Hull, rectangle
from vcmvsp.physics.world.world import Movable, Moving

TOUCHES_M = 1e-9  # bodies that only touch do not overlap

_SIDES = 16  # of the polygon that stands for a circle where outlines are compared


def start_of(movables: Sequence[Movable]) -> BodyMotion:
    """Movables at their places in the world, at rest."""
    places = np.array([each.pose(0.0) for each in movables], float).reshape(-1, 4)
    return still(places[:, :3], places[:, 3])


def on_time(moving: Sequence[Moving], now_ns: int) -> BodyMotion:
    """Moving obstacles at a time, by their time-tables."""
    now_s = now_ns / SECOND_NS
    places = np.array([each.pose(now_s) for each in moving], float).reshape(-1, 4)
    speeds = np.array([each.rates(now_s) for each in moving], float).reshape(-1, 4)
    turning = np.zeros((len(moving), 3))
    turning[:, 2] = speeds[:, 3]
    return still(places[:, :3], places[:, 3])._replace(velocity=speeds[:, :3], angular_velocity=turning)


def outline(hull: Hull, position: Vec3, heading: float) -> tuple[Array, float, float]:
    """A level hull from above: corners (k, 2) m, counter-clockwise, lowest and highest point, m."""
    (length, width, height), (dx, dy, dz) = hull.size, hull.offset
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = position[0] + cos * dx - sin * dy, position[1] + sin * dx + cos * dy
    if hull.kind == "cylinder":
        angles = heading + np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
        corners = np.column_stack([x + 0.5 * length * np.cos(angles), y + 0.5 * width * np.sin(angles)])
    else:
        corners = rectangle(float(x), float(y), 0.5 * length, 0.5 * width, heading)
    middle = position[2] + dz
    return corners, middle - 0.5 * height, middle + 0.5 * height


def depth_m(a: tuple[Array, float, float], b: tuple[Array, float, float]) -> float:
    """Depth, m, by which two level hulls of `outline` overlap; 0 or less: they are apart."""
    return min(overlap_m(a[0], b[0]), min(a[2], b[2]) - max(a[1], b[1]))
