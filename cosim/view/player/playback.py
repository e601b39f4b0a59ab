"""A recorded run that goes by at a wanted pace, as the one who looks at it orders."""

import queue
import time
from collections.abc import Callable

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.view.messages import Go, Order, Pace, PageUpdate, Seek, Sensors
from vcmvsp.cosim.view.player.recording import Recording

FASTEST, SLOWEST = 100.0, 0.01  # simulated seconds per second


class Player:
    """Shows a recording, from its start on once it is told to go; at its end it stands."""

    def __init__(self, recording: Recording, clock: Callable[[], float] = time.monotonic) -> None:
        self._recording, self._clock = recording, clock
        self._orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._paused, self._speed = True, 1.0
        self._from_s, self._from_ns = clock(), 0  # when it was told how to go on, and where it was then
        self._until_ns = recording.end_ns  # where it will stand
        self._sensors: tuple[str, ...] = ()
        self._last_ns: int | None = None  # that was shown

    def order(self, order: Order) -> None:
        """Obey at the next `show`; what a recording cannot obey is passed over. For any thread."""
        self._orders.put(order)

    def show(self) -> PageUpdate:
        """How things stand now, without what has not changed since the last time. For one thread.

        Raises:
            UsageError: see `Recording.at`.
        """
        before = self._sensors
        while not self._orders.empty():
            self._obey(self._orders.get())
        now_ns = self._now_ns()
        if now_ns >= self._until_ns:
            self._paused, self._from_ns = True, now_ns
        since_ns = None if self._last_ns is None or now_ns < self._last_ns else self._last_ns
        self._last_ns = now_ns
        shown = self._recording.at(now_ns, since_ns, self._sensors)
        if asked := [name for name in self._sensors if name not in before]:  # the newest, however old
            readings = self._recording.readings(now_ns, None, asked)
            shown = msgspec.structs.replace(shown, **{name: getattr(shown, name) | new for name, new in readings.items()})
        return msgspec.structs.replace(shown, pace=self._pace(now_ns))

    def _obey(self, order: Order) -> None:
        now_ns, end_ns = self._now_ns(), self._recording.end_ns
        match order:
            case Sensors():
                self._sensors = order.names
            case Seek():
                self._go_from(min(max(order.time_ns, 0), end_ns))
            case Go() if order.speed is None or order.speed > 0.0:
                self._paused = order.paused and order.step_ns <= 0
                self._speed = FASTEST if order.speed is None else min(max(order.speed, SLOWEST), FASTEST)
                self._go_from(0 if now_ns == end_ns and not order.paused else now_ns)
                if order.paused and order.step_ns > 0:
                    self._until_ns = min(now_ns + order.step_ns, end_ns)

    def _now_ns(self) -> int:
        if self._paused:
            return self._from_ns
        gone_ns = int((self._clock() - self._from_s) * self._speed * SECOND_NS)
        return min(self._from_ns + gone_ns, self._until_ns)

    def _go_from(self, time_ns: int) -> None:
        self._from_s, self._from_ns, self._until_ns = self._clock(), time_ns, self._recording.end_ns

    def _pace(self, now_ns: int) -> Pace:
        over = self._recording.ending if now_ns >= self._recording.end_ns else ""
        return Pace(paused=self._paused, speed=self._speed, achieved=None if self._paused else self._speed, over=over)
