"""An agent that recognises and tracks: the laws of the loop with the agent in it, whose target it is, and what it tells."""

import math
from itertools import pairwise
from typing import Any

import pytest

import vcmvsp
from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import T, Uav, info, received, said
from tests.support.agents.fake_cameras import T_NS, Eye, at_rest, keep_over, started
from vcmvsp.agents.reconnaissance.roster import Roster
from vcmvsp.agents.reconnaissance.track import CLIMB, TrackTarget
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Reception, Waypoint


def told(sender: str, tick: int, **body: Any) -> Reception:
    return said(sender, {"do": "track", "ms": tick * 100, **body})


# --- the loop -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0, -3.0])
def test_the_offset_shrinks_by_0_92_a_tick_at_any_yaw_once_the_target_is_confirmed(yaw: float) -> None:
    track = started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0))))
    was = keep_over(track, Uav((0.0, 0.0, 30.0), yaw), 40)
    assert [each.position for each in was[:3]] == [(0.0, 0.0, 30.0)] * 3  # it hovers until the third picture
    for before, after in pairwise(was[2:]):
        shares = [(t - b) / (t - a) for t, a, b in zip((3.0, -2.0), before.position[:2], after.position[:2], strict=True)]
        assert shares == pytest.approx([0.92, 0.92], abs=1e-6)
    assert {each.position[2] for each in was} == {30.0}
    assert {each.yaw for each in was} == {yaw}


@pytest.mark.parametrize(("smoothing", "lag", "within"), [(0.0, 0.625, 1e-6), (0.2, 0.0, 1e-3)])
def test_behind_a_target_at_half_a_metre_a_second_it_lags_by_v_over_k_unless_it_knows_the_speed(
    smoothing: float, lag: float, within: float
) -> None:
    track = started(TrackTarget(smoothing=smoothing), Eye(lambda time_s: {"alpha": (0.5 * time_s, 1.0)}))
    was = keep_over(track, Uav((0.0, 0.0, 30.0), 1.0), 300)
    for tick in range(200, 300):
        assert 0.5 * tick * T - was[tick].position[0] == pytest.approx(lag, abs=within)
        assert was[tick].position[1] == pytest.approx(1.0, abs=1e-6)


def test_with_pictures_now_and_then_it_gets_there_as_well() -> None:
    was = keep_over(started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0)), every=5)), Uav((0.0, 0.0, 30.0)), 120)
    assert was[-1].position == pytest.approx((3.0, -2.0, 30.0), abs=1e-3)


def test_it_climbs_to_its_height_no_faster_than_allowed() -> None:
    was = keep_over(started(TrackTarget(height=20.0), Eye(at_rest(alpha=(0.0, 0.0)))), Uav((0.0, 0.0, 30.0)), 300)
    heights = [each.position[2] for each in was]
    assert max(abs(b - a) for a, b in pairwise(heights)) <= CLIMB * T + 1e-9
    assert heights[-1] == pytest.approx(20.0, abs=1e-3)


def test_a_gain_that_cannot_settle_is_refused_at_the_start_by_its_key() -> None:
    for params, latency in (({"gain": 21.0}, 0.0), ({}, 2.0)):
        track = TrackTarget(**params)  # type: ignore[arg-type]
        track.watch = Eye(at_rest())  # type: ignore[assignment]
        with pytest.raises(ValueError, match=r"gain = .*must lie between 0 and"):
            track.start(info("me", ("me",), latency_s=latency, body=BODY))


# --- whose target -------------------------------------------------------------------------------------------------------------


def test_what_is_confirmed_is_told_and_noted_once() -> None:
    track = started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0))), alone=False)
    uav, notes = Uav((0.0, 0.0, 30.0)), []
    facts = []
    for tick in range(10):
        facts.append(track.facts(uav.see(tick * T_NS)))
        notes.append(track.drain_notes())
    assert facts[:2] == [{}, {}]
    for each in facts[2:]:
        assert each == {"recognised": True, "place": pytest.approx((3.0, -2.0))}
    assert notes[2] == {"found": "alpha", "found_x": pytest.approx(3.0), "found_y": pytest.approx(-2.0)}
    assert [each for i, each in enumerate(notes) if i != 2] == [{}] * 9


def test_of_two_the_nearest_is_found_first_and_the_other_at_the_next_picture() -> None:
    track = started(TrackTarget(), Eye(at_rest(alpha=(5.0, 0.0), bravo=(0.0, 4.0))), alone=False)
    uav, found = Uav((0.0, 0.0, 30.0)), []
    for tick in range(5):
        track.facts(uav.see(tick * T_NS))
        found.append(track.drain_notes().get("found"))
    assert found == [None, None, "bravo", "alpha", None]


