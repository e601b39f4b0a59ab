"""CSMA/CA of IEEE 802.15.4: what holds for any traffic of many radios."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.support.netsim.csma154_runs import LOUD, MS, NOISE_DBM, SILENT, US, World, assessments, levels, same
from vcmvsp.netsim.interfaces.medium import Decided, Fate


def crowd(count: int, frames: int, seed: int, *, period_ns: int = 2 * MS) -> tuple[World, dict[int, Decided], list[int]]:
    world, rng = World(levels(count), seed), np.random.default_rng(seed)
    senders = rng.integers(count, size=frames).tolist()
    for time_ns, sender in zip(np.cumsum(rng.integers(period_ns, size=frames)).tolist(), senders, strict=True):
        world.offer(time_ns, sender)
    return world, world.finish(), senders


def test_the_deaf_time_before_a_frame_is_the_only_gap_for_a_collision() -> None:
    """In one domain frames overlap only if they begin within 192 us, and then neither sender hears the other."""
    _, decided, senders = crowd(8, 2000, 3)
    sent = sorted((each for each in decided.values() if each.attempts), key=lambda each: each.start_ns)
    overlaps = [(a, b) for a, b in itertools.pairwise(sent) if b.start_ns < a.end_ns]
    assert len(overlaps) > 50
    for a, b in overlaps:
        assert b.start_ns - a.start_ns < 192 * US
        assert a.fate[senders[b.number]] == b.fate[senders[a.number]] == Fate.TRANSMITTING
    alone = [
        each
        for before, each, after in zip(sent, sent[1:], sent[2:], strict=False)
        if before.end_ns + 192 * US <= each.start_ns and each.end_ns <= after.start_ns
    ]
    assert len(alone) > 500
    for each in alone:
        assert np.count_nonzero(each.fate == Fate.RECEIVED) == 7


def test_every_frame_is_decided_once_and_a_radio_sends_one_at_a_time() -> None:
    world, decided, senders = crowd(6, 1500, 5)
    assert sorted(decided) == list(range(1500))
    assert world.medium.next_ns() is None
    assert world.finish() == {}
    for row in range(6):
        mine = [decided[number] for number, sender in enumerate(senders) if sender == row]
        assert [each.number for each in mine] == sorted(each.number for each in mine)
        for before, after in itertools.pairwise([each for each in mine if each.attempts]):
            assert after.start_ns - before.end_ns >= (640 + 320) * US
    for each in decided.values():
        assert (each.start_ns >= 0) == (each.attempts == 1)
        assert set(each.fate.tolist()) == {Fate.BUSY_CHANNEL} or each.attempts


@pytest.mark.parametrize("to", [-1, 0])
def test_frames_are_decided_at_foretold_times(to: int) -> None:
    """Access failures and acknowledgements that are not heard included."""
    for dbm, attempts in ((LOUD, {0, 1}), (NOISE_DBM - 0.6, {0, 1, 2, 3, 4})):
        in_steps, at_once = World(levels(5, dbm), max_backoffs=2), World(levels(5, dbm), max_backoffs=2)
        rng = np.random.default_rng(2)
        for time_ns in np.cumsum(rng.integers(3 * MS, size=400)).tolist():
            sender = int(rng.integers(1, 5))
            for world in (in_steps, at_once):
                world.offer(time_ns, sender, to=to, size=100)
        decided = in_steps.step()
        assert same(list(at_once.finish().values()), list(decided.values()))
        seen = {each.attempts for each in decided.values()}
        assert seen == (attempts if to >= 0 else {0, 1}) or seen > attempts


def test_who_always_finds_the_air_busy_gives_up_after_five_assessments() -> None:
    world = World(levels(2))
    world.offer(0, 0, size=50_000)  # on the air for 1.9 s
    number = world.offer(100 * MS, 1)
    lost = world.finish()[number]
    assert lost.end_ns == assessments(1, 4, 100 * MS)[-1]
    assert (lost.start_ns, lost.attempts) == (-1, 0)
    assert lost.fate.tolist() == [Fate.BUSY_CHANNEL] * 2


Script = list[tuple[int, int, int, int]]  # time us, sender, receiver (-1: all), payload


def scripts(count: int) -> st.SearchStrategy[Script]:
    frame = st.tuples(
        st.integers(0, 30_000), st.integers(0, count - 1), st.integers(-1, count - 1), st.sampled_from([1, 20, 100])
    )
    return st.lists(frame, max_size=25).map(sorted)


FIELD = np.array([[0, -60, -84, -90], [-60, 0, -78, -86], [-84, -78, 0, -60], [-90, -86, -60, 0]], float)


@settings(max_examples=60, deadline=None)
@given(script=scripts(4), cuts=st.lists(st.integers(0, 80_000), max_size=12).map(sorted))
def test_steps_make_no_difference_and_are_foretold(script: Script, cuts: list[int]) -> None:
    """Nothing is decided before `next_ns`, which never lies behind; it is None when nothing waits."""
    script = [(t, s, -1 if s == r else r, z) for t, s, r, z in script]
    at_once, in_steps = World(FIELD), World(FIELD)
    for time_us, sender, to, size in script:
        at_once.offer(time_us * US, sender, to=to, size=size)
    whole = list(at_once.medium.advance(10**12))
    pieces: list[Decided] = []
    rest = list(script)
    for cut_us in [*cuts, 10**9]:
        while rest and rest[0][0] <= cut_us:
            time_us, sender, to, size = rest.pop(0)
            pieces += in_steps.medium.advance(time_us * US)
            in_steps.offer(time_us * US, sender, to=to, size=size)
        foretold = in_steps.medium.next_ns()
        assert (foretold is None) == (len(pieces) == in_steps.offered)
        new = list(in_steps.medium.advance(cut_us * US))
        assert all(foretold is not None and each.end_ns >= foretold for each in new)
        after = in_steps.medium.next_ns()
        assert after is None or after > cut_us * US
        pieces += new
    assert same(whole, pieces)
    assert len(whole) == len(script)


@given(script=scripts(4))
@example(script=[(0, 1, 0, 100), (0, 3, 0, 20), (128, 0, 0, 100)])  # its frame begins while another is disturbed
@settings(max_examples=30, deadline=None)
def test_a_radio_out_of_reach_changes_nothing(script: Script) -> None:
    """Neither its draws nor its frames, wherever it stands in the order of rows."""
    apart = np.full((5, 5), SILENT)
    apart[:4, :4] = FIELD
    few, many = World(FIELD), World(apart)
    number_of = {}
    for index, (time_us, sender, _, size) in enumerate(script):
        few.offer(time_us * US, sender, size=size, patience=0.05)
        number_of[many.offer(time_us * US, sender, size=size, patience=0.05)] = index
        many.offer(time_us * US, 4, size=100)
    a, b = few.finish(), many.finish()
    for number, index in number_of.items():
        assert (a[index].start_ns, a[index].end_ns) == (b[number].start_ns, b[number].end_ns)
        assert a[index].fate.tolist() == b[number].fate[:4].tolist()
