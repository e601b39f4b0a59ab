"""Invariants of an aerial vehicle behind the supervisor, for any commands."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hardware.safety.test_ground_laws import FENCES, PERIOD_NS, RADIUS, STARTS, heard, limits, room
from tests.support.hardware.supervised_flight import Flight, flight_of, safety_of
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.safety.aerial_supervisor import AerialSupervisor
from vcmvsp.hardware.safety.obstacles import Others
from vcmvsp.hardware.safety.supervisor import Cause, Limits, Safety

pytestmark = pytest.mark.slow

QUAD = Limits(max_speed=2.0, max_yaw_rate=1.5, accel=1.5, decel=2.0, yaw_accel=3.0, yaw_decel=3.0)
APART = safety_of(QUAD, max_climb=1.0, radius_m=0.2, separation_m=0.3)
reals = st.floats(-4.0, 4.0) | st.sampled_from([0.0, 1.0, -1.0])
commands = st.tuples(reals, reals, reals, reals)


def velocity_of(command: Flight) -> Velocity:
    return Velocity(linear=command[:3], yaw_rate=command[3])


def others_at(places: Any, velocity: Any = None) -> Others:
    """Vehicles of radius 0.2 m at x, y, z."""
    rows = np.array(places, float).reshape(-1, 3)
    return Others(rows, np.zeros_like(rows) if velocity is None else np.array(velocity, float), np.full(len(rows), 0.2))


def fly(
    parameters: Safety,
    place: Flight,
    orders: list[tuple[Flight, int]],
    others: Others | None = None,
    ideal: bool = False,
) -> list[tuple[Flight, Flight, Any]]:
    """Place, speeds and decision after each piece of a flight; each command lasts for some periods."""
    supervisor, now, speeds, pieces = AerialSupervisor(parameters), 0, (0.0, 0.0, 0.0, 0.0), []
    for command, periods in orders:
        for _ in range(periods):
            decision = supervisor.step(now, velocity_of(command), place, others, heard(now))
            sent: Flight = (*decision.command.linear, decision.command.yaw_rate)
            for each in flight_of(place, speeds, sent, 0.1, parameters, ideal=ideal):
                place, speeds = each
                pieces.append((place, speeds, decision))
            now += PERIOD_NS
    return pieces


def flights(most: int) -> st.SearchStrategy[list[tuple[Flight, int]]]:
    return st.lists(st.tuples(commands, st.integers(1, 12)), min_size=1, max_size=most)


def test_it_flies_over_another_and_does_not_come_down_on_it() -> None:
    other = others_at([(3.0, 0.0, 1.0)])
    over = fly(APART, (0.0, 0.0, 2.0, 0.0), [((1.5, 0.0, 0.0, 0.0), 40)], other)
    assert over[-1][0][0] > 5.0
    assert all(decision.causes == () for _, _, decision in over[60:])
    down = fly(APART, (3.1, 0.1, 2.5, 0.0), [((0.0, 0.0, -1.0, 0.0), 40)], other)
    assert down[-1][0][2] == pytest.approx(1.7, abs=1e-2)
    assert down[-1][2].causes[-1] is Cause.SEPARATION
    beside = fly(APART, (0.0, 0.0, 1.0, 0.0), [((1.5, 0.0, 0.0, 0.0), 40)], other)
    assert beside[-1][0][0] == pytest.approx(2.3, abs=1e-2)
    away = fly(APART, (0.0, 0.0, 2.0, 0.0), [((0.0, 0.0, -1.0, 0.0), 40)], other)
    assert away[-1][0][2] < -1.0  # far to the side, every height is free


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slanting_flight_misses_another(sign: float) -> None:
    """Distance is kept above, beside and in between, and used up to 1 cm."""
    other, nearest = others_at([(3.0, 0.0, 0.0)]), []
    for tenth in range(10, 40):
        slant = [((1.5, 0.0, -sign, 0.0), 40)]
        pieces = fly(APART, (0.0, 0.0, 0.1 * tenth * sign, 0.0), slant, other)
        gaps = [max(math.hypot(x - 3.0, y), abs(z)) - 0.7 for (x, y, z, _), _, _ in pieces]
        assert min(gaps) >= -1e-6
        nearest.append(min(gaps))
    assert min(nearest) < 0.01


@pytest.mark.parametrize("inside", [0.0, 1e-12, 0.05])
def test_a_vehicle_slightly_too_near_comes_no_nearer(inside: float) -> None:
    """Poses have errors: a vehicle below another one must not pass through it because it is 1 mm too near."""
    other, z = others_at([(0.0, 0.0, 1.7)]), 1.0 + inside
    assert fly(APART, (0.1, 0.0, z, 0.0), [((0.0, 0.0, 1.0, 0.0), 20)], other)[-1][0][2] == pytest.approx(z, abs=1e-9)
    assert fly(APART, (0.1, 0.0, z, 0.0), [((0.0, 0.0, -1.0, 0.0), 20)], other)[-1][0][2] < 0.0
    assert fly(APART, (0.1, 0.0, z, 0.0), [((1.0, 0.0, 0.0, 0.0), 20)], other)[-1][0][0] > 1.0


def test_without_others_it_flies() -> None:
    nobody = Others(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert fly(APART, (0.0, 0.0, 1.0, 0.0), [((1.5, 0.0, 0.0, 0.0), 40)], nobody)[-1][0][0] > 4.0


@settings(max_examples=40)
@given(keep=limits, ideal=st.booleans(), c=st.floats(0.1, 1.0), way=st.sampled_from(["beside", "above", "below"]))
def test_it_stands_before_an_approaching_one_at_the_distance(keep: Limits, ideal: bool, c: float, way: str) -> None:
    axis, sign = {"beside": (0, 1.0), "above": (2, 1.0), "below": (2, -1.0)}[way]
    parameters = safety_of(keep, max_climb=1.5, radius_m=RADIUS, separation_m=0.3)
    supervisor, place, speeds, now = AerialSupervisor(parameters), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), 0
    at, going, ask = np.zeros(3), np.zeros(3), [0.0, 0.0, 0.0]
    at[axis], going[axis], ask[axis] = 5.0 * sign, -c * sign, 3.0 * sign
    while sign * (at[axis] - place[axis]) - RADIUS - 0.2 >= 0.3:
        command = Velocity(linear=(ask[0], ask[1], ask[2]))
        sent = supervisor.step(now, command, place, others_at([at], [going]), heard(now)).command
        place, speeds = list(flight_of(place, speeds, (*sent.linear, 0.0), 0.1, keep, ideal=ideal))[-1]
        at, now = at + 0.1 * going, now + PERIOD_NS
    assert sign * (at[axis] - place[axis]) - RADIUS - 0.2 >= 0.3 - 0.1 * c - 1e-6
    assert abs(speeds[axis]) <= 0.1 * keep.decel + 1e-9


def test_it_climbs_from_the_ground_through_the_floor_for_good() -> None:
    parameters = safety_of(QUAD, max_climb=1.0, radius_m=0.2, floor_m=0.5, ceiling_m=2.0)
    pieces = fly(
        parameters, (0.0, 0.0, 0.0, 0.0), [((0.0, 0.0, -1.0, 0.0), 10), ((0.0, 0.0, 1.0, 0.0), 40), ((1.0, 0.0, -1.0, 0.0), 40)]
    )
    heights = [place[2] for place, _, _ in pieces]
    assert min(heights) == 0.0
    assert max(heights) == pytest.approx(2.0, abs=1e-2)
    assert heights[-1] == pytest.approx(0.5, abs=1e-2)
    assert pieces[-1][0][0] > 3.0  # the floor does not block horizontal flight
    assert pieces[-1][2].causes == (Cause.LIMITS, Cause.GEOFENCE)


def test_at_the_fence_it_stands_and_can_leave() -> None:
    for name, fence in FENCES.items():
        parameters = safety_of(QUAD, max_climb=1.0, radius_m=RADIUS, fence=fence)
        x, y = STARTS[name]
        pieces = fly(parameters, (x, y, 1.0, 0.0), [((1.9, 0.4, 0.0, 0.0), 80)])
        standing = pieces[-1]
        assert room(fence, *standing[0][:2]) == pytest.approx(RADIUS, abs=1e-2)
        assert math.hypot(*standing[1][:2]) < 1e-2
        assert standing[2].causes[-1] is Cause.GEOFENCE
        away = fly(parameters, standing[0], [((-1.0, -0.2, 0.0, 0.0), 10)])
        assert room(fence, *away[-1][0][:2]) > RADIUS + 0.05


@pytest.mark.parametrize(("low", "high"), [(2.0, 1.0), (1.0, 1.0), (math.nan, 1.0), (0.0, math.inf)])
def test_the_floor_is_below_the_ceiling(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="below ceiling_m"):
        AerialSupervisor(safety_of(QUAD, max_climb=1.0, radius_m=0.2, floor_m=low, ceiling_m=high))
