"""Whose speed, and whose acceleration, a follower feeds forward, and what it passes on for that."""

import math
from typing import Any

import pytest

from tests.support.agents.formation_member import TICK_NS, Seat, says
from vcmvsp.agents.formation.followers.leader_follower import Feed, LeaderFollower
from vcmvsp.cosim.types import Reception


def speed(feed: Feed, *heard: Reception, **params: Any) -> float:
    """Commanded on a straight line, with no error of the place: what is fed forward alone."""
    seat = Seat("car3", feed=feed, handle=0.8, max_speed=9.0, **params)
    for _ in range(2):
        seat.act()
    command, _, _ = seat.act(*heard, x=0.03 * 2 - 0.8)
    return command.linear[0]


def test_the_parent_the_leader_or_nobody_feeds_its_speed_forward() -> None:
    parent, leader = says("car2", 2, v=0.5), says("car1", 2, v=0.2)
    assert speed("parent", parent, leader) == pytest.approx(0.5)
    assert speed("leader", parent, leader) == pytest.approx(0.2)
    assert speed("none", parent, leader) == pytest.approx(0.0)


def test_the_speed_of_the_leader_may_be_relayed() -> None:
    relayed = says("car2", 2, v=0.5, lead=[1 * TICK_NS, 0.0, 0.0, 0.0, 0.25, 0.0])
    assert speed("leader", relayed) == pytest.approx(0.25)
    assert speed("leader", relayed, says("car1", 2, v=0.2)) == pytest.approx(0.2)  # heard itself, and newer
    assert speed("leader", relayed, says("car1", 0, v=0.2)) == pytest.approx(0.25)  # heard itself, but older
    assert speed("leader", says("car2", 2, v=0.5)) == pytest.approx(0.5)  # nothing known of it: the parent's


@pytest.mark.parametrize(
    "lead", [[], [0], None, "lead", [9 * TICK_NS, 0, 0, 0, 0.9, 0], [0, 0, 0, 0, math.nan, 0], [0.5, 0, 0, 0, 0.9, 0]]
)
def test_nonsense_about_the_leader_is_not_believed(lead: Any) -> None:
    assert speed("leader", says("car2", 2, v=0.5, lead=lead)) == pytest.approx(0.5)


def test_a_leader_that_is_lost_feeds_nothing_forward() -> None:
    seat = Seat("car3", feed="leader", handle=0.8, estimator="hold", timeout_s=1.0)
    seat.act(says("car1", 0, v=0.9))
    for tick in range(1, 30):
        command, _, _ = seat.act(says("car2", tick, v=0.0), x=0.03 * tick - 0.8)
        assert command.linear[0] == pytest.approx(0.9 if tick < 10 else 0.0)


def test_those_who_need_the_leader_pass_on_what_they_know_of_it() -> None:
    seat = Seat("car3", feed="leader")
    *_, sent = seat.act()
    assert "lead" not in sent[0].body
    *_, sent = seat.act(says("car2", 0, lead=[0, 1.0, 2.0, 0.5, 0.25, 0.1]))
    assert isinstance(sent[0].body, dict)
    assert sent[0].body["lead"] == [0, 1.0, 2.0, 0.5, 0.25, 0.1]


def test_outside_a_team_a_parent_that_relays_nobody_is_the_leader() -> None:
    seat = Seat("car2")
    seat.follower = LeaderFollower("car1", 0.8, feed="leader", broadcast=True)
    *_, sent = seat.act(says("car1", 0, v=0.2))
    assert isinstance(sent[0].body, dict)
    assert sent[0].body["lead"] == [0, 0.0, 0.0, 0.0, 0.2, 0.0]


def test_the_acceleration_of_the_parent_makes_up_for_the_own_lag() -> None:
    report = says("car2", 2, v=0.5, a=0.4)
    assert speed("parent", report, feed_forward_s=0.5) == pytest.approx(0.7)
    assert speed("parent", report) == pytest.approx(0.5)
    assert speed("parent", says("car2", 2, v=0.5, a=math.nan), feed_forward_s=0.5) == pytest.approx(0.5)


def test_who_needs_accelerations_also_tells_its_own() -> None:
    seat = Seat("car3", feed_forward_s=0.5)
    assert [seat.act(v=v)[2][0].body["a"] for v in (0.1, 0.1, 0.15, 0.1)] == pytest.approx([0.0, 0.0, 0.5, -0.5])  # type: ignore[call-overload]
    *_, sent = Seat("car3").act()
    assert "a" not in sent[0].body
