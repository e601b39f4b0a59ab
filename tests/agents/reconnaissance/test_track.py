"""An agent that recognises and tracks: laws of the closed loop, ownership of targets, and messages."""

import math
from itertools import pairwise
from typing import Any

import pytest

import vcmvsp
from tests.support.agents.aerial_loop import BODY
from tests.support.agents.agent_loop import T, Uav, info, present, reception_of, reception_of_body
from tests.support.agents.fake_cameras import T_NS, FakeWatch, at_rest, positions_over, started_agent
from vcmvsp.agents.reconnaissance.roster import Roster
from vcmvsp.agents.reconnaissance.track import CLIMB, TrackTarget
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Reception, Waypoint


def claim_from(sender: str, tick: int, **body: Any) -> Reception:
    return reception_of_body(sender, {"do": "track", "ms": tick * 100, **body})


# --- the loop ---


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0, -3.0])
def test_the_offset_shrinks_by_0_92_a_tick_at_any_yaw_once_the_target_is_confirmed(yaw: float) -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0))))
    was = positions_over(track, Uav((0.0, 0.0, 30.0), yaw), 40)
    assert [each.position for each in was[:3]] == [(0.0, 0.0, 30.0)] * 3  # hovers until the third picture
    for before, after in pairwise(was[2:]):
        shares = [(t - b) / (t - a) for t, a, b in zip((3.0, -2.0), before.position[:2], after.position[:2], strict=True)]
        assert shares == pytest.approx([0.92, 0.92], abs=1e-6)
    assert {each.position[2] for each in was} == {30.0}
    assert {each.yaw for each in was} == {yaw}


@pytest.mark.parametrize(("smoothing", "lag", "within"), [(0.0, 0.625, 1e-6), (0.2, 0.0, 1e-3)])
def test_behind_a_target_at_half_a_metre_a_second_it_lags_by_v_over_k_without_speed_estimate(
    smoothing: float, lag: float, within: float
) -> None:
    track = started_agent(TrackTarget(smoothing=smoothing), FakeWatch(lambda time_s: {"alpha": (0.5 * time_s, 1.0)}))
    was = positions_over(track, Uav((0.0, 0.0, 30.0), 1.0), 300)
    for tick in range(200, 300):
        assert 0.5 * tick * T - was[tick].position[0] == pytest.approx(lag, abs=within)
        assert was[tick].position[1] == pytest.approx(1.0, abs=1e-6)


def test_it_converges_with_every_fifth_picture() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0)), every=5))
    was = positions_over(track, Uav((0.0, 0.0, 30.0)), 120)
    assert was[-1].position == pytest.approx((3.0, -2.0, 30.0), abs=1e-3)


def test_its_climb_to_its_height_is_limited() -> None:
    track = started_agent(TrackTarget(height=20.0), FakeWatch(at_rest(alpha=(0.0, 0.0))))
    was = positions_over(track, Uav((0.0, 0.0, 30.0)), 300)
    heights = [each.position[2] for each in was]
    assert max(abs(b - a) for a, b in pairwise(heights)) <= CLIMB * T + 1e-9
    assert heights[-1] == pytest.approx(20.0, abs=1e-3)


@pytest.mark.parametrize(("gain", "latency"), [(20.1, 0.0), (0.77, 2.0), (1.02, 1.5)])
def test_a_gain_unstable_with_the_latency_is_refused(gain: float, latency: float) -> None:
    track = TrackTarget(gain=gain)
    track.watch = FakeWatch(at_rest())  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"gain = .*must lie between 0 and"):
        track.start(info("me", ("me",), latency_s=latency, body=BODY))
    stable = TrackTarget(gain=0.99 * gain)
    stable.watch = track.watch
    stable.start(info("me", ("me",), latency_s=latency, body=BODY))


# --- ownership of targets ---


def test_a_confirmed_target_is_a_fact_and_noted_once() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0))), alone=False)
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


