"""``vcmvsp figure``: a figure of the thesis or of a further study, made again and compared with what must come out."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import Interrupted, UsageError
from vcmvsp.cosim.util.stdout import stdout_to_stderr


def figure_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A number of the thesis or a name; without it: the list.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for data, pictures and rows.")] = Path("figures"),
    jobs: Annotated[
        int | None, typer.Option(metavar="N", help="Runs at a time, each in a process of its own [all processors].")
    ] = None,
    json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Make a figure again, and compare it with what must come out.

    Leaves NAME.csv (what is drawn), NAME.png, NAME.svg, NAME-expected.csv and NAME.json (expected and measured numbers).
    The exit code is 1 if a number is not within its tolerance.

    Example: vcmvsp figure 24 --out figures
    """
    from vcmvsp.cosim.reproduction import figures

    if name is None:
        _list(json=json)
        return
    make = figures.find(name)
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be 1 or more")
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: there is a file of that name; name a folder")
    from vcmvsp.cosim.processes.worker_pool import cores
    from vcmvsp.cosim.reproduction.figures import files
    from vcmvsp.cosim.reproduction.figures.figure import Runner
    from vcmvsp.cosim.terminal.progress import StudyProgress

    try:
        with stdout_to_stderr(), StudyProgress(quiet=quiet) as progress:
            figure = make(Runner(jobs or cores(), lambda done, of: progress.on_run(done, 0, of)))
            written = files.write(name, figure, out)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    if json:
        sys.stdout.write(files.as_json(name, figure))
    else:
        paths = "\n".join(map(str, written))
        sys.stdout.write(f"{figure.title}\n\n{files.table(figure)}\n{paths}\n")
    if not figure.ok:
        missed = sum(not row.ok for row in figure.rows)
        sys.stderr.write(f"vcmvsp: {missed} of {len(figure.rows)} numbers are not within their tolerance\n")
        raise SystemExit(1)


def _list(*, json: bool) -> None:
    from vcmvsp.cosim.reproduction import figures

    about = {name: words for name, (_, words) in figures.NAMES.items()}
    if json:
        from vcmvsp.cosim.util.files import to_json

        sys.stdout.write(to_json(about))
        return
    width = max(map(len, about))
    sys.stdout.writelines(f"{name:<{width}}  {words}\n" for name, words in about.items())
