"""``vcmvsp reference``: every key of a scenario with type, range, default, unit and meaning, from the code."""

import shutil
import sys
from typing import Annotated

import typer

from cosim.cli_options import AsJson


def reference_command(
    section: Annotated[
        str, typer.Argument(metavar="[SECTION]", help="A table, a kind or a key, e.g. radio.loss, leader_follower, seed.")
    ] = "",
    json: AsJson = False,
) -> None:
    """Print every key of a scenario, or those of a section: type and range, default, unit, meaning.

    Example: vcmvsp reference radio.loss
    """
    from cosim import reference_asked, reference_text, reference_tree

    if json:
        import msgspec

        found = reference_tree.Reference(sections=tuple(reference_asked.asked(section)))
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(found), indent=2).decode() + "\n")
        return
    on_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if on_terminal else None
    for number, each in enumerate(reference_asked.asked(section)):
        shown = reference_text.lines(each, width, _strong if on_terminal else str)
        typer.echo(("\n" if number else "") + "\n".join(shown))


def _strong(word: str) -> str:
    return typer.style(word, bold=True)
