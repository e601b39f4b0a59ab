"""TOML and JSON from outside: read, or refused in one sentence, whatever they hold.

The parsers themselves give up in several ways: at depth, at digits, and slowly at keys of thousands of parts.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import msgspec

from vcmvsp.cosim.util import limits

T = TypeVar("T")

DEEPEST = 64
"""Tables and lists inside one another: what walks through them calls itself, and Python gives up below 1000."""

_TOKEN = re.compile(
    r'"""(?:\\[\s\S]|[^\\])*?"""(?:"{0,2})' r"|'''[\s\S]*?'''(?:'{0,2})"  # strings over several lines may end in quotes
    r'|"(?:\\.|[^"\\\n])*"' r"|'[^'\n]*'" r"|#[^\n]*|\n|[\[\]{}=,.]|[^\s\[\]{}=,.\"'#]+"
)  # fmt: skip


def read_toml(text: str) -> dict[str, Any]:
    """The content of a TOML document. Raises `ValueError` (it is none, too long or too deep)."""
    limits.within(len(text), limits.TOML_BYTES, "characters of TOML")
    if any(line.count(".") > DEEPEST for line in text.splitlines()):
        _check_keys(text)
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # Python reads no more digits
        raise ValueError("a whole number has thousands of digits") from None
    check_depth(content)
    return content


def read_json(data: bytes | str, kind: Any = Any, *, limit: int = limits.JSON_BYTES) -> Any:
    """The content of a JSON document.

    Args:
        kind: what it must be.

    Raises:
        ValueError: it is none, no such, too long or too deep.
    """
    limits.within(len(data), limit, "bytes of JSON")
    try:
        content = msgspec.json.decode(data, type=kind)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    check_depth(content)
    return content


def json_reader(kind: type[T], dec_hook: Callable[[type, Any], Any] | None = None) -> Callable[[bytes], T]:
    """What reads one message of a recording after another; it raises a `ValueError` as `read_json` does."""
    decode = msgspec.json.Decoder(kind, dec_hook=dec_hook).decode

    def read(data: bytes) -> T:
        try:
            return decode(data)
        except RecursionError:
            raise ValueError(_TOO_DEEP) from None

    return read


def check_depth(value: object) -> None:
    """Raise a `ValueError` if more tables and lists are inside one another than `DEEPEST`."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [inner for each in level for inner in _inside(each)]
        if not level:
            return
    raise ValueError(_TOO_DEEP)


def toml_tokens(text: str) -> Iterator[tuple[str, int]]:
    """The words and signs of a TOML document without comments, and the line of each; a line's end is one, too."""
    line, until = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", until, match.start())
        until = match.start()
        if not match[0].startswith("#"):
            yield match[0], line


_TOO_DEEP = f"more than {DEEPEST} tables and lists are inside one another"


def _inside(value: object) -> list[object]:
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return [each for each in inside if isinstance(each, Mapping | list | tuple)]


def _check_keys(text: str) -> None:
    """Refuse keys of very many parts, for which `tomllib` takes a time that grows with the square of their number."""
    dots = 0
    for word, line in toml_tokens(text):
        dots = dots + 1 if word == "." else 0 if word in "\n[]{}=," else dots
        if dots > DEEPEST:
            raise ValueError(f"the key in line {line} has more than {DEEPEST} parts")
