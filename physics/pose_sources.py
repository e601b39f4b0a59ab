"""What vehicles take for their own states, over a run: fixes are measured, estimators fed, and both published.

An estimator (pose source ``fusion``) is fed with what the wheels went at 10 Hz, as often as a Pioneer tells it, and at the
vehicle's own fixes. These instants depend on nothing but the vehicle: were it fed wherever somebody looks, a recording with
another period would cut the motion otherwise, and so change the last digits of what its agent sees. In between, it goes on at
the speeds that it was told last, as on a real robot.
"""

import copy
from collections.abc import Sequence
from math import isnan

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.frames import Quaternion, quaternion_from_yaw, travelled, yaw_of
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Fix, Odometry, Vec3, VehicleState
from vcmvsp.physics.engine.interface import Motion
from vcmvsp.physics.vehicles.specification import Fused, Fuser, VehicleSpec

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


def state_of(motion: Motion, row: int) -> VehicleState:
    """The state of one vehicle."""
    position, velocity, attitude, spin = (tuple(each[row].tolist()) for each in motion[:4])
    return VehicleState(position=position, velocity=velocity, attitude=attitude, angular_velocity=spin)


def estimate(
    pose_source: str, truth: VehicleState, odometry: Odometry | None, fix: Fix | None, fused: Fused | None = None
) -> VehicleState:
    """What a vehicle takes for its own state.

    The pose comes from its pose source; speeds come from its wheels, unless it is told the truth. Without wheels, all that is
    not in a fix is the truth. Until the first fix, and as long as a fused pose has no heading, odometry stands in.
    """
    if pose_source == "truth" or (odometry is None and fix is None):
        return truth
    if odometry is None:
        assert fix is not None  # noqa: S101  # else it is the truth
        return msgspec.structs.replace(truth, position=fix.position, attitude=_turned_to(fix.yaw, truth.attitude))
    (x, y, yaw), z = odometry.pose, 0.0
    if pose_source == "fusion" and fused is not None:
        x, y, yaw = fused.x, fused.y, fused.heading if fused.heading_known else yaw
    elif pose_source == "positioning" and fix is not None:
        (x, y, z), yaw = fix.position, yaw if fix.yaw is None else fix.yaw
    w, _, _, s = attitude = quaternion_from_yaw(yaw)
    velocity = (odometry.v * (w * w - s * s), odometry.v * 2.0 * w * s, 0.0)
    return VehicleState(position=(x, y, z), velocity=velocity, attitude=attitude, angular_velocity=(0.0, 0.0, odometry.w))


def _turned_to(yaw: float | None, attitude: Quaternion) -> Quaternion:
    """The attitude, turned about the vertical so that it has this yaw, rad; None: as it is."""
    if yaw is None:
        return attitude
    c, _, _, s = quaternion_from_yaw(yaw - yaw_of(attitude))
    w, x, y, z = attitude
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
