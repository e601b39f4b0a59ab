"""What a robot is to be told: the newest velocity while it counts, else to stand; and after each connection to stand first.

No clock and no link of its own: time comes in, velocities come out.
"""

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Velocity
from vcmvsp.hardware.drivers.command_repeater import NOT_YET


class Orders:
    """The newest command.

    Args:
        timeout_s: zero speed after so long without a command.

    Attributes:
        stopped: why the robot is held at zero speed; empty: it follows the commands.
        held: the robot has not said yet that it was told to stand.
    """

    def __init__(self, timeout_s: float) -> None:
        self.stopped, self.held = NOT_YET, True
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._velocity = Velocity()
        self._given_ns = self._stands_from = 0

    def connect(self, number: int) -> None:
        """A robot has come: it is to stand, until it has acted upon a message of at least this number."""
        self.stopped, self.held, self._stands_from = NOT_YET, True, number

    def heard(self, number: int) -> None:
        """The robot has acted upon this message."""
        if number >= self._stands_from:
            self.held = False

    def command(self, velocity: Velocity, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped, self._velocity, self._given_ns = "", velocity, now_ns

    def stop(self, cause: str) -> None:
        """Stand, ahead of a command that follows."""
        self.stopped = cause

    def at(self, now_ns: int) -> Velocity | None:
        """What to say now; None: that it is to stand."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        return None if self.stopped or self.held else self._velocity
