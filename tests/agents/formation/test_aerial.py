"""Formations in the air: leaders, their reports, followers, and avoidance."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.aerial_loop import BODY, Drifter, fly
from tests.support.agents.agent_loop import T, Uav, info, present, reception_of, reception_of_body
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import PotentialField
from vcmvsp.agents.formation.aerial import AerialFollower, AerialRoute, Airborne
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.prediction import DeadReckoning, Hold
from vcmvsp.agents.formation.reports.report import LeaderState, Report, parse
from vcmvsp.agents.formation.reports.sending import Sending
from vcmvsp.agents.formation.team.shape import Formation, Passage
from vcmvsp.cosim.agent import Agent, Body, Radio
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Reception, Vec3

pytestmark = pytest.mark.slow

SPEEDS = st.floats(-3.0, 3.0)
POINTS = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 3))


def report(state: LeaderState, **aloft: Any) -> Report:
    return Report(0, state, aloft)


# --- contents of reports ---


@given(velocity=st.tuples(SPEEDS, SPEEDS, SPEEDS), th=SPEEDS, w=SPEEDS, age_s=st.floats(0.0, 10.0))
def test_an_old_report_is_moved_by_its_velocity_at_any_heading(velocity: Vec3, th: float, w: float, age_s: float) -> None:
    vx, vy, vz = velocity
    received = report(LeaderState(1.0, -2.0, th, 0.0, w), vx=vx, vy=vy, vz=vz, z=4.0)
    then = Airborne(DeadReckoning(horizon_s=2.0, fade_s=1.0)).flight(received, age_s)
    fading = min(max(age_s - 2.0, 0.0), 1.0)
    lasted = min(age_s, 2.0) + fading - 0.5 * fading**2  # at full speed, then with a speed that falls linearly to 0 in 1 s
    assert then.position == pytest.approx((1.0 + vx * lasted, -2.0 + vy * lasted, 4.0 + vz * lasted), abs=1e-9)
    assert then.velocity == pytest.approx([each * (1.0 - fading) for each in velocity], abs=1e-9)
    assert math.cos(then.yaw - th - w * lasted) == pytest.approx(1.0, abs=1e-9)
    held = Airborne(Hold()).flight(received, age_s)
    assert (held.position, held.velocity) == ((1.0, -2.0, 4.0), velocity)


@given(v=SPEEDS, w=SPEEDS, th=SPEEDS, age_s=st.floats(0.0, 5.0))
def test_reports_of_vehicles_on_wheels_are_estimated_as_on_wheels(v: float, w: float, th: float, age_s: float) -> None:
    received = report(LeaderState(1.0, 2.0, th, v, w))
    inner = DeadReckoning()
    expected = inner.predict(received, age_s)
    assert Airborne(inner).predict(received, age_s) == expected
    flight = Airborne(inner).flight(received, age_s)
    assert flight.position == (expected.x, expected.y, 0.0)
    assert flight.velocity == pytest.approx((expected.v * math.cos(expected.th), expected.v * math.sin(expected.th), 0.0))


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, "1", None, [1.0], 1e300])
@pytest.mark.parametrize("key", ["vx", "vy", "vz", "z"])
def test_malformed_flight_fields_are_ignored(key: str, nonsense: Any) -> None:
    aloft = {"vx": 1.0, "vy": 1.0, "vz": 1.0, "z": 1.0, key: nonsense}
    received = report(LeaderState(0.0, 0.0, 0.0, 1.0, 0.0), **aloft)
    assert Airborne(DeadReckoning()).flight(received, 1.0).position == pytest.approx((1.0, 0.0, 0.0))


def test_the_planar_estimate_follows_the_velocity() -> None:
    received = report(LeaderState(0.0, 0.0, 0.5 * math.pi, 0.0, 0.0), vx=1.0, vy=0.5, vz=0.0, z=1.0)
    assert Airborne(DeadReckoning()).predict(received, 2.0) == pytest.approx((2.0, 1.0, 0.5 * math.pi, 0.5, 0.0))


# --- the leader ---


@settings(max_examples=25)
@given(way=st.lists(POINTS, min_size=1, max_size=4), speed=st.floats(0.2, 2.0), yaw=st.floats(-3, 3), course=st.booleans())
def test_all_points_are_reached_in_straight_lines(way: list[Vec3], speed: float, yaw: float, course: bool) -> None:
    agent = AerialRoute(tuple(way), speed=speed, arrive_m=0.2, heading="course" if course else "keep")
    length = sum(math.dist(a, b) + 1.0 for a, b in zip([(0.0, 0.0, 1.0), *way], way, strict=False))
    flight = fly({"a": agent}, [Uav((0.0, 0.0, 1.0), yaw)], round((length / speed + 20.0) / T))
    points = [note["point"] for note in flight.notes["a"] if "point" in note]
    assert points[-1] == len(way)
    assert [note["status"] for note in flight.notes["a"] if "status" in note] == ["arrived"]
    assert math.dist(flight.position["a"][-1], way[-1]) < 1e-3  # it continues to the point itself
    number = 0
    for position, command, note in zip(flight.position["a"], flight.commands["a"], flight.notes["a"], strict=True):
        number = int(note.get("point", number))
        goal = way[min(number, len(way) - 1)]
        away = math.dist(position, goal)
        assert math.hypot(*command.linear) == pytest.approx(min(speed, 0.8 * away), abs=1e-9)
        expected = [(b - a) / max(away, 1e-12) for a, b in zip(position, goal, strict=True)]
        assert command.linear == pytest.approx([min(speed, 0.8 * away) * each for each in expected], abs=1e-9)
    if not course:
        assert flight.yaw["a"] == pytest.approx([yaw] * len(flight.yaw["a"]), abs=1e-9)


def test_with_heading_course_it_turns_and_reports_its_motion() -> None:
    agent = AerialRoute(course_deg=90.0, speed=0.5, heading="course", yaw_rate=0.4)
    flight = fly({"a": agent}, [Uav((0.0, 0.0, 2.0))], 150)
    assert flight.yaw["a"][-1] == pytest.approx(0.5 * math.pi, abs=1e-3)
    assert max(each.yaw_rate for each in flight.commands["a"]) == pytest.approx(0.4)
    assert flight.position["a"][-1] == pytest.approx((0.0, 149 * T * 0.5, 2.0), abs=1e-9)
    first, last = flight.messages["a"][0], flight.messages["a"][-1]
    assert (first["vx"], first["vy"], first["vz"], first["z"]) == pytest.approx((0.0, 0.5, 0.0, 2.0))
    assert (first["v"], last["v"]) == pytest.approx((0.0, 0.5), abs=1e-3)  # along its heading
    assert parse(last, 10**12) is not None
    assert [message["seq"] for message in flight.messages["a"]] == list(range(150))


def test_a_loop_repeats_and_a_loop_of_one_place_hovers() -> None:
    square = ((1.0, 0.0, 1.0), (1.0, 1.0, 1.5), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0))
    flight = fly({"a": AerialRoute(square, loop=True, speed=1.0)}, [Uav((0.0, 0.0, 1.0))], 300)
    points = [note["point"] for note in flight.notes["a"] if "point" in note]
    assert points[:9] == [0, 1, 2, 3, 0, 1, 2, 3, 0]
    still = fly({"a": AerialRoute(((0.0, 0.0, 1.0),) * 2, loop=True)}, [Uav((0.0, 0.0, 1.0))], 20)
    assert still.position["a"][-1] == (0.0, 0.0, 1.0)


def test_it_returns_to_the_height_of_its_course() -> None:
    agent = AerialRoute(course_deg=0.0, speed=0.5)
    fly({"a": agent}, [Uav((0.0, 0.0, 2.0))], 1)
    blown = agent.act(Uav((0.0, 0.0, 1.5)).see(10**9), Radio("a", ("a",)))
    assert blown.linear == pytest.approx((0.5, 0.0, 0.4))


def test_when_needed_a_straight_sideways_flight_sends_only_heartbeats() -> None:
    agent = AerialRoute(course_deg=90.0, sending=Sending(when="needed", silence_s=2.0, acknowledge=False))
    flight = fly({"a": agent}, [Uav((0.0, 0.0, 2.0))], 101)
    assert len(flight.messages["a"]) == 6  # at 0, 2, 4, ... s


def test_when_needed_reports_keep_the_height_within_the_threshold() -> None:
    """Up and down at 1 m/s: the error is at most the threshold plus the motion of a tick."""
    way = ((0.0, 0.0, 2.0), (0.0, 0.0, 0.5), (0.0, 0.0, 2.0))
    agent = AerialRoute(way, speed=1.0, arrive_m=0.2, sending=Sending(when="needed", acknowledge=False))
    flight, reckons = fly({"a": agent}, [Uav((0.0, 0.0, 1.0))], 60), Airborne(DeadReckoning())
    reports = [received for body in flight.messages["a"] if (received := parse(body, 10**12)) is not None]
    for tick, (_, _, z) in enumerate(flight.position["a"]):
        newest = [each for each in reports if each.t_ns <= tick * 10**8][-1]
        assert abs(reckons.flight(newest, tick * T - newest.t_ns / 1e9).position[2] - z) <= 0.02
    assert len(reports) < 50


@pytest.mark.parametrize("estimator", ["acc", "plan"])
def test_estimators_for_wheels_are_refused(estimator: str) -> None:
    with pytest.raises(ScenarioError, match=f"estimator: '{estimator}' is for vehicles on wheels; choose 'hold' or 'dr'"):
        AerialRoute(course_deg=0.0, estimator=estimator)


def test_straight_up_or_down_it_keeps_its_course_despite_position_noise() -> None:
    """Position errors of 5 cm turn the bearing of the next point to all sides: while climbing, and on the last 30 cm."""
    rng = np.random.default_rng(1)
    agent, radio = AerialRoute(((2.0, 2.0, 1.0), (2.0, 2.0, 9.0), (0.0, 2.0, 9.0)), heading="course"), Radio("a", ("a",))
    agent.start(info(body=BODY))
    course = math.atan2(2.0, 2.0)

    def turns(at: Vec3, yaw_rate: float, ticks: int = 30) -> None:
        for tick in range(ticks):
            x, y, z = (place + error for place, error in zip(at, rng.normal(0.0, 0.05, 3), strict=True))
            assert agent.act(Uav((x, y, z), course).see(tick * 10**8), radio).yaw_rate == pytest.approx(yaw_rate, abs=0.06)

    agent.act(Uav((0.0, 0.0, 1.0), course).see(0), radio)
    turns((1.75, 1.75, 1.0), 0.0)
    agent.act(Uav((2.0, 2.0, 1.0), course).see(0), radio)
    turns((2.0, 2.0, 4.0), 0.0)
    agent.act(Uav((2.0, 2.0, 9.0), course).see(0), radio)
    turns((1.0, 2.0, 9.0), 1.0)  # westwards


@pytest.mark.parametrize("way", [{}, {"way": ((0.0, 0.0, 1.0),), "course_deg": 0.0}])
def test_either_a_way_or_a_course(way: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"either way .at least one point. or course_deg"):
        AerialRoute(**way)


# --- avoidance ---


@given(turn=st.integers(0, 31), at=st.integers(0, 31), near=st.floats(0.7, 1.1))
def test_the_push_in_the_world_does_not_depend_on_the_heading(turn: int, at: int, near: float) -> None:
    step = math.tau / 32
    commands = []
    for heading in (0, turn):
        ranges = [math.inf] * 32
        ranges[(at - heading) % 32] = near
        agent = AerialRoute(course_deg=0.0, avoidance=PotentialField(level=1, tang=0.0))
        agent.start(info(body=BODY, sensors=("scan",)))
        commands.append(agent.act(Uav((0.0, 0.0, 2.0), heading * step).see(0, scan=ring(ranges)), Radio("a", ("a",))))
    push = 0.1 * (1.2 - max(near, 0.65)) / (max(near, 0.65) - 0.6)
    velocity = (0.3 - push * math.cos(at * step), -push * math.sin(at * step))
    share = min(1.0, 0.6 / math.hypot(*velocity))
    for command in commands:
        assert command.linear == pytest.approx((share * velocity[0], share * velocity[1], 0.0), abs=1e-9)


def test_without_a_scan_a_vehicle_does_not_climb() -> None:
    agent = AerialRoute(((5.0, 0.0, 9.0),), avoidance=PotentialField())
    agent.start(info(body=BODY, sensors=("scan",)))
    command = agent.act(Uav((0.0, 0.0, 2.0)).see(0), Radio("a", ("a",)))
    assert command.linear == (0.0, 0.0, 0.0)
    assert agent.drain_notes()["mode"] == "blind"
    assert agent.sensors == ("scan",)


# --- followers: the law in closed form, teams, and loss of reception ---


@settings(max_examples=25)
@given(
    velocity=st.tuples(SPEEDS, SPEEDS, st.floats(-0.5, 0.5)),
    th=SPEEDS,
    slot=POINTS,
    off=POINTS,
    gain=st.floats(0.2, 3.0),
)
def test_the_error_decays_by_the_law(velocity: Vec3, th: float, slot: Vec3, off: Vec3, gain: float) -> None:
    """Sampled, z[n+1] = (1 - gain T) z[n] from the first report on; velocities are constant, so that dr has no error."""
    x, y = rotate2(slot[0], slot[1], th)
    place = (x, y, 5.0 + slot[2])
    follower = AerialFollower("lead", slot, gain=gain)
    start = Uav((place[0] + off[0], place[1] + off[1], place[2] + off[2]))
    flight = fly({"lead": Drifter(velocity), "f": follower}, [Uav((0.0, 0.0, 5.0), th), start], 60)
    z = np.array(flight.position["f"]) - np.array(flight.position["lead"]) - np.array(place) + np.array([0.0, 0.0, 5.0])
    expected = z[1] * (1.0 - gain * T) ** np.arange(59)[:, None]
    assert z[1:] == pytest.approx(expected, abs=1e-9)
    believed = [note["error_m"] for note in flight.notes["f"][1:]]
    assert believed == pytest.approx(np.linalg.norm(z[1:], axis=1), abs=1e-9)
    assert flight.notes["f"][1]["age_s"] == pytest.approx(T)
    follows = present(follower.follows)
    assert (follows.slot, follows.handle_m) == (slot[:2], 0.0)


def test_its_slot_turns_with_the_leaders_heading() -> None:
    follower = AerialFollower("lead", (-1.0, 0.5, 0.3), heading="leader")
    starts = [Uav((0.0, 0.0, 2.0)), Uav((-1.0, 0.5, 2.3))]
    flight = fly({"lead": Drifter((0.2, 0.0, 0.0), yaw_rate=0.3), "f": follower}, starts, 300)
    for own, lead, yaw, of in zip(
        flight.position["f"][100:], flight.position["lead"][100:], flight.yaw["f"][100:], flight.yaw["lead"][100:], strict=True
    ):
        slot = rotate2(-1.0, 0.5, of)
        error = math.hypot(own[0] - lead[0] - slot[0], own[1] - lead[1] - slot[1])
        # Velocities are held for a period, while that of the slot turns: the follower moves on a chord, off by less than half
        # of it.
        assert error < 0.5 * 0.3**2 * math.hypot(1.0, 0.5) * T / 0.8
        assert math.cos(yaw - of) > 1.0 - 1e-6


def test_a_flying_vehicle_follows_one_on_wheels() -> None:
    names = ("car", "uav")
    car, follower = Trajectory(path="circle", speed=0.3, yaw_rate=0.15), AerialFollower("car", (-0.5, 0.0, 2.0))
    radio = Radio("car", names)
    for name, agent in zip(names, (car, follower), strict=True):
        agent.start(info(name, names))
    car.act(Uav((0.0, 0.0, 0.0), 0.7).see(0), radio)
    (message,) = radio.drain()
    obs = Uav((5.0, 5.0, 1.0)).see(10**8, [reception_of(message)])
    command = follower.act(obs, Radio("uav", names))
    x, y, th = 0.3 * T * math.cos(0.7 + 0.0075), 0.3 * T * math.sin(0.7 + 0.0075), 0.7 + 0.015
    slot = rotate2(-0.5, 0.0, th)
    expected = (
        0.3 * math.cos(th) - 0.15 * slot[1] + 0.8 * (x + slot[0] - 5.0),
        0.3 * math.sin(th) + 0.15 * slot[0] + 0.8 * (y + slot[1] - 5.0),
        0.8 * (2.0 - 1.0),
    )
    assert command.linear == pytest.approx(expected, abs=1e-6)


def test_it_hovers_without_reception() -> None:
    follower = AerialFollower("lead", (-1.0, 0.0, 0.0), timeout_s=1.0, fade_s=0.5, horizon_s=5.0)
    starts = [Uav((0.0, 0.0, 2.0)), Uav((-1.0, 0.0, 2.0))]
    agents: dict[str, Agent] = {"lead": Drifter((0.3, 0.0, 0.0)), "f": follower}
    flight = fly(agents, starts, 60, lost=lambda tick, sender: tick < 5 or tick >= 20)
    status = [note["status"] for note in flight.notes["f"]]
    assert status == ["waiting"] * 6 + ["following"] * 23 + ["leader lost"] * 31  # the last report dates from 1.9 s
    speed = [math.hypot(*each.linear) for each in flight.commands["f"]]
    assert speed[:6] == [0.0] * 6
    left = np.clip(1.0 - np.arange(31) * T / 0.5, 0.0, 1.0)
    assert speed[29:] == pytest.approx(speed[28] * left, abs=1e-9)


def test_after_stand_by_it_stops_from_its_present_velocity() -> None:
    follower, radio = AerialFollower("lead", (-2.0, 0.0, 0.0), fade_s=1.0), Radio("f", ("lead", "f"))
    uav = Uav((-2.0, 0.0, 5.0))
    follower.start(info("f", ("lead", "f"), body=BODY))
    report = {"seq": 0, "t_ns": 0, "x": 0.0, "y": 0.0, "z": 5.0, "th": 0.0, "v": 4.0, "w": 0.0, "vx": 4.0, "vy": 0.0, "vz": 0.0}
    reception = reception_of_body("lead", report)
    assert follower.act(uav.see(0, [reception]), radio).linear == (4.0, 0.0, 0.0)
    uav.velocity = (0.0, -1.0, 0.0)
    for tick in range(1, 50):
        follower.stand_by(uav.see(tick * 100_000_000), radio)
    assert not radio.drain()
    fading = [follower.act(uav.see(tick * 100_000_000), radio).linear for tick in range(50, 62)]
    assert [vy for _, vy, _ in fading] == pytest.approx([-max(0.0, 1.0 - 0.1 * n) for n in range(12)])
    assert {(vx, vz) for vx, _, vz in fading} == {(0.0, 0.0)}


def test_its_speed_is_limited() -> None:
    follower = AerialFollower("lead", (0.0, 0.0, 0.0), max_speed=0.6)
    flight = fly({"lead": Drifter((0.3, 0.0, 0.0)), "f": follower}, [Uav((9.0, 5.0, 2.0)), Uav((0.0, 0.0, 1.0))], 30)
    assert [math.hypot(*each.linear) for each in flight.commands["f"][1:]] == pytest.approx([0.6] * 29)


# --- teams ---


def team(shape: Any = "wedge", **more: Any) -> tuple[dict[str, Agent], list[Uav]]:
    formation = Formation(shape=shape, spacing=2.0, **more)
    agents: dict[str, Agent] = {"a": AerialRoute(course_deg=0.0, formation=formation)}
    agents |= {name: AerialFollower(formation=formation, above=0.5, heartbeat_s=1.0) for name in "bc"}
    return agents, [Uav((0.0, 0.0, 2.0)), Uav((-1.7, -1.0, 2.0)), Uav((-1.7, 1.0, 2.0))]


def test_a_team_flies_its_shape_and_changes_it_with_the_leader() -> None:
    agents, starts = team(changes=((10.0, "column"),))
    flight = fly(agents, starts, 300)
    for tick, places in ((95, [(-math.sqrt(3.0), -1.0), (-math.sqrt(3.0), 1.0)]), (299, [(-2.0, 0.0), (-4.0, 0.0)])):
        lead = flight.position["a"][tick]
        own = sorted((flight.position[name][tick][0] - lead[0], flight.position[name][tick][1] - lead[1]) for name in "bc")
        assert np.array(own) == pytest.approx(np.array(sorted(places)), abs=1e-3)
        assert [flight.position[name][tick][2] for name in "bc"] == pytest.approx([2.5, 2.5], abs=1e-3)
    assert [note["shape"] for note in flight.notes["b"] if "shape" in note] == ["wedge", "column"]


def test_members_avoid_each_other_in_a_passage() -> None:
    """A member that hovers in the way does not make the lane narrow; avoidance keeps off it, with or without a passage."""
    names, commands = ("a", "b", "c"), []
    near = ring([0.3, *[math.inf] * 31], 10**8)  # a return from c
    for passage in (None, Passage()):
        of = Formation(spacing=2.0, members=names, passage=passage)
        radio = Radio("b", names)
        follower = AerialFollower(formation=of, max_speed=0.6, broadcast=True, avoidance=PotentialField())
        follower.start(info("b", names, body=BODY, sensors=("scan",)))
        receptions = [reported("a", 5.0, 1.0), reported("c", 0.55, 0.0)]
        commands.append(follower.act(Uav((0.0, 0.0, 2.0)).see(10**8, receptions, scan=near), radio).linear)
    assert commands[0] == commands[1]
    assert commands[1][0] <= 0.0


def reported(sender: str, x: float, y: float) -> Reception:
    body = {**dict.fromkeys(("seq", "t_ns"), 0), **dict.fromkeys(("th", "v", "w", "vx", "vy", "vz"), 0.0)}
    return reception_of_body(sender, {**body, "x": x, "y": y, "z": 2.0, "cl": 1})


# --- refusals ---


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"leader": "a"}, "slot and formation both define the place"),
        ({"formation": Formation(), "slot": (0.0, 0.0, 0.0)}, "slot and formation both define the place"),
        ({"leader": "a", "slot": (0.0, 0.0, 0.0), "above": 1.0}, "above needs a formation"),
    ],
)
def test_bad_parameters_of_a_follower_are_refused(params: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        AerialFollower(**params)


def test_a_first_member_without_a_leader_agent_is_refused() -> None:
    with pytest.raises(ValueError, match=r"leads it: give it a leader agent \(aerial_route\)"):
        AerialFollower(formation=Formation()).start(info())


@pytest.mark.parametrize("agent", [AerialRoute(course_deg=0.0), AerialFollower("b", (0.0, 0.0, 0.0))])
def test_a_vehicle_on_wheels_is_refused(agent: Agent) -> None:
    wheels = Body(width_m=0.3, radius_m=0.2)
    with pytest.raises(ValueError, match="a drives on wheels, but this agent is for vehicles that fly"):
        agent.start(info(body=wheels))
