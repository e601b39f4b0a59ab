"""Scenes made by hand, and readings of sensors in them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.rng import stream
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import Scene, World

SECOND_NS = 1_000_000_000
HULL = Hull((0.5, 0.4, 0.2), (0.0, 0.0, 0.15))


def scene_of(
    *places: Sequence[float],
    t: float = 0.0,
    yaw: float = 0.0,
    attitude: Any = None,
    rate: Sequence[float] = (0.0, 0.0, 0.0),
    acceleration: Sequence[float] = (0.0, 0.0, 0.0),
    wheels: Sequence[float] = (np.nan, np.nan),
    world: World | None = None,
    hull: Hull = HULL,
    hulls: Sequence[Hull] | None = None,
    touching: Any = (),
) -> Scene:
    """Vehicles car0, car1, ... at these places (default: one at the origin), with equal states unless ``attitude`` has rows."""
    position = np.array(places or [(0.0, 0.0, 0.0)], float)
    n = len(position)

    def rows(values: Any) -> Any:
        return np.array(np.broadcast_to(np.array(values, float), (n, np.shape(values)[-1])))

    return Scene(
        now_ns=round(t * SECOND_NS),
        world=world or World(),
        vehicles=tuple(f"car{number}" for number in range(n)),
        hulls=tuple(hulls or [hull] * n),
        position=position,
        velocity=np.zeros((n, 3)),
        attitude=rows(quaternion_from_yaw(yaw) if attitude is None else attitude),
        angular_velocity=rows(rate),
        acceleration=rows(acceleration),
        wheels=rows(wheels),
        touching=touching,
    )


def readings(sensor: Sensor, scenes: Sequence[Scene], name: str = "car0/sensor", row: int = 0) -> list[Any]:
    """Readings of one sensor in consecutive scenes."""
    rng = stream(1, name)
    return [sensor.measure(scene, row, rng) for scene in scenes]


def still(count: int, *places: Sequence[float], hz: float = 10.0, **state: Any) -> list[Scene]:
    """The same scene at all times."""
    return [scene_of(*places, t=number / hz, **state) for number in range(count)]
