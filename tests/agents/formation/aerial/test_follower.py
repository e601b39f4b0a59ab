"""Followers in the air: the law in closed form, teams, and what they do when nobody is heard."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.aerial_loop import BODY, Drifter, T, Uav, fly, ring
from tests.support.agents.agent_loop import received
from vcmvsp.agents.avoidance import PotentialField
from vcmvsp.agents.formation.aerial.follower import AerialFollower
from vcmvsp.agents.formation.aerial.route import AerialRoute
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.cosim.agent import Agent, Body, Radio, VehicleInfo
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Message, Reception, Vec3

SPEEDS = st.floats(-3.0, 3.0)
POINTS = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 3))


# --- the follower ---


@settings(max_examples=25)
@given(
    velocity=st.tuples(SPEEDS, SPEEDS, st.floats(-0.5, 0.5)),
    th=SPEEDS,
    slot=POINTS,
    off=POINTS,
    gain=st.floats(0.2, 3.0),
)
def test_the_error_decays_as_the_law_says(velocity: Vec3, th: float, slot: Vec3, off: Vec3, gain: float) -> None:
    """Sampled, z[n+1] = (1 - gain T) z[n], from the first report on: velocities are constant, so dr makes no error."""
    x, y = rotate2(slot[0], slot[1], th)
    place = (x, y, 5.0 + slot[2])
    follower = AerialFollower("lead", slot, gain=gain)
    start = Uav((place[0] + off[0], place[1] + off[1], place[2] + off[2]))
    seen = fly({"lead": Drifter(velocity), "f": follower}, [Uav((0.0, 0.0, 5.0), th), start], 60)
    z = np.array(seen.position["f"]) - np.array(seen.position["lead"]) - np.array(place) + np.array([0.0, 0.0, 5.0])
    expected = z[1] * (1.0 - gain * T) ** np.arange(59)[:, None]
    assert z[1:] == pytest.approx(expected, abs=1e-9)
    believed = [note["error_m"] for note in seen.notes["f"][1:]]
    assert believed == pytest.approx(np.linalg.norm(z[1:], axis=1), abs=1e-9)
    assert seen.notes["f"][1]["age_s"] == pytest.approx(T)
    assert follower.follows is not None
    assert (follower.follows.slot, follower.follows.handle_m) == (slot[:2], 0.0)


def test_its_place_goes_round_with_the_leaders_heading() -> None:
    follower = AerialFollower("lead", (-1.0, 0.5, 0.3), heading="leader")
    starts = [Uav((0.0, 0.0, 2.0)), Uav((-1.0, 0.5, 2.3))]
    seen = fly({"lead": Drifter((0.2, 0.0, 0.0), yaw_rate=0.3), "f": follower}, starts, 300)
    for own, lead, yaw, of in zip(
        seen.position["f"][100:], seen.position["lead"][100:], seen.yaw["f"][100:], seen.yaw["lead"][100:], strict=True
    ):
        slot = rotate2(-1.0, 0.5, of)
        error = math.hypot(own[0] - lead[0] - slot[0], own[1] - lead[1] - slot[1])
        # Velocities are held for a period in which the place's turns: it moves on a chord of it, less than half way off.
        assert error < 0.5 * 0.3**2 * math.hypot(1.0, 0.5) * T / 0.8
        assert math.cos(yaw - of) > 1.0 - 1e-6


def test_one_in_the_air_follows_one_on_wheels() -> None:
    names = ("car", "uav")
    car, follower = Trajectory(path="circle", speed=0.3, yaw_rate=0.15), AerialFollower("car", (-0.5, 0.0, 2.0))
    radio = Radio("car", names)
    for name, agent in zip(names, (car, follower), strict=True):
        agent.start(VehicleInfo(name=name, vehicles=names, period_s=T, latency_s=0.0, seed=1))
    car.act(Uav((0.0, 0.0, 0.0), 0.7).see(0), radio)
    (message,) = radio.drain()
    heard = Uav((5.0, 5.0, 1.0)).see(10**8, [received(message)])
    command = follower.act(heard, Radio("uav", names))
    x, y, th = 0.3 * T * math.cos(0.7 + 0.0075), 0.3 * T * math.sin(0.7 + 0.0075), 0.7 + 0.015
    slot = rotate2(-0.5, 0.0, th)
    expected = (
        0.3 * math.cos(th) - 0.15 * slot[1] + 0.8 * (x + slot[0] - 5.0),
        0.3 * math.sin(th) + 0.15 * slot[0] + 0.8 * (y + slot[1] - 5.0),
        0.8 * (2.0 - 1.0),
    )
    assert command.linear == pytest.approx(expected, abs=1e-6)


def test_it_hovers_until_it_hears_and_when_it_hears_no_more() -> None:
    follower = AerialFollower("lead", (-1.0, 0.0, 0.0), timeout_s=1.0, fade_s=0.5, horizon_s=5.0)
    starts = [Uav((0.0, 0.0, 2.0)), Uav((-1.0, 0.0, 2.0))]
    agents: dict[str, Agent] = {"lead": Drifter((0.3, 0.0, 0.0)), "f": follower}
    seen = fly(agents, starts, 60, lost=lambda tick, sender: tick < 5 or tick >= 20)
    status = [note["status"] for note in seen.notes["f"]]
    assert status == ["waiting"] * 6 + ["following"] * 23 + ["leader lost"] * 31  # the last report is of 1.9 s
    speed = [math.hypot(*each.linear) for each in seen.commands["f"]]
    assert speed[:6] == [0.0] * 6
    left = np.clip(1.0 - np.arange(31) * T / 0.5, 0.0, 1.0)
    assert speed[29:] == pytest.approx(speed[28] * left, abs=1e-9)


def test_one_that_was_busy_otherwise_stops_from_how_it_moves_and_not_from_what_it_was_told_long_ago() -> None:
    follower, radio = AerialFollower("lead", (-2.0, 0.0, 0.0), fade_s=1.0), Radio("f", ("lead", "f"))
    uav = Uav((-2.0, 0.0, 5.0))
    follower.start(VehicleInfo(name="f", vehicles=("lead", "f"), period_s=T, latency_s=0.0, seed=1, body=BODY))
    report = {"seq": 0, "t_ns": 0, "x": 0.0, "y": 0.0, "z": 5.0, "th": 0.0, "v": 4.0, "w": 0.0, "vx": 4.0, "vy": 0.0, "vz": 0.0}
    heard = received(Message(sender="lead", body=report, size_bytes=9))
    assert follower.act(uav.see(0, [heard]), radio).linear == (4.0, 0.0, 0.0)
    uav.velocity = (0.0, -1.0, 0.0)
    for tick in range(1, 50):
        follower.stand_by(uav.see(tick * 100_000_000), radio)
    assert not radio.drain()
    fading = [follower.act(uav.see(tick * 100_000_000), radio).linear for tick in range(50, 62)]
    assert [vy for _, vy, _ in fading] == pytest.approx([-max(0.0, 1.0 - 0.1 * n) for n in range(12)])
    assert {(vx, vz) for vx, _, vz in fading} == {(0.0, 0.0)}


def test_it_goes_no_faster_than_it_may() -> None:
    follower = AerialFollower("lead", (0.0, 0.0, 0.0), max_speed=0.6)
    seen = fly({"lead": Drifter((0.3, 0.0, 0.0)), "f": follower}, [Uav((9.0, 5.0, 2.0)), Uav((0.0, 0.0, 1.0))], 30)
    assert [math.hypot(*each.linear) for each in seen.commands["f"][1:]] == pytest.approx([0.6] * 29)


# --- teams ---


def team(shape: Any = "wedge", **more: Any) -> tuple[dict[str, Agent], list[Uav]]:
    formation = Formation(shape=shape, spacing=2.0, **more)
    agents: dict[str, Agent] = {"a": AerialRoute(course_deg=0.0, formation=formation)}
    agents |= {name: AerialFollower(formation=formation, above=0.5, heartbeat_s=1.0) for name in "bc"}
    return agents, [Uav((0.0, 0.0, 2.0)), Uav((-1.7, -1.0, 2.0)), Uav((-1.7, 1.0, 2.0))]


def test_a_team_flies_its_shape_and_changes_it_when_the_leader_says_so() -> None:
    agents, starts = team(changes=((10.0, "column"),))
    seen = fly(agents, starts, 300)
    for tick, places in ((95, [(-math.sqrt(3.0), -1.0), (-math.sqrt(3.0), 1.0)]), (299, [(-2.0, 0.0), (-4.0, 0.0)])):
        lead = seen.position["a"][tick]
        own = sorted((seen.position[name][tick][0] - lead[0], seen.position[name][tick][1] - lead[1]) for name in "bc")
        assert np.array(own) == pytest.approx(np.array(sorted(places)), abs=1e-3)
        assert [seen.position[name][tick][2] for name in "bc"] == pytest.approx([2.5, 2.5], abs=1e-3)
    assert [note["shape"] for note in seen.notes["b"] if "shape" in note] == ["wedge", "column"]


def test_members_keep_off_each_other_though_they_are_to_pass_through() -> None:
    """One that hovers in the way is no wall of the lane, but it is something to keep off, as it is without a passage."""
    names, commands = ("a", "b", "c"), []
    near = ring([0.3, *[math.inf] * 31], 10**8)  # the hull of c
    for passage in (None, Passage()):
        of = Formation(spacing=2.0, members=names, passage=passage)
        radio = Radio("b", names)
        follower = AerialFollower(formation=of, max_speed=0.6, broadcast=True, avoidance=PotentialField())
        follower.start(VehicleInfo(name="b", vehicles=names, period_s=T, latency_s=0.0, seed=1, body=BODY, sensors=("scan",)))
        heard = [reported("a", 5.0, 1.0), reported("c", 0.55, 0.0)]
        commands.append(follower.act(Uav((0.0, 0.0, 2.0)).see(10**8, heard, scan=near), radio).linear)
    assert commands[0] == commands[1]
    assert commands[1][0] <= 0.0


def reported(sender: str, x: float, y: float) -> Reception:
    body = {**dict.fromkeys(("seq", "t_ns"), 0), **dict.fromkeys(("th", "v", "w", "vx", "vy", "vz"), 0.0)}
    return received(Message(sender=sender, body={**body, "x": x, "y": y, "z": 2.0, "cl": 1}, size_bytes=9))


# --- what cannot be ---


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "leader.* unless there is a formation"),
        ({"leader": "a", "formation": Formation()}, "the formation says whom this vehicle follows"),
        ({"leader": "a"}, "slot says where to be"),
        ({"formation": Formation(), "slot": (0.0, 0.0, 0.0)}, "slot says where to be"),
        ({"leader": "a", "slot": (0.0, 0.0, 0.0), "above": 1.0}, "above needs a formation"),
        ({"leader": "a", "slot": (0.0, 0.0, 0.0), "heartbeat_s": 1.0}, "heartbeat_s needs a formation"),
        ({"formation": Formation(passage=Passage()), "broadcast": False}, "broadcast = false"),
        ({"formation": Formation(), "heartbeat_s": 1.0, "sending": Sending(when="needed")}, "heartbeat_s = 1.0 s"),
    ],
)
def test_a_follower_that_is_told_nonsense_says_so(given: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, ScenarioError), match=words):
        AerialFollower(**given)


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        (AerialFollower("nobody", (0.0, 0.0, 0.0)), "not another vehicle of this run"),
        (AerialFollower(formation=Formation()), "leads it: give it an agent that leads"),
    ],
)
def test_a_follower_that_has_nobody_to_follow_says_so(agent: AerialFollower, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        agent.start(VehicleInfo(name="a", vehicles=("a", "b"), period_s=T, latency_s=0.0, seed=1))


@pytest.mark.parametrize("agent", [AerialRoute(course_deg=0.0), AerialFollower("b", (0.0, 0.0, 0.0))])
def test_a_vehicle_on_wheels_is_refused(agent: Agent) -> None:
    wheels = Body(width_m=0.3, radius_m=0.2)
    with pytest.raises(ValueError, match="a drives on wheels, but this agent is for vehicles that fly"):
        agent.start(VehicleInfo(name="a", vehicles=("a", "b"), period_s=T, latency_s=0.0, seed=1, body=wheels))
