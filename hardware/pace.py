"""When which velocity is published: the newest at once, again at a steady rate, and zero when nobody commands.

No clock and no line of its own: time comes in, velocities come out.
"""

from cosim.clock import SECOND_NS, seconds_to_ns

NOT_YET = "no command yet"
Speeds = tuple[float, float]
"""Forward, m/s, and yaw rate, rad/s."""
ZERO_SPEEDS: Speeds = (0.0, 0.0)


class Pace:
    """The newest command, and when it has to be said.

    Args:
        rate_hz: how often it is said again.
        timeout_s: zero speed after so long without a command.

    Attributes:
        stopped: why the robot is held at zero speed; empty: it follows the commands.
    """

    def __init__(self, rate_hz: float, timeout_s: float) -> None:
        self._period_ns = round(SECOND_NS / rate_hz)
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._given_ns = self._said_ns = 0
        self.stop(NOT_YET)

    def command(self, v: float, w: float, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped = ""
        self._speeds, self._given_ns, self._waiting = (v, w), now_ns, True

    def stop(self, cause: str) -> None:
        """Zero speed at once, ahead of a command that follows."""
        self.stopped = cause
        self._speeds, self._waiting, self._zero_first = ZERO_SPEEDS, False, True

    def advance(self, now_ns: int) -> Speeds | None:
        """What to say now; None: nothing. Ask until there is nothing."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        if self._zero_first:
            self._zero_first = False
            self._said_ns = now_ns
            return ZERO_SPEEDS
        if not self._waiting and now_ns < self._said_ns + self._period_ns:
            return None
        self._waiting, self._said_ns = False, now_ns
        return self._speeds

    @property
    def due_ns(self) -> int:
        """When `advance` has something to do, if nothing is commanded until then."""
        if self._zero_first or self._waiting:
            return 0
        again_ns = self._said_ns + self._period_ns
        return again_ns if self.stopped else min(again_ns, self._given_ns + self._timeout_ns)
