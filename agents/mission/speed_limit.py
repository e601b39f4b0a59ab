"""The limit of the speed near obstacles, for the commands of anybody.

It knows nothing of states, take-overs and reasons, and comes after them all: what it lets through is what the vehicle does.
"""

import math

from vcmvsp.agents.avoidance.levels import ObstacleLevels, second_m
from vcmvsp.agents.avoidance.settings import Settings, body_of
from vcmvsp.agents.avoidance.view import ScanReader, View
from vcmvsp.agents.avoidance.waypoint import velocity_to
from vcmvsp.cosim.agent import Observation, VehicleInfo
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Velocity, Waypoint

STANDING = Velocity()


class Guard:
    """Lets a vehicle come no faster towards anything than in proportion to the way that is left; blind, it has it stand.

    Attributes:
        sensors: what it looks at.
        nearest_m: the least range at the last tick; 0: it was blind.
        second_m: from how near on the speed is limited, m.
        closing: whether the vehicle comes nearer to the nearest thing.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.sensors = settings, (settings.scanner,)
        self._looking = ScanReader(settings.scanner, settings.stale_s)
        self.nearest_m, self.second_m, self.closing = math.inf, 0.0, False

    def start(self, info: VehicleInfo) -> None:
        """Take the scanner and the body of the vehicle.

        Raises:
            ValueError: the scanner is missing, or the size of the vehicle is unknown.
        """
        self._looking.start(info, "avoidance.scanner")
        body = body_of(info)
        self._levels = ObstacleLevels(self.settings, body, info.latency_s)
        self._view: View | None = None
        self._flies, self._latency_s = body.flies, info.latency_s

    def look(self, obs: Observation) -> None:
        """Take in what is around at a tick: once, and before `limited`."""
        self._view = view = self._looking.look(obs)
        x, y, _ = obs.state.velocity
        self._speed = math.hypot(x, y)
        self.second_m = second_m(self._speed, self._levels.keep_m, self.settings.braking, self._latency_s)
        if view is None:
            self.nearest_m, self.closing = 0.0, True
            return
        self.nearest_m = view.nearest_m
        towards = rotate2(x, y, -obs.state.yaw)
        direction = view.units[int(view.ranges.argmin())]
        self.closing = math.isfinite(self.nearest_m) and float(direction @ towards) > 0.0

    def limited(self, obs: Observation, command: Velocity | Waypoint) -> Velocity | Waypoint:
        """The command, slowed near obstacles. The climb does not change, unless the vehicle has no valid scan.

        Near an obstacle a way-point becomes a velocity towards it, because the speed of an autopilot is unknown.
        """
        if self._view is None or not self._view.ranges.any():
            return STANDING
        straight = velocity_to(obs, command, self.settings.max_speed) if isinstance(command, Waypoint) else command
        x, y, z = straight.linear
        yaw = obs.state.yaw if self._flies else 0.0
        requested = rotate2(x, y, -yaw)
        level = self._levels.update(obs.time_ns, self._view.nearest_m, max(self._speed, math.hypot(x, y)))
        left = self._levels.limited(self._view, requested)
        if left == requested:
            return command if level < 2 else straight
        return Velocity(linear=(*rotate2(*left, yaw), z), yaw_rate=straight.yaw_rate)
