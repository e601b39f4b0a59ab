"""Exact scans of thin straight walls."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from vcmvsp.agents.avoidance.view import View, view_of
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array, Scan

Point = tuple[float, float]
Pose = tuple[float, float, float]
Wall = tuple[Point, Point]

SMALL = Body(width_m=0.33, radius_m=0.18)


def scan_of(ranges: Any, fov: float = math.pi, first: float | None = None, time_ns: int = 0) -> Scan:
    """Scan with ranges that begin at ``first``, rad; default: on the right, for a whole turn straight behind."""
    first, step = -0.5 * fov if first is None else first, fov / (len(ranges) - (fov != math.tau))
    return Scan(ranges=np.asarray(ranges, float), angle_min=first, angle_step=step, range_max=20.0, time_ns=time_ns)


def ring(ranges: Sequence[float], time_ns: int = 0) -> Scan:
    """A full turn, from straight ahead on."""
    return scan_of(ranges, math.tau, 0.0, time_ns)


def view(ranges: Any, fov: float = math.pi, first: float | None = None) -> View:
    """Observation of a vehicle with the scan of `scan_of`."""
    found = view_of(scan_of(ranges, fov, first))
    assert found is not None
    return found


@cache
def bearings(beams: int, fov: float, first: float | None = None) -> Array:
    return view(np.full(beams, math.inf), fov, first).bearings


def ranges_of(
    walls: Sequence[Wall],
    pose: Pose = (0.0, 0.0, 0.0),
    beams: int = 512,
    fov: float = math.pi,
    first: float | None = None,
) -> Array:
    """Range of each beam, m; inf where it meets no wall."""
    x, y, yaw = pose
    angles = yaw + bearings(beams, fov, first)[:, None]
    ux, uy = np.cos(angles), np.sin(angles)
    ends = np.array(walls, float).reshape(-1, 2, 2)
    (ax, ay), (ex, ey) = (ends[:, 0] - (x, y)).T, (ends[:, 1] - ends[:, 0]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        across = ux * ey - uy * ex
        along = (ax * ey - ay * ex) / across  # of the beam, m
        part = (ax * uy - ay * ux) / across  # of the wall
        met = (along >= 0.0) & (part >= 0.0) & (part <= 1.0)
    return np.where(met, along, math.inf).min(axis=1, initial=math.inf)


def sides(lower: Point, upper: Point) -> list[Wall]:
    """Four sides of the box between two corners."""
    (left, right), (bottom, top) = zip(lower, upper, strict=True)
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def wall_with_doors(distance: float, doors: Sequence[tuple[float, float]], tilt: float = 0.0, half: float = 20.0) -> list[Wall]:
    """A wall across the way with doors, each from and to this many metres to the left; tilted about its point on the x axis."""
    edges = [-half, *(edge for door in sorted(doors) for edge in door), half]

    def at(left: float) -> Point:
        return distance - left * math.sin(tilt), left * math.cos(tilt)

    return [(at(begin), at(end)) for begin, end in zip(edges[::2], edges[1::2], strict=True)]
