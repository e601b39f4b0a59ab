"""The run's side of a view: an observer that hands on the newest of everything, when the other side can take it.

Nothing here waits for the one who looks, grows while he does not, or changes the run.
"""

import time
from collections import deque
from collections.abc import Callable

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.newest_values import Newest, Places, Poses
from vcmvsp.cosim.view.messages import LogLine, Order, Pace, PageUpdate, Scenery, Sensors

PERIOD_S = 1.0 / 30.0  # of the wall clock, between two messages at least
AGAIN_S = 0.002  # between two tries to finish one
READING_S = 0.2  # between two readings that are worked out only to be shown
FAREWELL_S = 1.0  # for the other side to take the last message
MOST_ORDERS = 200  # that nobody has taken; older ones give way


class Feed:
    """Shows a run to who is at the other end of a pipe.

    Args:
        pipe: to the process that shows it.
        scenery: what that has been told.
        moving: where obstacles are that keep to a time-table, x, y, z m and yaw rad, by name; of the time, s.
        targets: where targets lie, x, y m; likewise.
        clock: the wall clock, s.
    """

    def __init__(
        self,
        pipe: protocol.Pipe,
        scenery: Scenery,
        *,
        moving: Poses | None = None,
        targets: Places | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipe, self._clock = pipe, clock
        self._newest = Newest(scenery, moving or {}, targets or {})
        self._now_ns, self._fresh = 0, True  # something has happened that has not been shown
        self._due_s = self._read_s = -1e9
        self._pace, self._paces = Pace(), deque[tuple[float, int]]()  # where the run was within the last second
        self._orders: deque[Order] = deque(maxlen=MOST_ORDERS)
        self.problem = ""  # why there is nobody at the other end any more, if it has said so

    def on(self, event: Event) -> None:
        """Take an event at its own time; times never decrease."""
        if event.time_ns != self._now_ns:
            self._write_if_due()  # the instant that is over, whole
            self._now_ns, self._fresh = event.time_ns, True
        self._newest.on(event)

    def pace(self, pace: Pace) -> None:
        """Say how the run goes on; ``achieved`` is measured here. Call it while the run stands still, too: then it listens."""
        self._fresh = self._fresh or pace != self._pace
        self._pace = pace
        self._write_if_due()

    def say(self, line: LogLine) -> None:
        """Add a line to the log that is shown."""
        self._newest.say(line)
        self._fresh = True

    def orders(self) -> list[Order]:
        """What the one who looks has asked for since the last call, oldest first. `Sensors` have been obeyed already."""
        self._listen()
        orders = list(self._orders)
        self._orders.clear()
        return orders

    @property
    def open(self) -> bool:
        """Whether there still is somebody at the other end, as far as is known."""
        return self._pipe.open

    def close(self, why: str) -> None:
        """Show how the run ended, if the other end takes it within a second; the pipe stays open."""
        self._pace = msgspec.structs.replace(self._pace, over=why)
        self._pipe.offer_within(self._encoded(self._clock()), FAREWELL_S)
        self._newest.forget()
        self._fresh = False

    def _write_if_due(self) -> None:
        now_s = self._clock()
        if now_s < self._due_s or not self._pipe.open:
            return
        self._due_s = now_s + PERIOD_S
        self._listen()
        if now_s - self._read_s >= READING_S and self._newest.work_out(self._now_ns):
            self._read_s, self._fresh = now_s, True
        if not self._pipe.push():
            self._due_s = now_s + AGAIN_S
        elif self._fresh and self._pipe.offer(self._encoded(now_s)):
            self._newest.forget()
            self._fresh = False

    def _encoded(self, now_s: float) -> bytes:
        pace = msgspec.structs.replace(self._pace, achieved=self._achieved(now_s))
        try:
            return protocol.fitting(codec.encode(self._newest.shown(self._now_ns, pace)))
        except ValueError as error:  # of a part of the user's own, or a vast mosaic
            self._newest.forget()
            line = LogLine(time_ns=self._now_ns, level="error", text=f"what has happened cannot be shown: {error}")
            return codec.encode(PageUpdate(time_ns=self._now_ns, lines=(line,), pace=pace))

    def _achieved(self, now_s: float) -> float | None:
        """Simulated seconds per second, over the last one."""
        paces = self._paces
        paces.append((now_s, self._now_ns))
        while now_s - paces[0][0] > 1.0 and len(paces) > 2:
            paces.popleft()
        then_s, then_ns = paces[0]
        return (self._now_ns - then_ns) / SECOND_NS / (now_s - then_s) if now_s > then_s else None

    def _listen(self) -> None:
        """Take orders, and obey those that ask for readings."""
        if not self._pipe.open:
            return
        try:
            messages = self._pipe.take()
        except ValueError as error:
            self._lose(f"the control station sent {error}")
            return
        for message in messages:
            try:
                order = protocol.answers.decode(message)
            except ValueError:
                self.say(LogLine(time_ns=self._now_ns, level="warning", text="the control station asked for what is no order"))
                continue
            if isinstance(order, Sensors):
                self._newest.ask(order.names)
            elif isinstance(order, protocol.Down):
                self._lose(order.problem)
            elif not isinstance(order, protocol.Up):
                self._orders.append(order)

    def _lose(self, problem: str) -> None:
        self.problem = problem
        self._pipe.close()
