"""Who must have been heard lately, else the robot stops; and which stops last for as long as the station does."""

from enum import StrEnum

import msgspec

from vcmvsp.cosim.clock import SECOND_NS


class Cause(StrEnum):
    """Why a robot was stopped, or slowed down."""

    OPERATOR = "operator"  # no heartbeat of the operator
    COMMAND = "command"  # no command
    POSITIONING = "positioning"  # no position
    FEDERATION = "federation"  # nothing from the run that the robot is part of
    CLOCK = "clock"  # time went back or jumped, or something was heard in the future
    NOT_FINITE = "not_finite"  # a command, a pose or another vehicle's is not a number
    LIMITS = "limits"  # the command was too fast, or changed too fast
    GEOFENCE = "geofence"
    SEPARATION = "separation"


class TimeOuts(msgspec.Struct, frozen=True, kw_only=True):
    """How long (s) each may be silent; None: nobody waits for it."""

    operator_s: float | None = 0.5
    command_s: float | None = 0.5
    positioning_s: float | None = 1.0
    federation_s: float | None = 0.5
    clock_s: float | None = 0.5  # from one step to the next


class LastReceived(msgspec.Struct, frozen=True, kw_only=True):
    """When each was heard last, ns on the clock of the steps; None: never."""

    operator_ns: int | None = None
    command_ns: int | None = None
    positioning_ns: int | None = None
    federation_ns: int | None = None


_SOURCES = (Cause.OPERATOR, Cause.COMMAND, Cause.POSITIONING, Cause.FEDERATION)
LATCHED = (Cause.OPERATOR, Cause.FEDERATION, Cause.CLOCK)


class Deadman:
    """Watches ages against time-outs.

    A cause in ``latched`` lasts for as long as this object does, also when what was lost is back; the others end by themselves.
    What was never heard stops the robot, but has not been lost: it latches nothing.
    """

    def __init__(self, time_outs: TimeOuts | None = None, latched: tuple[Cause, ...] = LATCHED) -> None:
        limits = time_outs or TimeOuts()
        seconds = {
            Cause.OPERATOR: limits.operator_s,
            Cause.COMMAND: limits.command_s,
            Cause.POSITIONING: limits.positioning_s,
            Cause.FEDERATION: limits.federation_s,
            Cause.CLOCK: limits.clock_s,
        }
        if wrong := [f"{cause}_s={each}" for cause, each in seconds.items() if each is not None and not 0.0 < each <= 1e6]:
            raise ValueError(f"a time-out must be above 0 and at most 1e6 s, or None: {', '.join(wrong)}")
        self._limits_ns = {cause: round(each * SECOND_NS) for cause, each in seconds.items() if each is not None}
        self._may_latch, self._held = latched, set[Cause]()
        self._last_ns: int | None = None

    def check(self, now_ns: int, received: LastReceived) -> tuple[Cause, ...]:
        """What stops the robot now, in the order of `Cause`; to be asked at every step."""
        causes = set[Cause]()
        if self._last_ns is not None and Cause.CLOCK in self._limits_ns:
            elapsed = now_ns - self._last_ns
            if not 0 <= elapsed <= self._limits_ns[Cause.CLOCK]:
                causes.add(Cause.CLOCK)
        self._last_ns = now_ns
        lost = self._silent(now_ns, received, causes)
        self._held.update(cause for cause in causes if cause in self._may_latch)
        causes |= lost | self._held
        return tuple(cause for cause in Cause if cause in causes)

    def _silent(self, now_ns: int, received: LastReceived, causes: set[Cause]) -> set[Cause]:
        """Add to ``causes`` what was lost or is from the future; return what was never heard."""
        never = set[Cause]()
        times = (received.operator_ns, received.command_ns, received.positioning_ns, received.federation_ns)
        for cause, time_ns in zip(_SOURCES, times, strict=True):
            if cause not in self._limits_ns:
                continue
            if time_ns is None:
                never.add(cause)
            elif time_ns > now_ns:
                causes.add(Cause.CLOCK)
            elif now_ns - time_ns > self._limits_ns[cause]:
                causes.add(cause)
        return never