@pytest.mark.parametrize(
    ("name", "place", "theirs"),
    [
        ("alpha", (15.0, 0.0), True),
        ("alpha", (90.0, 0.0), False),  # another one that looks alike
        ("", (3.0, 0.0), False),  # who does not see what is there
        ("bravo", (3.0, 0.0), False),
    ],
)
def test_a_target_that_another_tracks_is_not_recognised(name: str, place: tuple[float, float], theirs: bool) -> None:
    track = started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0))), alone=False)
    assert track.roster is not None
    uav, facts = Uav((0.0, 0.0, 30.0)), []
    notes: list[str] = []
    for tick in range(1, 8):
        obs = uav.see(tick * T_NS, [told("other", tick, tg=name, at=list(place), since=0)])
        track.roster.hear(obs)
        facts.append(track.facts(obs))
        notes += track.drain_notes()
    assert any("recognised" in each for each in facts) == ("found" in notes) == (not theirs)


def test_who_began_later_gives_way_and_leaves_the_place_alone_for_a_while() -> None:
    track = started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0))), alone=False)
    assert track.roster is not None
    uav, targets = Uav((0.0, 0.0, 30.0)), []
    for tick in range(1, 21):
        since = {"since": 0} if tick >= 15 else {"since": tick * 100}
        heard = [told("other", tick, tg="alpha", at=[3.0, -2.0], **since)] if tick >= 8 else []
        obs = uav.see(tick * T_NS, heard)
        track.roster.hear(obs)
        facts = track.facts(obs)
        if track.claim is None and "place" in facts:
            track.begin(obs, facts["place"])
        elif facts.get("taken"):
            assert tick == 15  # before that the other one had begun after this one
            track.end(obs)
        if "target" in (noted := track.drain_notes()):
            targets.append((tick, noted["target"]))
    assert targets == [(3, "alpha"), (15, "")]
    assert track.roster.given_up(16 * T_NS) == [pytest.approx((3.0, -2.0))]
    assert track.roster.given_up(15 * T_NS + 60_000_000_000) == []


def test_alone_it_searches_where_it_lost_the_target_and_then_gives_the_place_up() -> None:
    track = started(TrackTarget(), Eye(lambda time_s: {"alpha": (1.0, 0.0)} if time_s < 2.0 else {}))
    was = keep_over(track, Uav((0.0, 0.0, 30.0)), 200)
    lost = 1.9 + 3.0 + 10.0
    away = [math.dist(each.position[:2], (1.0, 0.0)) for each in was]
    assert max(away[20:48]) < 0.5
    assert max(away[50 : round(lost / T)]) > 3.0  # the spiral
    assert was[round(lost / T) + 2].position == was[-1].position  # then it hovers
    assert track.roster is not None
    assert track.roster.given_up(0) == [pytest.approx((1.0, 0.0))]
    assert track.claim is None


@pytest.mark.parametrize("params", [{"lost_s": 60.0}, {"spiral_s": 1.0}, {"lost_s": 0.5, "spiral_s": 60.0}])
def test_in_a_mission_it_is_lost_and_searched_for_as_long_as_the_mission_says(params: dict[str, float]) -> None:
    """Else the place would not be given up when the mission ends the search, and begun with again at once, for ever."""
    track = started(TrackTarget(**params), Eye(at_rest(alpha=(1.0, 0.0))), alone=False)  # type: ignore[arg-type]
    uav, radio = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other"))
    track.facts(uav.see(0))
    track.begin(uav.see(0), (1.0, 0.0))
    for tick in range(1, 31):
        uav.move(track.act(uav.see(tick * T_NS), radio))  # type: ignore[arg-type]
    assert track.watch is not None
    track.watch.targets = at_rest()  # type: ignore[attr-defined]  # it was seen last at 3.0 s
    away = {}
    for tick in range(31, 161):
        uav.move(track.act(uav.see(tick * T_NS), radio))  # type: ignore[arg-type]
        away[tick] = math.dist(uav.position[:2], (1.0, 0.0))
    assert max(away[tick] for tick in range(31, 60)) < 0.2
    assert all(away[tick] > 2.0 for tick in range(100, 160))
    track.end(uav.see(160 * T_NS))
    assert track.roster is not None
    assert track.roster.given_up(0) == [pytest.approx((1.0, 0.0))]


def test_it_may_be_started_again_and_knows_nothing_of_what_was_before() -> None:
    track, ways = TrackTarget(), []
    for _ in range(2):
        track.watch = Eye(lambda time_s: {"alpha": (3.0, -2.0)} if time_s < 2.0 else {})  # type: ignore[assignment]
        track.start(info("me", ("me", "other"), body=BODY))
        ways.append(keep_over(track, Uav((0.0, 0.0, 30.0)), 200))
        assert track.roster is not None
        assert len(track.roster.given_up(0)) == 1
    assert ways[0] == ways[1]


