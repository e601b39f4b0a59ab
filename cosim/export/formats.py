"""Exports a run's recording to other formats: `export`. Each output is written completely or not at all."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.recorded_run import FILE, Source
from vcmvsp.cosim.util.files import replacing

FOLDERS = ("rosbag2", "csv")
NAMES = {"rosbag2": "rosbag2", "csv": "csv", "mp4": "run.mp4", "layout": "layout.json"}
"""Default names of the outputs."""
Progress = Callable[[str, float], None]
"""Receives the current output and its progress, 0 to 1; restarts at 0 for each pass over the recording."""


def export(
    run_dir: str | Path,
    *,
    rosbag2: str | Path | None = None,
    csv: str | Path | None = None,
    mp4: str | Path | None = None,
    layout: str | Path | None = None,
    force: bool = False,
    tell: Callable[[str], None] = lambda _: None,
    progress: Progress = lambda *_: None,
) -> list[Path]:
    """Write the requested outputs; of a damaged recording, the readable part.

    Args:
        run_dir: the folder of a run.
        rosbag2: folder for a ROS 2 bag, see `cosim.export.rosbag`.
        csv: folder for tables, see `cosim.export.csv_files`.
        mp4: file for a video seen from above.
        layout: file for a Foxglove and Lichtblick layout.
        force: overwrite existing outputs; other files in a folder are kept.
        tell: receives a line for the user if the recording is damaged: how far it is readable.
        progress: see `Progress`.

    Returns:
        The written files and folders, in this order.

    Raises:
        UsageError: no output is requested, there is no recording, or an output cannot be written.
    """
    formats = {"rosbag2": rosbag2, "csv": csv, "mp4": mp4, "layout": layout}
    paths = {name: Path(path) for name, path in formats.items() if path is not None}
    if not paths:
        raise UsageError("nothing to export: add at least one of --rosbag2, --csv, --mp4 and --layout")
    folder = Path(run_dir)
    for name, path in paths.items():
        _check(name, path, folder, force=force)
    if len({path.resolve() for path in paths.values()}) < len(paths):
        raise UsageError("two exports have the same path: use different ones")
    source = Source(folder, tell)
    for name, path in paths.items():
        how_far = functools.partial(progress, name)
        source.progress = how_far
        with _replacing_in_folder(path) as place:
            _write(name, source, place, how_far)
    return list(paths.values())


def _write(name: str, source: Source, place: Path, progress: Callable[[float], None]) -> None:
    """Write one output; its libraries are imported here, so that the other outputs do not need them."""
    match name:
        case "rosbag2":
            from vcmvsp.cosim.export.rosbag import write_bag

            write_bag(source, place)
        case "csv":
            from vcmvsp.cosim.export.csv_files import write_csv

            place.mkdir()
            write_csv(source, place)
        case "mp4":
            from vcmvsp.cosim.export.video import write_video

            write_video(source, place, progress)
        case _:
            from vcmvsp.cosim.export.foxglove_layout import write_layout

            write_layout(source, place)


def _check(name: str, path: Path, run_dir: Path, *, force: bool) -> None:
    """Reject an existing or unwritable output before any work starts."""
    is_folder = name in FOLDERS
    if name == "mp4" and path.suffix.lower() != ".mp4":
        raise UsageError(f"{path}: the name must end in .mp4")
    if not path.name:
        raise UsageError(f"{path}: not the name of a {'folder' if is_folder else 'file'}")
    try:
        if path.is_dir() and not is_folder:
            raise UsageError(f"{path}: is a folder, not a file")
        if path.exists() and not path.is_dir() and is_folder:
            raise UsageError(f"{path}: is a file, not a folder")
        if is_folder and path.is_dir() and path.samefile(run_dir):
            raise UsageError(f"{path}: is the folder of the run; choose another one")
        if path.is_file() and (run_dir / FILE).is_file() and path.samefile(run_dir / FILE):
            raise UsageError(f"{path}: is the recording itself; choose another name")
        if not force and path.exists() and (not is_folder or any(path.iterdir())):
            problem = "is not empty" if is_folder else "already exists"
            raise UsageError(f"{path}: {problem}; choose another folder (--out), or add --force to overwrite")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


@contextlib.contextmanager
def _replacing_in_folder(path: Path) -> Iterator[Path]:
    """Context like `replacing` that also creates the folder."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as place:
            yield place
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error
