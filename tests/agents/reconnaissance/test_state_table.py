"""The state table of a mission: every row, and laws for any sequence of facts."""

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.state_table import DWELL_NS, LOST_NS, SPIRAL_NS, MissionFacts, MissionState, step

pytestmark = pytest.mark.slow

MS, SECOND = 1_000_000, 10**9
NEAR, NEARER = 1.0, 0.5  # nearer than d1 = 1.2 m, nearer than d2 = 0.9 m


def run(state: MissionState, from_s: float, to_s: float, **facts: Any) -> MissionState:
    """Ten ticks a second with constant facts, up to and including ``to_s``."""
    for tick in range(round(10 * from_s), round(10 * to_s) + 1):
        state = step(state, MissionFacts(100 * MS * tick, **facts))
    return state


def at(state: MissionState, when_s: float, **facts: Any) -> MissionState:
    return run(state, when_s, when_s, **facts)


def searching() -> MissionState:
    return run(MissionState(), 0.0, 9.9)


def tracking(from_s: float = 5.0, to_s: float = 9.9) -> MissionState:
    """State while the target is in sight."""
    state = at(MissionState(), from_s, recognised=True)
    for tick in range(round(10 * from_s) + 1, round(10 * to_s) + 1):
        state = step(state, MissionFacts(100 * MS * tick, seen_ns=100 * MS * tick))
    assert state.name == "track"
    return state


def avoiding(level: int, before: MissionState) -> MissionState:
    """State in which avoidance has just begun."""
    state = at(before, 10.0, nearest_m=NEAR if level == 1 else NEARER, closing=True, seen_ns=10 * SECOND)
    assert state.name == f"avoid{level}"
    return state


# --- search ---


def test_it_begins_with_the_search() -> None:
    assert MissionState().name == searching().name == "search"
    state = step(MissionState(), MissionFacts(7 * SECOND))
    assert (state.since_ns, state.why, state.switches) == (7 * SECOND, "start", 0)


@pytest.mark.parametrize(
    ("facts", "name", "why"),
    [
        ({"recognised": True}, "track", "a target is recognised"),
        ({"probability": 0.9901}, "track", "the map is sure of a target, P 0.9901"),
        ({"probability": 0.99}, "search", "start"),
        ({"recognised": True, "probability": 1.0, "taken": True}, "search", "start"),
        ({"nearest_m": 1.19, "closing": True}, "avoid1", "something at 1.19 m, nearer than 1.20 m, and closing on it"),
        ({"nearest_m": 1.2, "closing": True}, "search", "start"),
        ({"nearest_m": 1.19, "closing": False}, "search", "start"),
        ({"nearest_m": 0.89, "closing": False}, "avoid2", "something at 0.89 m, nearer than 0.90 m"),
        ({"nearest_m": 2.5, "second_m": 3.0}, "avoid2", "something at 2.50 m, nearer than 3.00 m"),
        ({"nearest_m": math.nan}, "avoid2", "something at nan m, nearer than 0.90 m"),
        ({"nearest_m": 1.0, "closing": True, "recognised": True}, "avoid1", None),
        ({"nearest_m": 0.5, "closing": True, "recognised": True}, "avoid2", None),
        ({"shared": True}, "formation", "the sector is shared"),
        ({"shared": True, "recognised": True}, "track", "a target is recognised"),
    ],
)
def test_transitions_from_the_search(facts: dict[str, Any], name: str, why: str | None) -> None:
    state = at(searching(), 10.0, **facts)
    assert state.name == name
    if why is not None:
        assert state.why == why
    assert state.since_ns == (0 if name == "search" else 10 * SECOND)


def test_a_shared_sector_is_searched_in_formation_until_it_is_not_shared() -> None:
    state = run(searching(), 10.0, 12.0, shared=True)
    assert state.name == "formation"
    assert run(state, 12.1, 13.0).name == "search"
    lost = run(tracking(), 10.0, 23.0, shared=True, seen_ns=10 * SECOND)
    assert lost.name == "formation"


# --- track ---


def test_a_target_is_tracked_while_in_sight() -> None:
    assert tracking(5.0, 60.0).name == "track"


def test_out_of_sight_it_is_lost_after_3_s_and_given_up_after_10_s_more() -> None:
    state = tracking()  # last seen at 9.9 s
    assert not run(state, 10.0, 12.8, seen_ns=9900 * MS).lost
    state = run(state, 10.0, 12.9, seen_ns=9900 * MS)
    assert (state.lost, state.name) == (True, "track")
    assert run(state, 13.0, 22.8, seen_ns=9900 * MS).name == "track"
    state = run(state, 13.0, 22.9, seen_ns=9900 * MS)
    assert (state.name, state.why) == ("search", "the target is lost")


