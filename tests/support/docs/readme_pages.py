"""Examples in the documents: shell lines, code blocks, and commands within sentences."""

import importlib.util
import re
import shlex
import tomllib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.paths import ROOT
from vcmvsp.cosim.cli import app as cli
from vcmvsp.cosim.reproduction.figures import NAMES
from vcmvsp.cosim.scenario import loader

PARTS = ("agents", "cosim", "hardware", "netsim", "physics", "scenarios")
PAGES = {
    str(path.relative_to(ROOT)): path.read_text("utf-8")
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted((ROOT / "docs").rglob("*.md")),
        ROOT / "examples" / "README.md",
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
    """Lines of a fence, or indented by four blanks."""

    page: str
    line: int
    language: str  # info string of the fence; `INDENTED`
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


class Command(NamedTuple):
    """A shell line without its comment."""

    page: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text}"


def blocks_of(page: str, text: str) -> Iterator[Block]:
    """Every fenced or indented block of a page."""
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
    """Shell words of a line without its comment, ``$(...)`` as one word."""
    return shlex.split(re.sub(r"\$\([^)]*\)", "VALUE", line), comments=True)


def program_of(words: list[str]) -> str:
    """Program of a line, without folder, variables, and ``sudo``."""
    rest = (word for word in words if word != "sudo" and not re.match(r"\w+=", word))
    return Path(next(rest, "")).name


def commands_in(block: Block) -> list[Command]:
    """Lines of a block, if it is a shell block; otherwise none."""
    lines = [line for line in block.text.splitlines() if line.strip()]
    if block.language == INDENTED:
        if program_of(_first_words(lines[0])) not in PROGRAMS:
            return []
    elif block.language not in SHELLS:
        return []
    return [Command(block.page, block.line + number, _uncommented(line)) for number, line in enumerate(lines)]


def _first_words(line: str) -> list[str]:
    """First words of a line that need not be a shell line."""
    try:
        return words_of(line)
    except ValueError:  # an unterminated quotation
        return []


def _uncommented(line: str) -> str:
    return re.sub(r"\s+#\s.*$", "", line).removesuffix("&").strip()


def mentions_of(page: str, text: str) -> list[str]:
    """Our commands within sentences: text in backticks that begins with one of our programs."""
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
    """The one shell line, on any page, that begins with these words."""
    (found,) = {each.text for each in COMMANDS if each.text.startswith(words)}
    return found


def block(page: str, words: str) -> str:
    """The one block of a page that contains these words."""
    (found,) = [each.text for each in BLOCKS if each.page == page and words in each.text]
    return found


TARGETS = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
READERS_OWN = re.compile(r"[A-Z_]+|\.\.\.|.*[./].*")  # RUN_DIR, mine.toml, runs/formation-circle-1


def our_words(words: Sequence[str]) -> list[str]:
    """Words behind ``vcmvsp``."""
    return [*words[next(at for at, word in enumerate(words) if Path(word).name == "vcmvsp") + 1 :]]


def parse_command(words: Sequence[str]) -> None:
    """Parse a whole command.

    Raises:
        ValueError: one of its words is unknown.
        Exception: of the parser, for a command that it rejects.
    """
    command, rest = _command(words)
    if hasattr(command, "commands"):
        _options(command, rest)
    else:
        command.make_context(command.name, cli._with_values(rest))
        _names(command, rest)


def check_mention(words: Sequence[str]) -> None:
    """Check a command within a sentence, which may be incomplete or have parts in brackets.

    Raises:
        ValueError: one of its words is unknown.
    """
    match program_of([*words]):
        case "vcmvsp":
            for each in _alternatives([word.strip("[]") for word in our_words(words)]):
                command, rest = _command(each)
                _options(command, rest)
                _names(command, rest)
        case "make":
            targets = [word for word in words[1:] if "=" not in word]
            for target in targets:
                _one_of("target", target, TARGETS)
        case "python" if importlib.util.find_spec(words[2]) is None:
            raise ValueError(f"there is no module {words[2]}")
        case "pip":
            for name, extra in re.findall(r"([\w.-]+)\[(\w+)\]", " ".join(words)):
                _one_of("package in any index called", name, ["."])  # ours is in none: it is installed from a checkout
                _one_of("extra", extra, PROJECT["optional-dependencies"])
        case "pytest" if not (ROOT / words[-1]).exists():
            raise ValueError(f"there is no {words[-1]}")


def _alternatives(words: list[str]) -> list[list[str]]:
    """``emulate ubisense | dwm1001`` is two commands."""
    if "|" not in words:
        return [words]
    first = words.index("|") - 1
    return [[*words[:first], word] for word in words[first:] if word != "|"]


def _command(words: Sequence[str]) -> tuple[Any, list[str]]:
    """Command named by the first words, and the remaining words."""
    command, rest = cli.command(), [*words]
    while rest and not rest[0].startswith("-") and hasattr(command, "commands"):
        _one_of("command", rest[0], command.commands)
        command = command.commands[rest.pop(0)]
    return command, rest


def _options(command: Any, words: list[str]) -> None:
    known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {"-h", "--help"}
    for word in words[: words.index("--") if "--" in words else None]:  # another program's words follow
        if re.match(r"--?[a-z]", word):
            _one_of("option", word, sorted(known))


def _names(command: Any, words: list[str]) -> None:
    """First word as the command's scenario or file, unless the reader chooses it."""
    about = {"run": loader.names(), "study": loader.names(), "check": loader.names(), "figure": NAMES}
    if command.name in about and words and not words[0].startswith("-") and not READERS_OWN.fullmatch(words[0]):
        _one_of("scenario" if command.name != "figure" else "figure", words[0], about[command.name])


def _one_of(kind: str, name: str, known: Collection[str]) -> None:
    if name not in known:
        raise ValueError(f"there is no {kind} {name}; there are {', '.join(known)}")
