"""Lines for the user, and texts from elsewhere, fit to be shown: what a host says of itself, or what an agent raises."""

import contextlib
import os
import re
import sys
from collections.abc import Callable, Iterator

Tell = Callable[[str], None]
"""Takes a line for the user."""

LONGEST_LINE, LONGEST_DETAILS, LONGEST_NAME = 500, 20_000, 100
"""Characters of what a host says of itself, of a traceback, and of a word inside a message."""

# A sequence that tells a terminal something: a control sequence, one with a text (such as a window's title), or a short one.
_ESCAPE = re.compile(r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]|(?:\x1b\]|\x9d).*?(?:\x07|\x1b\\|\x9c|$)|\x1b[ -/]*[0-~]", re.DOTALL)


def plain(text: str, limit: int = LONGEST_LINE, *, lines: bool = False) -> str:
    """A text from elsewhere, fit to be shown: nothing that a terminal obeys, no more than ``limit`` characters.

    Args:
        limit: the most characters; longer ones end in dots.
        lines: keep line breaks; else they become spaces.
    """
    text = _ESCAPE.sub("", text[: 2 * limit + 100])  # no more work than the answer needs
    keep = "\n" if lines else ""
    text = "".join(each if each.isprintable() or each in keep else " " for each in text)
    return text if len(text) <= limit else text[: limit - 3] + "..."


@contextlib.contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Standard output belongs to the answer of a command: what agents print, and what they start, goes to standard error."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        with contextlib.suppress(OSError, ValueError, AttributeError):  # where these are no files, there is nothing to turn
            sys.__stdout__.flush()  # type: ignore[union-attr]
            saved = os.dup(1)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, 1)
            os.dup2(2, 1)
        yield
