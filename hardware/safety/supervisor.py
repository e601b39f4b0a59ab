"""Safety of one vehicle: limits, stopping distances, time-outs of monitored sources, and the step that applies them.

A command acts until the next one, ``hold`` s later; from then on the robot may have to stop at ``decel``. A robot that is
commanded v while it moves at u, all along one line, stops after ::

    v hold + v**2 / (2 decel)                              if it is not slower than before, v >= u
    v hold + v**2 / (2 decel) + (u - v)**2 / (2 decel)     if it first slows down, and reaches v within hold
    u**2 / (2 decel)                                       if it does not reach v within hold

These are times of reaction and of braking as in ISO 13855 and ISO/TS 15066, 5.5.4 (protective separation distance); without
reaction the greatest speed is that of the dynamic window, sqrt(2 decel d) [Fox, Burgard, Thrun 1997, eq. 14]. An obstacle
that approaches at c m/s adds c times the time until the robot stands, hold + v / decel; one that recedes adds nothing, as it
may stop.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import StrEnum

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Value, Vec3, VehicleState, Velocity
from vcmvsp.hardware.safety.obstacles import Obstacles, Others, Polygon

Pose = tuple[float, ...]  # on the ground x, y m, yaw rad; in the air x, y, z m, yaw rad; world

TOLERANCE_M = 1e-9  # rounding of distances must not count as a danger


class Cause(StrEnum):
    """Reason to stop or slow down a robot."""

    OPERATOR = "operator"  # no heartbeat of the operator
    COMMAND = "command"  # no command
    POSITIONING = "positioning"  # no position
    FEDERATION = "federation"  # no message of the run
    CLOCK = "clock"  # time went back or jumped, or a message is from the future
    NOT_FINITE = "not_finite"  # a command, a pose or another vehicle's is not a number
    LIMITS = "limits"  # the command was too fast, or changed too fast
    GEOFENCE = "geofence"
    SEPARATION = "separation"


SOURCES = (Cause.OPERATOR, Cause.COMMAND, Cause.POSITIONING, Cause.FEDERATION)
LATCHED = (Cause.OPERATOR, Cause.FEDERATION, Cause.CLOCK)


class Limits(Value, frozen=True, kw_only=True):
    """Limits of speeds and accelerations; symmetric in both directions of motion and of rotation.

    The decelerations are guaranteed on the robot's floor, not its best ones: braking distances depend on them. They also limit
    how fast a command may slow down; there is no lower limit for braking. In the air, speed counts horizontally, accelerations
    count horizontally and vertically each.
    """

    max_speed: float  # m/s
    max_yaw_rate: float  # rad/s
    accel: float  # m/s2
    decel: float  # m/s2, guaranteed when it brakes
    yaw_accel: float  # rad/s2
    yaw_decel: float  # rad/s2


class Safety(Limits, frozen=True, kw_only=True):
    """Limits, fence, distances and time-outs; lengths in m, times in s. None: not checked."""

    max_climb: float = 1.0  # m/s, up and down, of flying vehicles
    radius_m: float  # of a circle around the body, centred at the pose
    fence: tuple[tuple[float, float], ...] | None = None  # corners x, y, world
    floor_m: float | None = None  # minimum height in the air; a vehicle below may climb
    ceiling_m: float | None = None  # maximum height in the air
    fence_margin_m: float = 0.0  # between body and fence: above all for the error of the pose
    separation_m: float = 0.5  # between bodies
    reaction_s: float = 0.2  # from a command to the effect of the next one, with all delays of pose and link
    jump_m: float = 1.0  # a larger jump of the position halts the robot until the station ends
    operator_s: float | None = None  # maximum silence of the operator (``vcmvsp operator``)
    command_s: float | None = 0.5
    positioning_s: float | None = 1.0
    federation_s: float | None = 0.5
    clock_s: float | None = 0.5  # between two steps


class LastReceived(msgspec.Struct, frozen=True, kw_only=True):
    """Time of the newest message of each source, ns on the clock of the steps; None: none yet."""

    operator_ns: int | None = None
    command_ns: int | None = None
    positioning_ns: int | None = None
    federation_ns: int | None = None


class Decision(msgspec.Struct, frozen=True, kw_only=True):
    """Command to send, and the causes of its difference from the requested one."""

    command: Velocity
    causes: tuple[Cause, ...] = ()  # all that act now
    began: tuple[Cause, ...] = ()  # not active at the step before
    stop: bool = False  # the robot must stop; a robot with its own deceleration may get zero at once


def clamp(v: float, w: float, last: tuple[float, float], dt: float, limits: Limits) -> tuple[float, float]:
    """Command within the limits nearest to (v m/s, w rad/s), ``dt`` s after the command ``last``.

    A command that is not finite is a stop. A robot stops before it reverses.
    """
    if not (math.isfinite(v) and math.isfinite(w)):
        v, w = 0.0, 0.0
    last_v, last_w = last
    v = max(-limits.max_speed, min(limits.max_speed, v))
    w = max(-limits.max_yaw_rate, min(limits.max_yaw_rate, w))
    if v * last_v < 0.0:
        v = 0.0
    speed = _ramp(v, last_v, limits.accel * dt, limits.decel * dt)
    return speed, _ramp(w, last_w, limits.yaw_accel * dt, limits.yaw_decel * dt)


def _ramp(target: float, last: float, up: float, down: float) -> float:
    """Value nearest to the target that can be reached: ``up`` away from zero, ``down`` towards it."""
    if last < 0.0:
        return -_ramp(-target, -last, up, down)
    # If slowing down takes a part of the time, the rest accelerates in the other direction.
    least = last - down if last >= down else -up * (1.0 - last / down)
    return max(least, min(last + up, target)) if down > 0.0 else last


def swept(v: float, u: float, hold: float, decel: float) -> float:
    """Stopping distance (m, or rad) for speeds v, u >= 0: see above."""
    if u - v >= decel * hold:
        return u * u / (2.0 * decel)
    slowing = max(0.0, u - v)
    return v * hold + (v * v + slowing * slowing) / (2.0 * decel)


def stops_within(free: float, u: float, closing: float, decel: float) -> bool:
    """Whether a robot at u m/s that brakes at once stops within ``free`` m."""
    return u * u / (2.0 * decel) + closing * u / decel <= free + TOLERANCE_M


def fastest(free: float, u: float, closing: float, hold: float, decel: float) -> float:
    """The highest speed v (m/s) that may be commanded at u m/s, so that the robot stands within ``free`` m; 0 if none fits.

    With a = decel, T = hold, c = closing: the greater root of v**2 + 2 (a T + c) v + 2 a (c T - free) = 0 if that is
    not below u, else of 2 v**2 + 2 (a T + c - u) v + u**2 + 2 a (c T - free) = 0.
    """
    if math.isinf(free):
        return math.inf
    half, rest = decel * hold + closing, 2.0 * decel * (free - closing * hold)
    if rest <= 0.0:
        return 0.0
    v = rest / (half + math.sqrt(half * half + rest))  # the root, without a difference of nearly equal numbers
    if v >= u:
        return v
    half -= u
    square = half * half + 2.0 * (rest - u * u)
    return max(0.0, 0.5 * (math.sqrt(square) - half)) if square >= 0.0 else 0.0


class Deadman:
    """Compares the ages of the sources' newest messages, and the time between two steps, with their time-outs.

    A cause in ``latched`` lasts as long as this object, also after the source is back; other causes end by themselves. A source
    without any message stops the robot, but latches nothing: it was not lost.
    """

    def __init__(self, safety: Safety, latched: tuple[Cause, ...] = LATCHED) -> None:
        seconds = {cause: getattr(safety, f"{cause}_s") for cause in (*SOURCES, Cause.CLOCK)}
        if wrong := [f"{cause}_s={each}" for cause, each in seconds.items() if each is not None and not 0.0 < each <= 1e6]:
            raise ValueError(f"timeouts must be above 0 and at most 1e6 s, or None: {', '.join(wrong)}")
        self._limits_ns = {cause: round(each * SECOND_NS) for cause, each in seconds.items() if each is not None}
        self._may_latch, self._held = latched, set[Cause]()
        self._last_ns: int | None = None

    def check(self, now_ns: int, received: LastReceived) -> tuple[Cause, ...]:
        """Causes to stop now, in the order of `Cause`; call it at every step."""
        lost, never = set[Cause](), set[Cause]()
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        if Cause.CLOCK in self._limits_ns and not 0 <= elapsed_ns <= self._limits_ns[Cause.CLOCK]:
            lost.add(Cause.CLOCK)
        self._last_ns = now_ns
        for cause in SOURCES:
            if (limit_ns := self._limits_ns.get(cause)) is None:
                continue
            time_ns: int | None = getattr(received, f"{cause}_ns")
            if time_ns is None:
                never.add(cause)
            elif time_ns > now_ns:
                lost.add(Cause.CLOCK)
            elif now_ns - time_ns > limit_ns:
                lost.add(cause)
        self._held.update(cause for cause in lost if cause in self._may_latch)
        causes = lost | never | self._held
        return tuple(cause for cause in Cause if cause in causes)


class Supervisor(ABC):
    """Last check of the commands of one vehicle, without a clock; ``latched``: see `Deadman`. `ValueError`: invalid limits."""

    def __init__(self, safety: Safety, latched: tuple[Cause, ...] = LATCHED) -> None:
        self._safety, self._deadman = safety, Deadman(safety, latched)
        self._fence = None if safety.fence is None else Polygon(safety.fence)
        self._needs_pose = self._fence is not None
        self._last_ns: int | None = None
        self._causes: tuple[Cause, ...] = ()

    def step(
        self, now_ns: int, command: Velocity | None, pose: Pose | None, others: Others | None, received: LastReceived
    ) -> Decision:
        """Decide what is sent at ``now_ns``, a monotonic time of the same clock as those in ``received``.

        The command may have any age; a pose is the result of `pose`, None: unknown; others: None: there are none.
        """
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns
        stops = list(self._deadman.check(now_ns, received))
        stops += [cause for cause in self._invalid(command, pose, others) if cause not in stops]
        # A late step must not jump in speed; after a clock that went back the vehicle still has to brake.
        reaction_s = self._safety.reaction_s
        dt = min(elapsed_ns / SECOND_NS, reaction_s) if elapsed_ns >= 0 else reaction_s
        slowed: tuple[Cause, ...] = ()
        if stops or command is None:
            self._brake(dt)
        else:
            slowed = self._make_safe(command, pose, others, dt)
        causes = (*stops, *slowed)
        began = tuple(cause for cause in causes if cause not in self._causes)
        self._causes = causes
        return Decision(command=self._velocity(), causes=causes, began=began, stop=bool(stops))

    @staticmethod
    @abstractmethod
    def pose(state: VehicleState) -> Pose:
        """Pose of a state, as `step` takes it."""

    @abstractmethod
    def _brake(self, dt: float) -> None:
        """Reduce the last command as fast as the vehicle can brake within ``dt`` s."""

    @abstractmethod
    def _make_safe(self, command: Velocity, pose: Pose | None, others: Others | None, dt: float) -> tuple[Cause, ...]:
        """Take the command within limits, fence and distances; the causes that changed it."""

    @abstractmethod
    def _velocity(self) -> Velocity:
        """The last safe command."""

    def _invalid(self, command: Velocity | None, pose: Pose | None, others: Others | None) -> list[Cause]:
        causes = []
        if command is None:
            causes.append(Cause.COMMAND)
        if pose is None and (self._needs_pose or others is not None):
            causes.append(Cause.POSITIONING)
        numbers = (*(() if command is None else (*command.linear, command.yaw_rate)), *(pose or ()))
        if not all(map(math.isfinite, numbers)) or (others is not None and not others.finite()):
            causes.append(Cause.NOT_FINITE)
        return causes


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
        return around.free(facing - right, facing + left).tolist()

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
