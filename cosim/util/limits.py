"""How much may come out of a file from outside, so that a small one cannot fill the memory.

`VCMVSP_LIMITS=off` in the environment lifts all limits. A recording of ten million receptions is within them.
"""

import os
import zipfile
from pathlib import Path

IS_OFF = os.environ.get("VCMVSP_LIMITS") == "off"
ROWS = 50_000_000  # of a table
COLUMNS = 10_000  # of a table
TABLE_TEXT_BYTES = 1 << 28  # of names and other words in a table
TOML_BYTES = 1 << 23
JSON_BYTES = 1 << 25  # a list of empty lists takes 25 times as much in memory
DRAWING_BYTES = 1 << 26  # of a world in a recording: 200 000 triangles have some 30 MB
YAML_BYTES = 1 << 18  # it is read ten times as slowly as TOML
CSV_BYTES = 1 << 29
FILE_BYTES = 1 << 29  # of meshes, pictures and archives
CHUNK_BYTES = 1 << 27  # of a recording, unpacked: a message is not divided, and a raw picture of 8K has 133 MB
UNPACKED_BYTES, UNPACKED_RATIO = 1 << 32, 1000  # of a recording: more than both is too much; plain pictures pack very well
MESSAGES = 1_000_000  # of a recording: more than these, and more than a message per byte of the file, is too much
PIXELS = 1 << 27  # of a picture
PICTURE = "" if IS_OFF else f", or has more than {PIXELS} pixels (VCMVSP_LIMITS=off lifts the limit)"
"""Added to the message of a picture that OpenCV does not read."""

if not IS_OFF:
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXELS))  # it is read when OpenCV is imported


def within(amount: int, limit: int, what: str) -> None:
    """Refuse what is beyond a limit. Raises `ValueError` (it is, and limits are not lifted)."""
    if amount > limit and not IS_OFF:
        raise ValueError(f"{what}: {amount}, and at most {limit} are read; VCMVSP_LIMITS=off in the environment lifts limits")


def read_bytes(path: Path, limit: int = JSON_BYTES) -> bytes:
    """The content of a file. Raises `OSError` (it cannot be read), `ValueError` (it is larger than the limit)."""
    check_size(path, limit)  # what has no size, a pipe, is cut
    with path.open("rb") as stream:
        data = stream.read(-1 if IS_OFF else limit + 1)
    within(len(data), limit, f"bytes in {path.name}")
    return data


def read_text(path: Path, limit: int = JSON_BYTES) -> str:
    """The content of a file in UTF-8; errors as in `read_bytes`."""
    return read_bytes(path, limit).decode("utf-8")


def check_size(path: Path, limit: int = FILE_BYTES) -> None:
    """Refuse a file that is larger than the limit; errors as in `read_bytes`."""
    within(path.stat().st_size, limit, f"bytes in {path.name}")


def check_archive(path: Path) -> None:
    """Refuse a file, or an archive that unpacks to too much; errors as in `read_bytes`."""
    check_size(path)
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            within(sum(each.file_size for each in archive.infolist()), FILE_BYTES, f"bytes packed in {path.name}")
