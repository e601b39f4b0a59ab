"""Rows of a measured log, and the design matrix of their means."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.util.files import read_cells
from vcmvsp.netsim.interfaces.layers import Bools, Floats
from vcmvsp.netsim.propagation.walls import Sightline

COLUMNS = ("time", "ax", "ay", "az", "bx", "by", "bz", "rssi_dbm")
RECEIVED = {"1": True, "true": True, "0": False, "false": False}  # the optional column ``received``


class MeasuredLinks(msgspec.Struct, frozen=True):
    """n frames, sent or received between the points a and b."""

    time_s: Floats  # (n,) in any order
    a: Floats  # (n, 3) m
    b: Floats  # (n, 3) m
    level_dbm: Floats  # (n,); NaN where lost

    @property
    def lost(self) -> Bools:
        """Which frames were not received, (n,)."""
        return np.isnan(self.level_dbm)

    @property
    def distance_m(self) -> Floats:
        """Distance from a to b, (n,) m."""
        return np.sqrt(((self.a - self.b) ** 2).sum(axis=1))

    def only(self, rows: NDArray[np.intp]) -> "MeasuredLinks":
        """The rows with these numbers, (m,)."""
        return MeasuredLinks(self.time_s[rows], self.a[rows], self.b[rows], self.level_dbm[rows])


def read_links(path: Path) -> MeasuredLinks:
    """Read a CSV file with the columns time, ax, ay, az, bx, by, bz, rssi_dbm and perhaps received: s, m and dBm.

    The order of columns is free; other columns are ignored. A row is lost if ``received`` is 0 or false; without that column,
    if ``rssi_dbm`` is empty or nan.

    Raises:
        UsageError: invalid file; the message names the file, the line and the allowed values.
    """
    lines = read_cells(path)
    _, header = next(lines, (0, []))
    if missing := [name for name in COLUMNS if name not in header]:
        names = ", ".join(header) or "nothing"
        raise UsageError(f"{path}: no column {', '.join(missing)}; required: {', '.join(COLUMNS)}[, received]; found: {names}")
    if twice := sorted({name for name in (*COLUMNS, "received") if header.count(name) > 1}):
        raise UsageError(f"{path}: column {', '.join(twice)} appears twice")
    table = np.fromiter(itertools.chain.from_iterable(_rows(path, header, lines)), np.float64).reshape(-1, len(COLUMNS))
    if not len(table):
        raise UsageError(f"{path}: no rows below the header")
    return MeasuredLinks(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7])


def _rows(path: Path, header: list[str], lines: Iterable[tuple[int, list[str]]]) -> Iterator[list[float]]:
    """The values of `COLUMNS` in each line."""
    for number, cells in lines:
        where = f"{path} line {number}"
        if len(cells) != len(header):
            raise UsageError(f"{where}: has {len(cells)} fields; the header has {len(header)}")
        row = dict(zip(header, cells, strict=True))
        values = [_number(where, row, name) for name in COLUMNS[:-1]]
        yield [*values, _number(where, row, "rssi_dbm") if _received(where, row) else math.nan]


def _number(where: str, row: dict[str, str], name: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{where}: {name} is {row[name]!r}; it must be a finite number")
    return value


def _received(where: str, row: dict[str, str]) -> bool:
    measured = row["rssi_dbm"].lower() not in ("", "nan")
    if "received" not in row:
        return measured
    received = RECEIVED.get(row["received"].lower())
    if received is None:
        raise UsageError(f"{where}: received is {row['received']!r}; it must be 0, 1, true or false")
    if received and not measured:
        raise UsageError(f"{where}: received = 1, but rssi_dbm is missing; lost frames need received = 0")
    return received


def sample(links: MeasuredLinks, most: int) -> NDArray[np.intp]:
    """Numbers of at most ``most`` rows: half of them spread evenly over the log, and the nearest neighbour of each.

    Spread rows determine the mean, near rows correlation and fading (P. Diggle, S. Lophaven, Bayesian geostatistical design,
    Scandinavian Journal of Statistics 33, 2006). Other rows add little: they share the shadowing of the sample.
    """
    from scipy.spatial import cKDTree

    count = len(links.level_dbm)
    if count <= most:
        return np.arange(count)
    parts = np.linspace(0.0, count, most // 2 + 1)
    spread = (parts[:-1] + np.diff(parts) * stream(0, "calibrate/sample").random(most // 2)).astype(int)  # one of each part
    ends = np.concatenate([np.hstack([links.a, links.b]), np.hstack([links.b, links.a])])  # both orientations
    near = np.asarray(cKDTree(ends).query(ends[spread], k=2)[1])
    near %= count  # a row with both ends at one point may be its own neighbour
    return np.union1d(spread, np.where(near[:, 0] == spread, near[:, 1], near[:, 0]))


def crossings(links: MeasuredLinks, sightline: Sightline) -> tuple[Floats, list[str]]:
    """Number of walls of each material on each row's path, (n, m), and these materials, without materials on no path."""
    crossed = np.zeros((len(links.a), len(sightline.materials)))
    start, group = np.unique(links.a, axis=0, return_inverse=True)
    for index, point in enumerate(start):
        rows = group.ravel() == index
        crossed[rows] = sightline.crossings(point, links.b[rows])[0]
    names = sorted({sightline.materials[index] for index in np.flatnonzero(crossed.any(axis=0))})
    of = np.array(sightline.materials, str)[:, None] == np.array(names, str)
    return crossed @ of.astype(np.float64), names


def design_of(links: MeasuredLinks, reference_distance_m: float, sightline: Sightline | None) -> tuple[Floats, list[str]]:
    """Design matrix (n rows, 2 + m) of reference level (dBm), exponent and wall losses (dB), and the m materials."""
    ratio = np.maximum(links.distance_m, reference_distance_m) / reference_distance_m
    walls, materials = (np.zeros((len(ratio), 0)), []) if sightline is None else crossings(links, sightline)
    return np.column_stack([np.ones(len(ratio)), -10.0 * np.log10(ratio), -walls]), materials


def require_told(links: MeasuredLinks, design: Floats, materials: Sequence[str]) -> None:
    """Reject rows that do not determine a coefficient of the mean.

    Args:
        links: n rows.
        design: see `design_of`, (n, 2 + m).
        materials: of the last m columns of ``design``.

    Raises:
        UsageError: the message names the coefficient and what to measure.
    """
    received = design[~links.lost]
    if len(received) < design.shape[1] + 2:
        raise UsageError(f"{len(received)} received rows; {design.shape[1]} parameters need at least {design.shape[1] + 2}")
    if np.ptp(received[:, 1]) < 1e-6:
        distance = float(links.distance_m[~links.lost].mean())
        raise UsageError(
            f"all received rows are at one distance ({distance:.4g} m), or nearer than the reference distance: the exponent is "
            "not identifiable; measure at several distances"
        )
    for material, column in zip(materials, received[:, 2:].T, strict=True):
        if not column.any():
            raise UsageError(
                f"the loss of walls of {material} is not identifiable, because all rows through them are lost: leave those out"
            )
    if np.linalg.matrix_rank(received / np.linalg.norm(received, axis=0), tol=1e-6) < design.shape[1]:
        raise UsageError(
            f"the losses of walls of {', '.join(materials)} cannot be separated from each other or from level and exponent: "
            "measure paths with and without each material"
        )
