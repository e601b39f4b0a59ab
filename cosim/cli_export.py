"""``vcmvsp export``: a run's recording for other tools."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli_run import Quiet
from cosim.progress import Shown


def export_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A folder that 'vcmvsp run' has left.")],
    rosbag2: Annotated[Path | None, typer.Option("--rosbag2", metavar="DIR", help="A ROS 2 bag (MCAP storage).")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="DIR", help="States, radio, commands, sensors as CSV.")] = None,
    mp4: Annotated[Path | None, typer.Option("--mp4", metavar="FILE", help="A film of the run from above.")] = None,
    layout: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A layout of Foxglove and Lichtblick for its run.mcap.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write a run's recording in the formats of other tools; also of a run that was killed, as far as it goes.

    Example: vcmvsp export runs/formation-circle-1 --csv tables --mp4 run.mp4 --layout layout.json
    """
    from cosim.record.export import export

    with _Exporting(quiet=quiet) as shown:
        written = export(
            run_dir,
            rosbag2=rosbag2,
            csv=csv,
            mp4=mp4,
            layout=layout,
            force=force,
            tell=shown.tell,
            progress=shown.on_part,
        )
    for path in written:
        sys.stdout.write(f"{path}\n")


class _Exporting(Shown):
    """How far an export is."""

    def on_part(self, name: str, part: float) -> None:
        """Note how far an output is, 0 to 1."""
        if self._is_due():
            words = f"{name}: {100 * part:.0f} %"
            self._draw(part, 1.0, words) if self._terminal else self.tell(words)
