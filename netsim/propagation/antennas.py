"""Antennas with a gain that depends on the direction, turned with their vehicles.

Directions are unit vectors away from the antenna. The axis of a dipole, and the pole of a pattern, is the body's z axis. The
gain is that of power; the polarisation of waves does not turn.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.util.files import read_cells
from vcmvsp.netsim.interfaces.layers import Floats, Ints, Paths, Radio

COLUMNS = ("elevation_deg", "azimuth_deg", "gain_dbi")
LEAST = 2.0**-54  # power ratio, so that every level is finite in dB
DIRECTIVITY = 1.643  # of a half-wave dipole, 2.15 dBi
_MOST_DBI = 100.0


class Pattern(Protocol):
    """The gain of an antenna by direction."""

    def gain(self, direction: Floats) -> Floats:
        """Power gain, a ratio, in directions (m, 3) in the body's frame, (m,)."""


class Dipole:
    """A half-wave dipole: ``1.643 (cos(pi / 2 cos t) / sin t)^2``, t being the angle to its axis.

    C. A. Balanis, Antenna theory, 2nd edition, 1997, equation 4-84 and section 4.6.
    """

    def gain(self, direction: Floats) -> Floats:
        """Power gain in directions, see `Pattern.gain`."""
        cosine = direction[:, 2]
        sine2 = np.maximum(1.0 - cosine * cosine, LEAST)
        return np.maximum(DIRECTIVITY * np.cos(0.5 * math.pi * cosine) ** 2 / sine2, LEAST)


@dataclass(frozen=True, eq=False)
class Measured:
    """Gains on a grid of elevation and azimuth, linear in dB between; azimuths go round, the outermost elevations go on."""

    elevation_deg: Floats  # (n,) rising
    azimuth_deg: Floats  # (k,) rising, less than a turn
    gain_dbi: Floats  # (n, k)

    def gain(self, direction: Floats) -> Floats:
        """Power gain in directions, see `Pattern.gain`."""
        across = np.sqrt(direction[:, 0] ** 2 + direction[:, 1] ** 2)
        row, up = _between(self.elevation_deg, np.degrees(np.arctan2(direction[:, 2], across)))
        first = self.azimuth_deg[0]
        turn = (np.degrees(np.arctan2(direction[:, 1], direction[:, 0])) - first) % 360.0 + first
        column, on = _between(np.append(self.azimuth_deg, first + 360.0), turn)
        round_dbi = np.append(self.gain_dbi, self.gain_dbi[:, :1], axis=1)
        next_row = np.minimum(row + 1, len(self.elevation_deg) - 1)
        low = (1.0 - on) * round_dbi[row, column] + on * round_dbi[row, column + 1]
        high = (1.0 - on) * round_dbi[next_row, column] + on * round_dbi[next_row, column + 1]
        return np.maximum(10.0 ** (0.1 * ((1.0 - up) * low + up * high)), LEAST)


def _between(grid: Floats, at: Floats) -> tuple[Ints, Floats]:
    """Index of the value of a rising grid before each number, and its share of the way to the next, 0 to 1."""
    index = np.clip(np.searchsorted(grid, at, side="right") - 1, 0, max(len(grid) - 2, 0))
    step = np.append(np.diff(grid), 1.0)[index]
    return index, np.clip((at - grid[index]) / step, 0.0, 1.0)


def pattern_of(radio: Radio) -> Pattern | None:
    """The pattern of a radio's antenna; None: it is isotropic.

    Raises:
        ScenarioError: both kinds are given, or the file is invalid.
    """
    if radio.antenna_pattern is None:
        return Dipole() if radio.antenna == "dipole" else None
    if radio.antenna != "isotropic":
        raise ScenarioError(f"is given beside antenna = {radio.antenna!r}: leave one of them out", key="antenna_pattern")
    try:
        return read_pattern(radio.antenna_pattern)
    except UsageError as error:
        raise ScenarioError(str(error), key="antenna_pattern") from error


