"""``vcmvsp figure``: a figure of the thesis or of a further study, made again and compared with what must come out."""

import os
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self

import typer

from cosim.cli_options import AsJson
from cosim.errors import Interrupted, UsageError
from cosim.streams import stdout_to_stderr

LOG_EVERY_S = 5.0


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
    from cosim import figures

    if name is None:
        _list(json=json)
        return
    make = figures.find(name)
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be 1 or more")
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: there is a file of that name; name a folder")
    from cosim.figures import files
    from cosim.figures.kit import Runner

    try:
        with _Progress(name, quiet=quiet) as progress, stdout_to_stderr():
            figure = make(Runner(jobs or _processors(), progress.on_run))
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


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _list(*, json: bool) -> None:
    from cosim import figures

    about = {name: words for name, (_, words) in figures.NAMES.items()}
    if json:
        from cosim.api import to_json

        sys.stdout.write(to_json(about))
        return
    width = max(map(len, about))
    sys.stdout.writelines(f"{name:<{width}}  {words}\n" for name, words in about.items())


class _Progress:
    """How many runs are done, on stderr: a bar on a terminal, else a line every few seconds."""

    def __init__(self, name: str, *, quiet: bool) -> None:
        self._name, self._quiet = name, quiet
        self._bar: Any = None
        self._task: Any = None
        self._last = time.monotonic()

    def __enter__(self) -> Self:
        if sys.stderr.isatty() and not self._quiet:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (TextColumn(f"figure {self._name}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("", total=None)
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def on_run(self, done: int, of: int) -> None:
        """Told after every run."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=of)
        elif not self._quiet and time.monotonic() - self._last > LOG_EVERY_S:
            self._last = time.monotonic()
            sys.stderr.write(f"figure {self._name}: {done} of {of} runs\n")
            sys.stderr.flush()
