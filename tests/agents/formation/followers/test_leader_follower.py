"""A follower in a team: its parent, its slot, what it relays, and loss of its predecessors."""

import math
from typing import Any

import pytest

from tests.support.agents.agent_loop import reception_of
from tests.support.agents.formation_member import COLUMN, TICK_NS, MemberRunner, member, report_of
from vcmvsp.agents.formation.followers.leader_follower import Feed, LeaderFollower
from vcmvsp.agents.formation.reports.report import heartbeat_for
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Message, Reception

# --- its slot ---


def test_the_team_sets_parent_and_slot() -> None:
    place = MemberRunner("car3").follows
    assert (place.leader, place.handle_m) == ("car2", 0.4)
    assert place.slot == pytest.approx((-0.8, 0.0))
    assert member("car3", handle=0.6).place.handle == 0.6


def test_a_slot_replaces_distance_and_bearing() -> None:
    by_slot = LeaderFollower("car1", slot=(-math.cos(math.pi / 6), -0.5))
    by_bearing = LeaderFollower("car1", 1.0, 30.0)
    assert by_slot.place == pytest.approx(by_bearing.place)
    assert LeaderFollower("car1", slot=(0.5, 1.0), handle=0.3).place == (0.8, 1.0, 0.3)


def test_parent_and_shape_are_noted_when_they_change() -> None:
    seat = MemberRunner("car3")
    _, notes, _ = seat.act()
    assert notes == {"status": "waiting", "parent": "car2", "shape": "column"}
    _, notes, _ = seat.act(report_of("car2", 0))
    assert set(notes) == {"status", "age_s", "z1", "z2"}
    _, notes, _ = seat.act(report_of("car1", 1, shape="line", sn=1, order=[0, 3, 2, 1]))
    assert (notes["shape"], notes["parent"], seat.follows.leader) == ("line", "car4", "car4")
    assert seat.follows.slot == pytest.approx((0.0, 1.6))


def test_a_new_shape_is_passed_on() -> None:
    seat = MemberRunner("car3")
    assert not {"shape", "sn", "order"} & set(seat.report(report_of("car2", 0)))
    for received in (report_of("car2", 1, shape="line", sn=4), report_of("car2", 2)):
        report = seat.report(received)
        assert (report["shape"], report["sn"]) == ("line", 4)


@pytest.mark.parametrize(
    ("name", "formation", "params", "reports"),
    [
        ("car3", COLUMN, {}, True),
        ("car4", COLUMN, {}, False),  # the last member has no followers
        ("car4", COLUMN, {"heartbeat_s": 1.0}, True),  # it may have to lead
        ("car4", {**COLUMN, "changes": ((9.0, "line"),)}, {}, True),  # the leader needs its position to assign slots
        ("car2", {"topology": "star"}, {}, False),
        ("car2", {"topology": "star"}, {"broadcast": True}, True),
        ("car3", COLUMN, {"broadcast": False}, False),
    ],
)
def test_only_needed_reports_are_sent(name: str, formation: dict[str, Any], params: dict[str, Any], reports: bool) -> None:
    *_, sent = MemberRunner(name, formation, **params).act()
    assert bool(sent) == reports


def test_answers_to_own_reports_are_not_counted_as_refused() -> None:
    seat = MemberRunner("car2")
    _, notes, _ = seat.act(reception_of(Message(sender="car3", body={"ack": 3}, size_bytes=9, to="car2")))
    assert "refused" not in notes


def test_followers_answer_a_report_that_requests_it() -> None:
    follower = MemberRunner("car3")
    *_, sent = follower.act(report_of("car2", 0, ak=1))
    assert [(each.body, each.to) for each in sent if each.to] == [({"ack": 0}, "car2")]
    assert not any(each.to for each in follower.act()[2])
    *_, sent = MemberRunner("car4").act(report_of("car2", 0, ak=1))
    assert not any(each.to for each in sent)


def test_a_follower_sends_when_needed_too() -> None:
    seat = MemberRunner("car3", sending=Sending(when="needed", acknowledge=False, silence_s=1.0))
    sent = [len(seat.act(report_of("car2", max(0, tick - 1)), v=0.0)[2]) for tick in range(30)]
    assert sum(sent) == 3  # at rest at the position reported


# --- loss of predecessors ---


def notes_with_losses(seat: MemberRunner, last_heard: dict[str, int], ticks: int) -> list[dict[str, Any]]:
    """Notes of a member that receives each of the others' reports up to a tick, one tick after they were sent."""
    notes = []
    for tick in range(ticks):
        receptions = [report_of(name, tick - 1) for name, last in last_heard.items() if 0 < tick <= last]
        notes.append(seat.act(*receptions)[1])
    return notes


