"""A map cut into square tiles, so that a message holds what changed and no more than fits; what a message must be like.

Bodies are ``{"ms": when it was sent, <key>: [[..., bytes], ...]}``, an inner list per tile, for any encoding that knows bytes.
Counts are little-endian, of one or two bytes, the hits of all cells of the tile before the misses.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from vcmvsp.agents.reconnaissance.probability_map import Grid
from vcmvsp.cosim.types import Array

SIDES = (16, 8, 4, 2, 1)  # cells, of a tile
OVERHEAD = 36  # bytes at most: "ms" with its number, the key, contributor, tile and age, and the lengths of all of it
MOST = 65535  # that two bytes count
LATEST_MS = 2**53  # of the clock; more is no time

Body = dict[str, Any]


class TileMessage(NamedTuple):
    """A message that makes sense as far as its outside goes."""

    ms: int
    entries: list[list[Any]]  # each a list as long as it should be, that ends with bytes


class Tiling:
    """Tiles of ``side`` x ``side`` cells over a grid; in tiled arrays the cells of a tile are neighbours.

    Args:
        grid: the cells.
        max_bytes: size of the largest message, encoded; the side of the tiles follows from it, so it is the same for the team.

    Raises:
        ValueError: not even a cell fits into a message.
    """

    def __init__(self, grid: Grid, max_bytes: int) -> None:
        fitting = [side for side in SIDES if 4 * side * side + OVERHEAD <= max_bytes]
        if not fitting:
            raise ValueError(f"max_bytes = {max_bytes}: a message of the map takes {4 + OVERHEAD} bytes at least")
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
        """A tiled array as (rows, columns)."""
        result: Array = tiled.reshape(-1)[self.index].reshape(self.grid.rows, self.grid.columns)
        return result

    def count(self, counts: Array, cells: Array, hits: Array) -> Array:
        """Add looks at cells, each at most once, to counts, (tiles, 2, cells of a tile) uint16; the tiles of these cells."""
        tiles, inner = np.divmod(self.index[cells], self.per_tile)
        kind = np.where(hits, 0, 1)
        counts[tiles, kind, inner] = np.minimum(counts[tiles, kind, inner], MOST - 1) + 1
        return tiles

    def counts_of(self, tile: Any, raw: Any) -> Array | None:
        """Hits and misses in bytes of a message, (2, cells of a tile) uint16; None where they are not such."""
        if type(tile) is not int or not 0 <= tile < self.tiles or not isinstance(raw, bytes):
            return None
        width = {2 * self.per_tile: "<u1", 4 * self.per_tile: "<u2"}.get(len(raw))
        if width is None:
            return None
        counts = np.frombuffer(raw, width).reshape(2, -1).astype(np.uint16)
        return None if counts[:, self.beyond[tile]].any() else counts

    def bodies(self, key: str, ms: int, entries: Iterable[list[Any]], most: int) -> tuple[list[Body], int]:
        """Up to ``most`` messages with as many of the entries as fit, in their order; how many these were."""
        empty = len(msgspec.msgpack.encode({"ms": ms, key: []})) + 2  # a list of more than 15 needs two bytes to say so
        bodies: list[Body] = []
        used, left = 0, 0
        for entry in entries:
            size = len(msgspec.msgpack.encode(entry))
            if size > left:
                if len(bodies) >= most:
                    break
                bodies.append({"ms": ms, key: []})
                left = self.max_bytes - empty
            bodies[-1][key].append(entry)
            left -= size
            used += 1
        return bodies, used


def packed(counts: Array) -> bytes:
    """Hits and misses, (2, n), as bytes: one for each count where that is enough."""
    return counts.astype("<u1" if counts.max(initial=0) < 256 else "<u2").tobytes()


def parsed(body: Any, key: str, length: int, latest_ms: int) -> TileMessage | None:
    """The outside of a message; None where it has no such key, is from the future or malformed."""
    if not isinstance(body, dict):
        return None
    ms, entries = body.get("ms"), body.get(key)
    if type(ms) is not int or not 0 <= ms <= min(latest_ms, LATEST_MS) or not isinstance(entries, list | tuple):
        return None
    if any(
        not isinstance(entry, list | tuple) or len(entry) != length or not isinstance(entry[-1], bytes) for entry in entries
    ):
        return None
    return TileMessage(ms, [list(entry) for entry in entries])


def number(value: Any, end: int) -> bool:
    """Whether it is a whole number >= 0 and < ``end``."""
    return type(value) is int and 0 <= value < end
