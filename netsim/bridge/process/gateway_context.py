"""The `GatewayContext` of a bridge process: it stores datagrams and keeps counts and levels."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, Gateway
from vcmvsp.netsim.bridge.process.datagram_store import DatagramStore


class BridgeContext:
    """See `netsim.bridge.gateways.base.GatewayContext`.

    Args:
        run, vehicles: of the scenario.
        loop: runs the gateways.
        store: takes datagrams.
        on_datagram: called after each stored datagram.
        on_level_request: called when a level is requested and none is known.
    """

    def __init__(
        self,
        run: str,
        vehicles: tuple[str, ...],
        loop: asyncio.AbstractEventLoop,
        store: DatagramStore,
        *,
        on_datagram: Callable[[], None],
        on_level_request: Callable[[], None],
    ) -> None:
        self.run, self.vehicles, self.loop = run, vehicles, loop
        self.counts: dict[str, Counter[str]] = {}
        self.changed_counts: dict[str, None] = {}  # vehicles with counts that were not reported yet
        self._levels: Array | None = None
        self._store, self._on_datagram, self._on_level_request = store, on_datagram, on_level_request

    def offer(self, gateway: Gateway, sender: int, to: int, payload: bytes, *, came_ns: int | None = None) -> bool:
        """Put it into the store, if there is room."""
        rows = range(len(self.vehicles))
        if len(payload) > LARGEST or sender not in rows or to == sender or (to not in rows and to != BROADCAST):
            raise ValueError(f"{type(gateway).__name__} offers {len(payload)} bytes from row {sender} to {to}")
        now_ns = time.monotonic_ns()
        if not self._store.put(gateway, sender, to, payload, now_ns if came_ns is None else min(came_ns, now_ns)):
            return False
        self._on_datagram()
        return True

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        """Count it."""
        name = self.vehicles[vehicle]
        self.counts.setdefault(name, Counter())[what] += by
        self.changed_counts[name] = None

    def level_dbm(self, sender: int, receiver: int) -> float:
        """The newest level from the run, which sends levels from the first request on."""
        if self._levels is None:
            self._on_level_request()
            return float("nan")
        return float(self._levels[sender, receiver])

    def tell_levels(self, first: int, dbm: Array) -> None:
        """Store rows of levels from row ``first`` on, (k, n) dBm: sender by row, receiver by column."""
        if self._levels is None:
            self._levels = np.full((len(self.vehicles), len(self.vehicles)), np.nan)
        self._levels[first : first + len(dbm)] = dbm
