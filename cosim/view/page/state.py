"""State of the control station: the newest values of all updates, with vehicles in the order of the scenery."""

from collections import deque
from collections.abc import Mapping
from typing import Any, get_origin

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import PageUpdate, Scenery

NEVER_NS = -(2**62)
LINES = 200  # log lines kept
MAPPINGS = tuple(each.name for each in msgspec.structs.fields(PageUpdate) if get_origin(each.type) is Mapping)
"""Fields of `PageUpdate` that keep the newest value of each key."""


class PageState:
    """The newest values of a run. A step back in time, in a recording, clears all but the values of that update.

    Rows are vehicles in the order of the scenery; the position of a vehicle that was never shown is NaN.

    Attributes:
        now: all updates merged; states, links and lines are from the last one.
        lines: log lines; ``line_count``: their total number so far.
        times_back: number of steps back in time.
        position, velocity, attitude: (n, 3) m and m/s, world; (n, 4) w, x, y, z, world_from_body.
        link_sent_ns, link_rssi_dbm, link_received: (n, n), of the newest frame from the row's vehicle for the column's.
    """

    now: PageUpdate
    line_count: int

    def __init__(self, scenery: Scenery) -> None:
        self.scenery = scenery
        self.names = [each.name for each in scenery.vehicles]
        self.row = {name: index for index, name in enumerate(self.names)}
        self.times_back = 0
        count = len(self.names)
        self.position = np.full((count, 3), np.nan)
        self.velocity = np.zeros((count, 3))
        self.attitude = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
        self._state_names: tuple[str, ...] = ()  # of the last states, with the index of each one, and its place among them
        self._rows = self._columns = np.zeros(0, int)
        self._forget(0)

    def take(self, update: PageUpdate) -> None:
        """Update from a message."""
        if update.time_ns < self.now.time_ns:
            self.times_back += 1
            lines = [line for line in self.lines if line.time_ns <= update.time_ns]
            self._forget(update.time_ns)
            self.lines.extend(lines)
        for line in update.lines:
            if line not in self.lines:  # a recording may repeat lines that are still listed
                self.lines.append(line)
                self.line_count += 1
        merged: dict[str, Any] = {name: {**getattr(self.now, name), **getattr(update, name)} for name in MAPPINGS}
        if update.sent is None or update.received is None:
            merged |= {"sent": self.now.sent, "received": self.now.received}
        if update.crafts:
            self.scenery = msgspec.structs.replace(self.scenery, vehicles=update.crafts)
        self.now = msgspec.structs.replace(update, **merged)
        self._take_states(update)
        self._take_links(update)

    @property
    def yaw(self) -> Array:
        """Heading of each vehicle, rad, counter-clockwise from east: (n,)."""
        return yaws_of(self.attitude)

    @property
    def speed(self) -> Array:
        """Speed of each vehicle, (n,) m/s; NaN: it was never shown."""
        return np.where(np.isfinite(self.position[:, 0]), np.linalg.norm(self.velocity, axis=1), np.nan)

    @property
    def age_s(self) -> Array:
        """Time since each vehicle's last reception, (n,) s; NaN before the first."""
        age_s = np.full(len(self.names), np.nan)
        for vehicle, heard_ns in self.now.heard_ns.items():
            if vehicle in self.row:
                age_s[self.row[vehicle]] = max(0, self.now.time_ns - heard_ns) / SECOND_NS
        return age_s

    @property
    def level_dbm(self) -> Array:
        """Level of the newest frame that each vehicle has received, (n,) dBm; NaN before the first."""
        sent_ns = np.where(self.link_received, self.link_sent_ns, NEVER_NS)
        if not len(sent_ns):
            return np.zeros(0)
        sender, column = sent_ns.argmax(axis=0), np.arange(len(sent_ns))
        return np.where(sent_ns[sender, column] > NEVER_NS, self.link_rssi_dbm[sender, column], np.nan)

    def _forget(self, time_ns: int) -> None:
        self.now = PageUpdate(time_ns=time_ns)
        self.lines: deque[LogLine] = deque(maxlen=LINES)
        self.line_count = 0
        count = len(self.names)
        self.link_sent_ns = np.full((count, count), NEVER_NS, np.int64)
        self.link_rssi_dbm = np.zeros((count, count))
        self.link_received = np.zeros((count, count), bool)

    def _take_states(self, update: PageUpdate) -> None:
        states = update.states
        if states is None:
            return
        if self._state_names != states.names:
            self._state_names = states.names
            pairs = [(self.row[name], column) for column, name in enumerate(states.names) if name in self.row]
            self._rows, self._columns = np.array(pairs, int).reshape(-1, 2).T
        self.position[self._rows] = states.position[self._columns]
        self.velocity[self._rows] = states.velocity[self._columns]
        self.attitude[self._rows] = states.attitude[self._columns]

    def _take_links(self, update: PageUpdate) -> None:
        for link in update.links:
            sender = self.row.get(link.sender)
            receivers = [self.row.get(name, -1) for name in link.receivers]
            if sender is None or -1 in receivers:
                continue
            self.link_sent_ns[sender, receivers] = link.sent_ns
            self.link_rssi_dbm[sender, receivers] = link.rssi_dbm
            self.link_received[sender, receivers] = link.received
