"""The lanes that a vehicle sweeps on its way straight to somewhere."""

import math

import numpy as np

from vcmvsp.agents.avoidance.view import View
from vcmvsp.cosim.types import Array

EVEN = 1e-9  # rad, and beams: less than that is rounding
ASIDE = -1e-8  # cosine of a beam that points exactly aside, and is rounded


def lane_free(view: View, bearing: float, half_width: float, length: float) -> bool:
    """Whether no return lies in a rectangle from the vehicle on, as far as one sees.

    A return at no distance at all lies where its beam points: with a scanner touched from behind, the way ahead is free.

    Args:
        view: what the scanner says.
        bearing: where the lane leads, rad.
        half_width: of the lane, m; what just touches it is beside it.
        length: of the lane, m.
    """
    near = np.flatnonzero(view.ranges <= math.hypot(half_width, length))
    if not len(near):
        return True
    ranges, units = view.ranges[near], view.units[near]
    cos, sin = math.cos(bearing), math.sin(bearing)
    along, across = units @ (cos, sin), units @ (-sin, cos)
    return not np.any((along >= ASIDE) & (ranges * along <= length) & (ranges * np.abs(across) < half_width))


def ways(view: View, half_width: float, length: float) -> Array:
    """Which beams, (n,), a disc can follow without touching a return, as far as one sees.

    A return at the distance d keeps it from all directions less than ``asin(half_width / d)`` beside its own, a quarter turn
    where d is less than ``half_width``.

    Args:
        view: what the scanner says.
        half_width: radius of the disc, m.
        length: what is further away than that does not count, m.
    """
    count = len(view.ranges)
    near = np.flatnonzero(view.ranges <= length)
    beside = np.ceil(half_angles(view.ranges[near], half_width) / view.step - EVEN).astype(int) - 1
    # What begins and ends to be blocked at each beam, also beyond both borders: in a full turn that is the other side.
    rows = 3 if view.cyclic else 1
    first, last = near - beside + (rows // 2) * count, near + beside + 1 + (rows // 2) * count
    size = rows * count
    begun = np.bincount(first.clip(0, size), minlength=size + 1) - np.bincount(last.clip(0, size), minlength=size + 1)
    blocked = begun.cumsum()[:-1].reshape(rows, count)
    return np.asarray(~blocked.any(axis=0))


def free_m(view: View, bearing: float, half_width: float, length: float) -> float:
    """How far a disc can go that way, rad, until it touches a return, m; inf: it passes all of those within ``length``, m."""
    near = np.flatnonzero(view.ranges <= length)
    ranges, units = view.ranges[near], view.units[near]
    cos, sin = math.cos(bearing), math.sin(bearing)
    ahead, aside = units @ (cos, sin), ranges * (units @ (-sin, cos))
    along, met = ranges * ahead, (ahead > EVEN) & (np.abs(aside) < half_width - EVEN)
    return float((along[met] - np.sqrt(half_width**2 - aside[met] ** 2)).min(initial=math.inf))


def half_angles(ranges: Array, half_width: float) -> Array:
    """Half of the angle, (n,) rad, that returns at these distances, m, block for a disc of radius ``half_width``, m."""
    half_angles: Array = np.arcsin(np.minimum(1.0, half_width / np.maximum(ranges, half_width)))
    return half_angles