def test_a_member_follows_the_nearest_living_ancestor() -> None:
    seat = MemberRunner("car4", heartbeat_s=0.5)
    notes = notes_with_losses(seat, {"car1": 99, "car2": 20, "car3": 10}, 30)
    assert {tick: note["parent"] for tick, note in enumerate(notes) if "parent" in note} == {0: "car3", 15: "car2", 25: "car1"}
    assert {note["status"] for note in notes[1:]} == {"following"}
    assert seat.follows.slot == pytest.approx((-2.4, 0.0))
    assert seat.act(report_of("car2", 29))[1]["parent"] == "car2"
    assert seat.act(report_of("car3", 30))[1]["parent"] == "car3"


def test_the_lowest_living_member_leads_and_stops() -> None:
    seat = MemberRunner("car2", heartbeat_s=1.0, fade_s=1.0)
    notes, commands = [], []
    for tick in range(60):
        received = [report_of("car1", tick - 1)] if 0 < tick <= 30 else []
        command, note, _ = seat.act(*received, report_of("car3", tick), x=0.03 * tick - 0.8)
        notes.append(note)
        commands.append(command.linear[0])
    assert notes[40]["parent"] == ""
    assert {note["status"] for note in notes[40:]} == {"leading"}
    assert seat.follower.follows is None
    last = commands[39]
    assert last > 0.2
    assert commands[40:50] == pytest.approx([last * (1 - 0.1 * k) for k in range(10)])
    assert commands[50:] == [0.0] * 10
    assert seat.act(report_of("car1", 59))[1]["parent"] == "car1"


def test_a_member_stopped_for_a_lost_leader_does_not_start_again_to_lead() -> None:
    seat = MemberRunner("car2", heartbeat_s=5.0, timeout_s=3.0)
    commands = [
        seat.act(*([report_of("car1", tick - 1)] if 0 < tick <= 10 else []), x=0.03 * tick - 0.8)[0].linear[0]
        for tick in range(80)
    ]
    assert commands[60:] == [0.0] * 20


def test_in_a_star_the_others_follow_the_lowest_living_member() -> None:
    star = {"shape": "wedge", "topology": "star", "spacing": 1.0}
    seat = MemberRunner("car4", star, heartbeat_s=1.0)
    notes = notes_with_losses(seat, {"car1": 20, "car3": 99}, 40)
    assert {tick: note["parent"] for tick, note in enumerate(notes) if "parent" in note} == {0: "car1", 30: "car3"}
    assert seat.follows.slot == pytest.approx((-math.sqrt(0.75), -1.5))  # car4 (-2 h, -1) minus car3 (-h, 0.5)


def test_without_heartbeat_the_parent_stays() -> None:
    notes = notes_with_losses(MemberRunner("car4"), {"car1": 99, "car2": 99, "car3": 10}, 60)
    assert [tick for tick, note in enumerate(notes) if "parent" in note] == [0]
    assert notes[-1]["status"] == "leader lost"


@pytest.mark.parametrize(
    ("loss", "false_alarms_per_s", "expected"),
    [(0.5, 1e-3, 1.3288), (0.9, 1e-3, 8.7417), (0.1, 1e-3, 1.0), (0.0, 1e-9, 1.0), (0.9, 20.0, 1.0)],
)
def test_the_heartbeat_for_a_loss(loss: float, false_alarms_per_s: float, expected: float) -> None:
    """max(1 s, T ln(eps T) / ln p) at T = 0.1 s."""
    assert heartbeat_for(loss, 0.1, false_alarms_per_s) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("loss", "period_s", "rate"), [(1.0, 0.1, 1.0), (-0.1, 0.1, 1.0), (0.5, 0.0, 1.0), (0.5, 0.1, 0.0)])