def test_of_two_targets_the_nearest_is_found_first() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(5.0, 0.0), bravo=(0.0, 4.0))), alone=False)
    uav, found = Uav((0.0, 0.0, 30.0)), []
    for tick in range(5):
        track.facts(uav.see(tick * T_NS))
        found.append(track.drain_notes().get("found"))
    assert found == [None, None, "bravo", "alpha", None]


@pytest.mark.parametrize(
    ("name", "place", "is_taken"),
    [
        ("alpha", (15.0, 0.0), True),
        ("alpha", (90.0, 0.0), False),  # another target with equal looks
        ("", (3.0, 0.0), False),  # claim from the map, without a detection
        ("bravo", (3.0, 0.0), False),
    ],
)
def test_a_target_tracked_by_another_is_not_recognised(name: str, place: tuple[float, float], is_taken: bool) -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0))), alone=False)
    uav, facts = Uav((0.0, 0.0, 30.0)), []
    notes: list[str] = []
    for tick in range(1, 8):
        obs = uav.see(tick * T_NS, [claim_from("other", tick, tg=name, at=list(place), since=0)])
        present(track.roster).hear(obs)
        facts.append(track.facts(obs))
        notes += track.drain_notes()
    assert any("recognised" in each for each in facts) == ("found" in notes) == (not is_taken)


def test_the_later_claim_yields_and_the_place_is_given_up_for_a_minute() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0))), alone=False)
    uav, roster, targets = Uav((0.0, 0.0, 30.0)), present(track.roster), []
    for tick in range(1, 21):
        since = {"since": 0} if tick >= 15 else {"since": tick * 100}
        receptions = [claim_from("other", tick, tg="alpha", at=[3.0, -2.0], **since)] if tick >= 8 else []
        obs = uav.see(tick * T_NS, receptions)
        roster.hear(obs)
        facts = track.facts(obs)
        if track.claim is None and "place" in facts:
            track.begin(obs, facts["place"])
        elif facts.get("taken"):
            assert tick == 15  # until then the other claim was the later one
            track.end(obs)
        if "target" in (noted := track.drain_notes()):
            targets.append((tick, noted["target"]))
    assert targets == [(3, "alpha"), (15, "")]
    assert roster.abandoned_places(16 * T_NS) == [pytest.approx((3.0, -2.0))]
    assert roster.abandoned_places(15 * T_NS + 60_000_000_000) == []


def test_alone_it_searches_for_a_lost_target_and_then_gives_the_place_up() -> None:
    track = started_agent(TrackTarget(), FakeWatch(lambda time_s: {"alpha": (1.0, 0.0)} if time_s < 2.0 else {}))
    was = positions_over(track, Uav((0.0, 0.0, 30.0)), 200)
    lost = 1.9 + 3.0 + 10.0
    away = [math.dist(each.position[:2], (1.0, 0.0)) for each in was]
    assert max(away[20:48]) < 0.5
    assert max(away[50 : round(lost / T)]) > 3.0  # the spiral
    assert was[round(lost / T) + 2].position == was[-1].position  # then hovering
    assert present(track.roster).abandoned_places(0) == [pytest.approx((1.0, 0.0))]
    assert track.claim is None


@pytest.mark.parametrize("params", [{"lost_s": 60.0}, {"spiral_s": 1.0}, {"lost_s": 0.5, "spiral_s": 60.0}])
def test_in_a_mission_the_mission_times_loss_and_search(params: dict[str, float]) -> None:
    """Otherwise the place would not be given up at the end of the search, and would be searched again at once, for ever."""
    eye = FakeWatch(lambda time_s: {"alpha": (1.0, 0.0)} if time_s < 3.05 else {})  # seen last at 3.0 s
    track = started_agent(TrackTarget(**params), eye, alone=False)  # type: ignore[arg-type]
    uav, radio, away = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other")), {}
    track.facts(uav.see(0))
    track.begin(uav.see(0), (1.0, 0.0))
    for tick in range(1, 161):
        uav.move(track.act(uav.see(tick * T_NS), radio))  # type: ignore[arg-type]
        away[tick] = math.dist(uav.position[:2], (1.0, 0.0))
    assert max(away[tick] for tick in range(31, 60)) < 0.2
    assert all(away[tick] > 2.0 for tick in range(100, 160))
    track.end(uav.see(160 * T_NS))
    assert present(track.roster).abandoned_places(0) == [pytest.approx((1.0, 0.0))]


