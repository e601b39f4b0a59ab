"""What one sweep of a range scanner says, fit to decide by: nonsense counts as something that is touched."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array, Scan

Geometry = tuple[int, float, float]  # beams, rad of the first, rad from one to the next

FEWEST = 2  # beams: with one, nothing is known of the ways beside it
FINEST = 1e-5  # rad between beams, and FURTHEST rad from ahead: beyond that a scanner is out of order
FURTHEST = 100.0
EVEN = 1e-9  # less than that is rounding: of what lies straight ahead or behind, and of the sum of all ranges on a side, m
ADOPTED_S = 0.5  # beams that lie otherwise than before: from then on that is believed
FULL = 1.0 - 1e-6  # of the range: where nothing came back, some scanners say that


class View(NamedTuple):
    """Ranges around a vehicle and the directions of its beams; the arrays are read-only."""

    ranges: Array  # (n,) m; inf: no return; 0: nearer than it can measure, or no number
    bearings: Array  # (n,) rad, from ahead to the left
    units: Array  # (n, 2): the direction of each beam, x forward, y left
    step: float  # rad between beams
    cyclic: bool  # they go all the way round: the last is beside the first

    @property
    def nearest_m(self) -> float:
        """The least range, m; inf: no return at all."""
        return float(self.ranges.min())

    def sees(self, bearing: float) -> bool:
        """Whether a bearing, rad, lies in the field of view."""
        return self.cyclic or abs(self.near_middle(bearing) - self.middle) <= 0.5 * (len(self.ranges) - 1) * self.step

    @property
    def middle(self) -> float:
        """Bearing of the middle of the field of view, rad."""
        return 0.5 * float(self.bearings[0] + self.bearings[-1])

    def near_middle(self, bearing: float) -> float:
        """The same bearing, rad, within half a turn of the middle of the field of view, as those of the beams are."""
        return self.middle + wrap(bearing - self.middle)

    def roomier_side(self, within_m: float) -> int:
        """Where there is more room, counted to ``within_m`` metres: 1, to the left, or -1; 1 in a tie."""
        room, aside = np.minimum(self.ranges, within_m), self.units[:, 1]
        return 1 if room[aside > EVEN].sum() >= room[aside < -EVEN].sum() - EVEN else -1


def view_of(scan: Any) -> View | None:
    """A sweep to decide by; None where nothing can be made of it.

    NaN and all that is below zero count as 0 (-inf: nearer than the scanner can measure), the full range as no return. Nothing
    can be made of what is no scan or holds what is no number, of fewer than two beams, and of beams that are not evenly spread
    over at most a full turn.
    """
    try:
        geometry = geometry_of(scan) if isinstance(scan, Scan) else None
        if geometry is None:
            return None
        bearings, units, cyclic = _beams(*geometry)
        with np.errstate(invalid="ignore"):
            ranges = np.where(scan.ranges > 0.0, scan.ranges, 0.0).astype(float)
            ranges[ranges >= FULL * scan.range_max] = np.inf
    except (TypeError, ValueError):
        return None
    return View(ranges, bearings, units, geometry[2], cyclic)


def geometry_of(scan: Scan) -> Geometry | None:
    """How the beams of a scan lie; None where that makes no sense."""
    ranges, first, step = np.asarray(scan.ranges), float(scan.angle_min), float(scan.angle_step)
    if ranges.ndim != 1 or ranges.dtype.kind not in "fiu" or len(ranges) < FEWEST or not scan.range_max > 0.0:
        return None
    if not (isinstance(scan.time_ns, int) and abs(first) <= FURTHEST and FINEST <= step <= math.tau / (len(ranges) - 1) + 1e-9):
        return None
    return len(ranges), first, step


class ScanReader:
    """What a vehicle sees by one of its scanners, tick by tick.

    Args:
        scanner: its name.
        stale_s: a scan older than that is none.
    """

    def __init__(self, scanner: str, stale_s: float) -> None:
        self.scanner, self._stale_ns = scanner, seconds_to_ns(stale_s)
        self._beside_m = 0.0
        self._forget()

    def _forget(self) -> None:
        self._geometry: Geometry | None = None  # of its scans
        self._other: Geometry | None = None  # of the last ones, which lie otherwise,
        self._since_ns: int | None = None  # and since when they do

    def start(self, info: VehicleInfo, key: str) -> None:
        """Before the first tick; ``key`` is what names the scanner, for the message.

        Raises:
            ValueError: the vehicle has no such scanner.
        """
        if info.sensors is not None and self.scanner not in info.sensors:
            carries = ", ".join(info.sensors) or "nothing"
            raise ValueError(f"{key} = {self.scanner!r}: {info.name} has no such sensor (it carries: {carries})")
        self._beside_m = info.beside_m.get(self.scanner, 0.0)
        self._forget()

    def look(self, obs: Observation) -> View | None:
        """What there is to decide by: nothing without a scan, with a stale one, one of the future, and one of other beams.

        Ranges count from the reference point; those of a scanner that sits beside it are shortened by how far, so that nothing
        is nearer than it seems. Beams lie as in the first scan; if they lie otherwise for half a second, and always the same,
        so they do from then on.
        """
        scan: Any = obs.readings.get(self.scanner)
        view = view_of(scan)
        if view is None or not 0 <= obs.time_ns - scan.time_ns <= self._stale_ns:
            self._since_ns = None
            return None
        if not self._is_usual(geometry_of(scan), obs.time_ns):
            return None
        return view._replace(ranges=np.maximum(view.ranges - self._beside_m, 0.0)) if self._beside_m else view

    def _is_usual(self, geometry: Geometry | None, now_ns: int) -> bool:
        """Whether the beams of a scan are unchanged, or have been for long enough since a change."""
        if self._geometry is None or geometry == self._geometry:
            self._geometry, self._since_ns = geometry, None
            return True
        if self._since_ns is None or geometry != self._other:
            self._other, self._since_ns = geometry, now_ns
        if now_ns - self._since_ns < seconds_to_ns(ADOPTED_S):
            return False
        self._geometry, self._since_ns = geometry, None
        return True


def wrapped(angles: Array) -> Array:
    """The same angles, rad, in [-pi, pi)."""
    result: Array = (angles + math.pi) % math.tau - math.pi
    return result


@lru_cache(maxsize=64)
def _beams(count: int, first: float, step: float) -> tuple[Array, Array, bool]:
    """Bearings, unit vectors, and whether they close a turn."""
    bearings = first + step * np.arange(count)
    units = np.column_stack([np.cos(bearings), np.sin(bearings)])
    bearings.flags.writeable = units.flags.writeable = False
    return bearings, units, abs(count * step - math.tau) < 0.5 * step
