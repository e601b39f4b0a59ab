"""``vcmvsp report``: the page of a run or a study, made again from its folder."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.errors import UsageError


def report_command(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN_OR_STUDY_DIR", help="A folder that 'vcmvsp run' or 'vcmvsp study' has left.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to put the page [report.html in that folder].")
    ] = None,
) -> None:
    """Make report.html of a run or a study again, in one file: figures, numbers, losses and why, how to repeat it.

    Of a run that was cut, or a study that goes on, it shows what there is, and says what is missing.

    Example: vcmvsp report runs/formation-circle-1
    """
    from vcmvsp.cosim.studies import outputs
    from vcmvsp.cosim.studies.store import PLAN
    from vcmvsp.cosim.util.files import writing

    if not folder.is_dir():
        raise UsageError(
            f"{folder}: {'is no folder' if folder.exists() else 'does not exist'}; name the folder of a run or a study"
        )
    if out is not None and out.is_dir():
        raise UsageError(f"--out {out}: is a folder; name a file, e.g. {out / 'report.html'}")
    with writing(out or folder):
        path = outputs.report_again(folder, out) if (folder / PLAN).is_file() else _of_run(folder, out)
    sys.stdout.write(f"{path}\n")


def _of_run(folder: Path, out: Path | None) -> Path:
    from vcmvsp.cosim.plots import files
    from vcmvsp.cosim.report import run_page
    from vcmvsp.cosim.runs.result import figures_again

    try:
        figures = figures_again(folder)
    except UsageError:  # its tables are not there, or damaged: the page says so
        figures = {}
    return run_page.write(folder, {name: files.svg(figure) for name, figure in figures.items()}, out)
