"""``vcmvsp figure``, ``validate`` and ``bench``: measure published numbers, laws and costs again, and compare them."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson, Quiet, show_names
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.text import stdout_to_stderr

HOME = Path(__file__).resolve().parents[2]
"""The checkout, which has a folder ``bench``."""


def figure_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A number of the thesis or a name; without it: the list.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for data, pictures and rows.")] = Path("figures"),
    jobs: Annotated[int | None, typer.Option(metavar="N", help="Number of parallel processes [all processors].")] = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Make a figure again and compare its numbers with the expected ones.

    Writes NAME.csv (the curves), NAME.png, NAME.svg, NAME.pdf, NAME-expected.csv and NAME.json (expected and measured numbers).
    The exit code is 1 if a number is outside its tolerance.

    Example: vcmvsp figure 24 --out figures
    """
    from vcmvsp.cosim.reproduction import figures

    if name is None:
        show_names({each: words for each, (_, words) in figures.NAMES.items()}, json=json)
        return
    make = figures.find(name)
    count = _checked(out, jobs)
    from vcmvsp.cosim.reproduction.figures import drawing
    from vcmvsp.cosim.reproduction.figures.figure import as_json, table
    from vcmvsp.cosim.reproduction.runner import Runner
    from vcmvsp.cosim.terminal.progress import StudyProgress

    with stdout_to_stderr(), StudyProgress(quiet=quiet) as progress:
        figure = make(Runner(count, lambda done, of: progress.on_run(done, 0, of)))
        written = drawing.write(name, figure, out)
    if json:
        sys.stdout.write(as_json(name, figure))
    else:
        paths = "\n".join(map(str, written))
        sys.stdout.write(f"{figure.title}\n\n{table(figure)}\n{paths}\n")
    if not figure.ok:
        missed = sum(not row.ok for row in figure.rows)
        sys.stderr.write(f"vcmvsp: {missed} of {len(figure.rows)} numbers are outside their tolerance\n")
        raise SystemExit(1)


def validate_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for VALIDATION.md, validation.csv, validation.json.")] = Path(
        "validation"
    ),
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this check, e.g. path-loss, figure-24; repeat for several.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", help="Number of parallel processes [all processors].")] = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure every law, closed form and outside reference again, and write expected and measured numbers.

    Writes VALIDATION.md (a line per check), validation.csv and validation.json (all rows). The exit code is 1 if a row is
    outside its tolerance or a check fails to run; each is named. All checks take about 13 minutes.

    Example: vcmvsp validate --only path-loss --only figure-24
    """
    from vcmvsp.cosim.reproduction import validation

    checks = validation.chosen(only or [])
    count = _checked(out, jobs)
    from vcmvsp.cosim.reproduction.validation import document
    from vcmvsp.cosim.terminal.progress import StudyProgress

    with stdout_to_stderr(), StudyProgress(quiet=quiet, what="checks") as progress:
        outcomes = validation.run_all(checks, count, lambda done, of: progress.on_run(done, 0, of))
    written = document.write(outcomes, out)
    if json:
        sys.stdout.write(document.as_json(outcomes))
    else:
        for each in outcomes:
            sys.stdout.write(
                f"{'ok ' if each.ok else 'OFF'}  {each.check.name:<23} {len(each.rows):>3} rows  {each.check.title}\n"
            )
        sys.stdout.write("\n" + "".join(f"{path}\n" for path in written))
    if off := document.failures(outcomes):
        sys.stderr.write(f"vcmvsp: {len(off)} of {sum(len(each.rows) for each in outcomes)} rows are off:\n")
        sys.stderr.writelines(f"  {line}\n" for line in off)
        raise SystemExit(1)


def _checked(out: Path, jobs: int | None) -> int:
    """The number of runs at a time; the folder may be new, but no file."""
    from vcmvsp.cosim.processes.worker_pool import cores

    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be 1 or more")
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: is a file; name a folder")
    return jobs or cores()


def bench_command(
    parts: Annotated[
        list[str] | None, typer.Argument(metavar="[PART]...", help="E.g. core, shares, messages, radio; without it: all.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Measure the cost of the platform beside other programs.

    The benchmarks are part of the sources: this command works only in a checkout. All parts take about 25 minutes; each
    prints its duration. The exit code is 1 if a target is missed.

    Example: vcmvsp bench core recording
    """
    if not (HOME / "bench" / "__main__.py").is_file():
        raise UsageError(f"there is no folder bench beside {HOME / 'cosim'}: run this in a checkout of the sources")
    command = [sys.executable, "-m", "bench", *(parts or []), *(["--json"] if json else [])]
    with subprocess.Popen(command, cwd=HOME) as measuring:
        try:
            code = measuring.wait()
        except KeyboardInterrupt:
            measuring.wait()  # until it has printed its results
            raise
    if code:
        raise SystemExit(code)
