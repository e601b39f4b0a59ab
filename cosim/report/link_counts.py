"""Every link of a run by itself: what was sent, what arrived and how strong it was. Counted at once, not link by link.

The counts are those of `cosim.analysis.links`: ``sent = received + lost + under way``, ratios are of what was decided, and
levels those of frames that were on the air.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.analysis.links import RECEIVED
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import Array


@dataclass(frozen=True)
class Links:
    """Frames by sender and receiver: arrays (n, n), [sender, receiver], in the order of ``names``."""

    names: tuple[str, ...]
    sent: Array
    received: Array
    under_way: Array
    level_dbm: Array  # mean; NaN where none was on the air
    frames: Array  # (n,) that each sent, for whomever: one that several were meant to hear counts once
    losses: Mapping[str, Array]  # by cause, the most frequent first

    @property
    def pairs(self) -> Iterator[tuple[int, int]]:
        """The links over which anything was sent, in the order of the run."""
        yield from ((int(a), int(b)) for a, b in np.argwhere(self.sent > 0))

    def ratio(self, a: int, b: int) -> float | None:
        """Share of what was decided that was received."""
        decided = int(self.sent[a, b] - self.under_way[a, b])
        return int(self.received[a, b]) / decided if decided else None

    def lost_to(self, a: int, b: int) -> str:
        """What the link lost to which cause."""
        counts = [(cause, int(lost[a, b])) for cause, lost in self.losses.items()]
        return ", ".join(f"{count} {cause}" for cause, count in sorted(counts, key=lambda each: -each[1]) if count)


def links_of(radio: pa.Table, vehicles: Sequence[str]) -> Links:
    """The links of a run; the vehicles are known to the table in their order."""
    (senders, by), (receivers, to), (outcomes, outcome) = (names_of(radio, name) for name in ("sender", "receiver", "outcome"))
    names = tuple(dict.fromkeys((*vehicles, *senders, *receivers)))
    n = len(names)
    code = _among(names, senders)[by] * n + _among(names, receivers)[to]

    def count(chosen: Array, weights: Array | None = None) -> Array:
        found = np.bincount(code[chosen], None if weights is None else weights[chosen], minlength=n * n)
        return np.asarray(found).reshape(n, n)

    def of(word: str) -> Array:
        return np.asarray(outcome == outcomes.index(word)) if word in outcomes else np.zeros(len(code), np.bool_)

    on_air = numbers(radio, "air_time_ns") > 0
    aired = count(on_air)
    level = np.full((n, n), np.nan)
    np.divide(count(on_air, numbers(radio, "rssi_dbm")), aired, out=level, where=aired > 0)
    causes = [word for word in outcomes if word not in (RECEIVED, UNDER_WAY)]
    losses = {cause: count(of(cause)) for cause in causes}
    return Links(
        names,
        count(np.ones(len(code), np.bool_)),
        count(of(RECEIVED)),
        count(of(UNDER_WAY)),
        level,
        np.bincount(_among(names, senders)[by][np.diff(numbers(radio, "frame"), prepend=-1) != 0], minlength=n),
        {cause: lost for cause, lost in sorted(losses.items(), key=lambda each: -int(each[1].sum())) if lost.any()},
    )


def _among(names: Sequence[str], some: Sequence[str]) -> Array:
    """The number of each of some names among all."""
    number = {name: i for i, name in enumerate(names)}
    return np.array([number[name] for name in some], np.int64)
