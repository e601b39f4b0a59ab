"""A measured log: from where to where, and how strong."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError
from netsim.layers import Bools, Floats

if TYPE_CHECKING:
    import _csv

COLUMNS = ("time", "ax", "ay", "az", "bx", "by", "bz", "rssi_dbm")
RECEIVED = {"1": True, "true": True, "0": False, "false": False}  # the optional column ``received``


class Links(msgspec.Struct, frozen=True):
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

    def only(self, rows: NDArray[np.intp]) -> "Links":
        """Some of the rows."""
        return Links(self.time_s[rows], self.a[rows], self.b[rows], self.level_dbm[rows])


def read_links(path: Path) -> Links:
    """Read a CSV file with the columns time, ax, ay, az, bx, by, bz, rssi_dbm and perhaps received: s, m and dBm.

    Others may stand beside them, in any order. A row is lost where ``received`` is 0 or false; without that column, where
    ``rssi_dbm`` is empty or nan.

    Raises:
        UsageError: that names the file, the line and what is allowed.
    """
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read as a CSV file: {error}") from error
    lines = csv.reader(text.splitlines())
    header = [name.strip() for name in next(lines, [])]
    if missing := [name for name in COLUMNS if name not in header]:
        found = ", ".join(header) or "nothing"
        raise UsageError(f"{path}: no column {', '.join(missing)}; wanted: {', '.join(COLUMNS)}[, received]; found: {found}")
    if twice := sorted({name for name in (*COLUMNS, "received") if header.count(name) > 1}):
        raise UsageError(f"{path}: column {', '.join(twice)} stands there twice")
    rows = list(_rows(path, header, lines))
    if not rows:
        raise UsageError(f"{path}: no rows under the header")
    table = np.array(rows, np.float64)
    return Links(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7])


def _rows(path: Path, header: list[str], lines: "_csv.Reader") -> Iterator[list[float]]:
    """Of each line that is not blank, the values of `COLUMNS`."""
    for cells in lines:
        where = f"{path} line {lines.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise UsageError(f"{where}: has {len(cells)} fields; the header has {len(header)}")
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
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
