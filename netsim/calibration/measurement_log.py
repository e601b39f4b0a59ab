"""A measured log: from where to where, and how strong."""

import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import read_cells
from vcmvsp.netsim.interfaces.layers import Bools, Floats

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
        """From a to b, (n,)."""
        distance: Floats = np.sqrt(((self.a - self.b) ** 2).sum(axis=1))
        return distance

    def only(self, rows: NDArray[np.intp]) -> "MeasuredLinks":
        """Some of the rows, by their numbers (m,)."""
        return MeasuredLinks(self.time_s[rows], self.a[rows], self.b[rows], self.level_dbm[rows])


def read_links(path: Path) -> MeasuredLinks:
    """Read a CSV file with the columns time, ax, ay, az, bx, by, bz, rssi_dbm and perhaps received: s, m and dBm.

    Others may stand beside them, in any order. A row is lost where ``received`` is 0 or false; without that column, where
    ``rssi_dbm`` is empty or nan.

    Raises:
        UsageError: that names the file, the line and what is allowed.
    """
    lines = read_cells(path)
    _, header = next(lines, (0, []))
    if missing := [name for name in COLUMNS if name not in header]:
        found = ", ".join(header) or "nothing"
        raise UsageError(f"{path}: no column {', '.join(missing)}; wanted: {', '.join(COLUMNS)}[, received]; found: {found}")
    if twice := sorted({name for name in (*COLUMNS, "received") if header.count(name) > 1}):
        raise UsageError(f"{path}: column {', '.join(twice)} stands there twice")
    table = np.fromiter(itertools.chain.from_iterable(_rows(path, header, lines)), np.float64).reshape(-1, len(COLUMNS))
    if not len(table):
        raise UsageError(f"{path}: no rows under the header")
    return MeasuredLinks(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7])


def _rows(path: Path, header: list[str], lines: Iterable[tuple[int, list[str]]]) -> Iterator[list[float]]:
    """Of each line, the values of `COLUMNS`."""
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
        raise UsageError(f"{where}: was received, but has no rssi_dbm; a lost one has received = 0")
    return received
