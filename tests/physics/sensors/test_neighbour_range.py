"""Ranges to neighbours: true, noisy by pair, within reach and in sight."""

import numpy as np
import pytest

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.physics.sensors.detectors import NeighbourRange
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

PLACES = [(0.0, 0.0, 0.0), (3.0, 4.0, 0.0), (0.0, 0.0, 12.0), (30.0, 0.0, 0.0)]


def test_without_noise_it_is_the_distance_to_each_within_reach() -> None:
    scene = scene_of(*PLACES)
    said = [readings(NeighbourRange(sigma_m=0.0), [scene], row=row)[0].values for row in range(4)]
    assert said[0] == {"car1": 5.0, "car2": 12.0}
    assert said[1] == {"car0": 5.0, "car2": 13.0}
    assert said[3] == {}
    far = readings(NeighbourRange(sigma_m=0.0, reach_m=30.0), [scene])[0].values
    assert far == {"car1": 5.0, "car2": 12.0, "car3": 30.0}


def test_noise_is_white_of_the_stated_size_and_independent_from_pair_to_pair() -> None:
    n = 4000
    said = readings(NeighbourRange(sigma_m=0.2, bias_m=0.5), still(n, *PLACES[:3]))
    e = np.array([(reading.values["car1"] - 5.0, reading.values["car2"] - 12.0) for reading in said])
    assert e.mean(axis=0) == pytest.approx(0.5, abs=4 * 0.2 / n**0.5)
    assert e.std(axis=0) == pytest.approx(0.2, rel=4 / (2 * n) ** 0.5)
    assert abs(np.corrcoef(e.T)[0, 1]) < 4 / n**0.5
    assert abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) < 4 / n**0.5


def test_a_further_vehicle_moves_no_draw() -> None:
    few = readings(NeighbourRange(), still(150, *PLACES[:2]))
    many = readings(NeighbourRange(), still(150, *PLACES))
    assert [each.values["car1"] for each in few] == [each.values["car1"] for each in many]
    other = readings(NeighbourRange(), still(150, *PLACES[:2]), "car7/range")
    assert few[0] != other[0]


def test_ranges_are_never_negative() -> None:
    said = readings(NeighbourRange(sigma_m=1.0), still(50, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)))
    assert min(reading.values["car1"] for reading in said) == 0.0


def test_behind_a_wall_it_is_not_seen_where_sight_is_needed() -> None:
    world = World(solids=(Box(center=(1.5, 2.0, 0.5), size=(3.0, 0.2, 2.0)),))
    scene = scene_of(*PLACES, world=world)
    assert set(readings(NeighbourRange(line_of_sight=True), [scene])[0].values) == {"car2"}
    assert set(readings(NeighbourRange(), [scene])[0].values) == {"car1", "car2"}
