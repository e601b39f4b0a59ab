"""Values of ``--vary KEY=...``."""

import json
from decimal import Decimal
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.studies.plan import label, values_of, vary_of

# Written as JSON these are TOML too: strings without control characters and lone surrogates, numbers, lists of them.
texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=12)
scalars = st.one_of(texts, st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False))
values = st.one_of(scalars, st.lists(scalars, max_size=3), st.lists(st.lists(texts, max_size=2), max_size=2))
decimals = st.decimals(-1000, 1000, allow_nan=False, places=3)


def equal_with_type(one: Any, other: Any) -> bool:
    return type(one) is type(other) and bool(one == other)


@given(st.lists(values, min_size=1, max_size=5))
def test_values_written_with_commas_between_them_are_read_back(listed: list[Any]) -> None:
    read = values_of(" , ".join(json.dumps(value, ensure_ascii=False) for value in listed))
    assert len(read) == len(listed)
    assert all(map(equal_with_type, read, listed))


@given(decimals, st.integers(0, 200), st.decimals("0.001", 10, places=3))
def test_a_range_has_both_ends_and_equal_decimal_steps(start: Decimal, steps: int, step: Decimal) -> None:
    for sign in (1, -1):
        read = values_of(f"{start:f}:{start + sign * steps * step:f}:{sign * step:f}")
        assert read == [float(start + sign * i * step) for i in range(steps + 1)]


@given(st.integers(-100, 100), st.integers(0, 50), st.integers(1, 9))
def test_a_range_of_whole_numbers_gives_whole_numbers(start: int, span: int, step: int) -> None:
    read = values_of(f"{start}:{start + span}:{step}")
    assert read == list(range(start, start + span + 1, step))
    assert all(type(value) is int for value in read)


@given(scalars, scalars)
def test_labels_are_equal_exactly_for_equal_values(one: Any, other: Any) -> None:
    numbers = all(isinstance(each, int | float) and not isinstance(each, bool) for each in (one, other))
    if numbers or type(one) is type(other):
        assert (label(one) == label(other)) == (one == other)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:1:0.1", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),  # 0.3 != 0.1 * 3
        ("0:1:0.4", [0.0, 0.4, 0.8]),
        ("1e-3:3e-3:1e-3", [0.001, 0.002, 0.003]),
        ("0,5:7:1,10", [0, 5, 6, 7, 10]),
        ("hold,dr", ["hold", "dr"]),
        ("hold, \"a,b\" ,'c,d'", ["hold", "a,b", "c,d"]),
        (r'"a\",b",c', ['a",b', "c"]),
        ("[1,2],[3]", [[1, 2], [3]]),
        ('{shape = "wedge", n = [1, 2]},{}', [{"shape": "wedge", "n": [1, 2]}, {}]),
        ("true,1", [True, 1]),
        ("mine.py:Mine", ["mine.py:Mine"]),
        ('""', [""]),
    ],
)
def test_values(text: str, expected: list[Any]) -> None:
    read = values_of(text)
    assert len(read) == len(expected)
    assert all(map(equal_with_type, read, expected))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "missing"),
        ("1,,2", "missing"),
        ("1,", "missing"),
        ("0:1", "start:stop:step"),
        ("0:1:0", "does not lead"),
        ("0:1:-1", "does not lead"),
        ("0:1e400:1", "finite"),
        ("0:1:1e-9", "more than"),
        ("[1,2", "closing ]"),
        ('"a', 'closing "'),
    ],
)
def test_bad_values_are_named(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        values_of(text)
    with pytest.raises(UsageError, match=words):
        vary_of([f"key={text}"])


@pytest.mark.parametrize(("arguments", "words"), [(["a=1", "a=2"], "already"), (["a"], "KEY=VALUES"), (["=1"], "KEY=VALUES")])
def test_bad_arguments_are_named(arguments: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        vary_of(arguments)
