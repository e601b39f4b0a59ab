import math
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support.agents.agent_loop import Floats, Pose, bodies, info, observe, reception_of_body
from tests.support.docs.readme_pages import block
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.leader import Leader
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.prediction import DeadReckoning
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.cosim.agent import Observation, Radio
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import ScenarioError

pytestmark = pytest.mark.slow


def commands(agent: Trajectory, duration_s: float, period_s: float = 0.1) -> Floats:
    """(ticks, 3): t in s, v in m/s, w in rad/s."""
    agent.start(info("car1", ("car1",), period_s=period_s))
    radio, rows = Radio("car1", ("car1",)), []
    for tick in range(round(duration_s / period_s)):
        now_ns = round(tick * period_s * 1e9)
        command = agent.act(observe((0.0, 0.0, 0.0), now_ns), radio)
        rows.append((now_ns / 1e9, command.linear[0], command.yaw_rate))
    return np.array(rows)


def wave(t: Floats, period_s: float) -> Any:
    return np.sin(2 * np.pi * t / period_s)


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize(
    ("path", "yaw_rate", "v", "w"),
    [
        ("straight", 0.0, lambda t: 0.3 + 0.0 * t, lambda t: 0.0 * t),
        ("circle", 0.15, lambda t: 0.3 + 0.0 * t, lambda t: 0.15 + 0.0 * t),
        ("slalom", 0.4, lambda t: 0.3 + 0.0 * t, lambda t: 0.4 * wave(t, 16)),
        ("stopgo", 0.3, lambda t: 0.3 * (1 + 0.5 * wave(t, 9)), lambda t: 0.3 * wave(t, 16)),
    ],
)
def test_the_standard_paths_are_their_formulas(path: Any, yaw_rate: float, v: Any, w: Any, scale: float) -> None:
    made = Trajectory(path) if scale == 1.0 else Trajectory(path, 0.3 * scale, scale * yaw_rate)
    t, got_v, got_w = commands(made, 40.0).T
    np.testing.assert_allclose(got_v, scale * v(t), atol=1e-12)
    np.testing.assert_allclose(got_w, scale * w(t), atol=1e-12)


def test_the_random_path_is_the_documented_sequence() -> None:
    """Implemented again from its description, for 0.3 m/s at 10 Hz: v* in 0.1 .. 0.45, w* in -0.35 .. 0.35."""
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


def test_speed_and_yaw_rate_bound_a_random_path_and_not_its_accelerations() -> None:
    _, v, w = commands(Trajectory("random", 1.0, 0.7), 200.0, period_s=0.5).T
    assert 1 / 3 <= v.min() < 0.6 < 1.2 < v.max() <= 1.5
    assert -0.7 <= w.min() < -0.4 < 0.4 < w.max() <= 0.7
    assert np.abs(np.diff(v)).max() == pytest.approx(0.3 * 0.5)
    assert np.abs(np.diff(w)).max() == pytest.approx(0.6 * 0.5)


def test_the_period_of_stop_and_go_can_be_set_and_it_can_go_straight() -> None:
    t, v, w = commands(Trajectory("stopgo", 0.4, 0.0, surge_s=5.0), 20.0).T
    np.testing.assert_allclose(v, 0.4 * (1 + 0.5 * wave(t, 5)), atol=1e-12)
    assert np.abs(w).max() == 0.0


def reports(agent: Leader, duration_s: float, period_s: float = 0.1) -> list[dict[str, Any]]:
    """Bodies of a leader's reports."""
    agent.start(info("car1", ("car1", "car2"), period_s=period_s))
    radio = Radio("car1", ("car1", "car2"))
    for tick in range(round(duration_s / period_s)):
        agent.act(observe((0.0, 0.0, 0.0), round(tick * period_s * 1e9)), radio)
    return bodies(radio)


@pytest.mark.parametrize("path", ["straight", "circle", "slalom", "stopgo", "random"])
@pytest.mark.parametrize(("period_s", "ticks"), [(0.1, 20), (0.5, 20), (0.03, 20), (0.1, 1), (0.1, 60)])
def test_a_plan_equals_the_next_commands_and_does_not_change_them(path: Any, period_s: float, ticks: int) -> None:
    plain = commands(Trajectory(path), 30.0, period_s)[:, 1:]
    set_to = {} if ticks == 20 else {"plan_ticks": ticks}
    bodies = reports(Trajectory(path, estimator="plan", **set_to), 30.0, period_s)
    assert [(each["v"], each["w"]) for each in bodies] == list(map(tuple, plain))
    for tick in range(len(bodies) - ticks):
        assert bodies[tick]["dt"] == pytest.approx(period_s)
        np.testing.assert_allclose(np.reshape(bodies[tick]["plan"], (ticks, 2)), plain[tick + 1 : tick + 1 + ticks], atol=1e-9)


def test_accelerations_are_differences_of_commands() -> None:
    t, v, w = commands(Trajectory("random"), 30.0).T
    bodies = reports(Trajectory("random", estimator="acc"), 30.0)
    assert (bodies[0]["a"], bodies[0]["al"]) == (0.0, 0.0)  # no previous command
    np.testing.assert_allclose([each["a"] for each in bodies[1:]], np.diff(v) / np.diff(t), atol=1e-6)
    np.testing.assert_allclose([each["al"] for each in bodies[1:]], np.diff(w) / np.diff(t), atol=1e-6)


class NeedsBoth(DeadReckoning):
    """A custom estimator that needs both."""

    needs = ("a", "plan")


