"""Whether a robot is there: its odometry is heard from one node, and something hears its commands."""

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns


class Presence:
    """What was heard when.

    Args:
        silence_s: for so long either may be missing.

    Attributes:
        sender: whose odometry is followed; None: it tells no id.
    """

    def __init__(self, silence_s: float) -> None:
        self.sender: bytes | None = None
        self._silence_ns = seconds_to_ns(silence_s)
        self._heard_ns: int | None = None  # when odometry was last
        self._listened_ns: int | None = None  # when something last listened to commands
        self._listens = False

    def hear(self, sender: bytes | None, now_ns: int) -> bool:
        """Odometry came; False: it is of another node than that which is followed, whose frame may be another.

        Another is followed when the one has been silent.
        """
        if sender != self.sender and self._recent(self._heard_ns, now_ns):
            return False
        self.sender, self._heard_ns = sender, now_ns
        return True

    def listen(self, listens: bool, now_ns: int) -> None:
        """Whether something listens to commands has changed."""
        if listens or self._listens:
            self._listened_ns = now_ns
        self._listens = listens

    def missing(self, now_ns: int) -> tuple[bool, bool]:
        """Whether odometry is missing, and whether a listener is."""
        unheard = not self._listens and not self._recent(self._listened_ns, now_ns)
        return not self._recent(self._heard_ns, now_ns), unheard

    def due_ns(self, now_ns: int) -> int:
        """When something may begin to be missing."""
        times = [self._heard_ns] if self._listens else [self._heard_ns, self._listened_ns]
        soon = [each + self._silence_ns for each in times if each is not None and each + self._silence_ns > now_ns]
        return min(soon, default=now_ns + SECOND_NS)

    def _recent(self, then_ns: int | None, now_ns: int) -> bool:
        return then_ns is not None and now_ns < then_ns + self._silence_ns