def test_a_heartbeat_needs_valid_loss_period_and_rate(loss: float, period_s: float, rate: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        heartbeat_for(loss, period_s, rate)


# --- refusals ---


def test_the_first_member_must_have_a_leader_agent() -> None:
    with pytest.raises(ValueError, match=r"car1 is the first member of the formation and leads it: give it"):
        member("car1")


@pytest.mark.parametrize(
    ("table", "error"),
    [
        ({}, r"^agent.leader: is missing"),
        ({"leader": "car1", "formation": {}}, r"^agent: .* and formation both define the leader of this vehicle; leave one"),
        ({"leader": "car1", "distance": -1.0}, r"^agent.distance: must be a number > 0"),
        ({"leader": "car1", "bearing_deg": 90.0}, r"^agent: .* set it, e.g. handle = 0.4"),
        ({"leader": "car1", "fade_s": 0}, r"^agent.fade_s: must be a number > 0"),
        ({"leader": "car1", "heartbeat_s": 1.0}, r"^agent.heartbeat_s: heartbeat_s needs a formation"),
        (
            {"formation": {}, "heartbeat_s": 2.0, "sending": {"when": "needed", "silence_s": 2.0}},
            r"heartbeat_s = 2.0 s must be longer than .*silence_s = 2.0 s",
        ),
        ({"leader": "car1", "slot": [1.0]}, r"^agent.slot: must be a list of 2 values, each a number"),
        ({"leader": "car1", "slot": [0.0, 1.0]}, r"^agent: slot = \[0.0, 1.0\] m does not put this vehicle behind .* set it"),
        ({"formation": {"shape": "wegde"}}, r"^agent.formation.shape: must be one of 'column', .*'wedge'.*, not 'wegde'"),
        ({"formation": {"spacing": 0}}, r"^agent.formation.spacing: must be a number > 0"),
        ({"formation": {"shap": "wedge"}}, r"^agent.formation: unknown key 'shap'; did you mean 'shape'\?"),
        ({"formation": {}, "feed": "father"}, r"^agent.feed: must be one of 'parent', 'leader', 'none'"),
    ],
)
def test_wrong_values_of_a_scenario_are_named(table: dict[str, Any], error: str) -> None:
    with pytest.raises(ScenarioError, match=error):
        call(LeaderFollower, table, key="agent")


# --- feed-forward of speed and acceleration, and the fields relayed for it ---


def speed(feed: Feed, *receptions: Reception, **params: Any) -> float:
    """Commanded speed on a straight line without error of the place: the feed-forward alone."""
    seat = MemberRunner("car3", feed=feed, handle=0.8, max_speed=9.0, **params)
    for _ in range(2):
        seat.act()
    command, _, _ = seat.act(*receptions, x=0.03 * 2 - 0.8)
    return command.linear[0]


def test_the_speed_of_the_parent_the_leader_or_none_is_fed_forward() -> None:
    parent, leader = report_of("car2", 2, v=0.5), report_of("car1", 2, v=0.2)
    assert speed("parent", parent, leader) == pytest.approx(0.5)
    assert speed("leader", parent, leader) == pytest.approx(0.2)
    assert speed("none", parent, leader) == pytest.approx(0.0)


def test_the_speed_of_the_leader_may_be_relayed() -> None:
    relayed = report_of("car2", 2, v=0.5, lead=[1 * TICK_NS, 0.0, 0.0, 0.0, 0.25, 0.0])
    assert speed("leader", relayed) == pytest.approx(0.25)
    assert speed("leader", relayed, report_of("car1", 2, v=0.2)) == pytest.approx(0.2)  # own reception, newer
    assert speed("leader", relayed, report_of("car1", 0, v=0.2)) == pytest.approx(0.25)  # own reception, older
    assert speed("leader", report_of("car2", 2, v=0.5)) == pytest.approx(0.5)  # leader unknown: speed of the parent


FUTURE, FRACTION = [9 * TICK_NS, 0, 0, 0, 0.9, 0], [0.5, 0, 0, 0, 0.9, 0]


@pytest.mark.parametrize("lead", [[], [0, 0, 0, 0, 0.9], None, 7, "lead", FUTURE, [0, 0, 0, 0, math.nan, 0], FRACTION])
def test_malformed_relays_of_the_leader_are_ignored(lead: Any) -> None:
    assert speed("leader", report_of("car2", 2, v=0.5, lead=lead)) == pytest.approx(0.5)


def test_the_speed_of_a_lost_leader_is_not_fed_forward() -> None:
    seat = MemberRunner("car3", feed="leader", handle=0.8, estimator="hold", timeout_s=1.0)
    seat.act(report_of("car1", 0, v=0.9))
    for tick in range(1, 30):
        command, _, _ = seat.act(report_of("car2", tick, v=0.0), x=0.03 * tick - 0.8)
        assert command.linear[0] == pytest.approx(0.9 if tick < 10 else 0.0)


def test_followers_that_feed_the_leader_forward_relay_it() -> None:
    seat, lead = MemberRunner("car3", feed="leader"), [0, 1.0, 2.0, 0.5, 0.25, 0.1]
    assert "lead" not in seat.report()
    assert seat.report(report_of("car2", 0, lead=lead))["lead"] == lead


def test_outside_a_team_a_parent_without_relay_is_the_leader() -> None:
    seat = MemberRunner("car2")
    seat.follower = LeaderFollower("car1", 0.8, feed="leader", broadcast=True)
    assert seat.report(report_of("car1", 0, v=0.2))["lead"] == [0, 0.0, 0.0, 0.0, 0.2, 0.0]


def test_the_acceleration_of_the_parent_compensates_the_own_lag() -> None:
    report = report_of("car2", 2, v=0.5, a=0.4)
    assert speed("parent", report, feed_forward_s=0.5) == pytest.approx(0.7)
    assert speed("parent", report) == pytest.approx(0.5)
    assert speed("parent", report_of("car2", 2, v=0.5, a=math.nan), feed_forward_s=0.5) == pytest.approx(0.5)


def test_users_of_accelerations_report_their_own() -> None:
    seat = MemberRunner("car3", feed_forward_s=0.5)
    assert [seat.report(v=v)["a"] for v in (0.1, 0.1, 0.15, 0.1)] == pytest.approx([0.0, 0.0, 0.5, -0.5])
    assert "a" not in MemberRunner("car3").report()
