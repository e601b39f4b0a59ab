"""Checked view of one scan of a range scanner, and its free lanes. Invalid ranges count as contacts."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array, Scan

Geometry = tuple[int, float, float]  # beams, rad of the first, rad from one to the next
Point = tuple[float, float]

FEWEST = 2  # beams: one alone shows nothing beside it
FINEST = 1e-5  # rad between beams, and FURTHEST rad from ahead: beyond that a scanner is out of order
FURTHEST = 100.0
EVEN = 1e-9  # tolerance of rounding: of directions, beams, and the sum of all ranges on a side, m
ASIDE = -1e-8  # cosine of a beam that points exactly aside, and is rounded
ADOPTED_S = 0.5  # after this time a changed geometry of beams is accepted
FULL = 1.0 - 1e-6  # share of the range: some scanners report it without a return


class View(NamedTuple):
    """Ranges around a vehicle and the directions of its beams; the arrays are read-only."""

    ranges: Array  # (n,) m; inf: no return; 0: nearer than it can measure, or no number
    bearings: Array  # (n,) rad, from ahead to the left
    units: Array  # (n, 2): the direction of each beam, x forward, y left
    step: float  # rad between beams
    cyclic: bool  # they cover a full turn: the last is beside the first

    @property
    def nearest_m(self) -> float:
        """Smallest range, m; inf: no return at all."""
        return float(self.ranges.min())

    def sees(self, bearing: float) -> bool:
        """Whether a bearing, rad, lies in the field of view."""
        return self.cyclic or abs(self.near_middle(bearing) - self.middle) <= 0.5 * (len(self.ranges) - 1) * self.step

    @property
    def middle(self) -> float:
        """Bearing of the middle of the field of view, rad."""
        return 0.5 * float(self.bearings[0] + self.bearings[-1])

    def near_middle(self, bearing: float) -> float:
        """The bearing, rad, wrapped to half a turn around the middle of the field of view, like bearings of beams."""
        return self.middle + wrap(bearing - self.middle)

    def roomier_side(self, within_m: float) -> int:
        """Side with more room within ``within_m`` metres: 1 left (also in a tie), -1 right."""
        room, aside = np.minimum(self.ranges, within_m), self.units[:, 1]
        return 1 if room[aside > EVEN].sum() >= room[aside < -EVEN].sum() - EVEN else -1

    def along(self, direction: Point, within_m: float) -> tuple[Array, Array, Array]:
        """Ranges of the returns up to ``within_m``, m, and the parts of their beams along and across a direction, (k,) each."""
        near = np.flatnonzero(self.ranges <= within_m)
        units, (x, y) = self.units[near], direction
        return self.ranges[near], units @ (x, y), units @ (-y, x)


def view_of(scan: Any) -> View | None:
    """View of a scan; None: the scan is unusable.

    NaN and negative ranges count as 0 (-inf: nearer than the scanner can measure), the full range as no return. Unusable are
    values that are no scan or not numeric, fewer than two beams, and beams that are not evenly spread over at most a full turn.
    """
    try:
        geometry = _geometry(scan) if isinstance(scan, Scan) else None
        if geometry is None:
            return None
        bearings, units, cyclic = _beams(*geometry)
        with np.errstate(invalid="ignore"):
            ranges = np.where(scan.ranges > 0.0, scan.ranges, 0.0).astype(float)
            ranges[ranges >= FULL * scan.range_max] = np.inf
    except (TypeError, ValueError):
        return None
    return View(ranges, bearings, units, geometry[2], cyclic)


def _geometry(scan: Scan) -> Geometry | None:
    """Geometry of the beams of a scan; None: it is invalid."""
    ranges, first, step = np.asarray(scan.ranges), float(scan.angle_min), float(scan.angle_step)
    if ranges.ndim != 1 or ranges.dtype.kind not in "fiu" or len(ranges) < FEWEST or not scan.range_max > 0.0:
        return None
    if not (isinstance(scan.time_ns, int) and abs(first) <= FURTHEST and FINEST <= step <= math.tau / (len(ranges) - 1) + 1e-9):
        return None
    return len(ranges), first, step


@lru_cache(maxsize=64)
def _beams(count: int, first: float, step: float) -> tuple[Array, Array, bool]:
    """Bearings, unit vectors, and whether they close a turn."""
    bearings = first + step * np.arange(count)
    units = np.column_stack([np.cos(bearings), np.sin(bearings)])
    bearings.flags.writeable = units.flags.writeable = False
    return bearings, units, abs(count * step - math.tau) < 0.5 * step


class ScanReader:
    """Reads the scanner of that name once a tick; a scan older than ``stale_s`` counts as missing."""

    def __init__(self, scanner: str, stale_s: float) -> None:
        self.scanner, self._stale_ns = scanner, seconds_to_ns(stale_s)

    def start(self, info: VehicleInfo, key: str) -> None:
        """Check the scanner before the first tick; `ValueError` with ``key``, which names the scanner: the vehicle has none."""
        check_carried(info, self.scanner, key)
        self._beside_m = info.beside_m.get(self.scanner, 0.0)
        self._geometry: Geometry | None = None  # of its scans
        self._new_geometry: Geometry | None = None  # of the last ones, which lie otherwise,
        self._since_ns: int | None = None  # and since when they do

    def look(self, obs: Observation) -> View | None:
        """View of the present scan; None: the scan is missing, stale, from the future, or has other beams.

        Ranges count from the reference point: ranges of a scanner beside it are shortened by that distance, so that no obstacle
        is nearer than it seems. The first scan gives the geometry of the beams; another one is accepted if it holds for half a
        second.
        """
        scan: Any = obs.readings.get(self.scanner)
        view = view_of(scan)
        if view is None or not 0 <= obs.clock_ns - scan.time_ns <= self._stale_ns:
            self._since_ns = None
            return None
        if not self._is_usual(_geometry(scan), obs.clock_ns):
            return None
        return view._replace(ranges=np.maximum(view.ranges - self._beside_m, 0.0)) if self._beside_m else view

    def _is_usual(self, geometry: Geometry | None, now_ns: int) -> bool:
        if self._geometry is not None and geometry != self._geometry:
            if self._since_ns is None or geometry != self._new_geometry:
                self._new_geometry, self._since_ns = geometry, now_ns
            if now_ns - self._since_ns < seconds_to_ns(ADOPTED_S):
                return False
        self._geometry, self._since_ns = geometry, None
        return True


def check_carried(info: VehicleInfo, sensor: str, key: str) -> None:
    """Reject (ValueError) a sensor, named by ``key``, that the vehicle does not carry."""
    if info.sensors is not None and sensor not in info.sensors:
        carries = ", ".join(info.sensors) or "nothing"
        raise ValueError(f"{key} = {sensor!r}: {info.name} has no such sensor; its sensors: {carries}")


def wrapped(angles: Array) -> Array:
    """Angles wrapped to [-pi, pi), rad."""
    return (angles + math.pi) % math.tau - math.pi


def lane_free(view: View, bearing: float, half_width: float, length: float) -> bool:
    """Whether no return lies in the lane towards a bearing, rad.

    A return on its side, ``half_width`` m from the middle, lies outside. A return at distance 0 lies where its beam points:
    with a contact behind the scanner, the way ahead is free.
    """
    ranges, along, across = view.along((math.cos(bearing), math.sin(bearing)), math.hypot(half_width, length))
    return not np.any((along >= ASIDE) & (ranges * along <= length) & (ranges * np.abs(across) < half_width))


def ways(view: View, half_width: float, length: float) -> Array:
    """Which beams, (n,), a disc of radius ``half_width`` can follow for ``length`` m without touching a return.

    A return at the distance d blocks all directions less than ``asin(half_width / d)`` beside its own, a quarter turn if d is
    less than ``half_width``.
    """
    count = len(view.ranges)
    near = np.flatnonzero(view.ranges <= length)
    beside = np.ceil(half_angles(view.ranges[near], half_width) / view.step - EVEN).astype(int) - 1
    # Starts and ends of blocked sectors by beam, also beyond both borders: in a full turn that is the other side.
    rows = 3 if view.cyclic else 1
    first, last = near - beside + (rows // 2) * count, near + beside + 1 + (rows // 2) * count
    size = rows * count
    begun = np.bincount(first.clip(0, size), minlength=size + 1) - np.bincount(last.clip(0, size), minlength=size + 1)
    blocked = begun.cumsum()[:-1].reshape(rows, count)
    return np.asarray(~blocked.any(axis=0))


def free_m(view: View, direction: Point, radius: float, within_m: float, half_width: float | None = None) -> float:
    """Free distance of a disc in a direction until it touches a return, m; inf: no contact within ``within_m``.

    Returns that lie no less than ``half_width`` m beside its way do not count; default: its radius, less rounding.
    """
    ranges, ahead, across = view.along(direction, within_m)
    along, aside = ranges * ahead, ranges * across
    met = (ahead > EVEN) & (np.abs(aside) < (radius - EVEN if half_width is None else half_width))
    return float((along[met] - np.sqrt(radius**2 - aside[met] ** 2)).min(initial=math.inf))


def half_angles(ranges: Array, half_width: float) -> Array:
    """Half of the angle, (n,) rad, that returns at these distances, m, block for a disc of radius ``half_width``, m."""
    return np.arcsin(np.minimum(1.0, half_width / np.maximum(ranges, half_width)))
