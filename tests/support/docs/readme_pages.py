"""What the READMEs show: lines of a shell, blocks of code, and commands that a sentence mentions."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.support.paths import ROOT

PARTS = ("agents", "cosim", "hardware", "netsim", "physics", "scenarios")
PAGES = {
    str(path.relative_to(ROOT)): path.read_text("utf-8")
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted((ROOT / "docs").glob("*.md")),
        *(page for part in PARTS for page in sorted((ROOT / part).rglob("README.md"))),
    )
}
PROGRAMS = {
    "cc",
    "curl",
    "docker",
    "kubectl",
    "make",
    "mkdir",
    "nc",
    "pip",
    "pytest",
    "python",
    "ssh",
    "unshare",
    "uv",
    "vcmvsp",
}
SHELLS = {"sh", "bash", "shell"}
INDENTED = "indented"


class Block(NamedTuple):
    """Lines that stand in a fence, or four blanks to the right of the text."""

    page: str
    line: int
    language: str  # what stands behind the fence; `INDENTED`
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


class Command(NamedTuple):
    """A line for a shell, without the comment behind it."""

    page: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text}"


def blocks_of(page: str, text: str) -> Iterator[Block]:
    """Every block of a page, fenced or indented, and nothing else."""
    language: str | None = None
    begun, lines = 0, [""]
    for number, line in enumerate([*text.splitlines(), ""], 1):
        fenced = line.startswith("```")
        if language in {None, INDENTED} and not fenced and line.startswith("    "):
            if language is None:
                language, begun, lines = INDENTED, number, []
            lines.append(line[4:])
        elif language == INDENTED:
            yield Block(page, begun, INDENTED, "\n".join(lines) + "\n")
            language = None
        elif fenced and language is None:
            language, begun, lines = line.strip("` "), number, []
        elif fenced and language is not None:
            yield Block(page, begun, language, "".join(f"{each}\n" for each in lines))
            language = None
        else:
            lines.append(line)
    assert language is None, f"{page}:{begun}: this fence is never closed"


def words_of(line: str) -> list[str]:
    """The words of a line for a shell, without its comment, ``$(...)`` taken as a word."""
    return shlex.split(re.sub(r"\$\([^)]*\)", "VALUE", line), comments=True)


def program_of(words: list[str]) -> str:
    """What the words start, without the folder that it is in, variables, and ``sudo``."""
    rest = (word for word in words if word != "sudo" and not re.match(r"\w+=", word))
    return Path(next(rest, "")).name


def commands_in(block: Block) -> list[Command]:
    """The lines of a block, if it is one for a shell; otherwise none."""
    lines = [line for line in block.text.splitlines() if line.strip()]
    if block.language == INDENTED:
        if program_of(_first_words(lines[0])) not in PROGRAMS:
            return []
    elif block.language not in SHELLS:
        return []
    return [Command(block.page, block.line + number, _uncommented(line)) for number, line in enumerate(lines)]


def _first_words(line: str) -> list[str]:
    """Those of a line that need not be one for a shell."""
    try:
        return words_of(line)
    except ValueError:  # a quotation that does not end
        return []


def _uncommented(line: str) -> str:
    return re.sub(r"\s+#\s.*$", "", line).removesuffix("&").strip()


def mentions_of(page: str, text: str) -> list[str]:
    """Commands of ours within sentences: what stands in backticks and begins with one of our programs."""
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    return [
        f"{page}: {span}"
        for span in spans
        if program_of(span.split()) in {"vcmvsp", "make", "python", "pytest"} and " " in span
    ]


BLOCKS = [block for page, text in PAGES.items() for block in blocks_of(page, text)]
COMMANDS = [command for block in BLOCKS for command in commands_in(block)]
CODE = [block for block in BLOCKS if not commands_in(block)]
MENTIONS = [mention for page, text in PAGES.items() for mention in mentions_of(page, text)]


def command(words: str) -> str:
    """The one line for a shell, on whatever pages, that begins so."""
    (found,) = {each.text for each in COMMANDS if each.text.startswith(words)}
    return found


def block(page: str, words: str) -> str:
    """The one block of a page in which these words stand."""
    (found,) = [each.text for each in BLOCKS if each.page == page and words in each.text]
    return found
