"""Metrics from agents' notes: changes of shape and mode, time off the task, time to re-form."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import TENTH, follows, metrics_after, note, states
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Follows

KEYS = ("shape_changes", "mode_toggles", "avoid_s", "reformed_s")
TEAM = [follows("b", "a", (-1.0, 0.0), 0.3), follows("c", "a", (-2.0, 0.0), 0.3)]


def at(k: int) -> int:
    return TENTH.at(k)


def row(off: Mapping[str, Sequence[float]], count: int = 100) -> list[Event]:
    """States of leader a and followers b and c in a row; ``off``: error of a follower, m, per tick; its last value holds to
    the end.
    """
    events = []
    for k in range(count + 1):
        error = {name: (off[name][min(k, len(off[name]) - 1)] if name in off else 0.0) for name in "bc"}
        places = {"a": (0.0, 0.0, 0.0), "b": (-1.0 - error["b"], 0.0, 0.0), "c": (-2.0 - error["c"], 0.0, 0.0)}
        events.append(states(at(k), places))
    return events


def changes(
    notes: Sequence[Event],
    off: Mapping[str, Sequence[float]] | None = None,
    team: Sequence[Event] = TEAM,
    window: tuple[float, float | None] = (0.0, None),
) -> dict[str, Any]:
    """Metrics of these notes in a run of 10 s."""
    formation = metrics_after("abc", [*team, *row(off or {}), *notes], 10 * SECOND_NS, window)["formation"]
    each = {name: {key: own[key] for key in KEYS} for name, own in formation["per_follower"].items()}
    return {**{key: formation[key] for key in KEYS}, **each}


def test_without_notes_nothing_has_changed() -> None:
    none = {"shape_changes": 0, "mode_toggles": None, "avoid_s": None, "reformed_s": None}
    assert changes([note("a", at(3), status="leading"), note("b", 0, z1=0.0)]) == {**none, "b": none, "c": none}


def test_unused_modes_count_zero_and_missing_modes_none() -> None:
    found = changes([note("b", 0, mode="task")])
    counts = [(each["mode_toggles"], each["avoid_s"]) for each in (found, found["b"], found["c"])]
    assert counts == [(0, 0.0), (0, 0.0), (None, None)]


@pytest.mark.parametrize("modes", [("task", "blind"), ("task", "cruise", 3.0, "task"), ("cruise",)])
def test_modes_without_avoidance_do_not_count(modes: Sequence[Any]) -> None:
    found = changes([note("b", at(10 * k), mode=mode) for k, mode in enumerate(modes)])
    assert (found["mode_toggles"], found["avoid_s"]) == (0, 0.0)


def test_shapes_are_counted_where_the_leader_changes_them() -> None:
    """The first value and a repeated one are no change; followers adopt the same changes later or not at all."""
    leader_shapes = [("a", 0, "wedge"), ("a", 20, "column"), ("a", 21, "column"), ("a", 50, "wedge"), ("a", 70, "line")]
    follower_shapes = [("b", 0, "wedge"), ("b", 22, "column"), ("b", 53, "wedge"), ("c", 0, "wedge"), ("c", 71, "line")]
    found = changes([note(name, at(k), shape=shape) for name, k, shape in leader_shapes + follower_shapes], window=(8.0, 9.0))
    assert [found["shape_changes"], found["b"]["shape_changes"], found["c"]["shape_changes"]] == [3, 2, 1]


def test_modes_of_followers_are_counted_to_and_from_the_task() -> None:
    modes = [("b", 0, "task"), ("b", 10, "avoid"), ("b", 15, "turn"), ("b", 20, "task"), ("b", 90, "turn")]
    modes += [("c", 3, "avoid"), ("c", 5, "blind"), ("c", 9, "task"), ("a", 0, "task"), ("a", 50, "avoid"), ("a", 60, "task")]
    found = changes([note(name, at(k), mode=mode, level=1.0) for name, k, mode in modes], window=(9.5, None))
    assert (found["mode_toggles"], found["avoid_s"]) == (4, pytest.approx(1.0 + 1.0 + 0.2))  # b's last mode lasts to the end
    assert (found["b"]["mode_toggles"], found["b"]["avoid_s"]) == (3, pytest.approx(2.0))
    assert (found["c"]["mode_toggles"], found["c"]["avoid_s"]) == (1, pytest.approx(0.2))


@given(st.lists(st.tuples(st.integers(0, 99), st.sampled_from(["task", "avoid", "turn", "blind"])), max_size=12))
@settings(deadline=None, max_examples=25)
def test_modes_equal_a_plain_walk_over_the_ticks(modes: list[tuple[int, str]]) -> None:
    at_tick = dict(sorted(modes))
    state, before, toggles, away = None, None, 0, 0
    for k in range(100):
        state = at_tick.get(k, state)
        if before is not None and (state in ("avoid", "turn")) != (before in ("avoid", "turn")):
            toggles += 1
        away += state in ("avoid", "turn")
        before = state
    found = changes([note("b", at(k), mode=mode) for k, mode in at_tick.items()])
    assert (found["mode_toggles"], found["avoid_s"]) == ((toggles, pytest.approx(0.1 * away)) if modes else (None, None))


def lane(*entries: tuple[int, str]) -> list[Event]:
    return [note("a", at(k), lane=state) for k, state in entries]


PASSED = lane((0, "free"), (10, "narrow"), (20, "free"), (22, "narrow"), (30, "free"))
OFF_UNTIL_5_S = {"b": [0.3] * 40 + [0.0], "c": [0.0] * 45 + [0.06] * 5 + [0.04]}


def test_reformed_from_the_last_time_the_lane_became_free_until_all_are_settled() -> None:
    found = changes(PASSED, OFF_UNTIL_5_S, window=(9.0, None))
    assert (found["reformed_s"], found["b"]["reformed_s"], found["c"]["reformed_s"]) == pytest.approx((2.0, 1.0, 2.0))
    assert changes(PASSED, {"b": [0.3] * 5 + [0.0]})["reformed_s"] == 0.0  # before the lane was free


@pytest.mark.parametrize(
    ("notes", "off"),
    [
        (lane((0, "free")), OFF_UNTIL_5_S),  # never narrow
        (lane((0, "narrow")), OFF_UNTIL_5_S),  # narrow to the end
        (lane((0, "free"), (10, "narrow"), (30, "free"), (99, "narrow")), OFF_UNTIL_5_S),  # narrow again
        (PASSED, {"b": [0.0] * 98 + [0.06]}),  # b is off at the end
    ],
)
def test_teams_that_have_not_reformed(notes: list[Event], off: dict[str, list[float]]) -> None:
    found = changes(notes, off)
    assert found["reformed_s"] is found["b"]["reformed_s"] is None


def test_a_team_in_the_narrow_shape_has_not_reformed() -> None:
    narrow = [note("a", 0, shape="wedge"), note("a", at(10), shape="column")]
    assert changes([*PASSED, *narrow])["reformed_s"] is None
    assert changes([*PASSED, *narrow, note("a", at(35), shape="wedge")], OFF_UNTIL_5_S)["reformed_s"] == pytest.approx(2.0)
    shape_order = [note("a", 0, shape="wedge"), note("a", at(5), shape="column")]  # not caused by the passage
    assert changes([*PASSED, *shape_order], OFF_UNTIL_5_S)["reformed_s"] == pytest.approx(2.0)


def two_teams(*lanes: tuple[str, int, str], chain: bool = False) -> list[float | None]:
    """``reformed_s`` of all, b, d and e. a leads b, c leads d and e (chain: d leads e); b settles at 4 s, d and e at 8 s."""
    events = [follows("b", "a", (-1.0, 0.0), 0.3), follows("d", "c", (-1.0, 0.0), 0.3)]
    events.append(follows("e", "d", (-1.0, 0.0), 0.3) if chain else follows("e", "c", (-2.0, 0.0), 0.3))
    for k in range(101):
        b, d = -1.0 - 0.3 * (k < 40), -1.0 - 0.3 * (k < 80)
        xs = {"a": 0.0, "b": b, "c": 0.0, "d": d, "e": (d if chain else -1.0) - 1.0 - (0.0 if chain else 0.3 * (k < 80))}
        events.append(states(at(k), {name: (x, 5.0 * (name in "cde"), 0.0) for name, x in xs.items()}))
    notes = [note(name, at(k), lane=state) for name, k, state in lanes]
    formation = metrics_after("abcde", [*events, *notes], 10 * SECOND_NS)["formation"]
    return [formation["reformed_s"], *(formation["per_follower"][name]["reformed_s"] for name in "bde")]


NARROW_A = (("a", 10, "narrow"), ("a", 20, "free"))


def test_each_team_re_forms_after_its_own_passage() -> None:
    both = two_teams(*NARROW_A, ("c", 10, "narrow"), ("c", 50, "free"))
    assert both == pytest.approx([3.0, 2.0, 3.0, 3.0])  # all: the longest time
    assert two_teams(*NARROW_A) == [pytest.approx(2.0), pytest.approx(2.0), None, None]  # lane of c never narrow
    assert two_teams(*NARROW_A, ("c", 10, "narrow")) == [None, pytest.approx(2.0), None, None]  # lane of c narrow to the end


def test_in_a_chain_the_lane_is_that_of_the_first_leader() -> None:
    *_, d, e = two_teams(*NARROW_A, ("c", 10, "narrow"), ("c", 50, "free"), chain=True)
    assert [d, e] == pytest.approx([3.0, 0.0])  # e keeps its slot beside d throughout


def test_only_leaders_that_never_follow_count() -> None:
    """In a chain, b forwards shapes and its own changes do not count, not even after it stops following."""
    chain = [follows("b", "a", (-1.0, 0.0), 0.3), follows("c", "b", (-1.0, 0.0), 0.3)]
    notes = [note(name, at(k), shape=shape) for name in "abc" for k, shape in ((0, "wedge"), (30, "column"))]
    assert changes(notes, team=chain)["shape_changes"] == 1
    assert changes(notes, team=[*chain, Event("b/follows", at(50), Follows(leader=None))])["shape_changes"] == 1
    assert changes(notes, team=[])["shape_changes"] == 0
