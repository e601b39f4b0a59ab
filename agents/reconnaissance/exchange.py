"""Four protocols for sharing the map of a team; lost messages lose evidence in all but the ledger.

``none``        no messages: each member searches on its own.
``delta``       the increments since the last message (what is lost is lost).
``consensus``   after its own update each moves its map towards the received ones, ``l <- (1 - n / N) l + sum of l_j / N``,
                n received of N members (Hu, Xie, Lum and Xu 2013): in the end all have the N-th part of all evidence.
``ledger``      cumulative counts by contributor: see `agents.reconnaissance.ledger`.
"""

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np

from vcmvsp.agents.reconnaissance.ledger import Ledger
from vcmvsp.agents.reconnaissance.probability_map import LIMIT, Grid, Sensor, log_odds
from vcmvsp.agents.reconnaissance.tiles import Body, Tiling, packed, parsed
from vcmvsp.cosim.types import Array

Kind = Literal["none", "delta", "consensus", "ledger"]
STEPS = 1600  # of a number in a message for 1 of l: 20 is 32000, which two bytes hold, and half a step is 0.0003


class MapExchange(Protocol):
    """A member's knowledge of the area. Each tick: `take` received messages, `look` (possibly at no cell), send `messages`."""

    @property
    def log_odds(self) -> Array:
        """The map to decide by, (rows, columns)."""

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages to be sent now, each of ``max_bytes`` encoded bytes at most."""

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Merge a received message; False: it was invalid or of another kind, and nothing changed."""


