"""The bumper: which segments of the hull touch something."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.physics.sensor_scenes import readings, scene_of
from vcmvsp.physics.sensors.detectors import Bumper
from vcmvsp.physics.world.solids import Hull

LONG = Hull((2.0, 1.0, 0.2), (0.3, 0.0, 0.15))
SIDES = {  # in the frame of the hull
    "front": [(1.0, 0.0), (1.0, 0.49), (1.0, -0.49)],
    "left": [(0.0, 0.5), (0.99, 0.5), (-0.99, 0.5)],
    "back": [(-1.0, 0.0), (-1.0, 0.49), (-1.0, -0.49)],
    "right": [(0.0, -0.5), (0.99, -0.5), (-0.99, -0.5)],
}


def pressed(x: float, y: float, *, segments: int = 4, yaw: float = 0.0, hull: Hull = LONG, z: float = 0.1) -> list[str]:
    """Segments that say 1 when a place in the frame of the hull touches the world."""
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