def test_a_second_start_repeats_the_first_run() -> None:
    track, ways = TrackTarget(), []
    for _ in range(2):
        track.watch = FakeWatch(lambda time_s: {"alpha": (3.0, -2.0)} if time_s < 2.0 else {})  # type: ignore[assignment]
        track.start(info("me", ("me", "other"), body=BODY))
        ways.append(positions_over(track, Uav((0.0, 0.0, 30.0)), 200))
        assert len(present(track.roster).abandoned_places(0)) == 1
    assert ways[0] == ways[1]


def test_it_sends_its_claim() -> None:
    track, radio = started_agent(TrackTarget(), FakeWatch(at_rest(alpha=(3.0, -2.0)))), Radio("me", ("me", "other"))
    uav = Uav((0.0, 0.0, 30.0))
    other = Roster("other", ("me", "other"))
    for tick in range(5):
        track.act(uav.see(tick * T_NS), radio)
        other.hear(uav.see(tick * T_NS, [reception_of(each) for each in radio.drain()]))
    claim = other.claims(5 * T_NS)["me"]
    assert claim.target == "alpha"
    assert claim.place == pytest.approx((3.0, -2.0))


# --- a target known from the map only ---


def test_a_target_is_not_lost_on_the_way_to_its_reported_place() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest()), alone=False)
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
    assert 29 <= tick - present(arrived) <= 31


def test_the_way_to_a_reported_place_has_a_time_limit() -> None:
    track = started_agent(TrackTarget(max_speed=4.0), FakeWatch(at_rest()), alone=False)
    uav = Uav((0.0, 0.0, 30.0))
    track.facts(uav.see(0))
    track.begin(uav.see(0), (60.0, 0.0))
    times_ns = [track.facts(uav.see(tick * T_NS))["seen_ns"] for tick in range(1, 400)]
    assert max(times_ns) == pytest.approx(2.0 * 60.0 / 4.0 * 1e9, abs=1.01 * T_NS)


def test_the_claim_gets_its_name_with_the_first_detection() -> None:
    track = started_agent(TrackTarget(), FakeWatch(at_rest(bravo=(0.5, 30.0))), alone=False)
    uav, radio, targets = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other")), []
    track.facts(uav.see(0))
    track.begin(uav.see(0), (0.0, 30.0))
    assert present(track.claim).target == ""
    for tick in range(1, 150):
        obs = uav.see(tick * T_NS)
        track.facts(obs)
        targets += [each for key, each in track.drain_notes().items() if key == "target"]
        uav.move(track.act(obs, radio))  # type: ignore[arg-type]
    assert targets == ["bravo"]
    assert present(track.claim).target == "bravo"
    assert uav.position[:2] == pytest.approx((0.5, 30.0), abs=1e-2)


# --- in a scenario ---


def test_alone_it_hovers_where_it_began() -> None:
    track, uav = started_agent(TrackTarget(height=25.0), FakeWatch(at_rest())), Uav((1.0, 2.0, 30.0))
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
def test_errors_name_the_key(params: dict[str, Any], key: str, words: str) -> None:
    scenario = {
        "name": "x",
        "duration_s": 1.0,
        "vehicle": [{"name": "u", "kind": "point", "position": [0.0, 0.0, 9.0], "agent": {"kind": "track", **params}}],
    }
    with pytest.raises(ScenarioError, match=words) as raised:
        vcmvsp.run(scenario)
    assert raised.value.key == f"vehicle.u.agent.{key}".rstrip(".")
