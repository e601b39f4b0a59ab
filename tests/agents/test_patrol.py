"""Patrol: points in turn, on wheels and in the air; it waits before obstacles."""

from typing import Any

import pytest

import vcmvsp

pytestmark = pytest.mark.slow

LOOP = [[4.0, 0.0, 0.0], [4.0, 4.0, 0.0]]


def run(agent: dict[str, Any], *, duration_s: float = 40.0, kind: str = "p2dx", **tables: Any) -> vcmvsp.Result:
    vehicle: dict[str, Any] = {
        "name": "a",
        "kind": kind,
        "sensors": {"scan": {"kind": "lms"}},
        "agent": {"kind": "patrol", "way": LOOP, "speed": 0.5, "loop": False, **agent},
        **({"position": [0.0, 0.0, 2.0]} if kind == "quadrotor" else {}),
    }
    return vcmvsp.run({"name": "patrol", "duration_s": duration_s, "seed": 1, "vehicle": [vehicle], **tables}, mcap=False)


def passed(result: vcmvsp.Result, x: float, y: float, near_m: float = 0.35) -> bool:
    columns = [result.states[name].to_numpy() for name in ("x", "y")]
    return bool((((columns[0] - x) ** 2 + (columns[1] - y) ** 2) < near_m**2).any())


@pytest.mark.parametrize("kind", ["p2dx", "quadrotor", "kinematic"])
def test_points_are_visited_in_turn_and_the_last_one_is_kept(kind: str) -> None:
    result = run({"flies": kind == "quadrotor"}, kind=kind)
    assert passed(result, 4.0, 0.0)
    assert result.states["y"].to_pylist()[-1] == pytest.approx(4.0, abs=0.35)


def test_points_may_be_relative_to_the_start() -> None:
    result = run({"relative": True, "way": [[2.0, 1.0, 0.0]]}, kind="kinematic")
    assert passed(result, 2.0, 1.0)


def test_it_stops_before_an_obstacle() -> None:
    box = {"center": [2.0, 0.05, 0.5], "size": [0.5, 2.0, 1.0]}
    result = run({"scanner": "scan"}, world={"kind": "boxes", "boxes": [box]})
    assert result.metrics["safety"]["collisions"] == 0
    x = result.states["x"].to_numpy()
    assert 0.9 < x.max() < 1.75 - 0.22  # it stops near the box only; the body reaches 0.22 m ahead


def test_reports_come_once_a_period_and_not_all_at_once() -> None:
    def first_s(seed: int) -> float:
        cars = [{"name": f"c{i}", "pose": [0.0, float(i), 0.0], "agent": {"kind": "patrol", "way": LOOP}} for i in range(2)]
        result = vcmvsp.run(
            {"name": "two", "duration_s": 5.0, "seed": seed, "vehicles": {"kind": "kinematic"}, "vehicle": cars}, mcap=False
        )
        assert result.metrics["radio"]["frames"] in (9, 10)
        return float(result.radio["sent_ns"].to_numpy().min())

    assert len({first_s(seed) for seed in range(4)}) > 1
