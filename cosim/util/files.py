"""The folder that a run or a study writes into, JSON as it stands there, and CSV files that users bring."""

import contextlib
import csv
import itertools
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import UsageError


class Folder:
    """Where a run is to be written. It is looked at when it is named, and taken, by one run alone, when it is needed.

    Args:
        path: the folder; it must be new or empty, unless ``force`` or ``numbered``.
        force: write into it whatever it holds.
        numbered: if it exists, take the first of ``path-2``, ``path-3``, ... that does not.
    """

    def __init__(self, path: Path, *, force: bool = False, numbered: bool = False) -> None:
        self.path, self.force, self._numbered = path, force, numbered
        if not numbered:
            self._check()

    def claim(self) -> Path:
        """Make it, and say where it is."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._numbered:
            numbers = (self.path.with_name(f"{self.path.name}-{number}") for number in itertools.count(2))
            self.path = next(path for path in itertools.chain([self.path], numbers) if _make(path))
        else:
            self._check()
            _make(self.path)
        return self.path

    def _check(self) -> None:
        try:
            if self.path.exists() and not self.path.is_dir():
                raise UsageError(f"--out {self.path}: is a file, not a folder")
            if self.path.is_dir() and any(self.path.iterdir()) and not self.force:
                raise UsageError(f"--out {self.path}: is not empty; give another folder, or --force to overwrite")
            parent = next(each for each in (self.path, *self.path.absolute().parents) if each.exists())
        except OSError as error:
            raise UsageError(f"--out {self.path}: {error.strerror}") from error
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise UsageError(f"--out {self.path}: {parent} cannot be written to")


def _make(path: Path) -> bool:
    """Make a folder; whether it is new. Of several processes that try, one succeeds."""
    try:
        path.mkdir()
    except FileExistsError:
        return False
    return True


@contextlib.contextmanager
def writing(folder: Path | None) -> Iterator[None]:
    """A full disk and the like is said in one line."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror or error}") from error


def finite(value: object) -> Any:
    """The value with None for numbers that JSON cannot say: a vehicle that was sent to infinity is infinitely far away."""
    if isinstance(value, dict):
        return {name: finite(each) for name, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: object) -> str:
    """JSON as it stands in the files: indented, keys in order, no NaN."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def read_cells(path: Path) -> list[tuple[int, list[str]]]:
    """The lines of a CSV file that are not blank: number of each, from 1, and its cells without white space around them.

    Raises:
        UsageError: there is no such file, or it is no CSV file in UTF-8.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except FileNotFoundError as error:
        raise UsageError(f"{path}: there is no such file") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path}: is not a CSV file in UTF-8 ({error})") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
    return [(number, cells) for number, cells in lines if any(cells)]
