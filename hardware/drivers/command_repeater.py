"""Schedule of velocities: zero first, then the newest command, repeated at a constant rate, and zero without commands.

It has no clock and no link: times are arguments, velocities are of any type.
"""

from typing import Generic, TypeVar

from vcmvsp.cosim.clock import seconds_to_ns

NOT_YET = "no command yet"

V = TypeVar("V")


class CommandRepeater(Generic[V]):
    """Newest command, and its schedule.

    Args:
        zero: the velocity of a robot that stands.
        timeout_s: zero speed after this time without a command.
        again_ns: period of repetition.
        least_ns: minimum time between two velocities. A stop does not wait for it and is repeated after it, as the first may be
            lost. 0: the newest command goes at once, and a stop once.

    Attributes:
        stopped: reason for zero speed; empty: the robot follows the commands.
    """

    def __init__(self, zero: V, timeout_s: float, *, again_ns: int, least_ns: int = 0) -> None:
        self.stopped = NOT_YET
        self._zero = self._speeds = zero
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._again_ns, self._least_ns = again_ns, least_ns
        self._given_ns = self._said_ns = 0
        self._zero_first, self._waiting = True, False

    def command(self, speeds: V, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped = ""
        self._speeds, self._given_ns, self._waiting = speeds, now_ns, True

    def stop(self, cause: str) -> None:
        """Zero speed at once, before any later command."""
        self.stopped = cause
        self._speeds, self._zero_first, self._waiting = self._zero, True, self._least_ns > 0

    def advance(self, now_ns: int) -> V | None:
        """Velocity to send now; None: nothing. Call it until it returns None."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        if self._zero_first:
            self._zero_first, self._said_ns = False, now_ns
            return self._zero
        if now_ns < self._next_ns:
            return None
        self._waiting, self._said_ns = False, now_ns
        return self._speeds

    @property
    def due_ns(self) -> int:
        """Time of the next `advance`, if no command comes before."""
        if self._zero_first:
            return 0
        return self._next_ns if self.stopped else min(self._next_ns, self._given_ns + self._timeout_ns)

    @property
    def _next_ns(self) -> int:
        return self._said_ns + (self._least_ns if self._waiting else self._again_ns)
