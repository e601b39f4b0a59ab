"""Time-outs of monitored sources, and which stops are latched."""

from enum import StrEnum

import msgspec

from vcmvsp.cosim.clock import SECOND_NS


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


class TimeOuts(msgspec.Struct, frozen=True, kw_only=True):
    """Maximum silence of each source, s; None: not monitored."""

    operator_s: float | None = 0.5
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


_SOURCES = (Cause.OPERATOR, Cause.COMMAND, Cause.POSITIONING, Cause.FEDERATION)
LATCHED = (Cause.OPERATOR, Cause.FEDERATION, Cause.CLOCK)


class Deadman:
    """Compares ages with time-outs.

    A cause in ``latched`` lasts as long as this object, also after the source is back; other causes end by themselves. A source
    without any message stops the robot, but latches nothing: it was not lost.
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
        """Causes to stop now, in the order of `Cause`; call it at every step."""
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
        """Add lost sources and times in the future to ``causes``; return sources without any message."""
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
