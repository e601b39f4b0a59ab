"""A team at a passage: shapes commanded by the leader, and motion and reports of the members."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from tests.support.agents.agent_loop import bodies
from tests.support.agents.formation_member import TICK_NS, report_of
from tests.support.agents.passage_team import CARS, ScriptedLeader, at, clear, formation, info, observation, scan
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import Gap
from vcmvsp.agents.formation.aerial import AerialFollower, AerialRoute
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Radio

# --- the leader ---


def test_the_leader_commands_narrow_and_wide_shapes_with_hysteresis() -> None:
    front = ScriptedLeader(formation(policy="immediate"))
    notes, report = front.act(scan((2.05, 0.0)))
    assert notes == {"shape": "wedge", "lane": "free"}
    assert "sn" not in report
    notes, report = front.act(scan((1.95, 0.3)))
    assert notes == {"shape": "column", "lane": "narrow"}
    assert (report["shape"], report["sn"]) == ("column", 1)
    for far in (2.05, 2.45):
        notes, report = front.act(scan((far, 0.0)))
        assert notes == {}
        assert (report["shape"], report["sn"]) == ("column", 1)
    notes, report = front.act(scan((2.55, 0.0)))
    assert notes == {"shape": "wedge", "lane": "free"}
    assert (report["shape"], report["sn"]) == ("wedge", 2)
    assert front.act(scan((2.45, 0.0)))[0] == {}


def test_without_a_scan_the_team_is_narrow() -> None:
    front = ScriptedLeader(formation())
    assert front.act(None)[0] == {"shape": "column", "lane": "narrow"}
    assert all(front.act(None, clear("car2", front.tick), clear("car3", front.tick))[0] == {} for _ in range(20))


def test_all_clear_waits_for_the_reports_of_members() -> None:
    front = ScriptedLeader(formation())
    assert front.act(scan((1.0, 0.0)))[0]["lane"] == "narrow"
    assert front.act(scan())[0] == {"lane": "free", "waits_for": "car2, car3"}
    notes = [front.act(scan(), clear("car2", front.tick), clear("car3", front.tick, 0))[0] for _ in range(10)]
    assert notes == [{"waits_for": "car3"}] + [{}] * 9
    notes = [front.act(scan(), clear("car2", front.tick), clear("car3", front.tick))[0] for _ in range(7)]
    assert notes == [{"waits_for": ""}] + [{}] * 4 + [{"shape": "wedge"}, {}]


def test_waits_for_names_at_most_three_members_and_none_in_a_narrow_lane() -> None:
    names = tuple(f"car{number}" for number in range(1, 7))
    front = ScriptedLeader(formation(), vehicles=names)
    waits = [front.act(reading)[0].get("waits_for") for reading in (scan((1.0, 0.0)), scan(), scan(), scan((1.0, 0.0)))]
    assert waits == [None, "car2, car3, car4", None, ""]


def test_clocks_of_members_may_be_ahead_up_to_the_bound() -> None:
    for bound_s, shapes in ((0.0, 0), (0.2, 1)):
        front = ScriptedLeader(formation(), clock_bound_s=bound_s)
        front.act(scan((1.0, 0.0)))
        history = [front.act(scan(), clear("car2", front.tick + 2), clear("car3", front.tick + 2))[0] for _ in range(20)]
        assert sum("shape" in notes for notes in history) == shapes


def test_a_shape_that_is_due_while_the_team_is_narrow_is_the_next_wide_one() -> None:
    of = Formation(spacing=1.0, changes=((0.2, "line"),), passage=Passage(policy="immediate"))
    front = ScriptedLeader(of)
    shapes = [front.act(scan((1.0, 0.0)))[0].get("shape") for _ in range(4)]
    assert shapes == ["column", None, None, None]
    assert front.act(scan())[0]["shape"] == "line"
    wide = ScriptedLeader(of)
    assert [wide.act(scan())[0].get("shape") for _ in range(4)] == ["wedge", None, "line", None]


def test_a_new_leader_continues_from_the_shape_of_the_members() -> None:
    """The members are still in the column; number 1 for 'wedge' would be older to them than their number."""
    front, member = ScriptedLeader(formation()), Team(formation(), CARS, "car2")
    assert member.take({"shape": "column", "sn": 7, "order": [0, 2, 1]})
    known = [report_of(car, 0, cl=0, **member.fields) for car in CARS[1:]]
    assert front.act(scan())[1].get("sn") is None
    notes, report = front.act(scan(), *known)
    assert (notes["shape"], report["shape"], report["sn"], report["order"]) == ("column", "column", 7, [0, 2, 1])
    reports = [front.act(scan(), clear("car2", front.tick), clear("car3", front.tick))[1] for _ in range(7)]
    assert (reports[-1]["shape"], reports[-1]["sn"]) == ("wedge", 8)
    assert member.take(reports[-1])


def test_shape_numbers_are_taken_once_and_in_small_steps() -> None:
    front = ScriptedLeader(formation(policy="timer", timer_s=0.0))
    front.act(scan())
    for sn, then in ((2**62, None), (10_001, None), (100, 101), (200, 101)):  # lane free: received shapes are replaced
        assert front.act(scan(), report_of("car2", front.tick, shape="line", sn=sn))[1].get("sn") == then
    assert front.act(scan(), report_of("car3", front.tick, shape="line", sn=300))[1]["sn"] == 301
    member = Team(formation(), CARS, "car2")
    for wrong in (2**62, 10_001, 2**64, -1, 1.0, True):
        assert not member.take({"shape": "line", "sn": wrong})
    assert member.take({"shape": "line", "sn": 10_000})


def test_a_leader_without_a_passage_keeps_its_own_shape() -> None:
    front = ScriptedLeader(Formation(spacing=1.0, changes=((0.0, "line"), (9.0, "box"))))
    assert front.act(None)[1]["sn"] == 1
    _, report = front.act(None, report_of("car2", 0, shape="wedge", sn=4))
    assert (report["shape"], report["sn"]) == ("line", 5)


def test_narrow_members_check_the_lane_of_the_next_wide_shape() -> None:
    """A line of 0.7 m needs 1.4 m on either side, the wedge half of it: with the wedge's lane they would be clear too early."""
    of = Formation(spacing=1.0, changes=((0.3, "line"),), passage=Passage(spacing=0.8))
    follower, radio = LeaderFollower(formation=of), Radio("car2", CARS)
    follower.start(info("car2"))
    clear_flags = []
    for tick in range(6):
        reading = scan((0.5, 0.9), time_ns=tick * TICK_NS)
        follower.act(observation(reading, tick, report_of("car1", tick, shape="column", sn=1)), radio)
        clear_flags += [report["cl"] for report in bodies(radio)]
    assert clear_flags == [1, 1, 1, 0, 0, 0]


