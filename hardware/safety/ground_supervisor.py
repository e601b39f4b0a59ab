"""Safety supervisor of a robot with two driven wheels."""

import math
from collections.abc import Callable, Sequence

from vcmvsp.cosim.types import Vec3, VehicleState, Velocity
from vcmvsp.hardware.safety.obstacles import Obstacles, Others
from vcmvsp.hardware.safety.supervisor import (
    Cause,
    Limits,
    Pose,
    Supervisor,
    clamp,
    fastest,
    stops_within,
    swept,
)

_HALVINGS = 12  # bisection steps of the yaw rate


class GroundSupervisor(Supervisor):
    """Safety of a robot with two driven wheels.

    A source that is silent for too long stops the robot at its stop deceleration. Otherwise the command is limited, then
    slowed down (never reversed) for fence and other vehicles. Turning on the spot is always allowed: the robot is a circle.
    ``last`` is the newest safe command; the robot is assumed to be no faster than that.
    """

    last = (0.0, 0.0)  # m/s, rad/s

    @staticmethod
    def pose(state: VehicleState) -> Vec3:
        """Position x, y m and yaw rad."""
        return state.position[0], state.position[1], state.yaw

    def _brake(self, dt: float) -> None:
        self.last = clamp(0.0, 0.0, self.last, dt, self._safety)

    def _velocity(self) -> Velocity:
        return Velocity(linear=(self.last[0], 0.0, 0.0), yaw_rate=self.last[1])

    def _make_safe(self, command: Velocity, pose: Pose | None, others: Others | None, dt: float) -> tuple[Cause, ...]:
        p, requested = self._safety, (command.linear[0], command.yaw_rate)
        safe = clamp(*requested, self.last, dt, p)
        causes = [] if safe == requested else [Cause.LIMITS]
        if pose is not None:
            x, y, yaw = pose
            obstacles: list[tuple[Cause, Obstacles]] = []
            if self._fence is not None:
                obstacles.append((Cause.GEOFENCE, self._fence.around(x, y, p.radius_m + p.fence_margin_m)))
            if others is not None and len(others.position):
                obstacles.append((Cause.SEPARATION, others.around(x, y, p.radius_m + p.separation_m)))
            safe, slowed = slow_down(safe, self.last, yaw, obstacles, dt=dt, hold=p.reaction_s, limits=p)
            causes += slowed
        self.last = safe
        return tuple(causes)


def slow_down(
    command: tuple[float, float],
    last: tuple[float, float],
    yaw: float,
    obstacles: Sequence[tuple[Cause, Obstacles]],
    *,
    dt: float,
    hold: float,
    limits: Limits,
) -> tuple[tuple[float, float], list[Cause]]:
    """The command, reduced so that the robot can stop before obstacles; and the causes of the reduction.

    The command is within the limits. The speed is reduced for the requested yaw rate. A yaw rate that turns towards
    obstacles within the stopping distance at the present speed is reduced, towards that of a robot that stops turning,
    until the robot is slower. The room for stopping at the last step is still there now
    (`hardware.safety.obstacles`): stopping always fits if poses are true.
    """
    (v, w), (last_v, last_w) = command, last
    speed, u, decel = abs(v), abs(last_v), limits.decel
    if speed == 0.0 and u == 0.0:
        return command, []
    far, until_still = swept(speed, u, hold, decel), hold + max(speed, u) / decel
    near = [
        (cause, around, around.closing.tolist())
        for cause, around in obstacles  # other obstacles are out of reach in every direction
        if far + float(around.closing.max(initial=0.0)) * until_still > around.clearance or speed > around.speed
    ]
    way = 1.0 if v > 0.0 or last_v > 0.0 else -1.0  # the limits stop it before it reverses
    facing = yaw if way > 0.0 else yaw + math.pi

    def room(around: Obstacles, rate: float) -> list[float]:
        left = swept(max(rate, 0.0), max(last_w, 0.0), hold, limits.yaw_decel)
        right = swept(max(-rate, 0.0), max(-last_w, 0.0), hold, limits.yaw_decel)
        free: list[float] = around.free(facing - right, facing + left).tolist()
        return free

    def fits(rate: float) -> bool:
        return all(
            stops_within(free, u, c, decel)
            for _, around, closing in near
            for free, c in zip(room(around, rate), closing, strict=True)
        )

    least_v, least_w = clamp(0.0, 0.0, last, dt, limits)
    causes = []
    for cause, around, closing in near:
        pairs = list(zip(room(around, w), closing, strict=True))
        most = min(around.speed, *(fastest(free, u, c, hold, decel) for free, c in pairs))
        if most < abs(v) or not all(stops_within(free, u, c, decel) for free, c in pairs):
            causes.append(cause)
        speed = min(speed, most)
    return (way * max(abs(least_v), speed), _nearest(least_w, w, fits) if causes else w), causes


def _nearest(sure: float, requested: float, fits: Callable[[float], bool]) -> float:
    """Value nearest to ``requested`` that fits, between it and ``sure``, by bisection."""
    if fits(requested):
        return requested
    for _ in range(_HALVINGS):
        middle = 0.5 * (sure + requested)
        sure, requested = (middle, requested) if fits(middle) else (sure, middle)
    return sure
