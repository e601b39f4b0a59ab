"""Invariants of a ground robot behind the supervisor, for any commands: an exactly integrated unicycle."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.hardware.supervised_flight import safety_of
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.safety.obstacles import Others, Polygon
from vcmvsp.hardware.safety.supervisor import Cause, GroundSupervisor, LastReceived, Limits, Safety

pytestmark = pytest.mark.slow

Pose = tuple[float, float, float]
SECOND = 10**9
PERIOD_NS = SECOND // 10
RADIUS = 0.18
FENCES = {
    "square": Polygon([(0, 0), (4, 0), (4, 3), (0, 3)]),
    "L, clockwise": Polygon([(0, 0), (0, 4), (2, 4), (2, 1.8), (5, 1.8), (5, 0)]),
    "star": Polygon(
        [(2.5 * (1 + i % 2) * math.cos(i * math.pi / 5), 2.5 * (1 + i % 2) * math.sin(i * math.pi / 5)) for i in range(10)]
    ),
    "thin corner": Polygon([(0, 0), (6, 1.5), (0, 3)]),
}
STARTS = {"square": (2, 1.5), "L, clockwise": (1, 1), "star": (0, 0), "thin corner": (1.5, 1.5)}

reals = st.floats(-3.0, 3.0) | st.sampled_from([0.0, 1.0, -1.0])
commands = st.tuples(reals, reals)
limits = st.builds(
    Limits,
    max_speed=st.floats(0.1, 2.2),
    max_yaw_rate=st.floats(0.1, 5.0),
    accel=st.floats(0.1, 3.0),
    decel=st.floats(0.2, 3.0),
    yaw_accel=st.floats(0.5, 10.0),
    yaw_decel=st.floats(0.5, 10.0),
)
AMIGO = Limits(max_speed=0.75, max_yaw_rate=1.74, accel=0.3, decel=0.75, yaw_accel=2.0, yaw_decel=2.0)
P2DX = Limits(max_speed=0.75, max_yaw_rate=1.74, accel=0.3, decel=0.6, yaw_accel=1.0, yaw_decel=1.0)
HARD = Limits(max_speed=1.3, max_yaw_rate=1.0, accel=1.77, decel=2.98, yaw_accel=1.0, yaw_decel=2.0)


def heard(now: int) -> LastReceived:
    """All inputs received at ``now``, ns."""
    return LastReceived(operator_ns=now, command_ns=now, positioning_ns=now, federation_ns=now)


def room(fence: Polygon, x: float, y: float) -> float:
    """Signed distance to the fence, m, positive inside, by plain loops independent of the product code."""
    best, turns = math.inf, 0.0
    for (ax, ay), (bx, by) in zip(fence.a.tolist(), fence.b.tolist(), strict=True):
        along = (bx - ax, by - ay)
        t = ((x - ax) * along[0] + (y - ay) * along[1]) / (along[0] ** 2 + along[1] ** 2)
        t = max(0.0, min(1.0, t))
        best = min(best, math.dist((x, y), (ax + t * along[0], ay + t * along[1])))
        turns += math.atan2((ax - x) * (by - y) - (ay - y) * (bx - x), (ax - x) * (bx - x) + (ay - y) * (by - y))
    return best if abs(turns) > math.pi else -best


def ideal(
    pose: Pose, speeds: tuple[float, float], target_speeds: tuple[float, float], dt: float, _: Limits
) -> Iterator[tuple[Pose, tuple[float, float]]]:
    """A robot that reaches the commanded speeds at once."""
    for part in range(1, 5):
        yield arc(pose, *target_speeds, dt * part / 4), target_speeds


def ramping(
    pose: Pose, speeds: tuple[float, float], target_speeds: tuple[float, float], dt: float, limits: Limits
) -> Iterator[tuple[Pose, tuple[float, float]]]:
    """A robot that accelerates and brakes at the limits; each piece is an arc."""
    (v, w), (dv, dw) = speeds, (target_speeds[0] - speeds[0], target_speeds[1] - speeds[1])
    ready_v, ready_w = abs(dv) / limits.decel, abs(dw) / limits.yaw_decel
    times = sorted({0.0, dt, 0.5 * dt, min(dt, ready_v), min(dt, ready_w)})  # both speeds are linear in between
    for t0, t1 in itertools.pairwise(times):
        before = v, w
        v = target_speeds[0] if t1 >= ready_v else speeds[0] + math.copysign(limits.decel * t1, dv)
        w = target_speeds[1] if t1 >= ready_w else speeds[1] + math.copysign(limits.yaw_decel * t1, dw)
        pose = arc(pose, 0.5 * (v + before[0]), 0.5 * (w + before[1]), t1 - t0)
        yield pose, (v, w)


def drive(
    supervisor: GroundSupervisor, robot: Any, pose: Pose, orders: list[tuple[float, float, int]], keep: Limits
) -> Iterator[tuple[Pose, tuple[float, float], Any]]:
    """Pose, command and decision after each piece of a drive; each command lasts for some periods."""
    now, speeds = 0, (0.0, 0.0)
    for v, w, periods in orders:
        for _ in range(periods):
            decision = supervisor.step(now, Velocity(linear=(v, 0.0, 0.0), yaw_rate=w), pose, None, heard(now))
            command = decision.command.linear[0], decision.command.yaw_rate
            for pose, speeds in robot(pose, speeds, command, PERIOD_NS / SECOND, keep):  # noqa: B007, B020
                yield pose, command, decision
            now += PERIOD_NS


def one_step(
    parameters: Safety, pose: Pose, last: tuple[float, float], command: tuple[float, float], others: Others | None
) -> tuple[float, float]:
    """Supervised command, v and w, 0.1 s after ``last``."""
    supervisor = GroundSupervisor(parameters)
    supervisor.step(0, Velocity(), pose, None, heard(0))
    supervisor.last = last
    safe = supervisor.step(PERIOD_NS, Velocity(linear=(command[0], 0, 0), yaw_rate=command[1]), pose, others, heard(PERIOD_NS))
    assert not safe.stop
    return safe.command.linear[0], safe.command.yaw_rate


def crowd(places: list[tuple[float, float, float, float]]) -> Others:
    """Vehicles of radius 0.2 m, from rows x, y, vx, vy."""
    rows = np.array(places, float).reshape(-1, 4)
    return Others(rows[:, :2], rows[:, 2:], np.full(len(rows), 0.2))


situations = {
    "name": st.sampled_from(sorted(FENCES)),
    "keep": limits,
    "pose": st.tuples(st.floats(-1.0, 6.0), st.floats(-3.0, 5.0), st.floats(-4.0, 4.0)),
    "last": st.tuples(st.floats(-1.5, 1.5), st.floats(-3.0, 3.0)),
    "command": commands,
    "places": st.lists(st.tuples(*4 * (reals,)), max_size=4),
}


@settings(max_examples=150)
@given(**situations, which=st.sampled_from(["speed", "accel", "margin", "separation", "reaction"]), by=st.floats(0.0, 1.0))
def test_a_stricter_limit_never_gives_a_faster_command(
    name: str, keep: Limits, pose: Pose, last: Any, command: Any, places: Any, which: str, by: float
) -> None:
    params: dict[str, Any] = {"limits": keep, "radius_m": RADIUS, "fence": FENCES[name], "separation_m": 0.2}
    stricter: Any = {
        "speed": {"limits": msgspec.structs.replace(keep, max_speed=keep.max_speed * (1.0 - 0.9 * by))},
        "accel": {"limits": msgspec.structs.replace(keep, accel=keep.accel * (1.0 - 0.9 * by))},
        "margin": {"fence_margin_m": by},
        "separation": {"separation_m": 0.2 + by},
        "reaction": {"reaction_s": 0.1 + by},
    }[which]
    loose = one_step(safety_of(**params), pose, last, command, crowd(places))
    strict = one_step(safety_of(**(params | stricter)), pose, last, command, crowd(places))
    assert abs(strict[0]) <= abs(loose[0]) + 1e-9


@settings(max_examples=100)
@given(**situations, by=st.floats(0.0, 0.9))
def test_a_stricter_yaw_rate_never_gives_a_faster_turn(
    name: str, keep: Limits, pose: Pose, last: Any, command: Any, places: Any, by: float
) -> None:
    rest: dict[str, Any] = {"radius_m": RADIUS, "reaction_s": 0.1, "fence": FENCES[name]}
    tighter = msgspec.structs.replace(keep, max_yaw_rate=keep.max_yaw_rate * (1.0 - by))
    loose = one_step(safety_of(keep, **rest), pose, last, command, None)
    strict = one_step(safety_of(tighter, **rest), pose, last, command, None)
    halving = 2.0**-12 * (abs(loose[1]) + abs(strict[1]))
    assert abs(strict[1]) <= abs(loose[1]) + halving + 1e-9


@settings(max_examples=300)
@given(**situations)
def test_safe_commands_are_unchanged(name: str, keep: Limits, pose: Pose, last: Any, command: Any, places: Any) -> None:
    parameters = safety_of(keep, radius_m=RADIUS, fence=FENCES[name], separation_m=0.2)
    once = one_step(parameters, pose, last, command, crowd(places))
    assert one_step(parameters, pose, last, once, crowd(places)) == once


@settings(max_examples=40)
@given(
    name=st.sampled_from(sorted(FENCES)),
    robot=st.sampled_from([ideal, ramping]),
    yaw=st.floats(-4.0, 4.0),
    keep=st.sampled_from([AMIGO, P2DX, HARD]),
)
def test_at_the_fence_it_slows_down_once_and_stands(name: str, robot: Any, yaw: float, keep: Limits) -> None:
    supervisor = GroundSupervisor(safety_of(keep, radius_m=RADIUS, fence=FENCES[name]))
    periods = 20 + int(10 * (6.0 / keep.max_speed + keep.max_speed / keep.accel + keep.max_speed / keep.decel))
    drives = list(drive(supervisor, robot, (*STARTS[name], yaw), [(3.0, 0.0, periods)], keep))
    speeds = [command[0] for _, command, _ in drives][3:]
    peak = speeds.index(max(speeds))
    rises = sum(max(0.0, after - before) for before, after in itertools.pairwise(speeds[peak:]))
    assert rises <= 0.03  # m/s: braking harder than assumed causes a creep over the last millimetres
    assert 0.0 <= speeds[-1] < 1e-2
    (x, y, _), _, last = drives[-1]
    assert room(FENCES[name], x, y) == pytest.approx(RADIUS, abs=1e-2)
    assert last.causes[-1] is Cause.GEOFENCE
    assert not last.stop


def test_a_goal_beyond_the_fence_causes_no_oscillation() -> None:
    supervisor = GroundSupervisor(safety_of(AMIGO, radius_m=RADIUS, fence=FENCES["square"]))
    pose, goal, speeds = (1.0, 1.0, 1.0), (5.0, 2.0), []
    for tick in range(600):
        bearing = math.atan2(goal[1] - pose[1], goal[0] - pose[0])
        ask = Velocity(linear=(math.dist(goal, pose[:2]), 0, 0), yaw_rate=2.0 * math.remainder(bearing - pose[2], math.tau))
        command = supervisor.step(tick * PERIOD_NS, ask, pose, None, heard(tick * PERIOD_NS)).command
        pose = arc(pose, command.linear[0], command.yaw_rate, 0.1)
        speeds.append((command.linear[0], command.yaw_rate))
    assert all(abs(v) < 1e-3 and abs(w) < 1e-3 for v, w in speeds[-100:])
    assert 4.0 - pose[0] == pytest.approx(RADIUS, abs=1e-2)


def test_a_robot_at_the_fence_can_turn_on_the_spot_and_leave() -> None:
    supervisor = GroundSupervisor(safety_of(AMIGO, radius_m=RADIUS, fence=FENCES["square"]))
    drives = list(drive(supervisor, ideal, (3.5, 1.5, 0.0), [(1.0, 0.0, 60), (1.0, 1.5, 18), (1.0, 0.0, 15)], AMIGO))
    standing, leaving = drives[4 * 60 - 1], drives[-1]
    assert standing[1][0] < 1e-3
    assert leaving[1][0] > 0.1
    assert leaving[0][0] < standing[0][0] - 0.1


def test_a_robot_outside_finds_back_into_every_fence() -> None:
    for name, fence in FENCES.items():
        supervisor = GroundSupervisor(safety_of(AMIGO, radius_m=RADIUS, fence=fence))
        pose = (6.5, 4.0, 0.0)
        for tick in range(1200):
            bearing = math.atan2(STARTS[name][1] - pose[1], STARTS[name][0] - pose[0])
            if not fence.contains(*pose[:2]):
                bearing = fence.way_back(*pose[:2])
            turn = math.remainder(bearing - pose[2], math.tau)
            ask = Velocity(linear=(0.7 if abs(turn) < 0.2 else 0.0, 0, 0), yaw_rate=2.0 * turn)
            command = supervisor.step(tick * PERIOD_NS, ask, pose, None, heard(tick * PERIOD_NS)).command
            pose = arc(pose, command.linear[0], command.yaw_rate, 0.1)
        assert room(fence, *pose[:2]) > RADIUS - 1e-6, name


@settings(max_examples=60)
@given(keep=limits, robot=st.sampled_from([ideal, ramping]), c=st.floats(0.1, 1.0))
def test_it_stands_before_an_oncoming_one_at_the_distance(keep: Limits, robot: Any, c: float) -> None:
    supervisor = GroundSupervisor(safety_of(keep, radius_m=RADIUS, separation_m=0.3))
    pose, speeds, x, tick = (0.0, 0.0, 0.0), (0.0, 0.0), 4.0, 0
    while x - pose[0] - RADIUS - 0.2 >= 0.3:
        others = crowd([(x, 0.0, -c, 0.0)])
        command = supervisor.step(tick * PERIOD_NS, Velocity(linear=(2.0, 0, 0)), pose, others, heard(tick * PERIOD_NS)).command
        pose, speeds = list(robot(pose, speeds, (command.linear[0], command.yaw_rate), 0.1, keep))[-1]
        x, tick = x - c * 0.1, tick + 1
    # the remaining shortfall is the other vehicle's motion in its last period
    assert x - pose[0] - RADIUS - 0.2 >= 0.3 - c * 0.1 - 1e-6
    assert speeds[0] <= keep.decel * 0.1 + 1e-9
