"""Physics of kind ``flight``: quadrotor dynamics as in Bullet, without contacts."""

import pytest

import vcmvsp

SCENARIO = {
    "name": "flight",
    "duration_s": 4.0,
    "world": {"kind": "empty", "wind": {"velocity": [1.0, 0.0, 0.0], "gust": 0.5}},
    "agents": {"kind": "patrol", "flies": True, "way": [[3.0, 0.0, 6.0], [3.0, 4.0, 5.0]]},
    "vehicle": [
        {"name": "uav1", "kind": "quadrotor", "position": [0.0, 0.0, 5.0], "agent": {}},
        {"name": "uav2", "kind": "quadrotor", "position": [0.0, 5.0, 5.0], "agent": {}},
    ],
}


def test_away_from_everything_it_is_bullet_to_the_last_bit() -> None:
    runs = [vcmvsp.run(SCENARIO, set={"physics.kind": kind}) for kind in ("bullet", "flight")]
    assert runs[0].states.equals(runs[1].states)


def test_quadrotors_pass_through_each_other_and_the_ground() -> None:
    down = {**SCENARIO, "agents": {"kind": "patrol", "flies": True, "way": [[0.0, 2.0, -3.0]], "speed": 2.0}}
    result = vcmvsp.run(down, set={"physics.kind": "flight", "duration_s": 6.0})
    last = result.states.to_pandas().groupby("vehicle")[["x", "y", "z"]].last()
    assert last["z"].max() < -1.0
    assert result.metrics["safety"]["collisions"] == 0


@pytest.mark.parametrize("kind", ["p2dx", "point"])
def test_other_vehicles_move_as_without_bodies(kind: str) -> None:
    agent = {"kind": "trajectory", "path": "circle", "speed": 0.3, "yaw_rate": 0.2}
    if kind == "point":
        agent = {"kind": "patrol", "flies": True, "way": [[3.0, 1.0, 2.0]]}
    content = {"name": "other", "duration_s": 3.0, "vehicle": [{"name": "one", "kind": kind, "agent": agent}]}
    runs = [vcmvsp.run(content, set={"physics.kind": physics}) for physics in ("kinematic", "flight")]
    assert runs[0].states.equals(runs[1].states)
