"""An obstacle that goes to and fro across the way: scanners see it where it is, robots with a body run into it."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.physics.physics_stepper import stepped
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, Instants, RunInfo
from vcmvsp.cosim.types import Contact, Later
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.range_scanner import RangeScanner
from vcmvsp.physics.vehicles.models import AmigoBot
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Moving, World

BOTH = pytest.mark.parametrize("kind", [KinematicPhysics, BulletPhysics])
CART = Moving(
    name="cart",
    solid=Box(center=(0.0, 0.0, 0.0), size=(0.4, 0.5, 1.0)),
    times_s=(0.0, 4.0, 8.0),
    way=((2.0, -1.0, 0.5, 0.0), (2.0, 1.0, 0.5, 0.0), (2.0, -1.0, 0.5, 0.0)),
    loop=True,
)


def standing(kind: type[Physics], x: float, duration_s: float) -> list[Event]:
    """What is published while a robot stands at x and looks ahead."""
    scan = RangeScanner(beams=721, field_of_view=math.pi, range_max=8.0, position=(0.0, 0.0, 0.3))
    sensors: Any = {"scan": scan}
    car = VehicleSpec(name="car", model=AmigoBot(), position=(x, 0.0, 0.0), sensors=sensors)
    tenth = Instants(Ticks.every(0.1))
    run = RunInfo(scenario="t", seed=1, duration_ns=round(duration_s * SECOND_NS), vehicles=("car",), instants=(tenth,))
    told = []
    for events in stepped(kind(world=World(moving=(CART,)), vehicles=[car]), run, []):
        for event in events:
            value = event.value
            told.append(Event(event.key, event.time_ns, value.get() if isinstance(value, Later) else value))
    return told


@BOTH
def test_scanners_see_it_where_it_is_at_the_time(kind: type[Physics]) -> None:
    """Its near side is 1.8 m ahead; the second time round as the first."""
    scans: list[Any] = [event for event in standing(kind, 0.0, 16.0) if event.key == "car/scan"]
    assert len(scans) > 100
    for event in scans:
        t = event.time_ns / SECOND_NS % 8.0
        y = -1.0 + 0.5 * t if t < 4.0 else 3.0 - 0.5 * t
        ranges = event.value.ranges
        assert ranges.min() == pytest.approx(math.hypot(1.8, max(0.0, abs(y) - 0.25)), abs=0.01)
        bearings = event.value.angle_min + event.value.angle_step * np.flatnonzero(np.isfinite(ranges))
        assert bearings.mean() == pytest.approx(math.atan2(y, 2.0), abs=0.03)


def test_a_robot_in_its_way_is_hit_and_the_contact_counts() -> None:
    """It comes from the right with 0.5 m/s; contacts are told at the next tenth of a second."""
    hits = [event for event in standing(BulletPhysics, 2.0, 3.0) if event.key == "world/contact"]
    assert {event.value for event in hits} == {Contact(vehicle="car", other="cart")}
    apart_m = 1.0 - 0.25 - 0.5 * AmigoBot().hull.size[1]
    assert apart_m / 0.5 < hits[0].time_ns / SECOND_NS < apart_m / 0.5 + 0.12


def test_without_bodies_there_are_no_contacts() -> None:
    assert not [event for event in standing(KinematicPhysics, 2.0, 3.0) if event.key == "world/contact"]
