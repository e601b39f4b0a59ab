"""Map exchange that survives loss: all members store, by contributor, the number of looks at each cell with each result.

Such counts only grow, so the greater of two is the newer. They can be merged in any order, any number of times and over any
route, with the same result (a state-based grow-only counter: Shapiro, Preguica, Baquero and Zawirski, "Conflict-free
replicated data types", SSS 2011). When every message has arrived, all members have the map of a single observer of all looks.

Trust:

- A vehicle never accepts counts of its own looks from others.
- A contributor's own counts are accepted and never decrease: old messages, copies and a restarted contributor lower nothing (a
  restarted one counts again where it has looked more often than before).
- Relayed counts of a contributor are accepted only if they are newer than its own last message about that tile, and not
  from the future; they add to its counts and reduce none. Of relayed counts the newest apply.
- A false relay can raise counts only until the contributor's next own message about the tile, and none with ``relay = False``.
  A contributor's own counts cannot be checked: looks have errors in any case.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vcmvsp.agents.reconnaissance.probability_map import LIMIT, Sensor
from vcmvsp.agents.reconnaissance.tiles import Body, Tiling, number, packed, parsed
from vcmvsp.cosim.types import Array

KEY = "l"
NEVER = -1
OLDEST_MS = 2**32 - 1  # 49 days, to which the room for ages in messages is cut


class Ledger:
    """Counts by contributor, in tiles. Changed tiles are sent first, newest first, then all others as room is left.

    An entry of a message is ``[contributor, tile, age_ms, counts]``: the contributor's number among the sorted members, the
    number of the tile, the time from its last change to ``ms``, and hits and misses. Within a millisecond, look before sending.

    Args:
        tiling: of the map, equal for all members.
        sensor: error rates of looks.
        prior: log-odds before the first look.
        me: this vehicle.
        members: all contributors, with this vehicle.
        relay: send and accept counts of third members.
        clock_bound_ms: largest lead of other clocks.
    """

    def __init__(
        self,
        tiling: Tiling,
        sensor: Sensor,
        prior: float,
        me: str,
        members: Sequence[str],
        *,
        relay: bool = True,
        clock_bound_ms: int = 0,
    ) -> None:
        self.tiling, self.sensor, self.prior, self.relay = tiling, sensor, prior, relay
        self._places = {name: place for place, name in enumerate(sorted(set(members)))}
        self._me, self._clock_bound_ms = self._places[me], clock_bound_ms
        n, tiles, cells = len(self._places), tiling.tiles, tiling.per_tile
        self._own = np.zeros((n, tiles, 2, cells), np.uint16)  # hits and misses from each contributor itself
        self._changed = np.full((n, tiles), NEVER)  # ms: when these last changed,
        self._said = np.full((n, tiles), NEVER)  # time of its last message
        self._others = np.zeros((n, tiles, 2, cells), np.uint16)  # relayed hits and misses
        self._others_changed = np.full((n, tiles), NEVER)
        self._times = np.zeros((n, tiles), int)  # messages with the change, own and received
        self._times_of = np.full((n, tiles), NEVER)  # which change that was

    @property
    def log_odds(self) -> Array:
        """The map, (rows, columns): of all looks that are known."""
        hits, misses = self.counts.sum(axis=0, dtype=np.int64)
        return np.clip(self.prior + self.sensor.evidence(hits, misses), -LIMIT, LIMIT)

    @property
    def counts(self) -> Array:
        """Hits and misses by contributor, (members, 2, rows, columns) uint16, as far as they are known."""
        of_tiles = np.moveaxis(self._believed(), 2, 1)
        shape = (*of_tiles.shape[:2], self.tiling.grid.rows, self.tiling.grid.columns)
        result: Array = of_tiles.reshape(*of_tiles.shape[:2], -1)[..., self.tiling.index].reshape(shape)
        return result

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""
        self._changed[self._me, self.tiling.count(self._own[self._me], cells, hits)] = now_ns // 1_000_000

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages to be sent now."""
        changed = np.where(self._newer(), self._others_changed, self._changed)
        self._times[changed != self._times_of] = 0
        self._times_of = changed
        changed_cells = changed != NEVER
        if not self.relay:
            changed_cells[np.arange(len(changed_cells)) != self._me] = False
        who, tile = np.nonzero(changed_cells)
        order = np.lexsort((tile, who, -changed[who, tile], who != self._me, self._times[who, tile]))
        who, tile, ms = who[order], tile[order], now_ns // 1_000_000
        bodies, used = self.tiling.bodies(KEY, ms, self._entries(who, tile, ms - changed[who, tile]), most)
        self._times[who[:used], tile[:used]] += 1
        return bodies

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Merge a received message; False: it is invalid, and nothing was merged."""
        teller, latest_ms = self._places.get(sender, self._me), now_ns // 1_000_000 + self._clock_bound_ms
        message = parsed(body, KEY, 4, latest_ms)
        if teller == self._me or message is None:
            return False
        entries = []
        for who, tile, age, raw in message.entries:
            counts = self.tiling.counts_of(tile, raw)
            if counts is None or not number(who, len(self._places)) or type(age) is not int:
                return False
            changed = message.ms - age  # where clocks differ, what is passed on may be from after it was sent
            if not max(0, latest_ms - OLDEST_MS) <= changed <= latest_ms:
                return False
            entries.append((who, tile, changed, counts))
        for who, tile, changed, counts in entries:
            if who == teller:
                np.maximum(self._own[who, tile], counts, out=self._own[who, tile])
                self._changed[who, tile] = max(self._changed[who, tile], changed)
                self._said[who, tile] = max(self._said[who, tile], message.ms)
            elif who != self._me and self.relay:
                self._pass_on(who, tile, changed, counts)
        return True

    def _pass_on(self, who: int, tile: int, changed: int, counts: Array) -> None:
        """Store relayed counts: the newer; of equal times, the first received."""
        self._times[who, tile] += changed == self._times_of[who, tile]  # already sent by another member: lower priority
        before = self._others_changed[who, tile]
        if changed > before or (changed == before and counts.tobytes() > self._others[who, tile].tobytes()):
            self._others_changed[who, tile], self._others[who, tile] = changed, counts

    def _newer(self) -> Array:
        """(members, tiles): whether relayed counts are newer than the contributor's own."""
        newer: Array = self._others_changed > self._said  # of this vehicle itself, both are never
        return newer

    def _believed(self) -> Array:
        """(members, tiles, 2, cells of a tile)."""
        return np.where(self._newer()[..., None, None], np.maximum(self._own, self._others), self._own)

    def _entries(self, who: Array, tile: Array, age_ms: Array) -> Iterator[list[Any]]:
        """A generator, since few entries fit into a message."""
        newer = self._newer()
        for a, k, age in zip(who.tolist(), tile.tolist(), age_ms.tolist(), strict=True):
            counts = np.maximum(self._own[a, k], self._others[a, k]) if newer[a, k] else self._own[a, k]
            yield [a, k, age, packed(counts)]
