"""A run that somebody looks at, and interferes with, while it goes on: orders of the control station become interventions.

All happens in the run's own thread, between two of its instants, or while it waits: nothing here can disturb a step.
"""

import time
from collections.abc import Callable, Sequence

from vcmvsp.cosim.assembly.interventions import Operator
from vcmvsp.cosim.clock import LISTEN_NS, Clock, LiveClock
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.scenario.schema import HaltTable, InterventionTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.util.text import Tell
from vcmvsp.cosim.view.live.feed import Feed
from vcmvsp.cosim.view.messages import Change, End, Go, Halt, LogLine, Move, Order, Outage, Pace

MAY = ("sensors", "halt", "outage", "end")
"""Orders that every run obeys."""


class Live:
    """What stands between a run and its feed.

    Args:
        feed: to the station.
        operator: who does what is asked for.
        clock: makes the clock that paces the run, given what it calls while it waits; one that is no `LiveClock` cannot be
            held up.
        stop: ends the run, as Ctrl-C does.
        tell: takes lines for the user.

    Attributes:
        clock: paces the run.
    """

    def __init__(
        self,
        feed: Feed,
        operator: Operator,
        *,
        clock: Callable[[Callable[[], None]], Clock],
        stop: Callable[[], None],
        tell: Tell,
    ) -> None:
        self._feed, self._operator, self._stop, self._tell = feed, operator, stop, tell
        self.clock = clock(self.listen)
        self._now_ns, self._heard_ns, self._alone = 0, 0, False

    def on(self, event: Event) -> None:
        """Show an event."""
        self._feed.on(event)

    def on_instant(self, now_ns: int) -> None:
        """Note the time, and listen if nobody has for a while: a clock that cannot be held up does not."""
        self._now_ns = now_ns
        if time.monotonic_ns() - self._heard_ns >= LISTEN_NS:
            self.listen()

    def listen(self) -> None:
        """Do what the one who looks has asked for."""
        self._heard_ns = time.monotonic_ns()
        for order in self._feed.orders():
            try:
                self._obey(order)
            except ValueError as error:
                self._feed.say(LogLine(time_ns=self._now_ns, level="warning", text=f"not done: {error}"))
        self._feed.pace(self._pace())
        if not self._feed.open and not self._alone:
            self._alone = True
            self._tell(f"the control station has gone{self._feed.problem and f': {self._feed.problem}'}; the run goes on")
            if isinstance(self.clock, LiveClock) and self.clock.paused:  # nobody is left who could let it
                self.clock.go(paused=False, speed=self.clock.speed)

    def close(self, why: str) -> None:
        """Show how the run ended."""
        self._feed.close(why)

    def _obey(self, order: Order) -> None:
        if isinstance(order, Go):
            if not isinstance(self.clock, LiveClock):
                raise ValueError("robots and programs outside keep to the wall clock")  # noqa: TRY004  it is a wish, not a type
            self.clock.go(paused=order.paused, speed=_speed(order.speed), step_ns=max(0, order.step_ns))
        elif isinstance(order, End):
            self._stop()
        elif (table := _intervention(order)) is not None:
            self._operator.ask(table)

    def _pace(self) -> Pace:
        return Pace(paused=isinstance(self.clock, LiveClock) and self.clock.paused, speed=self.clock.speed)


def may(*, movables: Sequence[object], keys: Sequence[str], held_up: bool) -> tuple[str, ...]:
    """The orders that a run obeys: whether anything can be moved, changed, or its time held up."""
    return (*MAY, *(("move",) if movables else ()), *(("set",) if keys else ()), *(("pace",) if held_up else ()))


def _speed(speed: float | None) -> float | None:
    if speed is not None and not 1e-3 <= speed <= 1e6:
        raise ValueError(f"a speed of {speed:g}: it must be between 0.001 and 1 000 000")
    return speed


def _intervention(order: Order) -> InterventionTable | None:
    """What an order asks the operator for; its time is that of the instant at which it is done."""
    match order:
        case Outage():
            return OutageTable(at_s=0.0, for_s=order.for_s, vehicles=order.vehicles)
        case Halt():
            return HaltTable(at_s=0.0, vehicles=order.vehicles, halted=order.halted)
        case Move():
            return MoveTable(at_s=0.0, obstacle=order.obstacle, position=order.position, yaw=order.yaw)
        case Change():
            return SetTable(at_s=0.0, key=order.key, value=order.value)
    return None
