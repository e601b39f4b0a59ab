"""The run's side of the live view: an observer that sends the newest values when the viewer process can receive them.

Nothing here waits for the viewer, grows while it does not read, or changes the run.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.recording.run_state import LogLine, RunState
from vcmvsp.cosim.types import Image, Later, Scan
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.messages import Craft, LinkStatus, Order, Pace, PageUpdate, Pose, Scenery, Sensors

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.page_publisher import PagePublisher

PERIOD_S = 1.0 / 30.0  # wall clock, minimum time between two messages
AGAIN_S = 0.002  # between two attempts to finish a message
READING_S = 0.2  # between two readings computed for display only
FAREWELL_S = 1.0  # time for the viewer to receive the last message
MOST_ORDERS = 200  # pending orders; older ones are dropped
MOST_LINES = 200  # log lines of a whole update
READINGS: Mapping[type, str] = {Scan: "scans", Image: "images"}


def motions_of(world: "worlds.World") -> dict[str, Any]:
    """Arguments of `Feed` for obstacles and targets that move by themselves."""
    moving = {each.name: each.pose for each in world.moving}
    targets = {each.name: each.place for each in world.targets}
    return {"moving": moving, "targets": targets}


Poses = Mapping[str, Callable[[float], Pose]]
Places = Mapping[str, Callable[[float], tuple[float, float]]]


class Feed:
    """Sends the state of a run through a pipe to the viewer process.

    Args:
        pipe: connection to the viewer process, or to observers of the run.
        scenery: scenery that the viewer process has received.
        moving: function of time, s: poses of obstacles with a time-table, x, y, z m and yaw rad, by name.
        targets: function of time, s: positions of targets, x, y m.
        whole_s: time between two updates that leave nothing out, for readers that join late or lose updates; None: none.
        clock: the wall clock, s.
    """

    def __init__(
        self,
        pipe: "protocol.Pipe | PagePublisher",
        scenery: Scenery,
        *,
        moving: Poses | None = None,
        targets: Places | None = None,
        whole_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipe, self._clock = pipe, clock
        self._moving, self._targets = moving or {}, targets or {}
        self._rows = {craft.name: row for row, craft in enumerate(scenery.vehicles)}
        self._state = RunState()
        readings = dict.fromkeys((Later, Scan, Image), self._on_reading)
        self._takers: dict[type, Callable[[str, int, Any], None]] = self._state.handlers | readings
        self._state.newest |= {name: {} for name in READINGS.values()}  # requested sensors: vehicle/sensor
        self._requests: frozenset[str] = frozenset()
        self._later: dict[str, Later] = {}
        self._now_ns, self._fresh = 0, True  # changes have occurred that were not sent
        self._due_s = self._read_s = -1e9
        self._pace, self._paces = Pace(), deque[tuple[float, int]]()  # times of the run within the last second
        self._crafts: tuple[Craft, ...] = ()  # not sent yet
        self._whole_s, self._whole_due_s = whole_s, -1e9
        self._sent_lines, self._all_crafts = deque[LogLine](maxlen=MOST_LINES), scenery.vehicles
        self._orders: deque[Order] = deque(maxlen=MOST_ORDERS)
        self.problem = ""  # reason for the end of the viewer process, if it gave one

    def on(self, event: Event) -> None:
        """Update from an event at its own time; times never decrease."""
        if event.time_ns != self._now_ns:
            self._write_if_due()  # the finished instant, complete
            self._now_ns, self._fresh = event.time_ns, True
        take = self._takers.get(type(event.value))
        if take is not None:  # most events are of other types
            take(event.key, event.time_ns, event.value)

    def pace(self, pace: Pace) -> None:
        """Set the pace of the run; ``achieved`` is measured here. Also call it during a pause: it reads orders."""
        self._fresh = self._fresh or pace != self._pace
        self._pace = pace
        self._write_if_due()

    def describe(self, crafts: Sequence[Craft]) -> None:
        """Show all vehicles as described from now on, with their agents."""
        self._crafts, self._fresh = tuple(crafts), True
        self._all_crafts = self._crafts

    def say(self, level: str, text: str) -> None:
        """Add a line to the displayed log."""
        self._state.say(self._now_ns, level, text)
        self._fresh = True

    def orders(self) -> list[Order]:
        """Orders since the last call, oldest first. `Sensors` orders have been applied already."""
        self._listen()
        orders = list(self._orders)
        self._orders.clear()
        return orders

    @property
    def open(self) -> bool:
        """Whether the viewer process is connected, as far as known."""
        return self._pipe.open

    @property
    def over(self) -> bool:
        """Whether the page shows that the run has ended."""
        return bool(self._pace.over)

    def close(self, why: str) -> None:
        """Show how the run ended, if the viewer receives it within a second; the pipe stays open."""
        self._pace = msgspec.structs.replace(self._pace, over=why)
        if self._whole_s is not None:
            self._leave_nothing_out()
        self._pipe.offer_within(self._encoded(self._clock()), FAREWELL_S)
        self._forget()

    def _on_reading(self, key: str, _: int, reading: Any) -> None:
        if key in self._requests:
            self._take_reading(key, reading)

    def _take_reading(self, key: str, reading: Any) -> None:
        if isinstance(reading, Later):
            self._later[key] = reading
        elif (collection := READINGS.get(type(reading))) is not None:
            self._state.keep(collection, key, reading)

    def _ask(self, names: Sequence[str]) -> None:
        self._requests = frozenset(names)
        state = self._state
        state.fresh = {each: None for each in state.fresh if each[0] not in READINGS.values() or each[1] in self._requests}
        self._later = {key: later for key, later in self._later.items() if key in self._requests}

    def _work_out(self) -> bool:
        """Compute one of the pending readings in turn; returns whether there was one."""
        if not self._later:
            return False
        key = next(iter(self._later))
        try:
            self._take_reading(key, self._later.pop(key).get())
        except Exception as error:  # the error recurs where the run itself uses the reading
            self.say("error", f"{key} could not be computed: {type(error).__name__}: {error}")
        return True

    def _write_if_due(self) -> None:
        now_s = self._clock()
        if now_s < self._due_s or not self._pipe.open:
            return
        self._due_s = now_s + PERIOD_S
        self._listen()
        if now_s - self._read_s >= READING_S and self._work_out():
            self._read_s, self._fresh = now_s, True
        if not self._pipe.push():
            self._due_s = now_s + AGAIN_S
            return
        if self._whole_s is not None and now_s >= self._whole_due_s:
            self._whole_due_s = now_s + self._whole_s
            self._leave_nothing_out()
        if self._fresh and self._pipe.offer(self._encoded(now_s)):
            self._forget()

    def _leave_nothing_out(self) -> None:
        """Make the next update hold everything but readings of sensors."""
        state = self._state
        state.settle()
        newest = {name: values for name, values in state.newest.items() if name not in READINGS.values()}
        state.fresh = {(name, key): None for name, values in newest.items() for key in values}
        state.lines.extendleft(reversed(self._sent_lines))
        self._sent_lines.clear()
        self._crafts, self._fresh = self._all_crafts, True

    def _forget(self) -> None:
        self._state.fresh.clear()
        self._sent_lines.extend(self._state.lines)
        self._state.lines.clear()
        self._crafts, self._fresh = (), False

    def _encoded(self, now_s: float) -> bytes:
        pace = msgspec.structs.replace(self._pace, achieved=self._achieved(now_s))
        try:
            return protocol.fitting(codec.encode(self._update(pace)))
        except ValueError as error:  # from a user's own class, or for a vast mosaic
            self._forget()
            self.say("error", f"the view cannot show an event: {error}")
            return codec.encode(PageUpdate(time_ns=self._now_ns, lines=tuple(self._state.lines), pace=pace))

    def _update(self, pace: Pace) -> PageUpdate:
        state, time_s = self._state, self._now_ns / SECOND_NS
        state.settle()
        news: dict[str, Any] = {}
        for collection, key in state.fresh:
            news.setdefault(collection, {})[key] = state.newest[collection][key]
        moving = {name: pose(time_s) for name, pose in self._moving.items()}
        targets = {name: place(time_s) for name, place in self._targets.items()}
        frames = news.pop("frames", {})
        counts = self._counts() if frames else {}
        return PageUpdate(
            time_ns=self._now_ns,
            states=news.pop("states", {}).get(""),
            obstacles=moving | news.pop("pushed", {}),
            targets=targets,
            links=tuple(map(LinkStatus.of, frames.values())),
            halted=tuple(name for name in self._rows if name in state.halted),
            lines=tuple(state.lines),
            crafts=self._crafts,
            pace=pace,
            **counts,
            **news,
        )

    def _counts(self) -> dict[str, Any]:
        sent, received = (np.zeros((len(self._rows),) * 2, np.int64) for _ in range(2))
        for (sender, receivers), tally in self._state.tallies.items():
            row, columns = self._rows[sender], [self._rows[name] for name in receivers]
            sent[row, columns] += tally[0]
            received[row, columns] += tally[1:]
        return {"sent": sent, "received": received}

    def _achieved(self, now_s: float) -> float | None:
        """Simulated seconds per second, over the last second."""
        paces = self._paces
        paces.append((now_s, self._now_ns))
        while now_s - paces[0][0] > 1.0 and len(paces) > 2:
            paces.popleft()
        then_s, then_ns = paces[0]
        return (self._now_ns - then_ns) / SECOND_NS / (now_s - then_s) if now_s > then_s else None

    def _listen(self) -> None:
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
                self.say("warning", "the control station sent an invalid command")
                continue
            if isinstance(order, Sensors):
                self._ask(order.names)
            elif isinstance(order, protocol.Down):
                self._lose(order.problem)
            elif not isinstance(order, protocol.Up):
                self._orders.append(order)

    def _lose(self, problem: str) -> None:
        self.problem = problem
        self._pipe.close()
