"""One [[vehicle]] table for many vehicles."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.loader import load, repeated

SWARM = {
    "name": "swarm",
    "duration_s": 1.0,
    "vehicle": [
        {"name": "uav", "kind": "kinematic", "count": 6, "columns": 3, "spacing": [10.0, 20.0], "position": [1.0, 2.0, 3.0]},
        {"name": "car1", "kind": "kinematic", "pose": [5.0, 5.0, 0.5]},
    ],
}


def test_copies_stand_in_rows_and_others_are_unchanged() -> None:
    parsed, _ = load(SWARM)
    assert [each.name for each in parsed.vehicle] == [*(f"uav{i}" for i in range(1, 7)), "car1"]
    places = [each.start[0] for each in parsed.vehicle]
    assert places[:6] == [(1.0 + 10.0 * (i % 3), 2.0 + 20.0 * (i // 3), 3.0) for i in range(6)]
    assert parsed.vehicle[-1].start == ((5.0, 5.0, 0.0), 0.5)


@given(count=st.integers(1, 200), columns=st.none() | st.integers(1, 20))
def test_no_two_copies_share_a_name_or_a_place(count: int, columns: int | None) -> None:
    one = {"name": "a", "count": count, **({} if columns is None else {"columns": columns})}
    copies = repeated([one], Source("test", Path()))
    assert len(copies) == count == len({each["name"] for each in copies}) == len({tuple(each["position"]) for each in copies})


def test_one_copy_or_all_can_be_set_by_name() -> None:
    parsed, _ = load(SWARM, settings={"vehicle.uav.count": 2, "vehicle.uav2.kind": "lag", "vehicle.uav.heading": 1.0})
    assert [each.kind for each in parsed.vehicle] == ["kinematic", "lag", "kinematic"]
    assert [each.heading for each in parsed.vehicle] == [1.0, 1.0, 0.0]


@pytest.mark.parametrize("place", ["pose", "position"])
def test_each_copy_is_turned_further(place: str) -> None:
    start = {"pose": [0.0, 0.0, 0.5]} if place == "pose" else {"position": [0.0, 0.0, 0.0], "heading": 0.5}
    one = {"name": "v", "kind": "kinematic", "count": 4, "turn_rad": 2.4, **start}
    parsed, _ = load({"name": "x", "duration_s": 1.0, "vehicle": [one]})
    headings = [each.heading if each.pose is None else each.pose[2] for each in parsed.vehicle]
    assert headings == pytest.approx([0.5 + 2.4 * number for number in range(4)])


@pytest.mark.parametrize("place", ["pose", "position"])
def test_a_seed_draws_starts_within_the_spread(place: str) -> None:
    start = {"pose": [0.0, 0.0, 0.5]} if place == "pose" else {"position": [0.0, 0.0, 1.0], "heading": 0.5}
    one = {"name": "v", "kind": "kinematic", "count": 50, "spacing": [10.0, 0.0], "spread": [4.0, 0.0, math.pi], **start}
    scenario = {"name": "x", "duration_s": 1.0, "vehicle": [one]}

    def starts(seed: int, settings: dict[str, Any] | None = None) -> list[Any]:
        return [each.start for each in load(scenario, seed=seed, settings=settings).scenario.vehicle]

    offsets = [(x - 10.0 * number, y, yaw - 0.5) for number, ((x, y, _), yaw) in enumerate(starts(1))]
    east, north, turn = (np.array(each) for each in zip(*offsets, strict=True))
    assert north.tolist() == [0.0] * 50
    assert (abs(east).max() <= 4.0, abs(turn).max() <= math.pi) == (True, True)
    assert (abs(east).max() > 3.5, abs(turn).max() > 0.8 * math.pi) == (True, True)
    assert starts(1) == starts(1)
    assert all(first != second for first, second in zip(starts(1), starts(2), strict=True))
    assert starts(2, {"vehicle.v.count": 3}) == starts(2)[:3]  # another vehicle changes no other's start
    assert starts(2, {"vehicle.v7.kind": "lag", "seed": 1}) == starts(2)


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"count": 0}, "vehicle.uav.count"),
        ({"count": 2.5}, "vehicle.uav.count"),
        ({"columns": 3}, "vehicle.uav.columns"),
        ({"count": 2, "spacing": [1.0]}, "vehicle.uav.spacing"),
        ({"spread": [1.0, 1.0, 0.0]}, "vehicle.uav.spread"),
        ({"count": 2, "spread": [1.0, -1.0, 0.0]}, "vehicle.uav.spread"),
        ({"count": 2, "position": "here"}, "vehicle.uav.position"),
    ],
)
def test_invalid_repetitions_are_refused(keys: dict[str, object], key: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        load({**SWARM, "vehicle": [{"name": "uav", "kind": "kinematic", **keys}]})
    assert raised.value.key == key


def test_a_pose_or_a_position_but_not_both() -> None:
    with pytest.raises(ScenarioError, match="either pose, or position and heading"):
        load({**SWARM, "vehicle": [{"name": "a", "kind": "kinematic", "pose": [1, 0, 0], "position": [1, 0, 0]}]})
