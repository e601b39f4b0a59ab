"""Four protocols for sharing the map of a team; message losses lose evidence in all but the ledger.

``none``        no messages: each member searches on its own.
``delta``       the increments since the last message (lost increments are not repeated).
``consensus``   after its own update each moves its map towards the received ones, ``l <- (1 - n / N) l + sum of l_j / N``,
                n received of N members (Hu, Xie, Lum and Xu 2013): in the end all have the N-th part of all evidence.
``ledger``      cumulative counts by contributor.

The map is cut into square tiles, so that a message holds what changed and no more than fits. Bodies are ``{"ms": when it was
sent, <key>: [[..., bytes], ...]}``, an inner list per tile, for any encoding that knows bytes. Counts are little-endian, of one
or two bytes, the hits of all cells of the tile before the misses.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal, TypeGuard

import msgspec
import numpy as np

from vcmvsp.agents.reconnaissance.probability_map import LIMIT, Grid, Sensor, log_odds
from vcmvsp.cosim.types import Array

Kind = Literal["none", "delta", "consensus", "ledger"]
Body = dict[str, Any]

SIDES = (16, 8, 4, 2, 1)  # cells, of a tile
OVERHEAD = 36  # bytes at most: "ms" with its number, the key, contributor, tile and age, and the lengths of all of it
MOST = 65535  # that two bytes count
LATEST_MS = 2**53  # of the clock; larger values are invalid
OLDEST_MS = 2**32 - 1  # 49 days, to which the room for ages in messages is cut
STEPS = 1600  # of a number in a message for 1 of l: 20 is 32000, which two bytes hold, and half a step is 0.0003
NEVER = -1


class Tiling:
    """Tiles of ``side`` x ``side`` cells over a grid; in tiled arrays the cells of a tile are neighbours.

    The side follows from ``max_bytes``, the size of the largest message, encoded, so that it is the same for the team.
    """

    def __init__(self, grid: Grid, max_bytes: int) -> None:
        fitting = [side for side in SIDES if 4 * side * side + OVERHEAD <= max_bytes]
        if not fitting:
            raise ValueError(f"max_bytes = {max_bytes}: a map message needs at least {4 + OVERHEAD} bytes")
        self.grid, self.max_bytes, self.side = grid, max_bytes, fitting[0]
        side, rows, columns = self.side, np.arange(grid.rows), np.arange(grid.columns)
        self.across = -(-grid.columns // side)
        self.tiles = self.across * -(-grid.rows // side)
        self.per_tile = side * side
        tile = (rows // side)[:, None] * self.across + columns // side
        self.index = (tile * self.per_tile + (rows % side)[:, None] * side + columns % side).ravel()  # by cell of the grid
        self.beyond: Array = np.ones((self.tiles, self.per_tile), bool)
        self.beyond.reshape(-1)[self.index] = False

    def of_grid(self, tiled: Array) -> Array:
        """Tiled arrays, (..., tiles, cells of a tile), as (..., rows, columns)."""
        flat = tiled.reshape(*tiled.shape[:-2], -1)[..., self.index]
        return flat.reshape(*flat.shape[:-1], self.grid.rows, self.grid.columns)

    def count(self, counts: Array, cells: Array, hits: Array) -> Array:
        """Add looks at cells, each at most once, to counts, (tiles, 2, cells of a tile) uint16; the tiles of these cells."""
        tiles, inner = np.divmod(self.index[cells], self.per_tile)
        kind = np.where(hits, 0, 1)
        counts[tiles, kind, inner] = np.minimum(counts[tiles, kind, inner], MOST - 1) + 1
        return tiles

    def counts_of(self, tile: Any, raw: bytes) -> Array | None:
        """Hits and misses in bytes of a message, (2, cells of a tile) uint16; None: they are invalid."""
        width = {2 * self.per_tile: "<u1", 4 * self.per_tile: "<u2"}.get(len(raw))
        if not _is_number(tile, self.tiles) or width is None:
            return None
        counts = np.frombuffer(raw, width).reshape(2, -1).astype(np.uint16)
        return None if counts[:, self.beyond[tile]].any() else counts

    def bodies(self, key: str, ms: int, entries: Iterable[list[Any]], most: int) -> tuple[list[Body], int]:
        """Up to ``most`` messages with as many of the entries as fit, in their order; and the number of these entries."""
        empty = len(msgspec.msgpack.encode({"ms": ms, key: []})) + 2  # a list of more than 15 needs two bytes to say so
        bodies: list[Body] = []
        used, free_bytes = 0, 0
        for entry in entries:
            size = len(msgspec.msgpack.encode(entry))
            if size > free_bytes:
                if len(bodies) >= most:
                    break
                bodies.append({"ms": ms, key: []})
                free_bytes = self.max_bytes - empty
            bodies[-1][key].append(entry)
            free_bytes -= size
            used += 1
        return bodies, used


def _packed(counts: Array) -> bytes:
    """Hits and misses, (2, n), as bytes: one byte for each count if that is enough."""
    return counts.astype("<u1" if counts.max(initial=0) < 256 else "<u2").tobytes()


def _is_number(value: Any, end: int) -> TypeGuard[int]:
    return type(value) is int and 0 <= value < end


class MapExchange:
    """A member's knowledge of the area. Each tick: `take` received messages, `look` (possibly at no cell), send `messages`.

    This one exchanges nothing (kind ``none``). An entry of a message is a list of ``length`` items that ends with bytes.
    ``tiling`` is equal for all ``members``, ``prior`` the log-odds before the first look, ``me`` this vehicle.
    """

    key = ""
    length = 0

    def __init__(
        self, tiling: Tiling, sensor: Sensor, prior: float, me: str, members: Sequence[str], clock_bound_ms: int
    ) -> None:
        self.tiling, self.sensor, self.prior = tiling, sensor, prior
        self._places = {name: place for place, name in enumerate(sorted(set(members)))}
        self._me, self._clock_bound_ms = self._places[me], clock_bound_ms
        self._map = np.full((tiling.tiles, tiling.per_tile), float(prior))

    @property
    def log_odds(self) -> Array:
        """The map to decide by, (rows, columns)."""
        return self.tiling.of_grid(self._map)

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""
        where = self.tiling.index[cells]
        flat = self._map.reshape(-1)
        flat[where] = np.clip(flat[where] + self.sensor.evidence(hits, ~np.asarray(hits, bool)), -LIMIT, LIMIT)

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages to be sent now, each of ``max_bytes`` encoded bytes at most."""
        return []

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Merge a received message; False: it was invalid or of another kind, and nothing changed."""
        place, latest_ms = self._places.get(sender, self._me), now_ns // 1_000_000 + self._clock_bound_ms
        if place == self._me or not self.key or not isinstance(body, dict):
            return False
        ms, entries = body.get("ms"), body.get(self.key)
        if not _is_number(ms, min(latest_ms, LATEST_MS) + 1) or not isinstance(entries, list | tuple):
            return False
        if any(
            not isinstance(each, list | tuple) or len(each) != self.length or not isinstance(each[-1], bytes)
            for each in entries
        ):
            return False
        checked = [self._checked(ms, latest_ms, *entry) for entry in entries]
        valid = [entry for entry in checked if entry is not None]
        if len(valid) < len(entries) or not self._fit(valid):
            return False
        for entry in valid:
            self._merge(place, ms, *entry)
        return True

    def _checked(self, ms: int, latest_ms: int, *entry: Any) -> tuple[Any, ...] | None:
        """An entry of a message as `_merge` takes it; None: it is invalid."""
        raise NotImplementedError

    def _fit(self, entries: list[tuple[Any, ...]]) -> bool:
        """Whether the entries of a message are consistent."""
        return True

    def _merge(self, place: int, ms: int, *entry: Any) -> None:
        raise NotImplementedError


class Delta(MapExchange):
    """Counts since the last message, tile by tile; an entry is ``[tile, counts]``.

    Of a sender's messages about a tile only the newest counts: copies are not counted twice; one that was overtaken is lost.
    """

    key, length = "d", 2

    def __init__(self, tiling: Tiling, *args: Any) -> None:
        super().__init__(tiling, *args)
        self._untold = np.zeros((tiling.tiles, 2, tiling.per_tile), np.uint16)
        self._since = np.zeros(tiling.tiles, np.int64)  # ms: the last look of these
        self._newest = np.full((len(self._places), tiling.tiles), NEVER)

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""
        super().look(cells, hits, now_ns)
        self._since[self.tiling.count(self._untold, cells, hits)] = now_ns // 1_000_000

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages, newest tiles first; tiles without room wait."""
        changed = np.nonzero(self._untold.any(axis=(1, 2)))[0]
        changed = changed[np.lexsort((changed, -self._since[changed]))]
        entries = ([tile, _packed(self._untold[tile])] for tile in changed.tolist())
        bodies, used = self.tiling.bodies(self.key, now_ns // 1_000_000, entries, most)
        self._untold[changed[:used]] = 0
        return bodies

    def _checked(self, ms: int, latest_ms: int, *entry: Any) -> tuple[int, Array] | None:
        tile, raw = entry
        counts = self.tiling.counts_of(tile, raw)
        return None if counts is None else (tile, counts)

    def _fit(self, entries: list[tuple[Any, ...]]) -> bool:
        return len({tile for tile, _ in entries}) == len(entries)

    def _merge(self, place: int, ms: int, *entry: Any) -> None:
        tile, (hits, misses) = entry
        if ms > self._newest[place, tile]:
            self._newest[place, tile] = ms
            self._map[tile] = np.clip(self._map[tile] + self.sensor.evidence(hits, misses), -LIMIT, LIMIT)


class Consensus(MapExchange):
    """The own map, moved towards received ones; an entry is ``[tile, l]``, l in steps of 1/1600 as little-endian int16.

    A call of `look` is one step of the protocol: first towards the maps received since the last step, then the own update,
    which `messages` send. In this order all members move from the values that they sent, and without loss no evidence is
    lost. It ends up divided by the number of members: with ``scaled`` the map for decisions is multiplied by it, which is
    fast, but rash before all agree; without, it takes N times the looks.
    """

    key, length = "c", 2

    def __init__(self, tiling: Tiling, *args: Any, scaled: bool) -> None:
        super().__init__(tiling, *args)
        self._members, self._next = len(self._places), 0
        self._gain = float(self._members) if scaled else 1.0
        self._heard = np.zeros((self._members, tiling.tiles, tiling.per_tile))
        self._fresh = np.zeros((self._members, tiling.tiles), bool)
        self._newest = np.full((self._members, tiling.tiles), NEVER)

    @property
    def log_odds(self) -> Array:
        """The map to decide by, (rows, columns)."""
        return np.clip(self.prior + self._gain * (super().log_odds - self.prior), -LIMIT, LIMIT)

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """One step: agree with the others, then add own looks, cells (n,), each at most once, and the result of each."""
        received, share = self._fresh.sum(axis=0)[:, None], 1.0 / self._members
        total = np.where(self._fresh[..., None], self._heard, 0.0).sum(axis=0)
        self._map = (1.0 - share * received) * self._map + share * total
        self._fresh[:] = False
        super().look(cells, hits, now_ns)

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages; where the whole map does not fit, they go on where the last ones ended."""
        tiles = np.roll(np.arange(self.tiling.tiles), -self._next).tolist()
        entries = ([tile, np.rint(self._map[tile] * STEPS).astype("<i2").tobytes()] for tile in tiles)
        bodies, used = self.tiling.bodies(self.key, now_ns // 1_000_000, entries, most)
        self._next = (self._next + used) % self.tiling.tiles
        return bodies

    def _checked(self, ms: int, latest_ms: int, *entry: Any) -> tuple[int, Array] | None:
        tile, raw = entry
        if not _is_number(tile, self.tiling.tiles) or len(raw) != 2 * self.tiling.per_tile:
            return None
        odds = np.frombuffer(raw, "<i2") / STEPS
        return None if np.abs(odds).max() > LIMIT else (tile, odds)

    def _merge(self, place: int, ms: int, *entry: Any) -> None:
        tile, odds = entry
        if ms > self._newest[place, tile]:
            self._newest[place, tile] = ms
            self._heard[place, tile], self._fresh[place, tile] = odds, True


class Ledger(MapExchange):
    """All members store, by contributor, the number of looks at each cell with each result.

    Such counts only grow, so the greater of two is the newer. They can be merged in any order, any number of times and over any
    route, with the same result (a state-based grow-only counter: Shapiro, Preguica, Baquero and Zawirski, "Conflict-free
    replicated data types", SSS 2011). When every message has arrived, all members have the map of a single observer of all
    looks. Changed tiles are sent first, newest first, then all others as room is left.

    An entry of a message is ``[contributor, tile, age_ms, counts]``: the contributor's number among the sorted members, the
    number of the tile, the time from its last change to ``ms``, and hits and misses. Within a millisecond, look before sending.

    Trust:

    - A vehicle never accepts counts of its own looks from others.
    - A contributor's own counts are accepted and never decrease: old messages, copies and a restarted contributor lower nothing
      (a restarted one counts again where it has looked more often than before).
    - Relayed counts of a contributor are accepted only if they are newer than its own last message about that tile, and not
      from the future; they add to its counts and reduce none. Of relayed counts the newest apply.
    - A false relay can raise counts only until the contributor's next own message about the tile, and none with
      ``relay = False``, with which counts of third members are neither sent nor accepted. A contributor's own counts cannot
      be checked: looks have errors in any case.
    """

    key, length = "l", 4

    def __init__(self, tiling: Tiling, *args: Any, relay: bool) -> None:
        super().__init__(tiling, *args)
        self.relay = relay
        n, tiles, cells = len(self._places), tiling.tiles, tiling.per_tile
        self._own = np.zeros((n, tiles, 2, cells), np.uint16)  # hits and misses from each contributor itself
        self._changed = np.full((n, tiles), NEVER)  # ms: when these last changed,
        self._sent_ms = np.full((n, tiles), NEVER)  # time of its last message
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
        believed = np.where(self._newer()[..., None, None], np.maximum(self._own, self._others), self._own)
        return self.tiling.of_grid(np.moveaxis(believed, 2, 1))

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
        owner, tile = np.nonzero(changed_cells)
        order = np.lexsort((tile, owner, -changed[owner, tile], owner != self._me, self._times[owner, tile]))
        owner, tile, ms = owner[order], tile[order], now_ns // 1_000_000
        bodies, used = self.tiling.bodies(self.key, ms, self._entries(owner, tile, ms - changed[owner, tile]), most)
        self._times[owner[:used], tile[:used]] += 1
        return bodies

    def _entries(self, owner: Array, tile: Array, age_ms: Array) -> Iterator[list[Any]]:
        """A generator, since few entries fit into a message."""
        newer = self._newer()
        for a, k, age in zip(owner.tolist(), tile.tolist(), age_ms.tolist(), strict=True):
            counts = np.maximum(self._own[a, k], self._others[a, k]) if newer[a, k] else self._own[a, k]
            yield [a, k, age, _packed(counts)]

    def _checked(self, ms: int, latest_ms: int, *entry: Any) -> tuple[int, int, int, Array] | None:
        owner, tile, age, raw = entry
        counts = self.tiling.counts_of(tile, raw)
        if counts is None or not _is_number(owner, len(self._places)) or type(age) is not int:
            return None
        changed = ms - age  # with different clocks, a relayed change may be later than its message
        return (owner, tile, changed, counts) if max(0, latest_ms - OLDEST_MS) <= changed <= latest_ms else None

    def _merge(self, place: int, ms: int, *entry: Any) -> None:
        owner, tile, changed, counts = entry
        if owner == place:
            np.maximum(self._own[owner, tile], counts, out=self._own[owner, tile])
            self._changed[owner, tile] = max(self._changed[owner, tile], changed)
            self._sent_ms[owner, tile] = max(self._sent_ms[owner, tile], ms)
        elif owner != self._me and self.relay:  # of relayed counts the newer; of equal times, the first received
            self._times[owner, tile] += changed == self._times_of[owner, tile]  # already sent by another member: lower priority
            before = self._others_changed[owner, tile]
            if changed > before or (changed == before and counts.tobytes() > self._others[owner, tile].tobytes()):
                self._others_changed[owner, tile], self._others[owner, tile] = changed, counts

    def _newer(self) -> Array:
        """(members, tiles): whether relayed counts are newer than the counts from the contributor; False for this vehicle."""
        return self._others_changed > self._sent_ms


def exchange(
    kind: Kind,
    grid: Grid,
    sensor: Sensor,
    me: str,
    members: Sequence[str],
    *,
    prior: float = 0.5,
    max_bytes: int = 1400,
    relay: bool = True,
    scaled: bool = False,
    clock_bound_s: float = 0.0,
) -> MapExchange:
    """One member's end of an exchange; all arguments but ``me`` must be equal for all members (`search.Search` explains them).

    `ValueError`: the prior is 0 or 1, or no cell fits into a message.
    """
    common = Tiling(grid, max_bytes), sensor, log_odds(prior), me, members, round(clock_bound_s * 1000.0)
    match kind:
        case "none":
            return MapExchange(*common)
        case "delta":
            return Delta(*common)
        case "consensus":
            return Consensus(*common, scaled=scaled)
        case "ledger":
            return Ledger(*common, relay=relay)
