"""What members see of their team's lane, and when each policy is for the wide shape."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import observe, said
from tests.support.agents.formation_member import TICK_NS, says
from tests.support.agents.passage_team import BEAMS, CARS, SIDE, at, clear, formation, free, heard_of, info, lookout, scan, sees
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import Gap, Vfh
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.reports.prediction import DeadReckoning
from vcmvsp.agents.formation.reports.report import ReportReceiver
from vcmvsp.agents.formation.team.passage import Lookout, Widening
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Body, Radio
from vcmvsp.cosim.types import Scan, Velocity

# --- the lane ---


@given(st.integers(0, BEAMS - 1), st.floats(0.01, 6.0), st.floats(0.5, 4.0))
def test_a_return_is_in_the_way_if_it_lies_in_the_rectangle(beam: int, distance: float, ahead_m: float) -> None:
    bearing = math.radians(beam - 90)
    x, y = distance * math.cos(bearing), distance * math.sin(bearing)
    assume(abs(x - ahead_m) > 1e-5 and abs(abs(y) - SIDE) > 1e-5)
    assert free(scan((x, y)), ahead_m=ahead_m) == (abs(y) > SIDE or x > ahead_m)


def test_the_lane_is_that_of_the_wide_shape_wherever_the_leader_is_in_it() -> None:
    """An echelon lies to the right of its leader."""
    echelon = lookout(given=Formation(shape="echelon", spacing=1.0, passage=Passage()))
    assert not free(scan((1.0, -1.6)), of=echelon)
    assert free(scan((1.0, 0.4)), of=echelon)
    echelon.team.change("column", {})
    assert not free(scan((1.0, -1.6)), of=echelon)


def test_what_is_behind_counts_as_far_as_the_lane_begins_there() -> None:
    for behind_m, is_free in ((0.29, False), (0.31, True)):
        assert free(ring([*[math.inf] * 180, behind_m, *[math.inf] * 179])) == is_free


def ranges(values: Any, **more: Any) -> Scan:
    return msgspec.structs.replace(scan(), ranges=np.asarray(values), **more)


@pytest.mark.parametrize(
    "bad",
    [
        None,
        "scan",
        ranges(np.zeros(BEAMS)),
        ranges(np.full(BEAMS, np.nan)),
        ranges(np.full(BEAMS, -np.inf)),
        ranges(np.full(BEAMS - 1, np.inf)),  # other beams than before
        ranges([np.inf]),
        ranges([]),
        ranges(np.full((BEAMS, 2), np.inf)),
        ranges(np.full(BEAMS, np.inf), angle_step=math.nan),
        ranges(np.full(BEAMS, np.inf), angle_min="0"),
        ranges(np.full(BEAMS, None)),
        ranges(np.full(BEAMS, np.inf), time_ns=-600_000_000),  # too old
        ranges([np.nan, *[np.inf] * (BEAMS - 1)]),
    ],
)
def test_a_bad_scan_or_none_is_no_free_lane(bad: Any) -> None:
    looks = lookout()
    assert free(scan(), of=looks)
    assert not free(bad, of=looks)
    assert free(scan(), of=looks)


# --- members are not in the way ---


def test_members_are_not_in_the_way_where_their_reports_put_them() -> None:
    heard = heard_of(at("car2", 0.8, 0.0))
    assert free(scan((0.63, 0.0), (0.8, 0.2)), heard=heard)
    assert not free(scan((0.63, 0.0), (0.8, 0.2)))
    assert not free(scan((0.8, 0.0), (1.4, 0.0)), heard=heard)  # one of the two is none
    assert not free(scan((0.8, 0.5)), heard=heard)


@pytest.mark.parametrize("member_m", [0.0, 0.1, 0.25, 0.4])
def test_how_far_from_its_report_a_member_may_be_seen_is_said(member_m: float) -> None:
    """By its lane, and by its avoidance."""
    looks, heard = lookout(given=formation(member_m=member_m)), heard_of(at("car2", 0.8, 0.0))
    for x, is_member in ((0.8 + 0.22 + member_m - 0.01, True), (0.8 + 0.22 + member_m + 0.01, False)):
        assert free(scan((x, 0.0)), heard=heard, of=looks) == is_member
        found = looks.without_members(sees(scan((x, 0.0))), heard, DeadReckoning(), "scan").readings["scan"]
        assert isinstance(found, Scan)
        assert bool(np.isinf(found.ranges).all()) == is_member


HEIGHTS = [(10.0, False), (0.45, False), (0.43, True), (-0.43, True), ("high", True), (math.nan, True)]  # two radii, 0.44 m


@pytest.mark.parametrize(("z", "is_level"), HEIGHTS)
def test_what_is_above_or_below_is_no_member(z: Any, is_level: bool) -> None:
    heard = heard_of(at("car2", 0.8, 0.0, vx=0.0, vy=0.0, vz=0.0, z=z))
    assert free(scan((0.63, 0.0)), heard=heard) == is_level
    assert (lookout("car3").behind_members(sees(scan()), 9.0, heard, DeadReckoning(), 0.4) < 9.0) == is_level


def test_one_on_wheels_is_not_what_a_vehicle_in_the_air_sees() -> None:
    aloft = info(body=Body(width_m=0.28, radius_m=0.22, flies=True))
    given = formation()
    assert given.passage is not None
    looks = Lookout(given.passage, Team(given, CARS, "car1"), aloft)
    for z, is_level in ((2.0, False), (0.3, True)):
        seen = sees(scan((0.63, 0.0)))
        seen = msgspec.structs.replace(seen, state=msgspec.structs.replace(seen.state, position=(0.0, 0.0, z)))
        assert looks.is_free(seen, heard_of(at("car2", 0.8, 0.0)), DeadReckoning(), 2.0) == is_level


def test_a_report_is_reckoned_to_now_and_soon_hides_nothing() -> None:
    heard = heard_of(says("car2", 10, v=0.3, x=0.5))  # at 1 s, and at x = 1.25 m 2.5 s later
    looks = lookout()
    for x, now_ns, is_free in ((1.1, 3_500_000_000, True), (0.5, 3_500_000_000, False), (1.1, 3_600_000_000, False)):
        seen = observe((0.0, 0.0, 0.0), now_ns, scan=scan((x, 0.0), time_ns=now_ns))
        assert looks.is_free(seen, heard, DeadReckoning(9.0), 2.0) == is_free


def test_what_is_too_near_to_be_measured_is_no_member() -> None:
    assert not free(ranges([np.nan, *[np.inf] * (BEAMS - 1)]), heard=heard_of(at("car2", 0.2, 0.0)))


def test_avoidance_of_a_member_does_not_see_the_others_but_all_else() -> None:
    heard, looks = heard_of(at("car1", 0.8, 0.0)), lookout("car2")
    seen = sees(scan((0.63, 0.0), (0.8, 0.5), (0.3, -0.1)))
    found = looks.without_members(seen, heard, DeadReckoning(), "scan").readings["scan"]
    assert isinstance(found, Scan)
    assert sorted(np.flatnonzero(np.isfinite(found.ranges)).tolist()) == sorted(
        90 + round(math.degrees(math.atan2(y, x))) for x, y in ((0.8, 0.5), (0.3, -0.1))
    )
    for bad in (None, ranges([1.0])):
        assert looks.without_members(sees(bad), heard, DeadReckoning(), "scan") == sees(bad)


@pytest.mark.parametrize(
    ("x", "y", "v", "limit"),
    [
        (0.8, 0.0, 0.3, 0.3 + 0.4 * (0.8 - 0.44)),  # as fast as that one, and as much more as there is room
        (0.8, 0.32, 0.0, 0.4 * (0.8 - 0.44)),
        (0.3, 0.0, 0.3, 0.3 - 0.4 * (0.44 - 0.3)),
        (0.3, 0.0, 0.0, 0.0),  # never back
        (0.8, 0.34, 0.0, 9.0),  # beside its way
    ],
)
def test_a_member_does_not_run_into_another_nor_back_into_one(x: float, y: float, v: float, limit: float) -> None:
    seen, heard = sees(scan(), 2), heard_of(says("car1", 2, v=v, x=0.06 + x, y=y))
    assert lookout("car2").behind_members(seen, 9.0, heard, DeadReckoning(), 0.4) == pytest.approx(limit)
    assert lookout("car2").behind_members(seen, 0.0, heard, DeadReckoning(), 0.4) == 0.0
    assert lookout("car2").behind_members(seen, -0.1, heard, DeadReckoning(), 0.4) == -0.1
    behind = heard_of(says("car1", 2, v=-v, x=0.06 - x, y=y))
    assert lookout("car2").behind_members(seen, -9.0, behind, DeadReckoning(), 0.4) == pytest.approx(-limit)
    assert lookout("car2").behind_members(seen, 0.1, behind, DeadReckoning(), 0.4) == 0.1


# --- policies ---


def widens(policy: Widening, *frees: bool, heard: ReportReceiver | None = None, first: int = 0) -> list[bool]:
    """Its answers, a tick of 0.1 s each."""
    listening = heard or ReportReceiver((), 0.0)
    names = CARS[1:] if heard else ()
    return [policy.widens((first + tick) * TICK_NS, each, names, listening) for tick, each in enumerate(frees)]


def test_immediate_says_what_the_lane_says() -> None:
    assert widens(Widening(Passage(policy="immediate")), True, False, True, True) == [True, False, True, True]


def test_the_timer_begins_anew_with_everything_that_is_seen() -> None:
    answers = widens(Widening(Passage(policy="timer")), *[True] * 30, False, *[True] * 31, True)
    assert [tick for tick, yes in enumerate(answers) if yes] == [61]  # 3 s after the first free one of the second stretch


@pytest.mark.parametrize("nonsense", ["1", [1], None, {"1": 1}, math.nan, 2])
def test_nonsense_is_not_clear(nonsense: Any) -> None:
    assert not any(widens(Widening(Passage()), *[True] * 9, heard=heard_of(clear("car2", 0), clear("car3", 0, nonsense))))


def test_old_reports_do_not_count_and_the_silent_are_left_out() -> None:
    policy, heard = Widening(Passage(steady_s=0.0)), ReportReceiver(CARS, 0.0)
    heard.take(sees(None, 0, clear("car2", 0), clear("car3", 0)))
    answers = widens(policy, *[True] * 120, heard=heard)
    assert [tick for tick, yes in enumerate(answers) if yes] == [*range(26), *range(100, 120)]
    late = ReportReceiver(CARS, 0.0)
    late.take(sees(None, 110, clear("car2", 110, 0)))
    assert not any(widens(policy, *[True] * 10, heard=late, first=110))  # car3 is left out, but car2 is not clear


@pytest.mark.parametrize("wrong", [{"x": math.nan}, {"t_ns": 10**12}, {"v": None}, None])
def test_who_says_what_cannot_be_used_is_there_nevertheless(wrong: dict[str, Any] | None) -> None:
    policy, heard = Widening(Passage(steady_s=0.0)), ReportReceiver(CARS, 0.0)
    answers = []
    for tick in range(130):
        body = {"seq": tick, "t_ns": tick * TICK_NS, "x": 0.0, "y": 0.0, "th": 0.0, "v": 0.3, "w": 0.0, "cl": 0}
        useless = said("car2", {"?": 1} if wrong is None else body | wrong)
        heard.take(sees(None, tick, useless, clear("car3", tick)))
        answers.append(policy.widens(tick * TICK_NS, True, CARS[1:], heard))
    assert not any(answers)


MUTE = 2  # a report that does not say whether its sender is clear
REPORT = st.sampled_from((None, 0, 1, MUTE))


@given(st.lists(st.tuples(st.booleans(), REPORT, REPORT), max_size=80))
def test_all_clear_widens_when_all_have_been_clear_for_half_a_second(ticks: list[tuple[bool, int | None, int | None]]) -> None:
    """Against the rule, put plainly: for six ticks on end free, and all newest reports clear and no older than 2 s."""
    policy, heard = Widening(Passage(report_s=2.0)), ReportReceiver(CARS, 0.0)
    newest: dict[str, tuple[int, int]] = {}
    good = 0
    for tick, (is_free, *told_clear) in enumerate(ticks):
        reports = {car: cl for car, cl in zip(CARS[1:], told_clear, strict=True) if cl is not None}
        receptions = [says(car, tick) if cl == MUTE else clear(car, tick, cl) for car, cl in reports.items()]
        told = {car: int(cl == 1) for car, cl in reports.items()}
        heard.take(sees(None, tick, *receptions))
        newest |= {car: (tick, cl) for car, cl in told.items()}
        ok = is_free and all(car in newest and newest[car][1] and tick - newest[car][0] <= 20 for car in CARS[1:])
        good = good + 1 if ok else 0
        wanted = good == 6
        assert policy.widens(tick * TICK_NS, is_free, CARS[1:], heard) == wanted
        good = 0 if wanted else good


# --- a follower on wheels does not get around the leader that it follows, however it is told whom to follow ---


WAYS = [
    {"leader": "car1", "slot": (-0.8, 0.0), "handle": 0.4},
    {"formation": Formation(shape="column", spacing=0.8)},
    {"formation": Formation(shape="own", offsets=((0.0, 0.0), (-0.8, 0.0), (-0.8, 0.8)), passage=Passage(spacing=0.8))},
]
LEADER = (0.6, 0.1)  # m from the follower, nearer than its place is
BACK = ((0.45, 0.0), (0.45, 0.1), (0.45, 0.2))  # of the leader, as the follower sees it


def command(told: dict[str, Any], points: tuple[tuple[float, float], ...], **more: Any) -> Velocity:
    """Of a follower that sees returns at these points, m, and has heard of its leader."""
    follower = LeaderFollower(**told, **more)
    follower.start(info("car2"))
    return follower.act(sees(scan(*points), 0, says("car1", 0, v=0.3, x=LEADER[0], y=LEADER[1])), Radio("car2", CARS))


@pytest.mark.parametrize("told", WAYS)
@pytest.mark.parametrize("method", [Gap(), Vfh()])
def test_a_follower_does_not_get_around_its_leader(told: dict[str, Any], method: Any) -> None:
    assert command(told, BACK, avoidance=method) == command(told, BACK)


@pytest.mark.parametrize("told", WAYS)
def test_a_follower_gets_around_what_stands_before_its_leader(told: dict[str, Any]) -> None:
    before = ((0.2, -0.2), (0.2, -0.15))
    around = command(told, (*before, *BACK), avoidance=Gap())
    assert around == command(told, before, avoidance=Gap()) != command(told, before)
