"""The values that a study gives a key: what ``--vary KEY=...`` says."""

import json
import math
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.scenario import loader

EXAMPLE = "--vary radio.loss.probability=0,0.2,0.5 or --vary radio.loss.probability=0:0.9:0.1"
MOST = 1_000_000  # runs of a study
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(?::({_NUMBER}))?")
_PAIRS = {"[": "]", "{": "}"}


def vary_of(arguments: Sequence[str]) -> dict[str, list[Any]]:
    """``--vary`` arguments as key path -> values."""
    vary: dict[str, list[Any]] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        key = key.strip()
        if not equals or not key:
            raise UsageError(f"--vary {argument}: write KEY=VALUES, e.g. {EXAMPLE}")
        if key in vary:
            raise UsageError(f"--vary {argument}: {key} is varied already; give all of its values at once")
        try:
            vary[key] = values_of(text)
        except ValueError as error:
            raise UsageError(f"--vary {argument}: {error}") from error
    return vary


def values_of(text: str) -> list[Any]:
    """The values that ``a,b,c`` or ``start:stop:step`` (both ends included) stands for, each in TOML.

    Commas inside quotes, lists and inline tables separate nothing; text that is no TOML is a string, as in ``--set``.
    Ranges are counted in decimals: ``0:1:0.1`` is eleven values, and the fourth is 0.3.

    Raises:
        ValueError: saying what is wrong with the text.
    """
    values: list[Any] = []
    for item in _items(text):
        if not item:
            raise ValueError('a value is missing (write "" for an empty string)')
        ends = _RANGE.fullmatch(item)
        values += _range(item, *ends.groups()) if ends else [loader.value_of(item)]
    return values


def label(value: object) -> str:
    """The value as text, the same for values that are the same to a scenario: 1 and 1.0, but not 1 and true."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return json.dumps(value, sort_keys=True, default=str)


def _items(text: str) -> list[str]:
    """The text, cut at the commas that stand in no quotes and no brackets."""
    items, closing, quote, escaped = [""], "", "", False
    for sign in text:
        if quote:
            quote = "" if sign == quote and not escaped else quote
            escaped = sign == "\\" and quote == '"' and not escaped
        elif sign in "\"'":
            quote = sign
        elif sign in _PAIRS:
            closing = _PAIRS[sign] + closing
        elif closing[:1] == sign:
            closing = closing[1:]
        elif sign == "," and not closing:
            items.append("")
            continue
        items[-1] += sign
    if quote or closing:
        raise ValueError(f"there is no closing {quote or closing[0]}")
    return [item.strip() for item in items]


def _range(item: str, *ends: str | None) -> list[int] | list[float]:
    if ends[2] is None:
        raise ValueError(f"{item} is neither a value nor start:stop:step")
    start, stop, step = (Decimal(end) for end in ends if end is not None)
    if not all(math.isfinite(float(end)) for end in (start, stop, step)):
        raise ValueError(f"{item}: must be finite")
    if not step or (stop - start) * step < 0:
        raise ValueError(f"{item}: with this step nothing leads from {start} to {stop}")
    if abs(stop - start) >= MOST * abs(step):
        raise ValueError(f"{item}: more than {MOST} values")
    steps = range(int((stop - start) / step) + 1)
    if all(end.lstrip("+-").isdigit() for end in ends if end is not None):
        return [int(start + i * step) for i in steps]
    return [float(start + i * step) for i in steps]