def test_it_tells_others_what_it_tracks() -> None:
    track, radio = started(TrackTarget(), Eye(at_rest(alpha=(3.0, -2.0)))), Radio("me", ("me", "other"))
    uav = Uav((0.0, 0.0, 30.0))
    other = Roster("other", ("me", "other"))
    for tick in range(5):
        track.act(uav.see(tick * T_NS), radio)
        other.hear(uav.see(tick * T_NS, [received(each) for each in radio.drain()]))
    claim = other.claims(5 * T_NS)["me"]
    assert claim.target == "alpha"
    assert claim.place == pytest.approx((3.0, -2.0))


# --- a target that only the map knows -----------------------------------------------------------------------------------------


def test_nobody_loses_a_target_on_the_way_to_where_it_is_said_to_be() -> None:
    track = started(TrackTarget(), Eye(at_rest()), alone=False)
    uav, radio = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other"))
    track.facts(uav.see(0))
    track.begin(uav.see(0), (60.0, 0.0))
    arrived = None
    for tick in range(1, 400):
        obs = uav.see(tick * T_NS)
        seen_ns = track.facts(obs)["seen_ns"]
        if math.dist(uav.position[:2], (60.0, 0.0)) > 2.0 and arrived is None:
            assert obs.time_ns - seen_ns <= T_NS
        else:
            arrived = arrived or tick
        if obs.time_ns - seen_ns >= 3_000_000_000:
            break
        uav.move(track.act(obs, radio))  # type: ignore[arg-type]
    assert arrived is not None
    assert 29 <= tick - arrived <= 31


def test_the_way_to_a_reported_place_has_a_time_limit() -> None:
    track = started(TrackTarget(max_speed=4.0), Eye(at_rest()), alone=False)
    uav = Uav((0.0, 0.0, 30.0))
    track.facts(uav.see(0))
    track.begin(uav.see(0), (60.0, 0.0))
    seen = [track.facts(uav.see(tick * T_NS))["seen_ns"] for tick in range(1, 400)]
    assert max(seen) == pytest.approx(2.0 * 60.0 / 4.0 * 1e9, abs=1.01 * T_NS)


def test_it_learns_which_one_it_is_when_it_sees_it() -> None:
    track = started(TrackTarget(), Eye(at_rest(bravo=(0.5, 30.0))), alone=False)
    uav, radio, targets = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other")), []
    track.facts(uav.see(0))
    track.begin(uav.see(0), (0.0, 30.0))
    assert track.claim is not None
    assert track.claim.target == ""
    for tick in range(1, 150):
        obs = uav.see(tick * T_NS)
        track.facts(obs)
        targets += [each for key, each in track.drain_notes().items() if key == "target"]
        uav.move(track.act(obs, radio))  # type: ignore[arg-type]
    assert targets == ["bravo"]
    assert track.claim.target == "bravo"
    assert uav.position[:2] == pytest.approx((0.5, 30.0), abs=1e-2)


# --- in a scenario ------------------------------------------------------------------------------------------------------------


def test_alone_it_hovers_where_it_began() -> None:
    track, uav = started(TrackTarget(height=25.0), Eye(at_rest())), Uav((1.0, 2.0, 30.0))
    assert track.act(uav.see(0), Radio("me", ("me", "other"))) == Waypoint(position=(1.0, 2.0, 25.0))


@pytest.mark.parametrize(
    ("params", "key", "words"),
    [
        ({"needed": 6}, "needed", "at most frames = 5"),
        ({"mosaic": {"area": [0.0, 0.0, 0.0, 1.0]}}, "mosaic.area", "right must be greater than left"),
        ({"mosaic": {"area": [0.0, 0.0, 9e4, 9e4]}}, "mosaic.cell_m", "million cells"),
        ({"watching": {"targets": []}}, "watching.targets", "at least one target"),
        (
            {"watching": {"targets": [{"name": "a", "picture": "no.png"}]}},
            "watching.targets[0].picture",
            "cannot read the picture of a",
        ),
        ({}, "", "watching is missing"),
    ],
)
def test_what_is_wrong_is_said_with_its_key(params: dict[str, Any], key: str, words: str) -> None:
    scenario = {
        "name": "x",
        "duration_s": 1.0,
        "vehicle": [{"name": "u", "kind": "point", "position": [0.0, 0.0, 9.0], "agent": {"kind": "track", **params}}],
    }
    with pytest.raises(ScenarioError, match=words) as raised:
        vcmvsp.run(scenario)
    assert raised.value.key == f"vehicle.u.agent.{key}".rstrip(".")