def test_a_target_known_from_the_map_only_is_lost_after_3_s() -> None:
    state = at(searching(), 10.0, probability=0.999)
    assert not run(state, 10.1, 12.9).lost
    assert run(state, 10.1, 13.0).lost
    assert run(state, 10.1, 23.0).name == "search"


def test_earlier_detections_do_not_count() -> None:
    state = at(searching(), 10.0, recognised=True, seen_ns=SECOND)
    assert not run(state, 10.1, 12.9, seen_ns=SECOND).lost


def test_a_detection_on_the_spiral_ends_it() -> None:
    state = run(tracking(), 10.0, 22.0, seen_ns=9900 * MS)
    state = at(state, 22.1, seen_ns=22100 * MS)
    assert (state.lost, state.spiral_ns, state.name) == (False, 0, "track")
    assert run(state, 22.2, 35.0, seen_ns=22100 * MS).name == "track"
    assert run(state, 22.2, 35.1, seen_ns=22100 * MS).name == "search"


def test_a_target_of_another_is_left_to_it() -> None:
    state = at(tracking(), 10.0, taken=True, seen_ns=10 * SECOND)
    assert (state.name, state.why) == ("search", "another vehicle tracks the target")


@pytest.mark.parametrize(
    ("nearest", "closing", "name"), [(NEAR, True, "avoid1"), (NEAR, False, "track"), (NEARER, False, "avoid2")]
)
def test_avoidance_goes_before_tracking(nearest: float, closing: bool, name: str) -> None:
    state = at(tracking(), 10.0, nearest_m=nearest, closing=closing, seen_ns=10 * SECOND)
    assert (state.name, state.task) == (name, "track")


# --- avoid ---


@pytest.mark.parametrize("before", [searching(), tracking()])
def test_level_1_ends_after_half_a_second_beyond_d1_plus_20_cm(before: MissionState) -> None:
    state = avoiding(1, before)
    assert run(state, 10.1, 20.0, nearest_m=1.4, seen_ns=20 * SECOND).name == "avoid1"
    assert run(state, 10.1, 10.5, nearest_m=1.41, seen_ns=10 * SECOND).name == "avoid1"
    over = run(state, 10.1, 10.6, nearest_m=1.41, seen_ns=10 * SECOND)
    assert (over.name, over.switches, over.since_ns) == (before.name, before.switches + 2, 10600 * MS)
    assert over.why == f"nothing is near any more ({before.task_why})"
    again = at(run(state, 10.1, 10.5, nearest_m=1.41, seen_ns=10 * SECOND), 10.6, nearest_m=1.3, seen_ns=10 * SECOND)
    assert run(again, 10.7, 11.1, nearest_m=9.0, seen_ns=10 * SECOND).name == "avoid1"
    assert run(again, 10.7, 11.2, nearest_m=9.0, seen_ns=10 * SECOND).name == before.name


@pytest.mark.parametrize("before", [searching(), tracking()])
def test_level_2_ends_in_level_1_after_half_a_second_beyond_d2_plus_15_cm(before: MissionState) -> None:
    state = avoiding(2, before)
    assert run(state, 10.1, 20.0, nearest_m=1.05, seen_ns=20 * SECOND).name == "avoid2"
    assert run(state, 10.1, 10.5, nearest_m=1.06, seen_ns=10 * SECOND).name == "avoid2"
    state = run(state, 10.1, 10.6, nearest_m=1.06, seen_ns=10 * SECOND)
    assert (state.name, state.why, state.task) == ("avoid1", "room for more speed", before.name)
    assert run(state, 10.7, 11.1, nearest_m=9.0, seen_ns=10 * SECOND).name == "avoid1"
    assert run(state, 10.7, 11.2, nearest_m=9.0, seen_ns=10 * SECOND).name == before.name


def test_a_target_confirmed_during_avoidance_is_tracked_afterwards() -> None:
    state = at(avoiding(1, searching()), 10.1, nearest_m=NEAR, closing=True, recognised=True)
    assert (state.name, state.task) == ("avoid1", "track")
    state = run(state, 10.2, 10.7, seen_ns=10200 * MS)
    assert (state.name, state.why) == ("track", "nothing is near any more (a target is recognised)")


@pytest.mark.parametrize("nearest", [NEAR, NEARER])
def test_a_spiral_counts_time_in_avoidance_and_ends_during_it(nearest: float) -> None:
    """As in a narrow street, or in front of a building with the reported target on it."""
    near = {"seen_ns": 9900 * MS, "nearest_m": nearest, "closing": True}
    state = run(tracking(), 10.0, 22.8, **near)
    assert (state.avoids, state.task, state.spiral_ns) == (True, "track", 9900 * MS)
    state = run(state, 22.9, 22.9, **near)
    assert (state.avoids, state.task, state.task_why) == (True, "search", "the target is lost")


