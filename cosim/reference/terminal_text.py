"""The reference on a terminal: a line per key, in columns, and what it means wrapped to the width of the window."""

import textwrap
from collections.abc import Callable, Iterator

from vcmvsp.cosim.reference.describe import toml
from vcmvsp.cosim.reference.tree import Key, Section

NARROWEST = 30  # columns for a meaning; where there are fewer, it stands below its key
Style = Callable[[str], str]


def lines(section: Section, width: int | None = None, strong: Style = str) -> Iterator[str]:
    """The lines of a section.

    Args:
        section: what is to be shown.
        width: of the window; None: there is none, and nothing is wrapped.
        strong: what makes a word stand out.
    """
    head = heading(section)
    yield from _wrapped(f"{strong(head)}: ", len(head) + 2, section.about, width, hanging=4)
    rows = [(key.name, key.type, default_of(key)) for key in section.keys]
    widths = [max(len(row[column]) for row in rows) if rows else 0 for column in range(3)]
    for key, row in zip(section.keys, rows, strict=True):
        name, *others = (cell.ljust(size) for cell, size in zip(row, widths, strict=True))
        begun = "  ".join(["", name.replace(key.name, strong(key.name)), *others, ""])
        yield from _wrapped(begun, sum(widths) + 8, key.meaning, width, hanging=sum(widths) + 8)


def heading(section: Section) -> str:
    """Where the keys stand, as ``--set`` names it, and of which kind they are."""
    where = f"[[{section.path}]]" if section.listed else section.path or "scenario"
    return f'{where}, kind = "{section.kind}"' if section.kind else where


def default_of(key: Key) -> str:
    """``required``, a value as TOML says it, or what holds without one."""
    return "required" if key.required else key.without or "none" if key.default is None else toml(key.default)


def _wrapped(begun: str, size: int, words: str, width: int | None, *, hanging: int) -> Iterator[str]:
    """A line that has begun, with ``size`` columns on the screen, and words that end it or go on below."""
    if width is None:
        yield f"{begun}{words}".rstrip()
    elif width - size < NARROWEST:
        yield begun.rstrip()
        yield from _lines(words, max(NARROWEST, width), first=6, others=6)
    else:
        first, *others = _lines(words, width, first=size, others=hanging) or [""]
        yield f"{begun}{first[size:]}".rstrip()
        yield from others


def _lines(words: str, width: int, *, first: int, others: int) -> list[str]:
    """Words in lines, indented; each stays whole."""
    return textwrap.wrap(
        words, width, initial_indent=" " * first, subsequent_indent=" " * others, break_long_words=False, break_on_hyphens=False
    )