@pytest.mark.parametrize(
    ("params", "more"),
    [
        ({}, []),
        ({"estimator": "hold"}, []),
        ({"estimator": "acc"}, ["a", "al"]),
        ({"estimator": "plan"}, ["plan", "dt"]),
        ({"tell": ["a"], "estimator": "plan"}, ["a", "al", "plan", "dt"]),
        ({"estimator": f"{__name__}:NeedsBoth"}, ["a", "al", "plan", "dt"]),
        ({"estimator": NeedsBoth()}, ["a", "al", "plan", "dt"]),
    ],
)
def test_reports_contain_the_fields_that_the_estimator_needs(params: dict[str, Any], more: list[str]) -> None:
    leader = call(Trajectory, {"path": "slalom", **params})
    body = reports(leader, 0.2)[-1]
    assert list(body) == ["seq", "t_ns", "x", "y", "th", "v", "w", *more]
    size = len(msgspec.msgpack.encode(body))
    assert size <= 76 + 24 * ("a" in more) + 380 * ("plan" in more)


def test_unknown_contents_of_reports_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"tell: must be .*'a', 'plan'"):
        call(Trajectory, {"tell": ["jerk"]})


class Waltz(Leader):
    """A custom leader without plans."""

    def speeds(self, obs: Observation) -> tuple[float, float]:
        return 0.3, 0.5 * math.sin(obs.time_s)


def test_a_custom_leader_reports_its_motion_without_a_plan() -> None:
    bodies = reports(call(Waltz, {"estimator": "plan", "tell": ["a"]}), 5.0)
    assert [each["w"] for each in bodies] == pytest.approx([0.5 * math.sin(tick / 10) for tick in range(50)])
    assert all(("a" in each, "plan" in each) == (True, False) for each in bodies)


def test_the_leader_of_the_readme_works() -> None:
    names: dict[str, Any] = {}
    exec(block("docs/reference/agents.md", "class Waltz"), names)
    bodies = reports(names["Waltz"](), 1.0)
    assert [(each["v"], each["w"]) for each in bodies] == [(0.3, 0.5 * math.sin(tick / 10)) for tick in range(10)]


LINE = Formation(shape="line", spacing=1.0, changes=((0.5, "column"), (1.0, "line")))


def reported_shapes(*received: tuple[int, dict[str, Any]]) -> list[tuple[Any, Any, Any]]:
    """Shape, number and order in each report of a leader of five; ``received``: ticks and bodies of received reports."""
    names = tuple(f"car{number}" for number in range(1, 6))
    leader, radio = Trajectory("straight", formation=LINE), Radio("car1", names)
    leader.start(info("car1", names))
    for tick in range(15):
        came = [reception_of_body(body["from"], body) for at, body in received if at == tick]
        leader.act(observe((1.0, 2.0, math.pi / 2), tick * 100_000_000, came), radio)
    return [(body.get("shape"), body.get("sn"), body.get("order")) for body in bodies(radio)]


def test_a_leader_changes_the_shape_at_its_times_and_reports_it() -> None:
    shapes = reported_shapes()
    assert shapes[:5] == [(None, None, None)] * 5
    assert [each[:2] for each in shapes[5:10]] == [("column", 1)] * 5
    assert [each[:2] for each in shapes[10:]] == [("line", 2)] * 5


def test_slots_are_assigned_by_the_reported_positions() -> None:
    """Members report positions along a column in another order: each gets the slot where it is."""
    behind = {"car2": 3.0, "car3": 1.0, "car4": 4.0, "car5": 2.0}  # m; the leader is at (1, 2), heading north
    received = [
        (3, {"from": name, "t_ns": 200_000_000, "x": 1.0, "y": 2.0 - away, "th": 1.57, "v": 0.0, "w": 0.0})
        for name, away in behind.items()
    ]
    shape, number, order = reported_shapes(*received)[6]
    assert (shape, number) == ("column", 1)
    assert order == [0, 2, 4, 1, 3]  # in order of slots: car1, car3, car5, car2, car4


def test_only_the_first_member_leads() -> None:
    leader = Trajectory(formation=Formation(members=("car2", "car1")))
    with pytest.raises(ValueError, match="formation: car1 does not lead this team, car2 does; put it first in members"):
        leader.start(info("car1", ("car1", "car2")))


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
        body: Any = message.body
        assert list(body) == ["seq", "t_ns", "x", "y", "th", "v", "w"]
        assert (body["seq"], body["t_ns"]) == (tick, tick * 100_000_000)
        assert (body["v"], body["w"]) == (command.linear[0], command.yaw_rate)
        assert (body["x"], body["y"], body["th"]) == pytest.approx(pose, abs=1e-12)
        assert message.size_bytes == len(msgspec.msgpack.encode(body)) <= 76


def test_a_follower_with_broadcast_reports_its_measured_speed_even_while_it_waits() -> None:
    agent, radio = LeaderFollower("car1", broadcast=True), Radio("car2", ("car1", "car2", "car3"))
    agent.act(observe((1.0, 2.0, 2.5), 300_000_000, v=-0.2, w=0.4), radio)
    (body,) = bodies(radio)
    assert body == pytest.approx({"seq": 0, "t_ns": 300_000_000, "x": 1.0, "y": 2.0, "th": 2.5, "v": -0.2, "w": 0.4})
    agent = LeaderFollower("car1", broadcast=False)
    agent.act(observe((1.0, 2.0, 2.5), 400_000_000), radio)
    assert radio.drain() == []
