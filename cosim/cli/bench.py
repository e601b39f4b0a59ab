"""``vcmvsp bench``: what the platform costs, measured by the programs that lie beside it in a checkout."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import Interrupted, UsageError

HOME = Path(__file__).resolve().parents[2]


def bench_command(
    parts: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PART]...", help="E.g. core, shares, messages, radio; without it: all."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Measure what the platform costs, beside what it is built on.

    The measuring programs come with the sources, not with an installation: elsewhere than in a checkout there is nothing to do.
    All of it takes about twenty-five minutes, and each part tells how long it took. The exit code is 1 if a demand is missed.

    Example: vcmvsp bench core recording
    """
    if not (HOME / "bench" / "__main__.py").is_file():
        raise UsageError(f"there is no folder bench beside {HOME / 'cosim'}: run this in a checkout of the sources")
    command = [sys.executable, "-m", "bench", *(parts or []), *(["--json"] if json else [])]
    with subprocess.Popen(command, cwd=HOME) as measuring:
        try:
            code = measuring.wait()
        except KeyboardInterrupt:
            measuring.wait()  # until it has told what it measured
            raise Interrupted("interrupted") from None
    if code:
        raise SystemExit(code)
