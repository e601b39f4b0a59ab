"""What supervisors on the ground and in the air share: parameters, and how a step begins and ends."""

import math

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import NonNegative, Positive, Velocity
from vcmvsp.hardware.safety.deadman import LATCHED, Cause, Deadman, Heard, TimeOuts
from vcmvsp.hardware.safety.geofence import Polygon
from vcmvsp.hardware.safety.limits import Limits
from vcmvsp.hardware.safety.separation import Others


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a supervisor keeps to; lengths in m, times in s."""

    limits: Limits  # in the air, speed counts horizontally, accelerations count horizontally and vertically each
    radius_m: NonNegative  # of a circle around the body, about the centre that its pose tells
    reaction_s: Positive  # from a command to when the next one acts: the control period, and the delays of pose and link
    fence: Polygon | None = None
    fence_margin_m: NonNegative = 0.0  # between body and fence: above all for the error of the pose
    separation_m: NonNegative = 0.5  # between bodies
    time_outs: TimeOuts = TimeOuts()
    latched: tuple[Cause, ...] = LATCHED


class Decision(msgspec.Struct, frozen=True, kw_only=True):
    """What to send, and why it is not what was asked for."""

    command: Velocity
    causes: tuple[Cause, ...] = ()  # all that act now
    began: tuple[Cause, ...] = ()  # those that did not act at the step before: what is worth recording
    stop: bool = False  # the robot must stop; one with a deceleration of its own may be told zero at once


class Rounds:
    """The time, the deadman and the causes of a supervisor."""

    def __init__(self, parameters: Parameters) -> None:
        self._deadman, self._reaction_s = Deadman(parameters.time_outs, parameters.latched), parameters.reaction_s
        self._last_ns: int | None = None
        self._causes: tuple[Cause, ...] = ()

    def begin(self, now_ns: int, heard: Heard, unusable: list[Cause]) -> tuple[float, list[Cause]]:
        """For how many seconds a command may have acted by now, and what stops the robot."""
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns
        stops = list(self._deadman.check(now_ns, heard))
        stops += [cause for cause in unusable if cause not in stops]
        # Whoever was late may not jump in speed, and where time went back it still has to brake.
        return min(elapsed_ns / SECOND_NS, self._reaction_s) if elapsed_ns >= 0 else self._reaction_s, stops

    def decide(self, command: Velocity, stops: list[Cause], slowed: tuple[Cause, ...]) -> Decision:
        """The decision of this step."""
        causes = (*stops, *slowed)
        began = tuple(cause for cause in causes if cause not in self._causes)
        self._causes = causes
        return Decision(command=command, causes=causes, began=began, stop=bool(stops))


def unusable(command: Velocity | None, pose: tuple[float, ...] | None, others: Others | None, placed: bool) -> list[Cause]:
    """What is missing, or is not a number, of what a decision needs; ``placed``: it must know where the vehicle is."""
    causes = []
    if command is None:
        causes.append(Cause.COMMAND)
    if pose is None and (placed or others is not None):
        causes.append(Cause.POSITIONING)
    numbers = (*(() if command is None else (*command.linear, command.yaw_rate)), *(pose or ()))
    if not all(map(math.isfinite, numbers)) or (others is not None and not others.finite()):
        causes.append(Cause.NOT_FINITE)
    return causes
