"""When which velocity is sent: zero first, the newest command, again at a steady rate, and zero when nobody commands.

No clock and no line of its own: time comes in, velocities come out, in whatever form the driver sends them.
"""

from typing import Generic, TypeVar

from vcmvsp.cosim.clock import seconds_to_ns

NOT_YET = "no command yet"

V = TypeVar("V")


class CommandRepeater(Generic[V]):
    """The newest command, and when it has to be said.

    Args:
        zero: what stands.
        timeout_s: zero speed after so long without a command.
        again_ns: how often it is said again.
        least_ns: between two, but for a stop, which waits for nothing and is said again after this, as it might have been
            lost; 0: the newest command at once, and a stop once.

    Attributes:
        stopped: why the robot is held at zero speed; empty: it follows the commands.
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
        """Zero speed at once, ahead of a command that follows."""
        self.stopped = cause
        self._speeds, self._zero_first, self._waiting = self._zero, True, self._least_ns > 0

    def advance(self, now_ns: int) -> V | None:
        """What to say now; None: nothing. Ask until there is nothing."""
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
        """When `advance` has something to do, if nothing is commanded until then."""
        if self._zero_first:
            return 0
        return self._next_ns if self.stopped else min(self._next_ns, self._given_ns + self._timeout_ns)

    @property
    def _next_ns(self) -> int:
        return self._said_ns + (self._least_ns if self._waiting else self._again_ns)