def test_an_interrupted_spiral_continues() -> None:
    """4 s of the spiral, 3 s of avoidance, then the remaining 3 s."""
    facts = {"seen_ns": 9900 * MS}
    state = run(tracking(), 10.0, 16.9, **facts)
    state = run(state, 17.0, 19.4, nearest_m=NEAR, closing=True, **facts)
    assert (state.name, state.spiral_ns) == ("avoid1", 6500 * MS)
    state = run(state, 19.5, 20.0, **facts)
    assert state.name == "track"
    assert run(state, 20.1, 22.8, **facts).name == "track"
    assert run(state, 20.1, 22.9, **facts).name == "search"


# --- any facts ---

lengths = st.one_of(st.sampled_from([0.0, 0.5, 1.0, 1.1, 1.3, 1.5, math.inf, math.nan, -math.inf]), st.floats(0.0, 3.0))
known = st.builds(
    MissionFacts,
    now_ns=st.one_of(st.integers(0, 3 * SECOND), st.integers(0, 150 * MS)),  # since the previous facts
    nearest_m=lengths,
    closing=st.booleans(),
    second_m=st.sampled_from([0.9, 0.9, 2.0]),
    shared=st.booleans(),
    recognised=st.booleans(),
    probability=st.sampled_from([0.0, 0.5, 1.0]),
    seen_ns=st.none() | st.integers(0, 100 * SECOND),
    taken=st.booleans(),
)


def history(sequence: list[MissionFacts]) -> list[tuple[MissionState, MissionFacts]]:
    """States and the facts that led to them, with increasing times."""
    state, now_ns, steps = MissionState(), 0, list[tuple[MissionState, MissionFacts]]()
    for each in sequence:
        now_ns += each.now_ns
        facts = each._replace(now_ns=now_ns)
        state = step(state, facts)
        steps.append((state, facts))
    return steps


@given(st.lists(known, max_size=60))
def test_there_is_at_most_one_switch_in_half_a_second(sequence: list[MissionFacts]) -> None:
    states = [MissionState(), *(state for state, _ in history(sequence))]
    switched = [after.now_ns for before, after in pairwise(states) if before.name != after.name]
    assert all(later - earlier >= DWELL_NS for earlier, later in pairwise(switched))  # type: ignore[operator]
    assert states[-1].switches == len(switched)


@given(st.lists(known, min_size=1, max_size=60))
def test_level_2_begins_as_soon_as_a_switch_is_allowed(sequence: list[MissionFacts]) -> None:
    """At most half a second late; no other algorithm begins before it."""
    before = MissionState()
    for state, facts in history(sequence):
        near = not facts.nearest_m >= facts.second_m
        allowed = before.switches == 0 or facts.now_ns - before.since_ns >= DWELL_NS
        if near:
            assert state.name == ("avoid2" if allowed else before.name)
        elif state.name == "avoid2":
            assert before.name == "avoid2"  # no begin without an obstacle
        before = state


@given(st.lists(known, max_size=60))
def test_a_suspended_task_returns(sequence: list[MissionFacts]) -> None:
    """Some time after the last near obstacle the task commands; the task is always one of the three tasks."""
    steps = history(sequence)
    assert all(state.task in ("search", "formation", "track") for state, _ in steps)
    state = steps[-1][0] if steps else MissionState()
    now_ns = state.now_ns or 0
    for tick in range(1, 25):
        then_ns = now_ns + tick * 100 * MS
        state = step(state, MissionFacts(then_ns, seen_ns=then_ns, shared=state.task == "formation"))
    assert state.name == state.task


@given(st.lists(known, min_size=1, max_size=40), st.integers(0, 10 * SECOND))
def test_a_clock_set_back_counts_as_no_time(sequence: list[MissionFacts], back_ns: int) -> None:
    state, facts = history(sequence)[-1]
    assert step(state, facts._replace(now_ns=facts.now_ns - back_ns)) == step(state, facts)


@given(st.lists(known, min_size=1, max_size=60))
def test_tracking_out_of_sight_is_limited(sequence: list[MissionFacts]) -> None:
    """The spiral counts the whole time between ticks, from the tick on at which the target is lost."""
    before, seen_ns, late_ns = MissionState(), 0, 0
    for state, facts in history(sequence):
        passed_ns = state.now_ns - (before.now_ns or state.now_ns)  # type: ignore[operator]
        if state.task == before.task == "track":
            seen_ns = max(seen_ns, facts.seen_ns or 0)
            late_ns = max(late_ns, passed_ns) if facts.now_ns - seen_ns >= LOST_NS else 0
            assert facts.now_ns - seen_ns < LOST_NS + SPIRAL_NS + late_ns
            assert state.spiral_ns in (0, before.spiral_ns + passed_ns)
        else:
            seen_ns, late_ns = facts.now_ns, 0
        before = state
