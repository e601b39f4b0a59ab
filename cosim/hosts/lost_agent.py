"""What becomes of a vehicle whose agent has failed, or whose host is lost, in a run that goes on without it."""

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Follows, Presence, Velocity
from vcmvsp.cosim.util.text import plain


class Absence:
    """A vehicle without its agent: it holds its last command for a while, or has none any more, and then stands still.

    Args:
        spec: of the agent; ``on_lost`` is ``hold`` or ``remove``.
        since_ns: its first tick without an answer.
        now_ns: when that answer would have taken effect.
        why: it has none.
        follows: whether it has said which place it means to keep.

    Attributes:
        final: it will not come back.
        news: what there is to publish at ``now_ns``.
    """

    def __init__(self, spec: AgentSpec, since_ns: int, now_ns: int, why: str, *, follows: bool) -> None:
        self.final = spec.on_lost == "remove"
        self._vehicle, self._rests = spec.vehicle, False
        self._rests_ns = now_ns if self.final else now_ns + seconds_to_ns(spec.hold_s)
        presence = Presence(state="removed" if self.final else "lost", since_ns=since_ns, why=plain(why))
        self.news = [Event(f"{self._vehicle}/host", now_ns, presence), *self.go_on(now_ns)]
        if self.final and follows:
            self.news.append(Event(f"{self._vehicle}/follows", now_ns, Follows(leader=None)))

    def go_on(self, now_ns: int) -> list[Event]:
        """What the vehicle does at ``now_ns`` by itself: it stops, once, when its last command has been held long enough."""
        if self._rests or now_ns < self._rests_ns:
            return []
        self._rests = True
        return [Event(f"{self._vehicle}/command", now_ns, Velocity())]

    def back(self, since_ns: int, now_ns: int, late: int) -> Event:
        """It has an agent again, from its tick ``since_ns`` on."""
        return Event(f"{self._vehicle}/host", now_ns, Presence(state="back", since_ns=since_ns, late=late))
