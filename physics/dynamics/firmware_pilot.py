"""Quadrotors that firmware flies (`cosim.federate.FlightFirmware`): at each step, sensors are read and rotor speeds are set.

The sensors are those that the vehicle carries: the first `InertialUnit`, `Magnetometer`, `Altimeter` and `Gps` each, with their
errors, otherwise the defaults. They are copies with draws of their own, so that readings of the vehicle's agent stay the same.
The inertial unit is read at every step, whatever its rate. A reading that falls between two steps is taken at the later one.
"""

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import FlightFirmware, FlightReadings
from vcmvsp.cosim.types import Imu, Measured, Reading, VehicleState
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.sensors.motion import Altimeter, InertialUnit, Magnetometer
from vcmvsp.physics.sensors.positioning import Gps
from vcmvsp.physics.sensors.sensor import FittedSensor, Sensor
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.world import Scene, World

LEAST_HZ = 200.0
"""Lowest rate of physics with firmware: rate loops of multicopters need readings at some 200 Hz (PX4, IMU_GYRO_RATEMAX)."""

_ORDER = (0, 2, 1, 3)  # of rotors in a fleet, by the order of `FlightFirmware.exchange`


class OnboardSensor(FittedSensor):
    """A sensor of one vehicle with its own draws, read at steps of physics."""

    def __init__(self, key: str, sensor: Sensor, seed: int) -> None:
        super().__init__(key, sensor, seed)
        self._ticks, self._phase_ns = self.train
        self._due_ns = self._phase_ns
        self._waiting: deque[tuple[int, Reading]] = deque()  # time of delivery, reading

    def read(self, scene: Scene, row: int) -> Reading | None:
        """The reading that is delivered by now, the newest of several; None: none."""
        now_ns = scene.now_ns
        if now_ns >= self._due_ns:
            self._due_ns = self._ticks.after(now_ns - self._phase_ns) + self._phase_ns
            reading = self.sensor.measure(scene, row, self.rng)
            if not self.drops_out():
                self._waiting.append((now_ns + self.latency_ns, reading))
        delivered = None
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, delivered = self._waiting.popleft()
        return delivered


class Onboard:
    """The sensors of one vehicle for its firmware."""

    def __init__(self, spec: VehicleSpec, rate_hz: float, seed: int) -> None:
        at_every_step = {"rate_hz": rate_hz, "phase_s": 0.0, "latency_s": 0.0, "drop_out": 0.0}
        self._sensors: list[OnboardSensor] = []
        for name, kind in _SENSORS.items():
            own = next((each for each in spec.sensors.values() if isinstance(each, kind)), None) or kind()
            changes = at_every_step if kind is InertialUnit else {}
            self._sensors.append(OnboardSensor(f"{spec.name}/firmware/{name}", dataclasses.replace(own, **changes), seed))

    def read(self, scene: Scene, row: int, state: VehicleState) -> FlightReadings:
        """Readings of a vehicle in a row of the scene."""
        imu, field, height, fix = (each.read(scene, row) for each in self._sensors)
        assert isinstance(imu, Imu)  # noqa: S101  it is read at every step
        readings: dict[str, Any] = {"imu": imu, "fix": fix}
        if isinstance(field, Measured):
            readings["field_ut"] = tuple(field.values.values())
        if isinstance(height, Measured):
            readings["height_m"] = height.values["height_m"]
        return FlightReadings(now_ns=scene.now_ns, state=state, **readings)


_SENSORS: Mapping[str, type[Sensor]] = {"imu": InertialUnit, "magnetometer": Magnetometer, "altimeter": Altimeter, "gps": Gps}


class FirmwarePilot:
    """Flies the vehicles of a fleet that have firmware.

    Args:
        specs: the vehicles of the fleet, by its rows.
        rate_hz: steps a second.
    """

    def __init__(
        self,
        firmware: FlightFirmware,
        fleet: QuadrotorFleet,
        specs: Sequence[VehicleSpec],
        *,
        world: World,
        gravity: float,
        rate_hz: float,
        seed: int,
    ) -> None:
        names = [spec.name for spec in specs]
        self._firmware, self._fleet, self._world, self._gravity = firmware, fleet, world, gravity
        self._ticks, self._step = Ticks.rate(rate_hz), 0
        self._rows = [names.index(name) for name in firmware.names]
        self._onboard = [Onboard(specs[row], rate_hz, seed) for row in self._rows]
        self._greatest = [model.max_rotor_speed for row in self._rows if isinstance(model := specs[row].model, Quadrotor)]
        self._held: set[int] = set()
        for row in self._rows:
            fleet.rotor[row] = 0.0  # they stand with still rotors
            fleet.drive(row, (0.0,) * 4)
        fleet.fly_by(self.advance)

    def advance(self, dt: float) -> None:
        """Exchange readings for rotor speeds before a step of ``dt`` s."""
        now_ns, self._step = self._ticks.at(self._step), self._step + 1
        fleet, rows = self._fleet, self._rows
        scene = Scene(
            now_ns=now_ns,
            world=self._world,
            vehicles=(),
            hulls=(),
            position=fleet.position[rows],
            velocity=fleet.velocity[rows],
            attitude=fleet.attitude[rows],
            angular_velocity=fleet.rate[rows],
            acceleration=(fleet.velocity[rows] - fleet.velocity_before[rows]) / dt,
            wheels=np.empty((0, 2)),
            gravity=self._gravity,
        )
        lists = (each.tolist() for each in (scene.position, scene.velocity, scene.attitude, scene.angular_velocity))
        states = [
            VehicleState(position=(*p,), velocity=(*v,), attitude=(*q,), angular_velocity=(*w,))
            for p, v, q, w in zip(*lists, strict=True)
        ]
        readings = [each.read(scene, k, states[k]) for k, each in enumerate(self._onboard)]
        for row, greatest, outputs in zip(rows, self._greatest, self._firmware.exchange(readings), strict=True):
            if outputs is not None:
                fleet.drive(row, [greatest * outputs[k] for k in _ORDER])
            elif row not in self._held:
                self._held.add(row)
                fleet.release(row)
