"""Engines with bodies, and a run of one vehicle."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import ENGINES, OPEN, engine
from tests.support.physics.runs import play
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Instants
from vcmvsp.physics.federate import Physics
from vcmvsp.physics.vehicles.models import GroundVehicle
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import World


@pytest.fixture(params=ENGINES)
def kind(request: pytest.FixtureRequest) -> type[Physics]:
    """Physics of each engine with bodies."""
    return request.param


@pytest.fixture(autouse=True)
def _close_engines() -> Iterator[None]:
    """Engines of `tests.support.physics.engines.engine` end with their test."""
    yield
    while OPEN:
        OPEN.pop().close()


@pytest.fixture
def either(kind: type[Physics]) -> Callable[..., Any]:
    """Factory of that engine, see `tests.support.physics.engines.engine`."""
    return partial(engine, kind=kind)


@pytest.fixture
def drive() -> Callable[..., Any]:
    """Drive one vehicle from the origin; arrays over time of its true motion and odometry."""

    def run(
        kind: type[Physics],
        model: GroundVehicle,
        commands: Sequence[tuple[float, float, float]],
        duration_s: float,
        *,
        hz: float = 10.0,
        world: World | None = None,
        **parameters: Any,
    ) -> SimpleNamespace:
        spec = VehicleSpec(name="car", model=model, position=(0.0, 0.0, 0.0))
        physics = kind(world=world or World(), vehicles=[spec], **parameters)
        named = [(at_s, "car", v, w) for at_s, v, w in commands]
        steps = play(physics, named, duration_s, [Instants(Ticks.rate(hz))])
        values = [{event.key: event.value for event in events} for events in steps]
        states: Any = [value["car/estimate"] for value in values]
        wheels: Any = [value["car/odometry"] for value in values]
        attitude = np.array([state.attitude for state in states])
        return SimpleNamespace(
            t=np.array([events[0].time_ns for events in steps]) / 1e9,
            position=np.array([state.position for state in states]),
            yaw=np.unwrap([state.yaw for state in states]),
            pitch=np.arcsin(2.0 * (attitude[:, 0] * attitude[:, 2] - attitude[:, 3] * attitude[:, 1])),
            speed=np.array([np.hypot(*state.velocity[:2]) for state in states]),
            yaw_rate=np.array([state.angular_velocity[2] for state in states]),
            odometry=np.array([wheel.pose for wheel in wheels]),
            wheel_speed=np.array([wheel.v for wheel in wheels]),
            contacts=[event for events in steps for event in events if event.key == "world/contact"],
        )

    return run
