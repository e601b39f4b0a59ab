"""Pose sources of vehicles over a run: measures fixes, feeds the estimators, and publishes both.

An estimator (pose source ``fusion``) gets the wheels' motion at 10 Hz, the rate of a Pioneer, and at the vehicle's own fixes.
These instants depend on the vehicle alone: fed at every publication instead, the last digits of an estimate would depend on the
recording's period. Between them it continues at the last speeds, as on a real robot.
"""

import copy
from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.fusion import FusedPose, Fusion
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.frames import quaternion_from_yaw, travelled, yaw_of
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Fix, Odometry, Vec3, VehicleState
from vcmvsp.physics.dynamics.engine import BodyMotion
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.specification import VehicleSpec

_FEED_TICKS = Ticks.rate(10.0)
_LEAST_SIGMA_M = 1e-3  # of a fix, for estimators that divide by it


class _FixSource(NamedTuple):
    row: int
    vehicle: str
    sensor: Positioning
    ticks: Ticks
    rng: np.random.Generator


class PoseSources:
    """Pose sources of the vehicles with these ``numbers``, which are their rows."""

    def __init__(self, vehicles: Sequence[VehicleSpec], numbers: Sequence[int], seed: int) -> None:
        self._numbers = [*numbers]
        self._vehicles: list[tuple[int, str, str, str]] = []  # row, pose source, keys of estimate and odometry
        self._fix_sources: list[_FixSource] = []
        self._fusers: dict[int, _Fuser] = {}
        self._fixes: dict[int, Fix] = {}  # newest
        for number in numbers:
            spec = vehicles[number]
            self._vehicles.append((number, spec.pose_source, f"{spec.name}/estimate", f"{spec.name}/odometry"))
            if (sensor := spec.positioning) is not None:
                rng = stream(seed, f"{spec.name}/positioning")
                self._fix_sources.append(_FixSource(number, spec.name, sensor, Ticks.rate(sensor.rate_hz), rng))
            if spec.pose_source == "fusion":
                if spec.fusion is None:
                    key = f"vehicle.{spec.name}.pose_source"
                    raise ScenarioError('"fusion" needs an estimator: add a fusion table to the vehicle', key=key)
                self._fusers[number] = _Fuser(copy.deepcopy(spec.fusion))

    @property
    def instants(self) -> tuple[Instants, ...]:
        """Instants of fixes, with the keys of their rates."""
        return tuple(Instants(each.ticks, key=f"vehicle.{each.vehicle}.positioning.rate_hz") for each in self._fix_sources)

    def due(self, now_ns: int) -> bool:
        """Whether a fix is due now."""
        return any(each.ticks.hits(now_ns) for each in self._fix_sources)

    def next_fed_ns(self, now_ns: int) -> int | None:
        """First instant after now at which estimators are fed; None: there are none."""
        return _FEED_TICKS.after(now_ns) if self._fusers else None

    def feed(self, now_ns: int, motion: BodyMotion) -> None:
        """Feed the wheels' motion to all estimators."""
        for number, fuser in self._fusers.items():
            fuser.odometry(now_ns, motion, number)

    def measure(self, now_ns: int, motion: BodyMotion) -> list[Event]:
        """The fixes of this instant."""
        events = []
        for number, name, sensor, ticks, rng in self._fix_sources:
            if ticks.hits(now_ns):
                position, velocity, attitude, spin = (tuple(each[number].tolist()) for each in motion[:4])
                state = VehicleState(position=position, velocity=velocity, attitude=attitude, angular_velocity=spin)
                fix = self._fixes[number] = sensor.measure(now_ns, state, rng)
                if number in self._fusers:
                    self._fusers[number].odometry(now_ns, motion, number)
                    x, y, _ = fix.position
                    self._fusers[number].estimator.fix(fix.time_ns, x, y, max(fix.sigma_m, _LEAST_SIGMA_M))
                events.append(Event(f"{name}/fix", now_ns, fix))
        return events

    def estimates(self, now_ns: int, motion: BodyMotion) -> list[Event]:
        """Each vehicle's estimate of its own state, and its wheel odometry."""
        rows = np.concatenate((*motion[:4], motion.odometry), axis=1)
        if len(self._vehicles) < len(rows):
            rows = rows[self._numbers]
        events = []
        for (number, source, estimate_key, odometry_key), row in zip(self._vehicles, rows.tolist(), strict=True):
            px, py, pz, vx, vy, vz, qw, qx, qy, qz, wx, wy, wz, x, y, yaw, v, w = row
            odometry = None if isnan(x) else Odometry(pose=(x, y, yaw), v=v, w=w)
            state = VehicleState(
                position=(px, py, pz), velocity=(vx, vy, vz), attitude=(qw, qx, qy, qz), angular_velocity=(wx, wy, wz)
            )
            if source != "truth":
                fused = self._fusers[number].estimator.estimate(now_ns) if number in self._fusers else None
                state = estimate(source, state, odometry, self._fixes.get(number), fused)
            events.append(Event(estimate_key, now_ns, state))
            if odometry is not None:
                events.append(Event(odometry_key, now_ns, odometry))
        return events


class _Fuser:  # an estimator, and the odometry that it got last
    def __init__(self, estimator: Fusion) -> None:
        self.estimator = estimator
        self._last: tuple[int, Vec3] | None = None

    def odometry(self, now_ns: int, motion: BodyMotion, row: int) -> None:
        """Feed the motion since the last call; no effect in a second call at the same instant."""
        x, y, yaw = motion.odometry[row, :3].tolist()
        last_ns, last_pose = self._last or (-1, (x, y, yaw))
        if now_ns > last_ns:
            self.estimator.odometry(now_ns, *travelled(last_pose, (x, y, yaw)))
            self._last = now_ns, (x, y, yaw)


def estimate(
    pose_source: str, truth: VehicleState, odometry: Odometry | None, fix: Fix | None, fused: FusedPose | None = None
) -> VehicleState:
    """A vehicle's estimate of its own state.

    The pose comes from its pose source; speeds come from its wheels, except with the source "truth". Without wheels, the parts
    that a fix lacks are true. Odometry replaces missing fixes, and the heading of a fused pose without one.
    """
    if pose_source == "truth" or (odometry is None and fix is None):
        return truth
    if odometry is None:
        assert fix is not None  # noqa: S101  # else it is the truth
        attitude = truth.attitude
        if fix.yaw is not None:  # turned about the vertical to it
            c, _, _, s = quaternion_from_yaw(fix.yaw - yaw_of(attitude))
            w, x, y, z = attitude
            attitude = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
        return msgspec.structs.replace(truth, position=fix.position, attitude=attitude)
    (x, y, yaw), z = odometry.pose, 0.0
    if pose_source == "fusion" and fused is not None:
        x, y, yaw = fused.x, fused.y, fused.heading if fused.heading_known else yaw
    elif pose_source == "positioning" and fix is not None:
        (x, y, z), yaw = fix.position, yaw if fix.yaw is None else fix.yaw
    w, _, _, s = attitude = quaternion_from_yaw(yaw)
    velocity = (odometry.v * (w * w - s * s), odometry.v * 2.0 * w * s, 0.0)
    return VehicleState(position=(x, y, z), velocity=velocity, attitude=attitude, angular_velocity=(0.0, 0.0, odometry.w))
