"""Where an agent that tracks looks, while it commands and while it does not, and what it shows of it."""

import pytest

from tests.support.agents.aerial_loop import Uav
from tests.support.agents.fake_cameras import T_NS, Eye, at_rest, keep_over, started
from vcmvsp.agents.reconnaissance.picture_recording import Mosaicking
from vcmvsp.agents.reconnaissance.probability_map import Rectangle
from vcmvsp.agents.reconnaissance.track import TrackTarget
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Mosaic, Sightings, Velocity


def test_while_it_sees_its_target_it_looks_around_it_and_at_all_of_the_picture_every_second() -> None:
    eye = Eye(lambda time_s: {"alpha": (1.0, 0.0)} if time_s < 4.0 else {})
    keep_over(started(TrackTarget(), eye), Uav((0.0, 0.0, 30.0)), 80)
    assert eye.regions[:3] == [None] * 3
    tracked = eye.regions[3:40]
    assert 3 <= tracked.count(None) <= 4
    assert all(each is None or (each.place == pytest.approx((1.0, 0.0)) and each.reach_m >= 2.0) for each in tracked)
    assert eye.regions[72:] == [None] * 8  # lost: it may be anywhere


def test_others_are_found_while_it_tracks_one() -> None:
    track = started(
        TrackTarget(), Eye(lambda time_s: {"alpha": (1.0, 0.0), "bravo": (9.0, 3.0)} if time_s > 2.0 else {"alpha": (1.0, 0.0)})
    )
    uav, radio, found = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other")), {}
    for tick in range(80):
        uav.move(command) if isinstance(command := track.act(uav.see(tick * T_NS), radio), Velocity) else None
        if name := track.drain_notes().get("found"):
            found[name] = tick
    assert found["alpha"] == 2
    assert 40 <= found["bravo"] <= 55  # three pictures, a second apart
    assert track.claim is not None
    assert track.claim.target == "alpha"


def test_standing_by_it_goes_on_seeing() -> None:
    track = started(TrackTarget(), Eye(lambda time_s: {"alpha": (0.5 * time_s, 0.0)}), alone=False)
    uav, radio = Uav((0.0, 0.0, 30.0)), Radio("me", ("me", "other"))
    for tick in range(60):
        obs = uav.see(tick * T_NS)
        if tick == 3:
            track.begin(obs, (0.0, 0.0))
        track.stand_by(obs, radio)
    assert track.goal == pytest.approx((0.5 * 5.9, 0.0), abs=1e-3)
    assert track.facts(uav.see(60 * T_NS))["seen_ns"] == 60 * T_NS
    assert radio.drain() == []


def test_every_picture_with_a_target_is_shown_and_its_pixels_once_a_second() -> None:
    track = started(TrackTarget(), Eye(lambda time_s: {"alpha": (1.0, 0.0)} if 7.0 <= time_s < 9.0 else {}), alone=False)
    uav, shown = Uav((0.0, 0.0, 30.0)), {}
    for tick in range(150):
        track.facts(uav.see(tick * T_NS))
        if (each := track.drain_shown().get("sightings")) is not None:
            assert isinstance(each, Sightings)
            assert (each.sensor, each.time_ns, each.width, each.height) == ("eye", tick * T_NS, 640, 480)
            shown[tick] = (len(each.found), each.jpeg[:2] == b"\xff\xd8")
    assert {tick for tick, each in shown.items() if each[0]} == set(range(70, 90))
    assert {tick for tick, each in shown.items() if each[1]} == {0, 50, 70, 80, 130}


def test_the_mosaic_is_shown_as_often_as_asked() -> None:
    mosaic = Mosaicking(area=Rectangle(-20.0, -20.0, 20.0, 20.0), cell_m=0.5, every_s=5.0)
    track = started(TrackTarget(mosaic=mosaic), Eye(at_rest()), alone=False)
    uav, shown = Uav((0.0, 0.0, 30.0)), []
    for tick in range(120):
        track.facts(uav.see(tick * T_NS))
        if (each := track.drain_shown().get("mosaic")) is not None:
            assert isinstance(each, Mosaic)
            assert each.pixels.shape == (80, 80, 3)
            shown.append(tick)
    assert shown == [0, 50, 100]
