"""Key expressions match as in Zenoh: compared with Zenoh's own implementation."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.federate import matches

CHUNKS = st.sampled_from(["a", "b", "car1", "car2", "send", "A_b-9"])
KEYS = st.lists(CHUNKS, min_size=1, max_size=5).map("/".join)
EXPRESSIONS = st.lists(CHUNKS | st.sampled_from(["*", "**"]), min_size=1, max_size=6).map("/".join)


@given(EXPRESSIONS, KEYS)
def test_keys_match_as_in_zenoh(expression: str, key: str) -> None:
    zenoh_expression, concrete = zenoh.KeyExpr.autocanonize(expression), zenoh.KeyExpr(key)
    is_included = zenoh_expression.includes(concrete)
    assert zenoh_expression.intersects(concrete) == is_included  # a key has no wildcards
    assert matches(expression, key) == is_included


@given(KEYS, st.data())
def test_a_key_matches_itself_with_wildcards(key: str, data: st.DataObject) -> None:
    """The random pairs above seldom match; these always match."""
    chunks = key.split("/")
    blurred = [data.draw(st.sampled_from([chunk, "*", "**"])) for chunk in chunks]
    at = data.draw(st.integers(0, len(blurred)))
    expression = "/".join([*blurred[:at], *data.draw(st.sampled_from([[], ["**"]])), *blurred[at:]])
    assert matches(expression, key)
    assert zenoh.KeyExpr.autocanonize(expression).includes(zenoh.KeyExpr(key))


@pytest.mark.parametrize(
    ("expression", "key", "expected"),
    [
        ("*/command", "car1/command", True),
        ("*/command", "car1/agent/command", False),
        ("*/command", "command", False),
        ("**/command", "command", True),
        ("car1/**", "car1", True),
        ("car1/**", "car12/send", False),
        ("car1", "car1/send", False),
        ("*", "car1", True),
        ("*", "car1/send", False),
    ],
)
def test_keys_of_a_run(expression: str, key: str, expected: bool) -> None:
    assert matches(expression, key) is expected
