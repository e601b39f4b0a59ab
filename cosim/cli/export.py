"""``vcmvsp export``: a run's recording for other tools."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.cli.run import Quiet
from vcmvsp.cosim.terminal.progress import Shown


def export_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A folder that 'vcmvsp run' has left.")],
    rosbag2: Annotated[bool, typer.Option("--rosbag2", help="rosbag2/: a ROS 2 bag, MCAP inside.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="csv/: tables of states, radio, commands and sensors.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="run.mp4: a film of the run from above.")] = False,
    layout: Annotated[
        bool, typer.Option("--layout", help="layout.json: for Foxglove and Lichtblick, which fits its run.mcap.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Where to put them [RUN_DIR].")] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write a run's recording in the formats of other tools; also of a run that was killed, as far as it goes.

    Example: vcmvsp export runs/formation-circle-1 --csv --mp4
    """
    from vcmvsp.cosim.export.formats import NAMES, export

    wanted = {"rosbag2": rosbag2, "csv": csv, "mp4": mp4, "layout": layout}
    paths = {name: (out or run_dir) / NAMES[name] for name, is_wanted in wanted.items() if is_wanted}
    with _Exporting(quiet=quiet) as shown:
        written = export(run_dir, **paths, force=force, tell=shown.tell, progress=shown.on_part)
    for path in written:
        sys.stdout.write(f"{path}\n")


class _Exporting(Shown):
    """How far an export is."""

    def on_part(self, name: str, part: float) -> None:
        """Note how far an output is, 0 to 1."""
        if self._is_due():
            words = f"{name}: {100 * part:.0f} %"
            self._draw(part, 1.0, words) if self._terminal else self.tell(words)
