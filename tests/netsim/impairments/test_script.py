"""Scripted changes: begin, end, affected links, and the sum of several."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import linked_frame
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.script import Change, Script
from vcmvsp.netsim.interfaces.layers import Frame

CARS = ("car1", "car2", "car3", "base")
MS = 1_000_000


def frame(sender: str = "car1", *receivers: str, at_ns: int = 15 * 10**9, wait_ns: int = 0) -> Frame:
    """A frame of 1 ms that begins at ``at_ns``, sent ``wait_ns`` before."""
    names = receivers or tuple(name for name in CARS if name != sender)
    return msgspec.structs.replace(linked_frame(sender, *names, at_s=at_ns / 1e9), sent_ns=at_ns - wait_ns)


def half() -> Any:
    return np.full((3, 2), 0.5)


def struck(script: Script, sent: Frame) -> list[str]:
    lost = script.lost(sent, half)
    return [name for name, is_lost in zip(sent.receivers, lost, strict=True) if is_lost]


@pytest.mark.parametrize(
    ("at_s", "touches"),
    [(9.998, False), (9.999, False), (9.999_000_001, True), (10.0, True), (19.999_999_999, True), (20.0, False), (30.0, False)],
)
def test_a_change_applies_to_frames_that_overlap_its_time(at_s: float, touches: bool) -> None:
    """The frame is 1 ms long; the change is [10 s, 20 s)."""
    script = Script((Change(from_s=10.0, to_s=20.0, loss=1.0, attenuation_db=6.0, delay_s=0.25),))
    sent = frame(at_ns=round(at_s * 1e9), wait_ns=3 * MS)
    assert script.lost(sent, half).tolist() == [touches] * 3
    assert script.gain_db(sent, half).tolist() == [-6.0 * touches] * 3
    assert script.delay_ns(sent, half).tolist() == [4 * MS + 250 * MS * touches] * 3  # from the sending: wait, air time, delay


@pytest.mark.parametrize(
    ("links", "sender", "expected"),
    [
        (("**",), "car1", ["car2", "car3", "base"]),
        (("car1/car2",), "car1", ["car2"]),
        (("car1/car2",), "car2", []),
        (("car1/*",), "car1", ["car2", "car3", "base"]),
        (("*/car1",), "car2", ["car1"]),
        (("*/car1",), "car1", []),
        (("car1/car3", "*/base"), "car1", ["car3", "base"]),
        (("nobody/*",), "car1", []),
        ((), "car1", []),
    ],
)
def test_links_by_key_expressions(links: tuple[str, ...], sender: str, expected: list[str]) -> None:
    assert struck(Script((Change(from_s=0.0, links=links, loss=1.0),)), frame(sender)) == expected


def test_links_without_vehicles_are_reported() -> None:
    links = ("car1/*", "nobody/*", "car2/car2", "**", "*/base", "car1/car9", "nobody/*")
    script = Script((Change(from_s=0.0, links=links, loss=1.0),))
    assert script.unmatched(CARS) == ["nobody/*", "car2/car2", "car1/car9"]


def test_losses_of_several_are_independent_and_the_rest_adds_up() -> None:
    """1 - 0.7 x 0.5 on the link that both affect."""
    script = Script(
        (
            Change(from_s=0.0, to_s=9.0, loss=0.3, attenuation_db=3.0, delay_s=0.1),
            Change(from_s=0.0, to_s=9.0, links=("car1/car2",), loss=0.5, attenuation_db=-10.0, delay_s=0.2),
        )
    )
    sent, rng = frame("car1", "car2", "car3", at_ns=5 * 10**9), np.random.default_rng(1)
    rate = np.mean([script.lost(sent, lambda: rng.random((2, 2))) for _ in range(20_000)], axis=0)
    assert rate == pytest.approx([0.65, 0.3], abs=4.5 * math.sqrt(0.25 / 20_000))
    assert script.gain_db(sent, half).tolist() == [7.0, -3.0]
    assert script.delay_ns(sent, half).tolist() == [301 * MS, 101 * MS]


spans = st.lists(st.tuples(st.integers(0, 12), st.one_of(st.none(), st.integers(1, 6))), max_size=6)


@given(spans, st.integers(0, 20), st.integers(1, 4))
def test_changes_apply_exactly_while_they_overlap_the_frame(found: list[tuple[int, int | None]], start: int, air: int) -> None:
    """Compared with the definition, in whole ns: change k attenuates by 2^k dB, so that the sum tells which are present."""
    changes = tuple(
        Change(from_s=begin / 1e9, to_s=None if length is None else (begin + length) / 1e9, attenuation_db=2.0**k)
        for k, (begin, length) in enumerate(found)
    )
    sent = linked_frame("a", "b", at_s=start / 1e9, air_ns=air)
    overlapping = (
        2.0**k for k, (begin, length) in enumerate(found) if begin < start + air and (length is None or begin + length > start)
    )
    assert -Script(changes).gain_db(sent, half)[0] == sum(overlapping)


def test_answers_do_not_depend_on_earlier_calls() -> None:
    """Returned arrays are read-only."""
    changes = Change(from_s=1.0, to_s=2.0, loss=0.4), Change(from_s=1.5, to_s=3.0, links=("*/car2",), attenuation_db=4.0)
    frames = [frame(sender, at_ns=t * MS) for t in range(900, 3200, 50) for sender in CARS]
    used = Script(changes)
    there = [used.gain_db(each, half).tolist() for each in frames]
    back = [used.gain_db(each, half).tolist() for each in reversed(frames)][::-1]
    assert there == back == [Script(changes).gain_db(each, half).tolist() for each in frames]
    with pytest.raises(ValueError, match="read-only"):
        used.gain_db(frames[0], half)[0] = 7.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"from_s": 5.0, "to_s": 5.0, "loss": 1.0}, r"to_s = 5 must be greater than from_s = 5"),
        ({"from_s": 5.0, "to_s": 6.0}, r"the entry from 5 s has no effect: set loss, attenuation_db or delay_s"),
        ({"from_s": 5.0, "loss": 1.5}, r"must be a number >= 0 and <= 1, not 1.5"),
        ({"from_s": 5.0, "los": 1.0}, r"unknown key 'los'; did you mean 'loss'\?"),
        ({"loss": 1.0}, r"from_s is missing"),
    ],
)
def test_bad_changes_are_refused_with_their_key(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        binding.call(Script, {"changes": [{"from_s": 0.0, "loss": 0.1}, change]}, key="radio.script")
    assert raised.value.key == "radio.script.changes[1]" + (".loss" if "must be a number" in message else "")


def test_probabilities_0_and_1_ignore_the_draw() -> None:
    sent, most = frame("car1", "car2", "car3"), 1.0 - 2.0**-53
    total = Script((Change(from_s=0.0, links=("car1/car2",), loss=1.0), Change(from_s=0.0, loss=0.0)))
    for draw in (0.0, 0.5, most):
        assert total.lost(sent, lambda draw=draw: np.full((2, 2), draw)).tolist() == [True, False]  # type: ignore[misc]
