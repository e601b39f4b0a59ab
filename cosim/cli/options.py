"""Options and helpers of several commands."""

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import to_json
from vcmvsp.cosim.util.text import aligned

if TYPE_CHECKING:
    from vcmvsp.cosim.types import Vec3

Changes = list[str] | None
"""Values of ``--set``."""


def changes(words: str) -> Any:
    """The option ``--set`` with this help."""
    return typer.Option("--set", metavar="KEY=VALUE", help=words)


Sets = Annotated[Changes, changes("Change a key of the scenario, e.g. radio.loss.probability=0.3.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on stdout and nothing else there.")]
KeysOfVehicle = Annotated[
    Path | None, typer.Option(metavar="FILE", help="This machine's certificate ('vcmvsp keys vehicle NAME').")
]
DialInsecurely = Annotated[bool, typer.Option("--insecure", help="Connect without certificate or secret, to any listener.")]
SecretOfRun = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Secret of a run without certificates [of your own runs on this machine].")
]
Trust = Annotated[bool, typer.Option("--trust", help="Execute user classes of the scenario in the folder, for more details.")]
DATA = "A folder of results is data: nothing of it is executed."
PROGRAM = (
    "A scenario is a program: its classes are imported and run with your rights. "
    "Do not run scenarios of people whose programs you would not start."
)
"""Help texts on trust: `DATA` for commands that read a run's files, `PROGRAM` for those that import a scenario's classes."""


def pose_of(text: str | None) -> "Vec3 | None":
    """Parse ``X,Y,YAW`` of ``--pose``: m, m, rad; None if it was not given.

    Raises:
        UsageError: the text has another form.
    """
    if text is None:
        return None
    try:
        x, y, yaw = map(float, text.split(","))
    except ValueError:
        x = y = yaw = math.nan
    if not all(map(math.isfinite, (x, y, yaw))):
        raise UsageError(f"--pose {text}: write X,Y,YAW (m, m, rad), e.g. 1.5,0,1.57")
    return x, y, yaw


def show_names(about: Mapping[str, str], *, json: bool) -> None:
    """Print names with their descriptions."""
    text = "".join(f"{line}\n" for line in aligned(about.items()))
    sys.stdout.write(to_json(about) if json else text)


def say(text: str) -> None:
    """Write a line to standard error at once."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
