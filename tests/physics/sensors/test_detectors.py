"""Bumper, ranges to neighbours, and the simulated target detector."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Looks
from vcmvsp.physics.sensors.detectors import Bumper, NeighbourRange, TargetSensor
from vcmvsp.physics.world.floor import GroundTarget
from vcmvsp.physics.world.solids import Box, Hull
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Empty

LONG = Hull((2.0, 1.0, 0.2), (0.3, 0.0, 0.15))
SIDES = {  # in the frame of the hull
    "front": [(1.0, 0.0), (1.0, 0.49), (1.0, -0.49)],
    "left": [(0.0, 0.5), (0.99, 0.5), (-0.99, 0.5)],
    "back": [(-1.0, 0.0), (-1.0, 0.49), (-1.0, -0.49)],
    "right": [(0.0, -0.5), (0.99, -0.5), (-0.99, -0.5)],
}


def pressed(x: float, y: float, *, segments: int = 4, yaw: float = 0.0, hull: Hull = LONG, z: float = 0.1) -> list[str]:
    """Segments pressed by a contact at a place in the frame of the hull."""
    x, y = x + hull.offset[0], y + hull.offset[1]
    place = (5.0 + x * math.cos(yaw) - y * math.sin(yaw), 6.0 + x * math.sin(yaw) + y * math.cos(yaw), z)
    (reading,) = readings(
        Bumper(segments=segments), [scene_of((5.0, 6.0, 0.0), yaw=yaw, hull=hull, touching=[(0, None, place)])]
    )
    assert set(reading.values.values()) <= {0.0, 1.0}
    assert len(reading.values) == segments
    return [name for name, value in reading.values.items() if value]


@pytest.mark.parametrize("yaw", [0.0, 2.0, -1.0])
@pytest.mark.parametrize("side", SIDES)
def test_four_segments_are_the_sides_of_a_box(side: str, yaw: float) -> None:
    for x, y in SIDES[side]:
        assert pressed(x, y, yaw=yaw) == [side]


@given(st.integers(1, 36).filter(lambda n: n != 4), st.floats(0.0, 1.0, exclude_max=True))
def test_segments_of_a_round_hull_share_the_bearings_evenly(segments: int, turn: float) -> None:
    offset = (turn * segments + 0.5) % 1.0
    if 0.001 < offset < 0.999:
        angle = math.tau * turn
        hull = Hull((0.5, 0.5, 0.1), kind="cylinder")
        expected = int(turn * segments + 0.5) % segments
        assert pressed(0.25 * math.cos(angle), 0.25 * math.sin(angle), segments=segments, hull=hull) == [f"s{expected}"]


def test_the_floor_does_not_count_but_a_body_at_its_height_does() -> None:
    assert pressed(1.0, 0.0, z=0.0) == []
    scene = scene_of((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), touching=[(0, 1, (0.25, 0.0, 0.0))])
    assert readings(Bumper(), [scene])[0].values["front"] == 1.0


def test_both_bodies_feel_a_contact_and_others_do_not() -> None:
    scene = scene_of((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (9.0, 0.0, 0.0), touching=[(1, 0, (0.25, 0.0, 0.1))])
    felt = [readings(Bumper(), [scene], row=row)[0].values for row in range(3)]
    assert felt[0] == {"front": 1.0, "left": 0.0, "back": 0.0, "right": 0.0}
    assert felt[1] == {"front": 0.0, "left": 0.0, "back": 1.0, "right": 0.0}
    assert not any(felt[2].values())


PLACES = [(0.0, 0.0, 0.0), (3.0, 4.0, 0.0), (0.0, 0.0, 12.0), (30.0, 0.0, 0.0)]


def test_without_noise_it_is_the_distance_to_each_within_reach() -> None:
    scene = scene_of(*PLACES)
    ranges = [readings(NeighbourRange(sigma_m=0.0), [scene], row=row)[0].values for row in range(4)]
    assert ranges[0] == {"car1": 5.0, "car2": 12.0}
    assert ranges[1] == {"car0": 5.0, "car2": 13.0}
    assert ranges[3] == {}
    far = readings(NeighbourRange(sigma_m=0.0, reach_m=30.0), [scene])[0].values
    assert far == {"car1": 5.0, "car2": 12.0, "car3": 30.0}


def test_noise_is_white_of_the_stated_size_and_independent_from_pair_to_pair() -> None:
    n = 4000
    samples = readings(NeighbourRange(sigma_m=0.2, bias_m=0.5), still(n, *PLACES[:3]))
    e = np.array([(reading.values["car1"] - 5.0, reading.values["car2"] - 12.0) for reading in samples])
    assert e.mean(axis=0) == pytest.approx(0.5, abs=4 * 0.2 / n**0.5)
    assert e.std(axis=0) == pytest.approx(0.2, rel=4 / (2 * n) ** 0.5)
    assert abs(np.corrcoef(e.T)[0, 1]) < 4 / n**0.5
    assert abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) < 4 / n**0.5


def test_another_vehicle_changes_no_draw() -> None:
    few = readings(NeighbourRange(), still(150, *PLACES[:2]))
    many = readings(NeighbourRange(), still(150, *PLACES))
    assert [each.values["car1"] for each in few] == [each.values["car1"] for each in many]
    other = readings(NeighbourRange(), still(150, *PLACES[:2]), "car7/range")
    assert few[0] != other[0]


def test_ranges_are_never_negative() -> None:
    samples = readings(NeighbourRange(sigma_m=1.0), still(50, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)))
    assert min(reading.values["car1"] for reading in samples) == 0.0


def test_walls_block_ranges_that_need_sight() -> None:
    world = World(solids=(Box(center=(1.5, 2.0, 0.5), size=(3.0, 0.2, 2.0)),))
    scene = scene_of(*PLACES, world=world)
    assert set(readings(NeighbourRange(line_of_sight=True), [scene])[0].values) == {"car2"}
    assert set(readings(NeighbourRange(), [scene])[0].values) == {"car1", "car2"}


def look(sensor: TargetSensor, world: World, *place: float, seed: int = 1, t: float = 0.0) -> Looks:
    return sensor.measure(scene_of(place, t=t, world=world), 0, stream(seed, "sensor"))


def world_of(*targets: GroundTarget, **keys: Any) -> World:
    return Empty(targets=targets, **keys).build()


def said(looks: Looks) -> set[tuple[int, int]]:
    return {(i, j) for i, j in looks.cells[looks.hits].tolist()}


def expected_cells(x: float, y: float, reach_m: float, cell_m: float) -> list[list[int]]:
    """Cells one by one, from the definition."""
    far = math.ceil(reach_m / cell_m) + 2
    about = [(math.floor(x / cell_m) + i, math.floor(y / cell_m) + j) for j in range(-far, far) for i in range(-far, far)]
    return [[i, j] for i, j in about if math.hypot((i + 0.5) * cell_m - x, (j + 0.5) * cell_m - y) <= reach_m]


@pytest.mark.parametrize("seed", range(20))
def test_the_cells_are_those_with_their_middle_within_reach(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (x, y), reach_m, cell_m = rng.uniform(-60, 60, 2).tolist(), float(rng.uniform(1, 12)), float(rng.uniform(0.4, 3))
    looks = look(TargetSensor(reach_m=reach_m, cell_m=cell_m), World(), x, y, 20.0)
    assert looks.cells.tolist() == expected_cells(x, y, reach_m, cell_m)
    assert looks.cell_m == cell_m
    assert [str(each.dtype) for each in (looks.cells, looks.hits)] == ["int32", "bool"]
    assert looks.hits.shape == (len(looks.cells),)


def test_no_cell_lies_beyond_the_bounds() -> None:
    looks = look(TargetSensor(), world_of(bounds=(-50.0, -50.0, 50.0, 50.0)), 49.0, -48.0, 20.0)
    columns, rows = looks.cells.T.tolist()
    assert (max(columns), min(rows)) == (24, -25)  # last 2 m cells inside the bounds
    assert [each for each in expected_cells(49.0, -48.0, 8.0, 2.0) if each[0] <= 24 and each[1] >= -25] == looks.cells.tolist()


def test_too_many_cells_are_refused_and_none_lie_beyond_the_bounds() -> None:
    sensor = TargetSensor(reach_m=1e5, cell_m=0.1)
    with pytest.raises(ScenarioError, match="use larger cells") as caught:
        look(sensor, World(), 0.0, 0.0, 20.0)
    assert caught.value.key == "target_sensor.cell_m"
    assert len(look(sensor, world_of(bounds=(-5.0, -5.0, 5.0, 5.0)), 0.0, 0.0, 20.0).cells) == 100 * 100
    assert len(look(sensor, world_of(bounds=(-5.0, -5.0, 5.0, 5.0)), -3e5, 0.0, 20.0).cells) == 0


def test_without_errors_it_reports_current_targets() -> None:
    world = world_of(
        GroundTarget(place=(3.9, -0.1)), GroundTarget(way=((0.0, 5.0), (4.0, 5.0)), speed=1.0), GroundTarget(place=(30.0, 0.0))
    )
    sensor = TargetSensor(p=1.0, q=0.0)
    for t, column in ((0.0, 0), (1.9, 0), (2.1, 1), (9.0, 2)):
        assert said(look(sensor, world, 1.0, 1.0, 30.0, t=t)) == {(1, -1), (column, 2)}
    contrary = look(TargetSensor(p=0.0, q=1.0), world, 1.0, 1.0, 30.0)
    assert {(i, j) for i, j in contrary.cells[~contrary.hits].tolist()} == {(1, -1), (0, 2)}


def hit_counts(sensor: TargetSensor, world: World, number: int) -> tuple[Array, Array]:
    """Answers for the cell of the origin, and numbers of hits in all other cells, (number,) each."""
    scenes = [scene_of((0.5, 0.5, 10.0), t=float(k), world=world) for k in range(number)]
    own, others = [], []
    for looks in readings(sensor, scenes):
        (here,) = np.flatnonzero((looks.cells == 0).all(axis=1))
        own.append(looks.hits[here])
        others.append(int(looks.hits.sum()) - int(looks.hits[here]))
    return np.array(own), np.array(others)


def test_answers_are_independent_draws_with_p_and_q() -> None:
    number, p, q = 3000, 0.8, 0.15
    own, others = hit_counts(TargetSensor(p=p, q=q), world_of(GroundTarget(place=(1.0, 1.0))), number)
    cells = len(expected_cells(0.5, 0.5, 8.0, 2.0)) - 1
    assert abs(own.mean() - p) < 4.0 * math.sqrt(p * (1 - p) / number)  # binomial, four standard deviations
    assert abs(others.mean() - q * cells) < 4.0 * math.sqrt(q * (1 - q) * cells / number)
    assert others.var() == pytest.approx(q * (1 - q) * cells, rel=4.0 * math.sqrt(2.0 / number))  # as of independent draws
    after = np.corrcoef(own[1:], own[:-1])[0, 1], np.corrcoef(others[1:], others[:-1])[0, 1], np.corrcoef(own, others)[0, 1]
    assert max(map(abs, after)) < 4.0 / math.sqrt(number)
