"""TOML and JSON from untrusted sources: parsed, or refused with a one-sentence `ValueError`.

The parsers themselves fail in several ways: on depth, on long numbers, and slowly on keys of thousands of parts.
"""

import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, TypeVar

import msgspec
import tomli_w

from vcmvsp.cosim.util import limits

T = TypeVar("T")

DEEPEST = 64
"""Deepest nesting of tables and lists: the code that walks through them is recursive, and Python's limit is below 1000."""

_TOKEN = re.compile(
    r'"""(?:\\[\s\S]|[^\\])*?"""(?:"{0,2})' r"|'''[\s\S]*?'''(?:'{0,2})"  # multi-line strings may end in quotes
    r'|"(?:\\.|[^"\\\n])*"' r"|'[^'\n]*'" r"|#[^\n]*|\n|[\[\]{}=,.]|[^\s\[\]{}=,.\"'#]+"
)  # fmt: skip


def read_toml(text: str) -> dict[str, Any]:
    """The content of a TOML document. Raises `ValueError` (invalid, too long or too deep)."""
    limits.within(len(text), limits.TOML_BYTES, "characters of TOML")
    if any(line.count(".") > DEEPEST for line in text.splitlines()):
        _check_keys(text)
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # Python limits the digits of an integer
        raise ValueError("an integer has thousands of digits") from None
    check_depth(content)
    return content


def toml_line(value: object) -> str:
    """A value in one line of TOML, as ``--set`` reads it."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{toml_line(str(key))} = {toml_line(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_line, value)) + "]"
    return tomli_w.dumps({"value": value}).removeprefix("value = ").rstrip("\n")


def read_json(data: bytes | str, kind: Any = Any, *, limit: int = limits.JSON_BYTES) -> Any:
    """The content of a JSON document.

    Args:
        kind: required type.

    Raises:
        ValueError: invalid, of another type, too long or too deep.
    """
    limits.within(len(data), limit, "bytes of JSON")
    try:
        content = msgspec.json.decode(data, type=kind)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    check_depth(content)
    return content


def json_reader(kind: type[T], dec_hook: Callable[[type, Any], Any] | None = None) -> Callable[[bytes], T]:
    """A decoder for many JSON messages of a recording; it raises a `ValueError` as `read_json` does."""
    decode = msgspec.json.Decoder(kind, dec_hook=dec_hook).decode

    def read(data: bytes) -> T:
        try:
            return decode(data)
        except RecursionError:
            raise ValueError(_TOO_DEEP) from None

    return read


def check_depth(value: object) -> None:
    """Raise a `ValueError` if tables and lists are nested deeper than `DEEPEST`."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [inner for each in level for inner in parts_of(each) if isinstance(inner, Mapping | list | tuple)]
        if not level:
            return
    raise ValueError(_TOO_DEEP)


def toml_tokens(text: str) -> Iterator[tuple[str, int]]:
    """The tokens of a TOML document without comments, and the line of each; line ends are tokens, too."""
    line, until = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", until, match.start())
        until = match.start()
        if not match[0].startswith("#"):
            yield match[0], line


_TOO_DEEP = f"tables and lists are nested more than {DEEPEST} deep"


def parts_of(value: object) -> Collection[object]:
    """The values of a table, or the items of a list; none of any other value."""
    if isinstance(value, Mapping):
        return value.values()
    return value if isinstance(value, list | tuple) else ()


def _check_keys(text: str) -> None:
    """Refuse keys of very many parts: `tomllib` takes quadratic time for them."""
    dots = 0
    for word, line in toml_tokens(text):
        if word == ".":
            dots += 1
        elif word in "\n[]{}=,":
            dots = 0
        if dots > DEEPEST:
            raise ValueError(f"the key in line {line} has more than {DEEPEST} parts")
