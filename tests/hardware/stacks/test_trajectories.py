"""Laws of uploaded trajectories: both formats, time, direction and place."""

import itertools
import math

import numpy as np
import pytest

from vcmvsp.hardware.stacks.trajectories import HEADER, PIECE, START, Piece, Trajectory, compressed, uncompressed

RNG = np.random.default_rng(1)
PIECES = tuple(Piece(duration, tuple(map(tuple, RNG.normal(size=(4, 8)).tolist()))) for duration in (0.5, 1.25))


def near(values: object) -> object:
    return pytest.approx(values, rel=1e-6, abs=1e-6)


def test_uploaded_round_trip() -> None:
    memory = b"".join(PIECE.pack(*(each for axis in piece.axes for each in axis), piece.duration_s) for piece in PIECES)
    for piece, expected in zip(uncompressed(b"\0" * 7 + memory, 7, 2), PIECES, strict=True):
        assert piece.duration_s == expected.duration_s
        assert np.array(piece.axes) == near(np.array(expected.axes))


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("time_scale", [0.5, 1.0, 3.0])
def test_velocity_is_the_derivative_of_the_place(time_scale: float, *, backwards: bool) -> None:
    flown, step = Trajectory(PIECES, time_scale, backwards, (1.0, 2.0, 3.0), turn=0.7), 1e-6
    for time_s in (0.2 * time_scale, 0.45 * time_scale, 1.5 * time_scale):
        before, after, now = flown.at(time_s - step), flown.at(time_s + step), flown.at(time_s)
        rates = (np.array([*after.position, after.yaw]) - [*before.position, before.yaw]) / (2.0 * step)
        assert [*now.velocity, now.yaw_rate] == pytest.approx(rates, rel=1e-4, abs=1e-4)


def test_a_reversed_trajectory_is_the_same_way_back_and_a_slow_one_the_same_way() -> None:
    forward, back, slow = Trajectory(PIECES), Trajectory(PIECES, reversed=True), Trajectory(PIECES, 2.0)
    for time_s in (0.0, 0.3, 0.9, 1.7):
        assert back.at(forward.duration_s - time_s).position == near(forward.at(time_s).position)
        assert slow.at(2.0 * time_s).position == near(forward.at(time_s).position)
        assert slow.at(2.0 * time_s).velocity == near(tuple(0.5 * each for each in forward.at(time_s).velocity))
    assert forward.at(99.0) == forward.at(forward.duration_s)
    assert forward.at(99.0).velocity == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("backwards", [False, True])
def test_a_moved_trajectory_begins_at_its_place(*, backwards: bool) -> None:
    own = Trajectory(PIECES, reversed=backwards)
    moved = own.moved_to((4.0, 5.0, 6.0), None)
    assert moved.at(0.0).position == near((4.0, 5.0, 6.0))
    way = np.subtract(moved.at(0.8).position, moved.at(0.0).position)
    assert way == near(np.subtract(own.at(0.8).position, own.at(0.0).position))


def test_a_turned_trajectory_has_its_yaw() -> None:
    at_origin = Piece(1.0, ((0.0, 1.0), (0.0,), (0.0,), (0.5,)))
    turned = Trajectory((at_origin,)).moved_to((1.0, 1.0, 1.0), 0.5 + math.pi / 2)
    assert turned.at(0.0).yaw == near(0.5 + math.pi / 2)
    assert turned.at(1.0).position == near((1.0, 2.0, 1.0))


def bezier(points: "list[float]", share: float) -> float:
    """Point of a Bezier curve by de Casteljau's construction."""
    while len(points) > 1:
        points = [(1.0 - share) * a + share * b for a, b in itertools.pairwise(points)]
    return points[0]


@pytest.mark.parametrize(("kind", "count"), [(0, 0), (1, 1), (2, 3), (3, 7)])
def test_a_compressed_axis_is_a_bezier_curve_behind_its_last_value(kind: int, count: int) -> None:
    numbers = [300 * k * (-1) ** k for k in range(1, count + 1)]
    body = b"".join(number.to_bytes(2, "little", signed=True) for number in numbers)
    memory = START.pack(1000, 250, -500, 900) + HEADER.pack(kind, 2000) + body + HEADER.pack(1, 500) + b"\0\0" + bytes(3)
    pieces = compressed(memory, 0)
    assert [piece.duration_s for piece in pieces] == [2.0, 0.5]
    points = [1.0, *(0.001 * number for number in numbers)]
    flown = Trajectory(pieces)
    for share in (0.0, 0.3, 0.8, 1.0):
        pose = flown.at(2.0 * share)
        assert pose.position == near((bezier(points, share), 0.25, -0.5))
        assert pose.yaw == near(math.pi / 2)
    assert flown.at(2.25).position[0] == near(0.5 * points[-1])  # half-way to 0
