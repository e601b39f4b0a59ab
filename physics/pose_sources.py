"""What vehicles take for their own states, over a run: fixes are measured, estimators fed, and both published.

An estimator (pose source ``fusion``) is fed with what the wheels went at 10 Hz, as often as a Pioneer tells it, and at the
vehicle's own fixes. These instants depend on nothing but the vehicle: were it fed wherever somebody looks, a recording with
another period would cut the motion otherwise, and so change the last digits of what its agent sees. In between, it goes on at
the speeds that it was told last, as on a real robot.
"""

import copy
from collections.abc import Sequence
from math import isnan

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.frames import travelled
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Fix, Odometry, Vec3, VehicleState
from vcmvsp.physics.engine.interface import Motion
from vcmvsp.physics.sensors.pose_estimate import Fuser, estimate, state_of
from vcmvsp.physics.vehicles.specification import VehicleSpec

_FED = Ticks.rate(10.0)
_LEAST_SIGMA_M = 1e-3  # of a fix, for an estimator that could not divide by 0


class PoseSources:
    """Those of the vehicles with these ``numbers``, which are their rows."""

    def __init__(self, vehicles: Sequence[VehicleSpec], numbers: Sequence[int], seed: int) -> None:
        specs = [(number, vehicles[number]) for number in numbers]
        self._numbers = [*numbers]
        self._told = [(n, spec.pose_source, f"{spec.name}/estimate", f"{spec.name}/odometry") for n, spec in specs]
        self._sensors = [
            (
                number,
                spec.name,
                spec.positioning,
                Ticks.rate(spec.positioning.rate_hz),
                stream(seed, f"{spec.name}/positioning"),
            )
            for number, spec in specs
            if spec.positioning is not None
        ]
        self._fixes: dict[int, Fix] = {}
        self._fusers = {number: _Fed(_fuser(spec)) for number, spec in specs if spec.pose_source == "fusion"}

    @property
    def instants(self) -> tuple[Instants, ...]:
        """When fixes are measured, with the keys that say so."""
        return tuple(Instants(ticks, key=f"vehicle.{name}.positioning.rate_hz") for _, name, _, ticks, _ in self._sensors)

    def due(self, now_ns: int) -> bool:
        """Whether a fix is to be measured now."""
        return any(ticks.hits(now_ns) for *_, ticks, _ in self._sensors)

    def next_fed_ns(self, now_ns: int) -> int | None:
        """The first instant after now at which estimators are fed; None: there are none."""
        return _FED.after(now_ns) if self._fusers else None

    def feed(self, now_ns: int, motion: Motion) -> None:
        """Tell all estimators how far the wheels went."""
        for number, fed in self._fusers.items():
            fed.odometry(now_ns, _pose(motion, number))

    def measure(self, now_ns: int, motion: Motion) -> list[Event]:
        """The fixes of this instant."""
        events = []
        for number, name, sensor, ticks, rng in self._sensors:
            if ticks.hits(now_ns):
                fix = self._fixes[number] = sensor.measure(now_ns, state_of(motion, number), rng)
                if number in self._fusers:
                    self._fusers[number].odometry(now_ns, _pose(motion, number))
                    self._fusers[number].fix(fix)
                events.append(Event(f"{name}/fix", now_ns, fix))
        return events

    def estimates(self, now_ns: int, motion: Motion) -> list[Event]:
        """What each vehicle takes for its own state, and what its wheels say."""
        numbers = np.concatenate((*motion[:4], motion.odometry), axis=1)
        if len(self._told) < len(numbers):
            numbers = numbers[self._numbers]
        events = []
        for (number, source, estimate_key, odometry_key), row in zip(self._told, numbers.tolist(), strict=True):
            px, py, pz, vx, vy, vz, qw, qx, qy, qz, wx, wy, wz, x, y, yaw, v, w = row
            odometry = None if isnan(x) else Odometry(pose=(x, y, yaw), v=v, w=w)
            believed = VehicleState(
                position=(px, py, pz), velocity=(vx, vy, vz), attitude=(qw, qx, qy, qz), angular_velocity=(wx, wy, wz)
            )
            if source != "truth":
                fused = self._fusers[number].fuser.estimate(now_ns) if number in self._fusers else None
                believed = estimate(source, believed, odometry, self._fixes.get(number), fused)
            events.append(Event(estimate_key, now_ns, believed))
            if odometry is not None:
                events.append(Event(odometry_key, now_ns, odometry))
        return events


class _Fed:
    """An estimator, and the odometry that it knows."""

    def __init__(self, fuser: Fuser) -> None:
        self.fuser = fuser
        self._last: tuple[int, Vec3] | None = None

    def odometry(self, now_ns: int, pose: Vec3) -> None:
        """Tell it the motion up to this pose, unless it was told already."""
        then_ns, before = self._last or (-1, pose)
        if now_ns > then_ns:
            self.fuser.odometry(now_ns, *travelled(before, pose))
            self._last = now_ns, pose

    def fix(self, fix: Fix) -> None:
        """Tell it a position."""
        x, y, _ = fix.position
        self.fuser.fix(fix.time_ns, x, y, max(fix.sigma_m, _LEAST_SIGMA_M))


def _fuser(spec: VehicleSpec) -> Fuser:
    """A fresh estimator."""
    if spec.fusion is None:
        key = f"vehicle.{spec.name}.pose_source"
        raise ScenarioError('"fusion" needs an estimator, and the vehicle was given none', key=key)
    return copy.deepcopy(spec.fusion)


def _pose(motion: Motion, number: int) -> Vec3:
    x, y, yaw = motion.odometry[number, :3].tolist()
    return x, y, yaw
