"""Members' knowledge of each other in a mission, with lost, copied, reordered and false messages."""

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Uav
from tests.support.agents.agent_loop import reception_of_body as reception
from vcmvsp.agents.reconnaissance.roster import Claim, Roster
from vcmvsp.cosim.agent import Observation, Radio

S = 1_000_000_000
NAMES = ("a", "b", "c", "d")


def seen(now_s: float, *messages: tuple[str, Any]) -> Observation:
    return Uav((0.0, 0.0, 9.0)).see(round(now_s * S), [reception(*each) for each in messages])


def said(name: str, now_s: float, task: Any = "search", claim: Claim | None = None) -> tuple[str, Any]:
    """Sender and body of a member's message."""
    radio = Radio(name, NAMES)
    Roster(name, NAMES).tell(seen(now_s), radio, task, claim)
    (message,) = radio.drain()
    return name, message.body


def tracks(
    name: str, now_s: float, target: str, place: tuple[float, float] = (5.0, 5.0), since_s: float = 0.0
) -> tuple[str, Any]:
    return said(name, now_s, "track", Claim(target, place, round(since_s * S)))


def test_members_report_once_a_period_and_at_every_change() -> None:
    radio, roster = Radio("a", NAMES), Roster("a", NAMES, report_s=1.0)
    claim = Claim("alpha", (1.0, 2.0), 0)
    sent = []
    for tick in range(40):
        task, held = ("track", claim) if tick >= 25 else ("search", None)
        roster.tell(seen(0.1 * tick), radio, task, held)  # type: ignore[arg-type]
        sent += [tick] * len(radio.drain())
    assert sent == [0, 10, 20, 25, 35]


def test_silent_members_are_lost_and_any_message_counts() -> None:
    roster = Roster("a", NAMES, alive_s=5.0)
    roster.hear(seen(0.0))
    assert roster.alive(4 * S) == NAMES  # before the first messages were due
    roster.hear(seen(3.0, ("b", {"map": 1}), ("c", {}), ("x", {})))
    assert roster.alive(5 * S) == ("a", "b", "c")
    assert roster.alive(8 * S) == ("a",)
    roster.hear(seen(9.0, said("d", 9.0)))
    assert roster.alive(9 * S) == ("a", "d")


def test_messages_of_other_programs_do_not_hide_a_lost_agent() -> None:
    roster = Roster("a", NAMES, alive_s=5.0)
    for now_s in range(10):
        roster.hear(seen(now_s, said("b", now_s), ("c", b"\x00"), ("d", msgspec.msgpack.encode(said("d", now_s)[1]))))
    assert roster.alive(9 * S) == ("a", "b")


def test_tracking_members_leave_the_search_to_the_rest() -> None:
    roster = Roster("a", NAMES)
    roster.hear(seen(1.0, *(said(name, 1.0) for name in "bc"), tracks("d", 1.0, "alpha")))
    assert roster.searchers(S) == roster.sectors(S) == ("a", "b", "c")
    assert roster.claims(S) == {"d": Claim("alpha", (5.0, 5.0), 0)}
    roster.hear(seen(2.0, said("d", 2.0)))
    assert roster.sectors(2 * S) == NAMES
    assert not roster.claims(2 * S)


def test_the_first_searching_member_of_a_sector_leads() -> None:
    sectors = (("b", "a"), ("c", "d"))
    one, two = Roster("a", NAMES, sectors=sectors), Roster("b", NAMES, sectors=sectors)
    assert (one.sector, one.shared(0), two.shared(0)) == ("b", True, False)
    assert one.sectors(0) == ("b", "c")
    one.hear(seen(1.0, tracks("b", 1.0, "alpha"), said("c", 1.0), said("d", 1.0)))
    assert not one.shared(S)
    one.hear(seen(2.0, said("b", 2.0)))
    assert one.shared(2 * S)
    one.hear(seen(8.0))
    assert not one.shared(8 * S)  # the first member is lost
    assert one.sectors(8 * S) == ("b",)  # its own sector keeps its name


def test_a_target_belongs_to_the_vehicle_that_tracked_it_first() -> None:
    """For any times of the claims: of two vehicles that receive each other exactly one gives way."""
    for since_a, since_b in ((1.0, 2.0), (2.0, 1.0), (1.0, 1.0)):
        a, b = Roster("a", NAMES), Roster("b", NAMES)
        own, other = Claim("alpha", (5.0, 5.0), round(since_a * S)), Claim("alpha", (5.1, 5.0), round(since_b * S))
        a.hear(seen(3.0, tracks("b", 3.0, "alpha", (5.1, 5.0), since_b)))
        b.hear(seen(3.0, tracks("a", 3.0, "alpha", (5.0, 5.0), since_a)))
        assert a.has_prior_claim(own, 3 * S) is (since_b < since_a)
        assert b.has_prior_claim(other, 3 * S) is not a.has_prior_claim(own, 3 * S)


