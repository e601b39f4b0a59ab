"""``vcmvsp reference``: every key of a scenario with type, range, default, unit and meaning, from the code."""

import shutil
import sys
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson


def reference_command(
    section: Annotated[
        str, typer.Argument(metavar="[SECTION]", help="A table, a kind or a key, e.g. radio.loss, leader_follower, seed.")
    ] = "",
    json: AsJson = False,
) -> None:
    """Print every key of a scenario, or those of a section: type and range, default, unit, meaning.

    Example: vcmvsp reference radio.loss
    """
    from vcmvsp.cosim.reference import query, terminal_text, tree

    if json:
        import msgspec

        found = tree.Reference(sections=tuple(query.asked(section)))
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(found), indent=2).decode() + "\n")
        return
    on_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if on_terminal else None
    for number, each in enumerate(query.asked(section)):
        shown = terminal_text.lines(each, width, _strong if on_terminal else str)
        typer.echo(("\n" if number else "") + "\n".join(shown))


def _strong(word: str) -> str:
    return typer.style(word, bold=True)