def test_a_member_does_not_reverse_into_another_hidden_from_its_avoidance() -> None:
    """Its slot is behind it, and so is another member, 0.5 m away."""
    back = ring([*[math.inf] * 175, *[0.3] * 11, *[math.inf] * 174], TICK_NS)
    follower = LeaderFollower(formation=Formation(spacing=1.0, passage=Passage()), avoidance=Gap())
    follower.start(info("car2"))
    command = follower.act(observation(back, 1, at("car1", -0.6, 0.5, 1), at("car3", 0.03 - 0.5, 0.0, 1)), Radio("car2", CARS))
    assert command.linear[0] > -0.4 * (0.5 - 0.44) - 1e-9


# --- the members ---


def test_members_report_whether_they_are_clear() -> None:
    follower, radio = LeaderFollower(formation=formation()), Radio("car2", CARS)
    follower.start(info("car2"))
    assert follower.sensors == ("scan",)
    for reading, cl in ((scan((1.15, 0.6)), 0), (scan((1.25, 0.0)), 1), (None, 0), (scan(), 1)):
        follower.act(observation(reading), radio)
        assert [report["cl"] for report in bodies(radio)] == [cl]


def test_without_a_passage_members_do_not_scan_or_report() -> None:
    follower, radio = LeaderFollower(formation=Formation(), broadcast=True), Radio("car2", CARS)
    follower.start(info("car2", body=None))
    follower.act(observation(scan((0.5, 0.0))), radio)
    assert ["cl" in report for report in bodies(radio)] == [False]
    assert follower.sensors is None