class Alone:
    """A map of own looks (kind ``none``)."""

    def __init__(self, tiling: Tiling, sensor: Sensor, prior: float) -> None:
        self.tiling, self.sensor = tiling, sensor
        self._map = np.full((tiling.tiles, tiling.per_tile), float(prior))

    @property
    def log_odds(self) -> Array:
        """The map, (rows, columns)."""
        return self.tiling.of_grid(self._map)

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""
        where = self.tiling.index[cells]
        flat = self._map.reshape(-1)
        flat[where] = np.clip(flat[where] + self.sensor.evidence(hits, ~np.asarray(hits, bool)), -LIMIT, LIMIT)

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """There are none."""
        return []

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Nothing is believed."""
        return False


class Delta(Alone):
    """Counts since the last message, tile by tile; an entry is ``[tile, counts]``.

    Of a sender's messages about a tile only the newest counts: copies are not counted twice; one that was overtaken is lost.
    """

    def __init__(
        self, tiling: Tiling, sensor: Sensor, prior: float, me: str, members: Sequence[str], clock_bound_ms: int
    ) -> None:
        super().__init__(tiling, sensor, prior)
        self._clock_bound_ms = clock_bound_ms
        self._untold = np.zeros((tiling.tiles, 2, tiling.per_tile), np.uint16)
        self._since = np.zeros(tiling.tiles, np.int64)  # ms: the last look of these
        self._newest = {name: np.full(tiling.tiles, -1) for name in members if name != me}

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and the result of each."""
        super().look(cells, hits, now_ns)
        self._since[self.tiling.count(self._untold, cells, hits)] = now_ns // 1_000_000

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Up to ``most`` messages, newest tiles first; what has no room waits."""
        changed = np.nonzero(self._untold.any(axis=(1, 2)))[0]
        changed = changed[np.lexsort((changed, -self._since[changed]))]
        entries = ([tile, packed(self._untold[tile])] for tile in changed.tolist())
        bodies, used = self.tiling.bodies("d", now_ns // 1_000_000, entries, most)
        self._untold[changed[:used]] = 0
        return bodies

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Add the increments of another; False: nonsense, and nothing was added."""
        newest, message = self._newest.get(sender), parsed(body, "d", 2, now_ns // 1_000_000 + self._clock_bound_ms)
        if newest is None or message is None:
            return False
        counts = {tile: self.tiling.counts_of(tile, raw) for tile, raw in message.entries if type(tile) is int}
        if len(counts) < len(message.entries):  # what is no number, or a tile twice
            return False
        tiles = {tile: each for tile, each in counts.items() if each is not None}
        if len(tiles) < len(counts):
            return False
        for tile, (hits, misses) in tiles.items():
            if message.ms > newest[tile]:
                newest[tile] = message.ms
                odds = self._map[tile] + self.sensor.evidence(hits, misses)
                self._map[tile] = np.clip(odds, -LIMIT, LIMIT)
        return True


class Consensus(Alone):
    """The own map, moved towards received ones; an entry is ``[tile, l]``, l in steps of 1/1600 as little-endian int16.

    A call of `look` is one step of the protocol: first towards the maps received since the last step, then the own update,
    which `messages` send. In this order all members move from the values that they sent, and without loss no evidence is
    lost. It ends up divided by the number of members: with ``scaled`` the map for decisions is multiplied by it, which is
    fast, but rash before all agree; without, it takes N times the looks.
    """

    def __init__(
        self,
        tiling: Tiling,
        sensor: Sensor,
        prior: float,
        me: str,
        members: Sequence[str],
        clock_bound_ms: int,
        scaled: bool,
    ) -> None:
        super().__init__(tiling, sensor, prior)
        self._prior, self._clock_bound_ms = prior, clock_bound_ms
        self._members, self._next = len(set(members)), 0
        self._gain = float(self._members) if scaled else 1.0
        others = sorted({*members} - {me})
        self._places = {name: place for place, name in enumerate(others)}
        self._heard = np.zeros((len(others), tiling.tiles, tiling.per_tile))
        self._fresh = np.zeros((len(others), tiling.tiles), bool)
        self._newest = np.full((len(others), tiling.tiles), -1)

    @property
    def log_odds(self) -> Array:
        """The map to decide by, (rows, columns)."""
        return np.clip(self._prior + self._gain * (super().log_odds - self._prior), -LIMIT, LIMIT)

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
        bodies, used = self.tiling.bodies("c", now_ns // 1_000_000, entries, most)
        self._next = (self._next + used) % self.tiling.tiles
        return bodies

    def take(self, sender: str, body: Any, now_ns: int) -> bool:
        """Store a received map until the next step; False: it is invalid and was dropped."""
        place, message = self._places.get(sender), parsed(body, "c", 2, now_ns // 1_000_000 + self._clock_bound_ms)
        if place is None or message is None:
            return False
        entries: list[tuple[int, Array]] = []
        for tile, raw in message.entries:
            if type(tile) is not int or not 0 <= tile < self.tiling.tiles or len(raw) != 2 * self.tiling.per_tile:
                return False
            entries.append((tile, np.frombuffer(raw, "<i2") / STEPS))
        if any(np.abs(odds).max() > LIMIT for _, odds in entries):
            return False
        for tile, odds in entries:
            if message.ms > self._newest[place, tile]:
                self._newest[place, tile] = message.ms
                self._heard[place, tile], self._fresh[place, tile] = odds, True
        return True


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
    """One member's end of an exchange; all arguments but ``me`` must be equal for all members.

    Args:
        kind: of the protocol.
        grid: the cells.
        sensor: error rates of looks.
        me: this vehicle.
        members: all members, with this vehicle.
        prior: probability of a target in a cell before the first look.
        max_bytes: size of the largest message, encoded: about 100 for 802.15.4, 1400 for 802.11.
        relay: of a ``ledger``: send and accept counts of third members.
        scaled: of ``consensus``: decide by N times the map.
        clock_bound_s: largest lead of other clocks, s; messages from further in the future are rejected.

    Raises:
        ValueError: ``me`` is not among the members, the prior is 0 or 1, or no cell fits into a message.
    """
    if me not in members:
        raise ValueError(f"members: they must include {me!r}; they are {', '.join(members)}")
    tiling, start, bound_ms = Tiling(grid, max_bytes), log_odds(prior), round(clock_bound_s * 1000.0)
    match kind:
        case "none":
            return Alone(tiling, sensor, start)
        case "delta":
            return Delta(tiling, sensor, start, me, members, bound_ms)
        case "consensus":
            return Consensus(tiling, sensor, start, me, members, bound_ms, scaled)
        case "ledger":
            return Ledger(tiling, sensor, start, me, members, relay=relay, clock_bound_ms=bound_ms)
