"""Team members that share small maps."""

from typing import Any

import msgspec
import numpy as np

from vcmvsp.agents.reconnaissance.exchange import Kind, Ledger, MapExchange, exchange
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor
from vcmvsp.cosim.types import Array

SMALL = Grid(Rectangle(0.0, 0.0, 19.0, 7.0), 1.0)  # larger than a tile, and no multiple of one
SENSOR = Sensor(0.9, 0.2)
GRID = Grid(Rectangle(0.0, 0.0, 100.0, 100.0), 2.0)
S = 1_000_000_000  # ns
TEAM = ("a", "b", "c")
KINDS: tuple[Kind, ...] = ("none", "delta", "consensus", "ledger")


def over_the_air(body: dict[str, Any]) -> Any:
    """Body as a receiver decodes it."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(body))


def size(body: dict[str, Any]) -> int:
    """Bytes of payload."""
    return len(msgspec.msgpack.encode(body))


def ledger(me: str, grid: Grid = SMALL, **more: Any) -> Ledger:
    mind = exchange("ledger", grid, SENSOR, me, TEAM, **more)
    assert isinstance(mind, Ledger)
    return mind


def look(mind: MapExchange, rng: np.random.Generator, now_ns: int, grid: Grid = SMALL) -> tuple[Array, Array]:
    """A random look at a part of the grid."""
    (width, height), spot = (grid.columns, grid.rows), rng.random(2)
    cells = grid.within(spot[0] * width, spot[1] * height, 3.0)
    hits = rng.random(len(cells)) < 0.5
    mind.look(cells, hits, now_ns)
    return cells, hits


def tell(teller: MapExchange, hearers: dict[str, MapExchange], me: str, now_ns: int, most: int = 100) -> None:
    for body in teller.messages(now_ns, most):
        for mind in hearers.values():
            assert mind.take(me, over_the_air(body), now_ns)


def full_state(mind: Ledger) -> tuple[bytes, ...]:
    """All state that can matter later, except how often each part was sent."""
    return tuple(each.tobytes() for each in (mind._own, mind._changed, mind._sent_ms, mind._others, mind._others_changed))
