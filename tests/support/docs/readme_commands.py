"""Whether the words of a README are words of ours: asked of the command line's own parser, and nothing is started."""

import importlib.util
import re
import tomllib
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import typer

from tests.support.docs.readme_pages import program_of
from tests.support.paths import ROOT
from vcmvsp.cosim.cli import app as cli
from vcmvsp.cosim.reproduction.figures import NAMES
from vcmvsp.cosim.scenario import loader

TARGETS = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
READERS_OWN = re.compile(r"[A-Z_]+|\.\.\.|.*[./].*")  # RUN_DIR, mine.toml, runs/formation-circle-1


@cache
def app() -> Any:
    """Our command line, as its parser has it."""
    return typer.main.get_command(cli.app)


def ours(words: Sequence[str]) -> list[str]:
    """The words behind ``vcmvsp``."""
    return [*words[next(at for at, word in enumerate(words) if Path(word).name == "vcmvsp") + 1 :]]


def understood(words: Sequence[str]) -> None:
    """Parse a whole command.

    Raises:
        ValueError: one of its words is not known.
        Exception: of the parser, which has not understood it.
    """
    command, rest = _command(words)
    if hasattr(command, "commands"):
        _options(command, rest)
    else:
        command.make_context(command.name, cli._with_speed(rest))
        _names(command, rest)


def mentioned(words: Sequence[str]) -> None:
    """Look at a command within a sentence, of which any part may be left out, or stand in brackets.

    Raises:
        ValueError: one of its words is not known.
    """
    match program_of([*words]):
        case "vcmvsp":
            for each in _alternatives([word.strip("[]") for word in ours(words)]):
                command, rest = _command(each)
                _options(command, rest)
                _names(command, rest)
        case "make":
            _one_of("target", words[-1], TARGETS)
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
    """What the first words name, and the rest of them."""
    command, rest = app(), [*words]
    while rest and not rest[0].startswith("-") and hasattr(command, "commands"):
        _one_of("command", rest[0], command.commands)
        command = command.commands[rest.pop(0)]
    return command, rest


def _options(command: Any, words: list[str]) -> None:
    known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {"-h", "--help"}
    for word in words[: words.index("--") if "--" in words else None]:  # what follows is another program's
        if re.match(r"--?[a-z]", word):
            _one_of("option", word, sorted(known))


def _names(command: Any, words: list[str]) -> None:
    """What it is about, if that is the first word and none of the reader's own."""
    about = {"run": loader.names(), "study": loader.names(), "check": loader.names(), "figure": NAMES}
    if command.name in about and words and not words[0].startswith("-") and not READERS_OWN.fullmatch(words[0]):
        _one_of("scenario" if command.name != "figure" else "figure", words[0], about[command.name])


def _one_of(what: str, name: str, known: Collection[str]) -> None:
    if name not in known:
        raise ValueError(f"there is no {what} {name}; there are {', '.join(known)}")
