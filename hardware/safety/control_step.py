"""Control step of a safety supervisor: time-outs and invalid input stop the vehicle, else its command is made safe."""

import math
from abc import ABC, abstractmethod

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import NonNegative, Positive, VehicleState, Velocity
from vcmvsp.hardware.safety.deadman import LATCHED, Cause, Deadman, LastReceived, TimeOuts
from vcmvsp.hardware.safety.geofence import Polygon
from vcmvsp.hardware.safety.limits import Limits
from vcmvsp.hardware.safety.separation import Others

Pose = tuple[float, ...]  # on the ground x, y m, yaw rad; in the air x, y, z m, yaw rad; world


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of a supervisor; lengths in m, times in s."""

    limits: Limits  # in the air, speed counts horizontally, accelerations count horizontally and vertically each
    radius_m: NonNegative  # of a circle around the body, about the centre that its pose tells
    reaction_s: Positive  # from a command to when the next one acts: the control period, and the delays of pose and link
    fence: Polygon | None = None
    fence_margin_m: NonNegative = 0.0  # between body and fence: above all for the error of the pose
    separation_m: NonNegative = 0.5  # between bodies
    time_outs: TimeOuts = TimeOuts()
    latched: tuple[Cause, ...] = LATCHED


class Decision(msgspec.Struct, frozen=True, kw_only=True):
    """Command to send, and the causes of its difference from the requested one."""

    command: Velocity
    causes: tuple[Cause, ...] = ()  # all that act now
    began: tuple[Cause, ...] = ()  # not active at the step before
    stop: bool = False  # the robot must stop; a robot with its own deceleration may get zero at once


class Supervisor(ABC):
    """Last check of the commands of one vehicle. It has no clock: time is an argument."""

    def __init__(self, parameters: Parameters) -> None:
        self._deadman, self._reaction_s = Deadman(parameters.time_outs, parameters.latched), parameters.reaction_s
        self._needs_pose = parameters.fence is not None
        self._last_ns: int | None = None
        self._causes: tuple[Cause, ...] = ()

    def step(
        self, now_ns: int, command: Velocity | None, pose: Pose | None, others: Others | None, received: LastReceived
    ) -> Decision:
        """Decide what is sent at ``now_ns``.

        Args:
            now_ns: monotonic time, of the same clock as the times in ``received``.
            command: newest command, of any age.
            pose: result of `pose`; None: unknown.
            others: vehicles to keep away from; None: there are none.
            received: time of the newest message of each monitored source.
        """
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns
        stops = list(self._deadman.check(now_ns, received))
        stops += [cause for cause in self._invalid(command, pose, others) if cause not in stops]
        # A late step must not jump in speed; after a clock that went back the vehicle still has to brake.
        dt = min(elapsed_ns / SECOND_NS, self._reaction_s) if elapsed_ns >= 0 else self._reaction_s
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
        """Causes to stop because an input is missing or not finite."""
        causes = []
        if command is None:
            causes.append(Cause.COMMAND)
        if pose is None and (self._needs_pose or others is not None):
            causes.append(Cause.POSITIONING)
        numbers = (*(() if command is None else (*command.linear, command.yaw_rate)), *(pose or ()))
        if not all(map(math.isfinite, numbers)) or (others is not None and not others.finite()):
            causes.append(Cause.NOT_FINITE)
        return causes
