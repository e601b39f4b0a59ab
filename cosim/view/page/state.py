"""What the control station knows: the newest of all that it was shown, in rows as the scenery has its vehicles."""

from collections import deque
from collections.abc import Mapping
from typing import get_origin

import msgspec
import numpy as np

from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Array, Fix, Follows, Image, Mosaic, Presence, ProbabilityMap, RealStatus, Scan, Sightings
from vcmvsp.cosim.view.messages import Pace, PageUpdate, Scenery

NEVER_NS = -(2**62)
LINES = 200  # of the log are kept
MAPPINGS = tuple(each.name for each in msgspec.structs.fields(PageUpdate) if get_origin(each.type) is Mapping)
"""Fields of `PageUpdate` of which the newest of each key counts."""


class Known:
    """The newest of each thing. Where time goes back, in a recording, all is forgotten but what is shown then.

    Rows are vehicles in the order of the scenery; a vehicle that was never shown is somewhere that is not a number.
    """

    time_ns: int
    lines: deque[LogLine]
    told: int  # lines so far: tells whether there are new ones
    sent: Array | None
    received: Array | None
    obstacles: dict[str, tuple[float, float, float, float]]
    targets: dict[str, tuple[float, float]]
    places: dict[str, Follows]
    notes: dict[str, dict[str, float | str | bool]]
    fixes: dict[str, Fix]
    scans: dict[str, Scan]
    images: dict[str, Image]
    sightings: dict[str, Sightings]
    maps: dict[str, ProbabilityMap]
    mosaics: dict[str, Mosaic]
    heard_ns: dict[str, int]
    presence: dict[str, Presence]
    real: dict[str, RealStatus]

    def __init__(self, scenery: Scenery) -> None:
        self.scenery = scenery
        self.names = [each.name for each in scenery.vehicles]
        self.row = {name: index for index, name in enumerate(self.names)}
        self.times_back = 0  # how often time went back
        count = len(self.names)
        self.position = np.full((count, 3), np.nan)  # m, world
        self.velocity = np.zeros((count, 3))  # m/s, world
        self.attitude = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))  # w, x, y, z; world_from_body
        self._rows_of: tuple[tuple[str, ...], list[int], list[int]] = ((), [], [])
        self._forget(0)

    def take(self, shown: PageUpdate) -> None:
        """Learn how things stand."""
        if shown.time_ns < self.time_ns:
            self.times_back += 1
            kept = [line for line in self.lines if line.time_ns <= shown.time_ns]
            self._forget(shown.time_ns)
            self.lines.extend(kept)
        self.time_ns = shown.time_ns
        self.pace, self.halted = shown.pace, shown.halted
        for field in MAPPINGS:
            getattr(self, field).update(getattr(shown, field))
        for line in shown.lines:
            if line not in self.lines:  # a recording may tell those again that stand there still
                self.lines.append(line)
                self.told += 1
        if shown.sent is not None and shown.received is not None:
            self.sent, self.received = shown.sent, shown.received
        self._take_states(shown)
        self._take_links(shown)

    @property
    def yaw(self) -> Array:
        """Of each vehicle, rad, counter-clockwise from east: (n,)."""
        w, x, y, z = self.attitude.T
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def _forget(self, time_ns: int) -> None:
        self.time_ns = time_ns
        self.pace, self.halted = Pace(), ()
        self.lines = deque(maxlen=LINES)
        self.told = 0
        for field in MAPPINGS:
            setattr(self, field, {})
        self.sent = self.received = None
        count = len(self.names)
        self.link_sent_ns = np.full((count, count), NEVER_NS, np.int64)  # newest frame of the row's vehicle for the column's
        self.link_rssi_dbm = np.zeros((count, count))
        self.link_received = np.zeros((count, count), bool)

    def _take_states(self, shown: PageUpdate) -> None:
        states = shown.states
        if states is None:
            return
        if self._rows_of[0] != states.names:
            known = [(self.row[name], column) for column, name in enumerate(states.names) if name in self.row]
            self._rows_of = (states.names, [row for row, _ in known], [column for _, column in known])
        _, rows, columns = self._rows_of
        self.position[rows] = states.position[columns]
        self.velocity[rows] = states.velocity[columns]
        self.attitude[rows] = states.attitude[columns]

    def _take_links(self, shown: PageUpdate) -> None:
        for link in shown.links:
            sender = self.row.get(link.sender)
            receivers = [self.row.get(name, -1) for name in link.receivers]
            if sender is None or -1 in receivers:
                continue
            self.link_sent_ns[sender, receivers] = link.sent_ns
            self.link_rssi_dbm[sender, receivers] = link.rssi_dbm
            self.link_received[sender, receivers] = link.received