def test_policy_all_clear_needs_broadcast() -> None:
    with pytest.raises(ValueError, match="broadcast = false"):
        LeaderFollower(formation=formation(), broadcast=False)
    LeaderFollower(formation=formation(policy="timer"), broadcast=False)


# --- refusals ---


@pytest.mark.parametrize("agent", [Trajectory, LeaderFollower, AerialFollower, partial(AerialRoute, course_deg=0.0)])
def test_reports_must_not_expire_before_the_next(agent: Callable[..., Any]) -> None:
    rare = Sending(when="needed", silence_s=2.5)
    with pytest.raises(ValueError, match=r"silence_s = 2\.5 s must be shorter than .*report_s = 2\.5 s"):
        agent(formation=formation(), sending=rare)
    agent(formation=formation(report_s=3.0), sending=rare)
    agent(formation=formation(), sending=Sending(when="needed"))  # the default
    agent(formation=formation(), sending=Sending(silence_s=9.0))  # every tick


@pytest.mark.parametrize(
    ("passage", "about", "says_so"),
    [
        ({"scanner": "lidar"}, {"sensors": ("scan", "imu")}, r"'lidar': car1 has no such sensor; its sensors: scan, imu"),
        ({}, {"sensors": ()}, r"'scan': car1 has no such sensor; its sensors: nothing"),
        ({}, {"body": None}, "needs the size of car1"),
    ],
)
def test_a_vehicle_without_scanner_or_size_is_refused(passage: dict[str, Any], about: dict[str, Any], says_so: str) -> None:
    with pytest.raises(ValueError, match=says_so):
        ScriptedLeader(formation(**passage), **about)
    follower = LeaderFollower(formation=formation(**passage))
    with pytest.raises(ValueError, match=says_so.replace("car1", "car2")):
        follower.start(info("car2", **about))


def test_an_inconsistent_passage_is_refused() -> None:
    with pytest.raises(ValueError, match=r"free_m = 1\.5 must not be less than narrow_m = 2"):
        Passage(free_m=1.5)
    with pytest.raises(ValueError, match="is also the formation's shape"):
        Formation(shape="column", passage=Passage())
    with pytest.raises(ValueError, match=r"silence_s = 1 must be greater than report_s = 2: a member counts as gone"):
        Passage(silence_s=1.0, report_s=2.0)
    with pytest.raises(
        ValueError, match=r"passage.shape = 'line' is no narrower than the formation's own, 'wedge': 2 m instead of 1"
    ):
        Team(Formation(passage=Passage(shape="line")), CARS, "car1")
    Team(Formation(members=("car1",), passage=Passage(shape="line")), CARS, "car1")  # a single member has a constant width
    with pytest.raises(ValueError, match="needs offsets"):
        Team(Formation(passage=Passage(shape="own")), CARS, "car1")


def test_the_narrow_shape_has_a_spacing_of_its_own() -> None:
    team = Team(formation(), CARS, "car3")
    assert team.places("column") == ((0.0, 0.0), (-0.8, 0.0), (-1.6, 0.0))
    assert team.places("wedge")[2] == pytest.approx((-math.sqrt(0.75), 0.5))
    same = Team(Formation(spacing=1.2, passage=Passage()), CARS, "car3")
    assert same.places("column")[1] == (-1.2, 0.0)