def test_a_claim_with_a_detection_does_not_yield_to_one_without() -> None:
    roster = Roster("b", NAMES)
    roster.hear(seen(3.0, tracks("a", 3.0, "", (5.0, 5.0), 1.0)))
    assert not roster.has_prior_claim(Claim("alpha", (5.1, 5.0), 2 * S), 3 * S)
    assert roster.has_prior_claim(Claim("", (5.1, 5.0), 2 * S), 3 * S)


def test_targets_are_equal_by_name_or_without_a_name_by_place() -> None:
    alpha = Claim("alpha", (0.0, 0.0), 0)
    assert alpha.same(Claim("alpha", (19.0, 0.0), 0))
    assert not alpha.same(Claim("alpha", (90.0, 0.0), 0))  # two targets with equal looks
    assert not alpha.same(Claim("bravo", (0.0, 0.0), 0))
    assert alpha.same(Claim("", (2.9, 0.0), 0))
    assert not alpha.same(Claim("", (3.1, 0.0), 0))


def test_the_target_of_a_lost_member_is_free_later_than_its_sector() -> None:
    roster = Roster("a", NAMES, alive_s=5.0, claim_s=20.0)
    roster.hear(seen(1.0, tracks("b", 1.0, "alpha")))
    own = Claim("alpha", (5.0, 5.0), 2 * S)
    assert roster.has_prior_claim(own, 20 * S)
    assert "b" not in roster.alive(20 * S)
    assert not roster.has_prior_claim(own, 21 * S)


@given(st.permutations(range(5)), st.lists(st.integers(0, 4), max_size=5))
def test_copies_and_another_order_change_nothing(order: list[int], copies: list[int]) -> None:
    messages = [tracks("b", 1.0 + n, f"t{n}", since_s=0.5) for n in range(5)]
    straight, mixed = Roster("a", NAMES), Roster("a", NAMES)
    straight.hear(seen(9.0, *messages))
    mixed.hear(seen(9.0, *(messages[n] for n in [*order, *copies])))
    assert mixed.claims(9 * S) == straight.claims(9 * S) == {"b": Claim("t4", (5.0, 5.0), S // 2)}


HOSTILE: tuple[Any, ...] = (
    b"search",
    {"do": "search"},
    {"do": "land", "ms": 1},
    {"do": ["search"], "ms": 1},
    {"do": "search", "ms": True},
    {"do": "search", "ms": 2_000},  # from the future
    {"do": "search", "ms": -1},
    {"do": "track", "ms": 1, "tg": 5, "at": [0.0, 0.0], "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha" * 100, "at": [0.0, 0.0], "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha", "at": [0.0], "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha", "at": [float("nan"), 0.0], "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha", "at": [1e300, 0.0], "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha", "at": "ab", "since": 0},
    {"do": "track", "ms": 1, "tg": "alpha", "at": [0.0, 0.0], "since": 2},  # later than its message
)


@pytest.mark.parametrize("body", HOSTILE)
def test_malformed_messages_are_ignored(body: Any) -> None:
    roster = Roster("a", NAMES)
    roster.hear(seen(1.0, ("b", body), *((name, body) for name in ("a", "stranger"))))
    assert not roster.claims(S)
    assert roster.searchers(S) == NAMES


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(("do", "ms", "tg", "at", "since")), inner),
    max_leaves=12,
)


@given(st.sampled_from(("a", "b", "stranger")), JSON)
def test_no_message_raises_an_exception(sender: str, body: Any) -> None:
    roster = Roster("a", NAMES)
    roster.hear(seen(1.0, (sender, body if isinstance(body, dict | bytes) else {"do": body, "ms": 0})))
    assert roster.alive(S) == NAMES


def test_bad_sectors_and_times_are_refused() -> None:
    with pytest.raises(ValueError, match="sectors names a twice"):
        Roster("a", NAMES, sectors=(("a", "b"), ("a",)))
    with pytest.raises(ValueError, match="sectors: a sector has no members"):
        Roster("a", NAMES, sectors=(("a", "b"), ()))
    with pytest.raises(ValueError, match="alive_s"):
        Roster("a", NAMES, alive_s=1.0, report_s=1.0)
