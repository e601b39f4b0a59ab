import math
from typing import Any

import msgspec
import numpy as np
import pytest

from agents.formation import LeaderFollower, Trajectory
from cosim.agent import Radio, VehicleInfo
from cosim.frames import arc
from tests.agents.loops import Floats, Pose, observe


def commands(agent: Trajectory, duration_s: float, period_s: float = 0.1) -> Floats:
    """(ticks, 3): t in s, v in m/s, w in rad/s."""
    agent.start(VehicleInfo(name="car1", vehicles=("car1",), period_s=period_s, latency_s=0.0, seed=1))
    radio, rows = Radio("car1", ("car1",)), []
    for tick in range(round(duration_s / period_s)):
        now_ns = round(tick * period_s * 1e9)
        command = agent.act(observe((0.0, 0.0, 0.0), now_ns), radio)
        rows.append((now_ns / 1e9, command.linear[0], command.yaw_rate))
    return np.array(rows)


@pytest.mark.parametrize(
    ("path", "v", "w"),
    [
        ("straight", lambda t: 0.3 + 0.0 * t, lambda t: 0.0 * t),
        ("circle", lambda t: 0.3 + 0.0 * t, lambda t: 0.15 + 0.0 * t),
        ("slalom", lambda t: 0.3 + 0.0 * t, lambda t: 0.4 * np.sin(2 * np.pi * t / 16)),
        ("stopgo", lambda t: 0.3 * (1 + 0.5 * np.sin(2 * np.pi * t / 9)), lambda t: 0.3 * np.sin(2 * np.pi * t / 16)),
    ],
)
def test_the_standard_paths_are_their_formulas(path: Any, v: Any, w: Any) -> None:
    t, got_v, got_w = commands(Trajectory(path), 40.0).T
    np.testing.assert_allclose(got_v, v(t), atol=1e-12)
    np.testing.assert_allclose(got_w, w(t), atol=1e-12)


def test_the_random_path_is_the_documented_sequence() -> None:
    """Written again from its description, for 0.3 m/s at 10 Hz: v* in 0.1 .. 0.45, w* in -0.35 .. 0.35."""
    draws, v, w = np.random.default_rng(7), 0.3, 0.0
    for tick, (_, got_v, got_w) in enumerate(commands(Trajectory("random"), 60.0)):
        if tick % 20 == 0:
            v_star, w_star = draws.uniform(0.1, 0.45), draws.uniform(-0.35, 0.35)
        v += np.clip(v_star - v, -0.03, 0.03)
        w += np.clip(w_star - w, -0.06, 0.06)
        assert (got_v, got_w) == pytest.approx((v, w), abs=1e-12)


def test_a_random_path_depends_on_its_seed_alone() -> None:
    once, again, other = (commands(Trajectory("random", path_seed=seed), 20.0) for seed in (7, 7, 8))
    assert np.array_equal(once, again)
    assert not np.allclose(once, other)


def test_the_circle_closes_after_one_turn() -> None:
    turn_s, pose = 2 * math.pi / 0.15, (0.0, 0.0, 0.0)
    radii = []
    for _ in range(100):
        pose = arc(pose, 0.3, 0.15, turn_s / 100)
        radii.append(math.hypot(pose[0], pose[1] - 2.0))
    assert radii == pytest.approx([2.0] * 100)
    assert pose == pytest.approx((0.0, 0.0, 2 * math.pi), abs=1e-9)


@pytest.mark.parametrize(("path", "standard"), [("circle", 0.15), ("slalom", 0.4), ("stopgo", 0.3)])
def test_speed_and_yaw_rate_scale_a_path(path: Any, standard: float) -> None:
    base, twice = commands(Trajectory(path), 20.0), commands(Trajectory(path, 0.6, 2 * standard), 20.0)
    np.testing.assert_allclose(twice[:, 1:], 2 * base[:, 1:], atol=1e-12)


def test_speed_and_yaw_rate_bound_a_random_path_and_its_accelerations_stay() -> None:
    _, v, w = commands(Trajectory("random", 1.0, 0.7), 200.0, period_s=0.5).T
    assert 1 / 3 <= v.min() < 0.6 < 1.2 < v.max() <= 1.5
    assert -0.7 <= w.min() < -0.4 < 0.4 < w.max() <= 0.7
    assert np.abs(np.diff(v)).max() == pytest.approx(0.3 * 0.5)
    assert np.abs(np.diff(w)).max() == pytest.approx(0.6 * 0.5)


def test_wrong_paths_are_refused() -> None:
    with pytest.raises(ValueError, match="not one of straight, circle, slalom, stopgo, random"):
        Trajectory("spiral")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a straight path has no yaw rate"):
        Trajectory("straight", yaw_rate=0.1)


def test_every_tick_is_reported_with_pose_and_command() -> None:
    agent, radio = Trajectory("slalom"), Radio("car1", ("car1", "car2"))
    pose: Pose = (1.5, -2.0, 0.7)
    for tick in range(3):
        command = agent.act(observe(pose, tick * 100_000_000, v=9.0, w=9.0), radio)
        (message,) = radio.drain()
        assert message.to is None
        body = message.body
        assert isinstance(body, dict)
        assert list(body) == ["seq", "t_ns", "x", "y", "th", "v", "w"]
        assert (body["seq"], body["t_ns"], body["v"], body["w"]) == (
            tick,
            tick * 100_000_000,
            command.linear[0],
            command.yaw_rate,
        )
        assert (body["x"], body["y"], body["th"]) == pytest.approx(pose, abs=1e-12)
        assert message.size_bytes == len(msgspec.msgpack.encode(body)) <= 76


def test_a_follower_with_broadcast_reports_its_measured_speed_even_while_it_waits() -> None:
    agent, radio = LeaderFollower("car1", broadcast=True), Radio("car2", ("car1", "car2", "car3"))
    agent.act(observe((1.0, 2.0, 2.5), 300_000_000, v=-0.2, w=0.4), radio)
    (message,) = radio.drain()
    body = message.body
    assert isinstance(body, dict)
    assert body == pytest.approx({"seq": 0, "t_ns": 300_000_000, "x": 1.0, "y": 2.0, "th": 2.5, "v": -0.2, "w": 0.4})
    agent.broadcast = False
    agent.act(observe((1.0, 2.0, 2.5), 400_000_000), radio)
    assert radio.drain() == []