@lru_cache(maxsize=64)
def read_pattern(file: str) -> Measured:
    """Read a pattern: a header, and a line elevation_deg,azimuth_deg,gain_dbi for every point of a grid, in any order.

    Raises:
        UsageError: no such file, or not such a file; the message names the line.
    """
    lines = list(read_cells(Path(file)))
    if not lines or tuple(lines[0][1]) != COLUMNS:
        raise UsageError(f"{file}: the first line must be {','.join(COLUMNS)}")
    points = np.array([_numbers(file, *line) for line in lines[1:]]).reshape(-1, 3)
    elevation, row = np.unique(points[:, 0], return_inverse=True)
    azimuth, column = np.unique(points[:, 1], return_inverse=True)
    gain_dbi = np.full((len(elevation), len(azimuth)), np.nan)
    gain_dbi[row, column] = points[:, 2]
    if not len(points) or len(points) != gain_dbi.size or np.isnan(gain_dbi).any():
        size = f"{len(elevation)} elevations x {len(azimuth)} azimuths"
        raise UsageError(f"{file}: {len(points)} points are not a grid of {size}: give each pair once")
    if azimuth[-1] - azimuth[0] >= 360.0:
        raise UsageError(f"{file}: azimuths from {azimuth[0]:g} to {azimuth[-1]:g} are a whole turn: leave the last one out")
    return Measured(elevation, azimuth, gain_dbi)


def _numbers(file: str, line: int, cells: list[str]) -> tuple[float, float, float]:
    try:
        elevation, azimuth, gain = map(float, cells)
    except ValueError:
        raise UsageError(
            f"{file} line {line}: must be three numbers ({','.join(COLUMNS)}), not {','.join(cells)[:60]}"
        ) from None
    if not (-90.0 <= elevation <= 90.0 and -360.0 <= azimuth <= 360.0 and abs(gain) <= _MOST_DBI):
        limits = f"elevation -90 to 90, azimuth -360 to 360, gain -{_MOST_DBI:g} to {_MOST_DBI:g}"
        raise UsageError(f"{file} line {line}: {','.join(cells)[:60]} is out of range: {limits}")
    return elevation, azimuth, gain


class Antennas(NamedTuple):
    """The antennas of n vehicles."""

    patterns: Sequence[Pattern]
    number: Ints  # (n,) pattern of each; -1: isotropic
    attitude: Floats  # (n, 4) w, x, y, z; world_from_body

    @classmethod
    def of(cls, radios: Sequence[Radio], attitude: Floats | None) -> "Antennas":
        """The antennas of radios; without attitudes all are level."""
        by_radio = [pattern_of(radio) for radio in radios]
        patterns = [pattern for pattern in by_radio if pattern is not None]
        has_pattern = np.array([pattern is not None for pattern in by_radio], bool)
        number = np.where(has_pattern, np.cumsum(has_pattern) - 1, -1)
        if attitude is None:
            attitude = np.tile((1.0, 0.0, 0.0, 0.0), (len(radios), 1))
        return cls(patterns, number, attitude)

    def gain(self, vehicle: Ints, direction: Floats) -> Floats:
        """Power gain of the antennas of some vehicles, by row (m,), each in a direction in the world, (m, 3)."""
        gain = np.ones(len(vehicle))
        numbers = self.number[vehicle]
        for number in np.unique(numbers[numbers >= 0]).tolist():
            (these,) = np.nonzero(numbers == number)
            gain[these] = self.patterns[number].gain(_in_body(self.attitude[vehicle[these]], direction[these]))
        return gain


class LinkAntennas(NamedTuple):
    """The antennas of the links from one vehicle to n others."""

    antennas: Antennas
    sender: int  # row of the vehicle
    receivers: Ints  # (n,)

    def gain(self, link: Ints, leaving: Floats, arriving: Floats) -> Floats:
        """Gain of both antennas for m paths, a ratio of powers; directions away from the sender and the receiver, (m, 3)."""
        sent = self.antennas.gain(np.full(len(link), self.sender), leaving)
        return sent * self.antennas.gain(self.receivers[link], arriving)

    def straight(self, paths: Paths) -> Floats:
        """Gain of both antennas along the straight lines, (n,)."""
        towards = (paths.rx - paths.tx) / np.maximum(paths.distance_m, 1e-9)[:, None]
        return self.gain(np.arange(len(towards)), towards, -towards)


def _in_body(attitude: Floats, direction: Floats) -> Floats:
    """Directions in the world, (m, 3), in the frames of bodies with these attitudes, (m, 4)."""
    w, v = attitude[:, :1], -attitude[:, 1:]  # of the inverse rotation
    across = 2.0 * np.cross(v, direction)
    return np.asarray(direction + w * across + np.cross(v, across))
