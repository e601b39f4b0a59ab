"""Lines for the user, and untrusted texts made safe to show: answers of hosts, exceptions of agents."""

import contextlib
import os
import re
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Sequence

Tell = Callable[[str], None]
"""Shows a line to the user."""

LONGEST_LINE, LONGEST_DETAILS, LONGEST_NAME = 500, 20_000, 100
"""Longest texts, in characters: a line of a host, a traceback, and a word inside a message."""

# A terminal control sequence: CSI, one with a text (such as a window's title), or a short one.
_ESCAPE = re.compile(r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]|(?:\x1b\]|\x9d).*?(?:\x07|\x1b\\|\x9c|$)|\x1b[ -/]*[0-~]", re.DOTALL)


def plain(text: str, limit: int = LONGEST_LINE, *, lines: bool = False) -> str:
    """An untrusted text made safe to show: without terminal control, at most ``limit`` characters.

    Args:
        limit: the most characters; longer ones end in dots.
        lines: keep line breaks; else they become spaces.
    """
    text = _ESCAPE.sub("", text[: 2 * limit + 100])  # bounds the work on long texts
    keep = "\n" if lines else ""
    for unsafe in {each for each in text if not each.isprintable() and each not in keep}:
        text = text.replace(unsafe, " ")
    return text if len(text) <= limit else text[: limit - 3] + "..."


def aligned(rows: Iterable[Sequence[str]], right: Container[int] = ()) -> list[str]:
    """Rows of cells as lines, with columns of equal width two spaces apart; the columns ``right`` end at their right."""
    listed = list(rows)
    widths = [max(map(len, column)) for column in zip(*listed, strict=True)]
    marks = ["<>"[column in right] for column in range(len(widths))]
    return ["  ".join(map("{:{}{}}".format, row, marks, widths)).rstrip() for row in listed]


@contextlib.contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect output of agents and child processes to standard error: standard output is for a command's answer."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        with contextlib.suppress(OSError, ValueError, AttributeError):  # streams without a descriptor stay as they are
            sys.__stdout__.flush()  # type: ignore[union-attr]
            saved = os.dup(1)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, 1)
            os.dup2(2, 1)
        yield
