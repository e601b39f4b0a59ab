"""The `Hall` of a bridge process: what its doors hand over goes into the store, what they count and ask is kept here."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, Door
from vcmvsp.netsim.bridge.process.datagram_store import Store


class OpenHall:
    """See `netsim.bridge.gateways.base.Hall`.

    Args:
        run: name of the scenario.
        vehicles: of the run.
        loop: that turns the doors.
        store: where datagrams go.
        news: called when there is a datagram that the run does not know of.
        wanted: called when levels are asked for that nobody has told.
    """

    def __init__(
        self,
        run: str,
        vehicles: tuple[str, ...],
        loop: asyncio.AbstractEventLoop,
        store: Store,
        *,
        news: Callable[[], None],
        wanted: Callable[[], None],
    ) -> None:
        self.run, self.vehicles, self.loop = run, vehicles, loop
        self.counts: dict[str, Counter[str]] = {}
        self.counted: dict[str, None] = {}  # for whom, since whoever looks at them took them out
        self._levels: Array | None = None
        self._store, self._news, self._wanted = store, news, wanted

    def offer(self, door: Door, sender: int, to: int, payload: bytes, *, came_ns: int | None = None) -> bool:
        """Put it into the store, if there is room."""
        rows = range(len(self.vehicles))
        if len(payload) > LARGEST or sender not in rows or to == sender or (to not in rows and to != BROADCAST):
            raise ValueError(f"{type(door).__name__} offers {len(payload)} bytes from row {sender} to {to}")
        now_ns = time.monotonic_ns()
        if not self._store.put(door, sender, to, payload, now_ns if came_ns is None else min(came_ns, now_ns)):
            return False
        self._news()
        return True

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        """Count it."""
        name = self.vehicles[vehicle]
        self.counts.setdefault(name, Counter())[what] += by
        self.counted[name] = None

    def level_dbm(self, sender: int, receiver: int) -> float:
        """The newest that the run has told; it begins to when it is asked."""
        if self._levels is None:
            self._wanted()
            return float("nan")
        return float(self._levels[sender, receiver])

    def tell_levels(self, first: int, dbm: Array) -> None:
        """Take rows of levels from ``first`` on, (k, n) dBm: of the row's radio at the column's."""
        if self._levels is None:
            self._levels = np.full((len(self.vehicles), len(self.vehicles)), np.nan)
        self._levels[first : first + len(dbm)] = dbm
