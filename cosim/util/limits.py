"""Limits on the content of untrusted files, so that a small one cannot fill the memory.

`VCMVSP_LIMITS=off` in the environment lifts all limits. A recording of ten million receptions is within them.
"""

import os
import zipfile
from pathlib import Path

IS_OFF = os.environ.get("VCMVSP_LIMITS") == "off"
ROWS = 50_000_000  # rows of a table
COLUMNS = 10_000  # columns of a table
TABLE_TEXT_BYTES = 1 << 28  # names and other words in a table
TOML_BYTES = 1 << 23
JSON_BYTES = 1 << 25  # a list of empty lists takes 25 times as much in memory
DRAWING_BYTES = 1 << 26  # of a world in a recording: 200 000 triangles have some 30 MB
YAML_BYTES = 1 << 18  # YAML is parsed ten times as slowly as TOML
CSV_BYTES = 1 << 29
FILE_BYTES = 1 << 29  # of meshes, pictures and archives
CHUNK_BYTES = 1 << 27  # of an unpacked recording: a chunk holds at least one message, and a raw 8K picture has 133 MB
UNPACKED_BYTES, UNPACKED_RATIO = 1 << 32, 1000  # of a recording: exceeding both is refused; plain pictures compress very well
TRIANGLES = 200_000  # of a drawing in a recording
TOPICS = 8000  # of a ROS 2 bag, whose writer compares each with all others
VEHICLES = 2000  # of a recording: the view counts the frames of each pair
CELLS = 50_000_000  # of an exported table: exceeding both this and one cell per byte of the recording is refused
MESSAGES = 1_000_000  # of a recording: exceeding both this and one message per byte of the file is refused
PIXELS = 1 << 27  # pixels of a picture
PICTURE = "" if IS_OFF else f", or has more than {PIXELS} pixels (VCMVSP_LIMITS=off lifts the limit)"
"""Added to the message of a picture that OpenCV cannot read."""

if not IS_OFF:
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXELS))  # OpenCV reads it when it is imported


def within(amount: int, limit: int, what: str) -> None:
    """Check an amount. Raises `ValueError` (it exceeds the limit, and limits are not lifted)."""
    if amount > limit and not IS_OFF:
        raise ValueError(f"{what}: {amount} exceeds the limit of {limit}; VCMVSP_LIMITS=off in the environment lifts limits")


def read_bytes(path: Path, limit: int = JSON_BYTES) -> bytes:
    """The content of a file. Raises `OSError` (it cannot be read), `ValueError` (it exceeds the limit)."""
    check_size(path, limit)  # a pipe has no size: its content is cut
    with path.open("rb") as stream:
        data = stream.read(-1 if IS_OFF else limit + 1)
    within(len(data), limit, f"bytes in {path.name}")
    return data


def read_text(path: Path, limit: int = JSON_BYTES) -> str:
    """The content of a file in UTF-8; errors as in `read_bytes`."""
    return read_bytes(path, limit).decode("utf-8")


def check_size(path: Path, limit: int = FILE_BYTES) -> None:
    """Refuse a file that exceeds the limit; errors as in `read_bytes`."""
    within(path.stat().st_size, limit, f"bytes in {path.name}")


def check_archive(path: Path) -> None:
    """Refuse a file, or an archive with too large a content; errors as in `read_bytes`."""
    check_size(path)
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            within(sum(each.file_size for each in archive.infolist()), FILE_BYTES, f"bytes packed in {path.name}")
