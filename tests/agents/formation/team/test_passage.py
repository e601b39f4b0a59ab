"""Views of a team's lane by its members, and the conditions of each policy for the wide shape."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Uav, observe, reception_of_body
from tests.support.agents.formation_member import TICK_NS, report_of
from tests.support.agents.passage_team import (
    BEAMS,
    CARS,
    SIDE,
    at,
    clear,
    formation,
    free,
    info,
    lookout,
    observation,
    receptions_of,
    scan,
)
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import Gap, Vfh
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.reports.prediction import DeadReckoning
from vcmvsp.agents.formation.reports.report import ReportReceiver
from vcmvsp.agents.formation.team.passage import Widening
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.cosim.agent import Body, Radio
from vcmvsp.cosim.types import Scan, Velocity

# --- the lane ---


@given(st.integers(0, BEAMS - 1), st.floats(0.01, 6.0), st.floats(0.5, 4.0))
def test_a_return_is_in_the_way_if_it_lies_in_the_rectangle(beam: int, distance: float, ahead_m: float) -> None:
    bearing = math.radians(beam - 90)
    x, y = distance * math.cos(bearing), distance * math.sin(bearing)
    assume(abs(x - ahead_m) > 1e-5 and abs(abs(y) - SIDE) > 1e-5)
    assert free(scan((x, y)), ahead_m=ahead_m) == (abs(y) > SIDE or x > ahead_m)


def test_the_lane_is_that_of_the_wide_shape_around_the_leader() -> None:
    """An echelon extends to the right of its leader."""
    echelon = lookout(team_formation=Formation(shape="echelon", spacing=1.0, passage=Passage()))
    assert not free(scan((1.0, -1.6)), of=echelon)
    assert free(scan((1.0, 0.4)), of=echelon)
    echelon.team.change("column", {})
    assert not free(scan((1.0, -1.6)), of=echelon)


def test_returns_behind_count_up_to_the_start_of_the_lane() -> None:
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
        ranges(np.full(BEAMS - 1, np.inf)),  # other number of beams
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
def test_without_a_valid_scan_the_lane_is_not_free(bad: Any) -> None:
    looks = lookout()
    assert free(scan(), of=looks)
    assert not free(bad, of=looks)
    assert free(scan(), of=looks)


# --- members are not obstacles ---


def test_members_at_reported_positions_are_no_obstacles() -> None:
    receiver = receptions_of(at("car2", 0.8, 0.0))
    assert free(scan((0.63, 0.0), (0.8, 0.2)), receiver=receiver)
    assert not free(scan((0.63, 0.0), (0.8, 0.2)))
    assert not free(scan((0.8, 0.0), (1.4, 0.0)), receiver=receiver)  # one of the two returns is no member
    assert not free(scan((0.8, 0.5)), receiver=receiver)


@pytest.mark.parametrize("member_m", [0.0, 0.1, 0.25, 0.4])
def test_member_m_sets_how_far_a_return_may_be_from_a_report(member_m: float) -> None:
    """Distance of a return from a report up to which it counts as the member: for the lane and for the avoidance."""
    looks, receiver = lookout(team_formation=formation(member_m=member_m)), receptions_of(at("car2", 0.8, 0.0))
    for x, is_member in ((0.8 + 0.22 + member_m - 0.01, True), (0.8 + 0.22 + member_m + 0.01, False)):
        assert free(scan((x, 0.0)), receiver=receiver, of=looks) == is_member
        found = looks.without_members(observation(scan((x, 0.0))), receiver, DeadReckoning(), "scan").readings["scan"]
        assert isinstance(found, Scan)
        assert bool(np.isinf(found.ranges).all()) == is_member


HEIGHTS = [(10.0, False), (0.45, False), (0.43, True), (-0.43, True), ("high", True), (math.nan, True)]  # two radii, 0.44 m


@pytest.mark.parametrize(("z", "is_level"), HEIGHTS)
def test_returns_at_other_heights_are_no_members(z: Any, is_level: bool) -> None:
    receiver = receptions_of(at("car2", 0.8, 0.0, vx=0.0, vy=0.0, vz=0.0, z=z))
    assert free(scan((0.63, 0.0)), receiver=receiver) == is_level
    assert (lookout("car3").behind_members(observation(scan()), 9.0, receiver, DeadReckoning(), 0.4) < 9.0) == is_level


def test_returns_in_the_air_are_no_vehicles_on_wheels() -> None:
    looks = lookout(body=Body(width_m=0.28, radius_m=0.22, flies=True))
    for z, is_level in ((2.0, False), (0.3, True)):
        obs = Uav((0.0, 0.0, z)).see(0, scan=scan((0.63, 0.0)))
        assert looks.is_free(obs, receptions_of(at("car2", 0.8, 0.0)), DeadReckoning(), 2.0) == is_level


def test_a_report_is_extrapolated_and_expires() -> None:
    receiver = receptions_of(report_of("car2", 10, v=0.3, x=0.5))  # at 1 s; 2.5 s later at x = 1.25 m
    looks = lookout()
    for x, now_ns, is_free in ((1.1, 3_500_000_000, True), (0.5, 3_500_000_000, False), (1.1, 3_600_000_000, False)):
        obs = observe((0.0, 0.0, 0.0), now_ns, scan=scan((x, 0.0), time_ns=now_ns))
        assert looks.is_free(obs, receiver, DeadReckoning(9.0), 2.0) == is_free


def test_returns_below_the_minimum_range_are_no_members() -> None:
    assert not free(ranges([np.nan, *[np.inf] * (BEAMS - 1)]), receiver=receptions_of(at("car2", 0.2, 0.0)))


def test_avoidance_of_a_member_ignores_only_the_other_members() -> None:
    receiver, looks = receptions_of(at("car1", 0.8, 0.0)), lookout("car2")
    obs = observation(scan((0.63, 0.0), (0.8, 0.5), (0.3, -0.1)))
    found = looks.without_members(obs, receiver, DeadReckoning(), "scan").readings["scan"]
    assert isinstance(found, Scan)
    assert sorted(np.flatnonzero(np.isfinite(found.ranges)).tolist()) == sorted(
        90 + round(math.degrees(math.atan2(y, x))) for x, y in ((0.8, 0.5), (0.3, -0.1))
    )
    for bad in (None, ranges([1.0])):
        assert looks.without_members(observation(bad), receiver, DeadReckoning(), "scan") == observation(bad)


@pytest.mark.parametrize(
    ("x", "y", "v", "limit"),
    [
        (0.8, 0.0, 0.3, 0.3 + 0.4 * (0.8 - 0.44)),  # the speed of the other member, plus 0.4/s times the room between both
        (0.8, 0.32, 0.0, 0.4 * (0.8 - 0.44)),
        (0.3, 0.0, 0.3, 0.3 - 0.4 * (0.44 - 0.3)),
        (0.3, 0.0, 0.0, 0.0),  # never backwards
        (0.8, 0.34, 0.0, 9.0),  # beside its path
    ],
)
def test_a_member_keeps_off_others_ahead_and_behind(x: float, y: float, v: float, limit: float) -> None:
    obs, receiver = observation(scan(), 2), receptions_of(report_of("car1", 2, v=v, x=0.06 + x, y=y))
    assert lookout("car2").behind_members(obs, 9.0, receiver, DeadReckoning(), 0.4) == pytest.approx(limit)
    assert lookout("car2").behind_members(obs, 0.0, receiver, DeadReckoning(), 0.4) == 0.0
    assert lookout("car2").behind_members(obs, -0.1, receiver, DeadReckoning(), 0.4) == -0.1
    behind = receptions_of(report_of("car1", 2, v=-v, x=0.06 - x, y=y))
    assert lookout("car2").behind_members(obs, -9.0, behind, DeadReckoning(), 0.4) == pytest.approx(-limit)
    assert lookout("car2").behind_members(obs, 0.1, behind, DeadReckoning(), 0.4) == 0.1


# --- policies ---


def widens(policy: Widening, *frees: bool, receiver: ReportReceiver | None = None, first: int = 0) -> list[bool]:
    """Answers of a policy, in ticks of 0.1 s."""
    listening = receiver or ReportReceiver((), 0.0)
    names = CARS[1:] if receiver else ()
    return [policy.widens((first + tick) * TICK_NS, each, names, listening) for tick, each in enumerate(frees)]


def test_immediate_follows_the_lane() -> None:
    assert widens(Widening(Passage(policy="immediate")), True, False, True, True) == [True, False, True, True]


def test_the_timer_restarts_with_every_return() -> None:
    answers = widens(Widening(Passage(policy="timer")), *[True] * 30, False, *[True] * 31, True)
    assert [tick for tick, yes in enumerate(answers) if yes] == [61]  # 3 s after the first free tick of the second stretch


@pytest.mark.parametrize("nonsense", ["1", [1], None, {"1": 1}, math.nan, 2])
def test_malformed_is_not_clear(nonsense: Any) -> None:
    assert not any(
        widens(Widening(Passage()), *[True] * 9, receiver=receptions_of(clear("car2", 0), clear("car3", 0, nonsense)))
    )


def test_old_reports_do_not_count_and_silent_members_are_left_out() -> None:
    policy, receiver = Widening(Passage(steady_s=0.0)), ReportReceiver(CARS, 0.0)
    receiver.take(observation(None, 0, clear("car2", 0), clear("car3", 0)))
    answers = widens(policy, *[True] * 120, receiver=receiver)
    assert [tick for tick, yes in enumerate(answers) if yes] == [*range(26), *range(100, 120)]
    late = ReportReceiver(CARS, 0.0)
    late.take(observation(None, 110, clear("car2", 110, 0)))
    assert not any(widens(policy, *[True] * 10, receiver=late, first=110))  # car3 has timed out, but car2 is not clear


@pytest.mark.parametrize("wrong", [{"x": math.nan}, {"t_ns": 10**12}, {"v": None}, None])
def test_members_with_malformed_reports_are_not_left_out(wrong: dict[str, Any] | None) -> None:
    policy, receiver = Widening(Passage(steady_s=0.0)), ReportReceiver(CARS, 0.0)
    answers = []
    for tick in range(130):
        body = {"seq": tick, "t_ns": tick * TICK_NS, "x": 0.0, "y": 0.0, "th": 0.0, "v": 0.3, "w": 0.0, "cl": 0}
        useless = reception_of_body("car2", {"?": 1} if wrong is None else body | wrong)
        receiver.take(observation(None, tick, useless, clear("car3", tick)))
        answers.append(policy.widens(tick * TICK_NS, True, CARS[1:], receiver))
    assert not any(answers)


MUTE = 2  # a report without the field for clear
REPORT = st.sampled_from((None, 0, 1, MUTE))


@given(st.lists(st.tuples(st.booleans(), REPORT, REPORT), max_size=80))
def test_all_clear_widens_when_all_have_been_clear_for_half_a_second(ticks: list[tuple[bool, int | None, int | None]]) -> None:
    """Equal to the rule: for six consecutive ticks free, and all newest reports clear and no older than 2 s."""
    policy, receiver = Widening(Passage(report_s=2.0)), ReportReceiver(CARS, 0.0)
    newest: dict[str, tuple[int, int]] = {}
    good = 0
    for tick, (is_free, *clear_fields) in enumerate(ticks):
        reports = {car: cl for car, cl in zip(CARS[1:], clear_fields, strict=True) if cl is not None}
        receptions = [report_of(car, tick) if cl == MUTE else clear(car, tick, cl) for car, cl in reports.items()]
        clear_flags = {car: int(cl == 1) for car, cl in reports.items()}
        receiver.take(observation(None, tick, *receptions))
        newest |= {car: (tick, cl) for car, cl in clear_flags.items()}
        ok = is_free and all(car in newest and newest[car][1] and tick - newest[car][0] <= 20 for car in CARS[1:])
        good = good + 1 if ok else 0
        expected = good == 6
        assert policy.widens(tick * TICK_NS, is_free, CARS[1:], receiver) == expected
        good = 0 if expected else good


# --- a follower on wheels does not get around its own leader, for any way of naming the leader ---


WAYS = [
    {"leader": "car1", "slot": (-0.8, 0.0), "handle": 0.4},
    {"formation": Formation(shape="column", spacing=0.8)},
    {"formation": Formation(shape="own", offsets=((0.0, 0.0), (-0.8, 0.0), (-0.8, 0.8)), passage=Passage(spacing=0.8))},
]
LEADER = (0.6, 0.1)  # m from the follower, nearer than its slot
BACK = ((0.45, 0.0), (0.45, 0.1), (0.45, 0.2))  # returns from the leader's back


def command(params: dict[str, Any], points: tuple[tuple[float, float], ...], **more: Any) -> Velocity:
    """Command of a follower with returns at these points, m, and a report of its leader."""
    follower = LeaderFollower(**params, **more)
    follower.start(info("car2"))
    return follower.act(
        observation(scan(*points), 0, report_of("car1", 0, v=0.3, x=LEADER[0], y=LEADER[1])), Radio("car2", CARS)
    )


@pytest.mark.parametrize("params", WAYS)
@pytest.mark.parametrize("method", [Gap(), Vfh()])
def test_a_follower_does_not_get_around_its_leader(params: dict[str, Any], method: Any) -> None:
    assert command(params, BACK, avoidance=method) == command(params, BACK)


@pytest.mark.parametrize("params", WAYS)
def test_a_follower_gets_around_obstacles_before_its_leader(params: dict[str, Any]) -> None:
    before = ((0.2, -0.2), (0.2, -0.15))
    around = command(params, (*before, *BACK), avoidance=Gap())
    assert around == command(params, before, avoidance=Gap()) != command(params, before)
