"""``vcmvsp validate``: every law, closed form and outside reference, measured anew."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import Interrupted, UsageError
from vcmvsp.cosim.util.stdout import stdout_to_stderr


def validate_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for VALIDATION.md and validation.json.")] = Path(
        "validation"
    ),
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="This check alone, e.g. path-loss, figure-24; repeat for several.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", help="Checks at a time, each in a process of its own [all processors].")
    ] = None,
    json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Measure every law, closed form and outside reference anew, and write what came out.

    The exit code is 1 if a row is not within its tolerance, or a check breaks off: which, is said. All take several minutes.

    Example: vcmvsp validate --only path-loss --only figure-24
    """
    from vcmvsp.cosim.reproduction import validation

    checks = validation.chosen(only or [])
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be 1 or more")
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: there is a file of that name; name a folder")
    from vcmvsp.cosim.processes.worker_pool import cores
    from vcmvsp.cosim.reproduction.validation import check, document
    from vcmvsp.cosim.terminal.progress import StudyProgress

    try:
        with stdout_to_stderr(), StudyProgress(quiet=quiet, what="checks") as progress:
            outcomes = check.run_all(checks, jobs or cores(), lambda done, of: progress.on_run(done, 0, of))
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
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
