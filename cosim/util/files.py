"""Files and folders: the output folder of a run or a study, atomic writing, JSON, and CSV files of users."""

import contextlib
import csv
import itertools
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util import limits

PART = ".part"  # suffix of incomplete folders


class Folder:
    """Output folder of a run or a study: checked when it is named, and claimed by one run when it is needed.

    Args:
        path: the folder; it must be new or empty, unless ``force`` or ``numbered``.
        force: also write into a folder that is not empty.
        numbered: if it exists, take the first of ``path-2``, ``path-3``, ... that does not.
    """

    def __init__(self, path: Path, *, force: bool = False, numbered: bool = False) -> None:
        self.path, self.force, self._numbered = path, force, numbered
        if not numbered:
            self._check()

    def claim(self) -> Path:
        """Make the folder and return its path."""
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
                raise UsageError(f"--out {self.path}: is not empty; choose another folder, or add --force to overwrite")
            parent = next(each for each in (self.path, *self.path.absolute().parents) if each.exists())
        except OSError as error:
            raise UsageError(f"--out {self.path}: {error.strerror}") from error
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise UsageError(f"--out {self.path}: no write access to {parent}")


def _make(path: Path) -> bool:
    try:
        path.mkdir()
    except FileExistsError:
        return False
    return True


@contextlib.contextmanager
def writing(folder: Path | None) -> Iterator[None]:
    """Report a full disk and other file errors in one line; None: the system's folder for temporary files."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"cannot write into {folder or tempfile.gettempdir()}: {error.strerror or error}") from error


@contextlib.contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Atomic writing: gives a temporary place for a file or folder, which replaces ``path`` in the end.

    If the writing fails, the place is removed and the old content is untouched. The place is new, private and randomly named,
    and a link to a file is replaced, so files prepared by others are never written to. A device or a pipe is written directly.

    Args:
        durable: flush the file to the disk before it replaces the old one, so that it survives a power cut.
    """
    if _is_stream(path):
        yield path
        return
    beside = Path(tempfile.mkdtemp(prefix=".vcmvsp-", suffix=PART, dir=path.parent))
    try:
        place = beside / path.name
        yield place
        if place.is_dir():
            path.mkdir(exist_ok=True)
            for each in sorted(place.iterdir()):
                each.replace(path / each.name)
        else:
            if durable:
                _sync(place)
            place.replace(path)
            if durable:
                _sync(path.parent)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_whole(path: Path, content: str | bytes, mode: int = 0o666) -> None:
    """Write a file atomically (`replacing`), with this mode from the first byte on; text as UTF-8."""
    with replacing(path) as place:
        new = 0 if place == path else os.O_CREAT | os.O_EXCL
        with open(os.open(place, os.O_WRONLY | new, mode), "wb") as file:  # noqa: PTH123  Path sets no mode
            file.write(content.encode() if isinstance(content, str) else content)


def _is_stream(path: Path) -> bool:
    """Whether a path is a device or a pipe; links to one count only in ``/dev``, e.g. ``/dev/stdout``."""
    links = path.is_symlink() and not path.absolute().is_relative_to("/dev")
    return path.exists() and not (path.is_file() or path.is_dir() or links)


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def finite(value: object) -> Any:
    """The value with None for numbers that JSON lacks: a vehicle that was sent to infinity is infinitely far away."""
    if isinstance(value, dict):
        return {name: finite(each) for name, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: object) -> str:
    """JSON as in the files: indented, no NaN."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def read_cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines of a CSV file that are not blank: line number, from 1, and stripped cells.

    Raises:
        UsageError: the file does not exist, or is no CSV file in UTF-8.
    """
    try:
        limits.check_size(path, limits.CSV_BYTES)
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            for line in reader:
                cells = [cell.strip() for cell in line]
                if any(cells):
                    yield reader.line_num, cells
    except FileNotFoundError as error:
        raise UsageError(f"{path}: there is no such file") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path}: is not a CSV file in UTF-8 ({error})") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error
