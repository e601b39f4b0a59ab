"""Several algorithms on one vehicle: calls, the commander, take-overs, and the guard."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.aerial_loop import BODY as WINGS
from tests.support.agents.agent_loop import T, Uav, info, reception_of_body
from tests.support.agents.scans import ring
from vcmvsp.agents.avoidance import PotentialField
from vcmvsp.agents.mission.runner import AlgorithmRunner, Command, Guard
from vcmvsp.agents.reconnaissance.state_table import MissionFacts, MissionState, step
from vcmvsp.cosim.agent import Agent, Body, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Reception, Vec3, Velocity, Waypoint

pytestmark = pytest.mark.slow

WHEELS = Body(width_m=0.4, radius_m=0.25)
POINT = Waypoint(position=(5.0, 0.0, 3.0))


class Scripted(Agent):
    """Returns the given commands in turn, then the last one; records receptions; sends its name and the number of calls."""

    sensors: tuple[str, ...] | None = ("gps",)

    def __init__(self, name: str, *answers: Command | None) -> None:
        self.name, self.answers, self.act_count = name, answers, 0
        self.receptions, self.calls = list[Reception](), list[str]()

    def start(self, info: VehicleInfo) -> None:
        self.calls.append("start")

    def act(self, obs: Observation, radio: Radio) -> Command | None:
        self.receptions += obs.heard
        self.act_count += 1
        self.calls.append("act")
        self.note(asked=self.act_count)
        radio.send(who=self.name, asked=self.act_count)
        return self.answers[min(self.act_count, len(self.answers)) - 1]

    def close(self) -> None:
        self.calls.append("close")


class ScriptedWithStandBy(Scripted):
    """Only receives while it is suspended."""

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        self.receptions += obs.heard
        self.calls.append("stand_by")


class HalfSpeed(Scripted):
    """Avoidance: half of the wanted speed."""

    def around(self, obs: Observation, radio: Radio, requested: Command | None) -> Command | None:
        self.calls.append(f"around {getattr(requested, 'linear', requested)}")
        return going(*(0.5 * v for v in requested.linear)) if isinstance(requested, Velocity) else self.answers[0]


def going(*linear: float, turn: float = 0.0) -> Velocity:
    x, y, z = (*linear, 0.0, 0.0, 0.0)[:3]
    return Velocity(linear=(x, y, z), yaw_rate=turn)


def runner_of(*agents: Scripted, acceleration: float = 1.0, body: Body = WINGS) -> AlgorithmRunner:
    runner = AlgorithmRunner({agent.name: agent for agent in agents}, acceleration=acceleration, yaw_acceleration=2.0)
    runner.start(info(body=body))
    return runner


RADIO = Radio("a", ("a", "b"))


def ask(
    runner: AlgorithmRunner,
    tick: int,
    commander: str,
    *,
    task: str | None = None,
    why: str = "",
    receptions: tuple[Reception, ...] = (),
    velocity: Vec3 = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    turning: float = 0.0,
) -> Any:
    obs = Uav((0.0, 0.0, 3.0), yaw, velocity, turning).see(tick * 100_000_000, receptions)
    runner.look(obs)
    return runner.act(obs, RADIO, commander, task=task, why=why)


# --- calls ---


def test_the_commander_is_obeyed_and_the_others_continue() -> None:
    search, track = Scripted("search", going(1.0)), ScriptedWithStandBy("track", going(2.0))
    runner = runner_of(search, track)
    message = reception_of_body("b", {})
    RADIO.drain()
    assert ask(runner, 0, "search", receptions=(message,)) == going(1.0)
    ask(runner, 1, "track", receptions=(message,))
    ask(runner, 2, "search")
    runner.close()
    assert search.calls == ["start", "act", "act", "act", "close"]
    assert track.calls == ["start", "stand_by", "act", "stand_by", "close"]
    assert len(search.receptions) == len(track.receptions) == 2
    sent = [(m.body["who"], m.body["asked"]) for m in RADIO.drain() if isinstance(m.body, dict)]
    assert sent == [("search", 1), ("search", 2), ("track", 1), ("search", 3)]


def test_a_suspended_algorithm_keeps_its_state() -> None:
    """It is called at every tick, and its present command counts again."""
    search, track = Scripted("search", *(going(0.01 * n) for n in range(100))), Scripted("track", going())
    runner = runner_of(search, track)
    commanders = ["search"] * 3 + ["track"] * 5 + ["search"] * 3
    commands = [ask(runner, tick, commander) for tick, commander in enumerate(commanders)]
    assert commands == [going(0.01 * n) if c == "search" else going() for n, c in enumerate(commanders)]


def test_without_command_the_commanders_last_one_holds() -> None:
    search, track = Scripted("search", going(0.05), None), Scripted("track", going(-0.05))
    runner = runner_of(search, track)
    assert [ask(runner, n, c) for n, c in enumerate(("search", "track", "search"))] == [going(0.05), going(-0.05), going(0.05)]


def test_a_commander_without_any_command_stands_still() -> None:
    runner = runner_of(Scripted("search", going(0.05)), Scripted("track", None))
    assert [ask(runner, n, c) for n, c in enumerate(("track", "search", "track"))] == [None, going(0.05), going()]


def test_avoidance_is_called_last_with_the_command_of_the_task() -> None:
    around, search, track = HalfSpeed("avoid1", None), Scripted("search", going(1.0), going(2.0)), Scripted("track", going(3.0))
    runner = runner_of(around, search, track, acceleration=1e9)
    assert ask(runner, 0, "search") == going(1.0)
    assert ask(runner, 1, "avoid1", task="search") == going(1.0)
    assert ask(runner, 2, "avoid1", task="track") == going(1.5)
    assert around.calls[1:] == ["around (1.0, 0.0, 0.0)", "around (2.0, 0.0, 0.0)", "around (3.0, 0.0, 0.0)"]


def test_avoidance_receives_the_present_command_of_the_task() -> None:
    """Avoidance lets the task continue, so it does not stand by; the other algorithms do."""
    around, search, track = (
        HalfSpeed("avoid", None),
        ScriptedWithStandBy("search", *(going(n) for n in (1.0, 2.0, 3.0, 4.0))),
        ScriptedWithStandBy("track"),
    )
    runner = runner_of(around, search, track, acceleration=1e9)
    commands = [ask(runner, n, c, task="search") for n, c in enumerate(("search", "avoid", "avoid", "search"))]
    assert commands == [going(1.0), going(1.0), going(1.5), going(4.0)]
    assert search.calls == ["start"] + 4 * ["act"]
    assert track.calls == ["start"] + 4 * ["stand_by"]


def test_an_agent_with_several_names_is_called_once() -> None:
    around = HalfSpeed("avoid", going(1.0))
    runner = AlgorithmRunner({"avoid1": around, "avoid2": around}, acceleration=1.0, yaw_acceleration=1.0)
    runner.start(info(body=WINGS))
    assert ask(runner, 0, "avoid1") == ask(runner, 1, "avoid2") == going(1.0)
    assert around.calls == ["start", "around None", "around None"]


def test_sensors_and_notes_of_all_algorithms_are_collected() -> None:
    search, track = Scripted("search", going()), Scripted("track", going())
    track.sensors = ("camera", "gps")
    runner = runner_of(search, track)
    assert runner.sensors == ("gps", "camera")
    ask(runner, 0, "search")
    ask(runner, 1, "search")
    assert runner.said == {"search": {"asked": 2.0}, "track": {"asked": 2.0}}
    track.sensors = None
    assert runner.sensors is None


def test_a_change_of_the_commander_is_noted_with_its_reason() -> None:
    runner = runner_of(Scripted("search", going()), Scripted("track", going()))
    notes = []
    for tick, commander in enumerate(("search", "search", "track", "search")):
        ask(runner, tick, commander, why=f"{tick}")
        notes.append(runner.notes)
    assert notes == [
        {"commander": "search", "since_s": 0.0, "why": "0"},
        {},
        {"commander": "track", "since_s": 0.2, "why": "2"},
        {"commander": "search", "since_s": pytest.approx(0.3), "why": "3"},
    ]


# --- take-over ---


def test_after_its_run_up_the_commander_is_not_limited() -> None:
    runner = runner_of(Scripted("search", going(0.1)), Scripted("track", going(0.1), going(0.2), going(9.0)))
    ask(runner, 0, "search")
    assert [ask(runner, tick, "track").linear[0] for tick in (1, 2)] == [0.2, 9.0]  # called at the first tick, too


def test_from_a_way_point_the_run_up_begins_at_the_vehicles_velocity() -> None:
    search, track = Scripted("search", POINT), Scripted("track", going(0.0))
    runner = runner_of(search, track)
    assert ask(runner, 0, "search") == POINT
    assert ask(runner, 1, "track", velocity=(0.0, 2.0, 0.0), turning=0.5) == going(0.0, 1.9, turn=0.3)
    assert ask(runner, 2, "search", velocity=(0.0, 1.9, 0.0)) == POINT
    pointed = runner_of(Scripted("search", going(0.0)), Scripted("track", POINT, POINT, going(9.0)))
    assert [ask(pointed, n, c) for n, c in enumerate(("search", "track", "track"))] == [going(0.0), POINT, going(9.0)]
    wheels = runner_of(Scripted("search", POINT), Scripted("track", going(0.0)), body=WHEELS)
    ask(wheels, 0, "search")
    command = ask(wheels, 1, "track", velocity=(0.0, 2.0, 0.0), yaw=0.5 * math.pi)
    assert command.linear == pytest.approx((1.9, 0.0, 0.0))  # on wheels: forwards


speeds = st.floats(-5.0, 5.0)
answers = st.lists(st.none() | st.builds(going, speeds, speeds, speeds, turn=st.floats(-2.0, 2.0)), min_size=1, max_size=8)


@given(
    st.lists(answers, min_size=3, max_size=3), st.lists(st.sampled_from("abc"), min_size=2, max_size=60), st.floats(0.1, 20.0)
)
def test_the_command_does_not_jump_at_a_take_over(
    messages: list[list[Any]], commanders: list[str], acceleration: float
) -> None:
    """Jumps are those of one commander after its run-up; there are none at a take-over."""
    agents = [Scripted(name, *each) for name, each in zip("abc", messages, strict=True)]
    runner = runner_of(*agents, acceleration=acceleration)
    commands = [ask(runner, tick, commander) for tick, commander in enumerate(commanders)]
    for (before, old), (after, new) in pairwise(zip(commanders, commands, strict=True)):
        if before != after and old is not None:
            assert math.dist(new.linear, old.linear) <= acceleration * T * (1.0 + 1e-9) + 1e-12
            assert abs(new.yaw_rate - old.yaw_rate) <= 2.0 * T * (1.0 + 1e-9) + 1e-12


def wish(tick: int) -> tuple[float, float, float]:
    return 3.0 * math.sin(tick), 3.0 * math.cos(1.7 * tick), 0.0


@pytest.mark.parametrize("velocity_at", [lambda tick: (2.0, -1.0, 0.5), wish])
def test_a_run_up_ends_at_the_commanders_command(velocity_at: Callable[[int], Vec3]) -> None:
    """A constant command is reached at that acceleration; the difference from the command never grows."""
    track = Scripted("track", *(going(*velocity_at(tick), turn=-0.7) for tick in range(100)))
    runner = runner_of(Scripted("search", going(-1.0)), track, acceleration=2.0)
    last = ask(runner, 0, "search")
    for tick in range(1, 60):
        command, goal = ask(runner, tick, "track"), velocity_at(tick)
        short, turning = math.dist(last.linear, goal), abs(last.yaw_rate + 0.7)
        assert math.dist(command.linear, goal) <= max(0.0, short - 0.2) + 1e-9 or command.linear == goal
        assert abs(command.yaw_rate + 0.7) <= max(0.0, turning - 0.2) + 1e-9
        last = command
    if velocity_at is not wish:
        assert last == going(2.0, -1.0, 0.5, turn=-0.7)


# --- the guard: a minimum distance for any commander, table and take-over ---


KEEP = 0.5
SETTINGS = PotentialField(keep_m=KEEP)


def guard_of(body: Body | None = WINGS, sensors: tuple[str, ...] = ("scan",)) -> Guard:
    guard = Guard(SETTINGS)
    guard.start(info(body=body, sensors=sensors))
    return guard


def seen(ranges: Any, tick: int = 0, x: float = 0.0, velocity: float = 0.0, yaw: float = 0.0) -> Observation:
    """Observation of a vehicle at x that moves along x, with any heading."""
    now_ns = tick * 100_000_000
    scan = None if ranges is None else ring(ranges, now_ns)
    return Uav((x, 0.0, 5.0), yaw, (velocity, 0.0, 0.0)).see(now_ns, scan=scan)


def limited(guard: Guard, obs: Observation, command: Any) -> Any:
    guard.look(obs)
    return guard.limited(obs, command)


FREE = [math.inf] * 8


def test_far_from_obstacles_commands_are_unchanged() -> None:
    for command in (Velocity(linear=(3.0, 1.0, -1.0), yaw_rate=2.0), Waypoint(position=(9.0, 9.0, 9.0))):
        assert limited(guard_of(), seen(FREE), command) is command


def test_the_approach_speed_is_proportional_to_the_remaining_distance() -> None:
    """At 0.8 m: 0.4 (0.8 - 0.5 - 0.03) m/s; motion past the obstacle and climb are unchanged."""
    wall = [0.8, *FREE[1:]]
    slower = limited(guard_of(), seen(wall), Velocity(linear=(2.0, 0.3, 0.7), yaw_rate=1.0))
    assert slower.linear == pytest.approx((0.108, 0.3, 0.7))
    assert slower.yaw_rate == 1.0
    assert limited(guard_of(WHEELS), seen(wall), Velocity(linear=(2.0, 0.0, 0.0))).linear[0] == pytest.approx(0.108)
    way = limited(guard_of(), seen(wall), Waypoint(position=(9.0, 0.0, 5.0)))
    assert way.linear == (pytest.approx(0.108), 0.0, 0.0)
    back = limited(guard_of(), seen(wall), Waypoint(position=(-9.0, 0.0, 5.0), speed=0.5, yaw=math.pi / 2))
    assert back == Velocity(linear=(-0.5, 0.0, 0.0), yaw_rate=1.0)


def test_in_the_air_commands_are_in_the_world_frame_and_scans_in_the_body_frame() -> None:
    """Heading north, flying west: it approaches obstacles on its left."""
    guard, north = guard_of(), 0.5 * math.pi
    for direction, closes in ((2, True), (6, False)):  # beams 2 and 6 of eight: left, right
        ranges = [*FREE[:direction], 0.8, *FREE[direction + 1 :]]
        command = limited(guard, seen(ranges, velocity=-0.5, yaw=north), Velocity(linear=(-2.0, 0.0, 0.0)))
        assert guard.closing is closes
        assert command.linear[:2] == pytest.approx((-0.108 if closes else -2.0, 0.0))


@pytest.mark.parametrize("ranges", [None, [0.0] * 8, [math.nan] * 8])
def test_without_a_scan_it_stops(ranges: Any) -> None:
    guard = guard_of()
    assert limited(guard, seen(ranges), Velocity(linear=(1.0, 0.0, 1.0), yaw_rate=1.0)) == Velocity()
    assert guard.nearest_m == 0.0
    assert step(MissionState(), MissionFacts(0, nearest_m=guard.nearest_m, second_m=guard.second_m)).name == "avoid2"


def test_the_guard_gives_the_nearest_distance_and_whether_it_shrinks() -> None:
    guard = guard_of()
    guard.look(seen([2.0, *FREE[1:]], velocity=0.5))
    assert (guard.nearest_m, guard.closing) == (2.0, True)
    assert guard.second_m == pytest.approx(KEEP + 0.25 / 0.6)
    guard.look(seen([2.0, *FREE[1:]], velocity=-0.5))
    assert not guard.closing
    guard.look(seen(FREE, velocity=0.5))
    assert (guard.nearest_m, guard.closing) == (math.inf, False)


def test_a_vehicle_without_a_size_or_a_scanner_is_refused() -> None:
    with pytest.raises(ValueError, match="has no body"):
        guard_of(None)
    with pytest.raises(ValueError, match="no such sensor"):
        guard_of(sensors=("camera",))


# --- with table and runner ---


class WallSeeker(Agent):
    """Flies at the wall at a constant speed."""

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        return Velocity(linear=(self.speed, 0.0, 0.0))


def fly_at_wall(facts: list[dict[str, Any]], speeds: tuple[float, float, float], *, limits: bool) -> tuple[float, int]:
    """Least distance to a wall at 6 m, with a speed lag of 0.5 s, if every algorithm flies at the wall.

    And the number of ticks nearer than d2 without level 2.
    """
    search, track, avoid = (WallSeeker(speed) for speed in speeds)
    algorithms = {"search": search, "formation": search, "track": track, "avoid1": avoid, "avoid2": avoid}
    looks, guard = Guard(SETTINGS), Guard(SETTINGS) if limits else None
    runner = AlgorithmRunner(algorithms, acceleration=1.0, yaw_acceleration=1.0, guard=guard)
    for each in (looks, runner):
        each.start(info(body=WINGS, sensors=("scan",)))
    x, v, state, nearest, late, radio = 0.0, 0.0, MissionState(), math.inf, 0, Radio("a", ("a",))
    for tick in range(200):
        ranges = np.full(64, np.inf)
        ahead = np.cos(math.tau * np.arange(64) / 64)
        ranges[ahead > 0.05] = np.maximum(0.01, (6.0 - x) / ahead[ahead > 0.05])
        obs = seen(ranges, tick, x, v)
        looks.look(obs)
        runner.look(obs)
        known = MissionFacts(obs.time_ns, looks.nearest_m, looks.closing, second_m=looks.second_m, **facts[tick % len(facts)])
        state = step(state, known)
        late += known.nearest_m < known.second_m and state.name != "avoid2"
        command = runner.act(obs, radio, state.name, task=state.task, why=state.why)
        assert isinstance(command, Velocity)
        for _ in range(10):
            v += 0.01 / 0.5 * (command.linear[0] - v)
            x += 0.01 * v
        nearest = min(nearest, 6.0 - x)
    return nearest, late


changing = st.lists(
    st.fixed_dictionaries({"recognised": st.booleans(), "taken": st.booleans(), "shared": st.booleans()}),
    min_size=1,
    max_size=30,
)


@settings(max_examples=25)
@given(changing, st.tuples(st.floats(0.1, 1.0), st.floats(0.1, 1.0), st.floats(0.1, 1.0)))
def test_the_distance_is_kept_for_every_commander_and_any_begin_of_level_2(
    facts: list[dict[str, Any]], speeds: tuple[float, float, float]
) -> None:
    nearest, _ = fly_at_wall(facts, speeds, limits=True)
    assert nearest >= KEEP


def test_without_the_guard_the_distance_is_not_kept() -> None:
    """Proof that the test above can fail; the table delays level 2, and the limit holds meanwhile."""
    facts = [{"recognised": True, "taken": False}] * 5 + [{"taken": True}] * 5  # a switch per half second
    assert fly_at_wall(facts, (1.0, 1.0, 1.0), limits=False)[0] < 0.0
    nearest, late = fly_at_wall(facts, (1.0, 1.0, 1.0), limits=True)
    assert nearest >= KEEP
    assert 0 < late < 5
