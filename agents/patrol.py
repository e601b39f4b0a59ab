"""Patrol: drive or fly from way-point to way-point; wait while the way is blocked."""

import math

import numpy as np

from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Array, NonNegative, Positive, Scan, Vec3, Velocity, Waypoint

TURN_GAIN = 1.5  # 1/s
LANE_M = 0.6  # width of the lane
TURN_ON_THE_SPOT = 0.8  # rad: larger bearings are turned away before driving on


class Patrol(Agent):
    """Visit points in turn.

    On wheels: turn towards the point, then drive at it, slower the further it lies aside. In the air: send way-points to the
    autopilot. A ground vehicle with a range scanner stops while something in its way is nearer than ``clearance`` and than the
    point; after ``patience_s`` it turns to the roomier side until the way is free. Vehicles can so pass each other, but there
    is no path planning around walls.

    Args:
        way: points, x, y, z m, world; z is ignored on wheels.
        relative: points are relative to the start position.
        speed: m/s.
        loop: start again after the last point; otherwise stay there.
        arrive_m: distance at which a point is reached.
        flies: command way-points instead of velocities.
        scanner: name of the range scanner; empty: none.
        clearance: of the way ahead, m.
        patience_s: wait before turning aside, s.
        report_s: period of position reports by radio, s, from a random instant on; 0: never.
    """

    def __init__(
        self,
        way: tuple[Vec3, ...],
        *,
        relative: bool = False,
        speed: Positive = 0.3,
        loop: bool = True,
        arrive_m: Positive = 0.3,
        flies: bool = False,
        scanner: str = "",
        clearance: Positive = 0.6,
        patience_s: NonNegative = 2.0,
        report_s: NonNegative = 1.0,
    ) -> None:
        if not way:
            raise ValueError("way needs at least one point")
        self.way, self.relative, self.speed, self.loop, self.arrive_m = way, relative, speed, loop, arrive_m
        self.flies, self.scanner, self.report_s = flies, scanner, report_s
        self.clearance, self.patience_s = clearance, patience_s
        self.sensors = (scanner,) if scanner else ()
        self._next, self._waiting_s = 0, 0.0
        self._origin: Vec3 | None = None

    def start(self, info: VehicleInfo) -> None:
        """Draw the time of the first report: random, so that vehicles do not report at once."""
        self._period_s = info.period_s
        self._report_at_s = info.stream("report").uniform(0.0, self.report_s) if self.report_s else math.inf

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint:
        """The command towards the next point."""
        if self._origin is None:
            self._origin = obs.state.position if self.relative else (0.0, 0.0, 0.0)
        if obs.time_s >= self._report_at_s:
            self._report_at_s += self.report_s
            x, y, z = obs.state.position
            radio.send(x=x, y=y, z=z)
        return Waypoint(position=self._aim(obs), speed=self.speed) if self.flies else self._drive(obs)

    def _aim(self, obs: Observation) -> Vec3:
        """The next point, or the one after it once that is reached."""
        for _ in self.way:
            x, y, z = (a + b for a, b in zip(self.way[self._next], self._origin or (0.0, 0.0, 0.0), strict=True))
            coordinates, is_last = 3 if self.flies else 2, not self.loop and self._next == len(self.way) - 1
            if is_last or math.dist((x, y, z)[:coordinates], obs.state.position[:coordinates]) > self.arrive_m:
                break
            self._next = (self._next + 1) % len(self.way)
        return x, y, z

    def _drive(self, obs: Observation) -> Velocity:
        x, y, _ = self._aim(obs)
        ahead, left = rotate2(x - obs.state.position[0], y - obs.state.position[1], -obs.state.yaw)
        distance, aside = math.hypot(ahead, left), wrap(math.atan2(left, ahead))
        if distance <= self.arrive_m:
            return Velocity()
        scan = obs.readings.get(self.scanner) if self.scanner else None
        if isinstance(scan, Scan) and abs(aside) < TURN_ON_THE_SPOT and _nearest(scan, 0.0) < min(self.clearance, distance):
            self._waiting_s += self._period_s
            if self._waiting_s <= self.patience_s:
                return Velocity()
            sides = [_nearest(scan, side * TURN_ON_THE_SPOT) for side in (1, -1)]
            return Velocity(yaw_rate=0.5 if sides[0] >= sides[1] else -0.5)
        self._waiting_s = 0.0
        forward = self.speed * max(0.0, math.cos(aside)) if abs(aside) < TURN_ON_THE_SPOT else 0.0
        return Velocity(linear=(forward, 0.0, 0.0), yaw_rate=max(-1.0, min(TURN_GAIN * aside, 1.0)))


def _nearest(scan: Scan, bearing: float) -> float:
    """Distance of the nearest return in a lane around a bearing, m."""
    aside = scan.angle_min + scan.angle_step * np.arange(len(scan.ranges)) - bearing
    valid = np.isfinite(scan.ranges) | (scan.ranges < 0.0)  # -inf: nearer than it can measure, counts as 0
    ranges = np.where(valid, np.maximum(scan.ranges, 0.0), 0.0)
    ahead, across = ranges * np.cos(aside), ranges * np.sin(aside)
    inside: Array = ahead[valid & (np.cos(aside) > 0.0) & (np.abs(across) < 0.5 * LANE_M)]
    return float(inside.min()) if len(inside) else math.inf
