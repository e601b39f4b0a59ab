"""Metrics of the radio: frames, losses, delays, connectivity. Tables are read block by block, in little memory.

Connectivity: in each second of the window the graph has an edge between two vehicles if either received a frame of the other
in it. The algebraic connectivity is the second smallest eigenvalue of its Laplacian (Fiedler, Czechoslovak Mathematical
Journal 23, 1973): 0 for a disconnected graph, N for a complete graph, 1 for a star, 2 (1 - cos(pi/N)) for a path. The
convergence rate of a consensus is proportional to it. Every vehicle of the run counts, sender or not; messages sent less
than once a second leave seconds without an edge.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import Window, window_ns
from vcmvsp.cosim.tables.columns import codes_of, names_of, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.tables.schema import Table, blocks_of
from vcmvsp.cosim.types import Array

_RECEPTIONS, _ORIGINS = ("sender", "receiver", "sent_ns", "received_ns"), ("origin", "destination", "origin_sent_ns")


@dataclass(frozen=True)
class ReceptionRows:
    """The received frames, in the order in which they entered the channel."""

    receivers: tuple[str, ...]
    senders: tuple[str, ...]
    to: Array  # (n,) index of the receiver's name
    by: Array  # (n,) index of the sender's name
    sent_ns: Array  # (n,)
    received_ns: Array  # (n,)


def receptions(radio: pa.Table) -> ReceptionRows:
    """The received frames of the table."""
    (receivers, to), (senders, by) = names_of(radio, "receiver"), names_of(radio, "sender")
    received, sent = numbers(radio, "received_ns", null=-1), numbers(radio, "sent_ns")
    is_received = received >= 0
    if not is_received.all():
        to, by, sent, received = to[is_received], by[is_received], sent[is_received], received[is_received]
    return ReceptionRows(receivers, senders, to, by, sent, received)


def informed(radio: pa.Table) -> ReceptionRows:
    """Receptions of information: as `receptions`, but relayed messages count from their origin.

    A relayed message counts only at its destinations (`cosim.metrics.routing`).
    """
    received = receptions(radio)
    if "origin" not in radio.column_names:
        return received
    rows = np.flatnonzero(numbers(radio, "received_ns", null=-1) >= 0)
    (origins, by), (destinations, only) = names_of(radio, "origin"), names_of(radio, "destination")
    by, only = by[rows], only[rows]
    has_origin, is_broadcast = np.array(origins) != "", np.array(destinations) == ""
    is_addressee = has_origin[by] & (codes_of(received.receivers, origins)[by] != received.to)
    is_addressee &= is_broadcast[only] | (codes_of(received.receivers, destinations)[only] == received.to)
    sent_ns = numbers(radio, "origin_sent_ns")[rows]
    return ReceptionRows(
        received.receivers,
        origins,
        received.to[is_addressee],
        by[is_addressee],
        sent_ns[is_addressee],
        received.received_ns[is_addressee],
    )


class Parts:
    """Receptions of a table in parts, which are read anew each time; all parts name the same vehicles.

    Args:
        radio: the table.
        part_of: `receptions` or `informed`.
    """

    def __init__(self, radio: Table, part_of: Callable[[pa.Table], ReceptionRows] = receptions) -> None:
        columns = _RECEPTIONS if part_of is receptions else (*_RECEPTIONS, *_ORIGINS)
        self._radio, self._part_of = radio, part_of
        self._columns = [name for name in columns if name in radio.schema.names]

    def __iter__(self) -> Iterator[ReceptionRows]:
        return map(self._part_of, blocks_of(self._radio, self._columns))


def radio_metrics(radio: Table, ages: dict[str, float | None]) -> dict[str, Any]:
    """The ``radio`` part: counts of the whole run, delays of all receptions, the given ages.

    A frame still in transit at the end of the run is neither received nor lost.
    """
    counts, frames, newest = Counter[str](), 0, -1
    delays_s = [np.empty(0)]
    for block in blocks_of(radio, ("frame", "outcome", "delay_ns")):
        outcomes, code = names_of(block, "outcome")
        counts.update(dict(zip(outcomes, np.bincount(code, minlength=len(outcomes)).tolist(), strict=True)))
        frame, delays = numbers(block, "frame"), numbers(block, "delay_ns", null=-1)
        frames += int(np.count_nonzero(np.diff(frame, prepend=newest)))  # the rows of a frame are adjacent
        newest = int(frame[-1]) if len(frame) else newest
        delays_s.append(delays[delays >= 0] / SECOND_NS)
    received, under_way = counts.pop("received", 0), counts.pop(UNDER_WAY, 0)
    decided, losses = radio.num_rows - under_way, {cause: number for cause, number in sorted(counts.items()) if number}
    return {
        "frames": frames,
        "receptions": received,
        "delivery_ratio": received / decided if decided else None,
        "under_way": under_way,
        "losses": losses,
        "delay_s": quantiles(np.concatenate(delays_s), ("mean", "p50", "p95", "p99", "max")),
        "age_s": ages,
    }


_OF_ALL: dict[str, Any] = {"mean": np.mean, "sd": np.std, "max": np.max}


def quantiles(values: Array, names: Sequence[str]) -> dict[str, float | None]:
    """Mean, sd, min, median, max and percentiles (``p95``; linear between ranks); None without values."""
    numbers: dict[str, float | None] = dict.fromkeys(names)
    if not values.size:
        return numbers
    percents = {"min": 0, "median": 50} | {name: int(name[1:]) for name in names if name[0] == "p"}
    ranked = [name for name in names if name in percents]
    numbers |= zip(ranked, np.percentile(values, [percents[name] for name in ranked]).tolist(), strict=True)
    for name in numbers.keys() & _OF_ALL.keys():
        numbers[name] = float(_OF_ALL[name](values))
    return numbers


SPAN_NS = SECOND_NS  # time covered by one graph
MOST_VEHICLES = 200  # above, eigenvalues would take longer than the run
AT_ONCE = 1 << 20  # matrix entries in memory at once
DECIMALS = 9  # eigenvalues agree on all machines to this precision


def connectivity_metrics(
    parts: Iterable[ReceptionRows], vehicles: Sequence[str], window: Window, end_ns: int
) -> dict[str, float | None]:
    """The ``connectivity`` part; None for a single vehicle, more than `MOST_VEHICLES`, or a window shorter than `SPAN_NS`."""
    begin, last = window_ns(window)
    graphs = (min(last, end_ns) - begin) // SPAN_NS
    if not 2 <= len(vehicles) <= MOST_VEHICLES or graphs < 1:
        return dict.fromkeys(("mean", "min", "connected_share"))
    values = algebraic_connectivity(adjacency(parts, vehicles, begin, graphs))
    return {"mean": float(values.mean()), "min": float(values.min()), "connected_share": float((values > 0.0).mean())}


def adjacency(parts: Iterable[ReceptionRows], vehicles: Sequence[str], begin_ns: int, graphs: int) -> Array:
    """Adjacency of the vehicles in each of ``graphs`` seconds, in either direction: (graphs, n, n) bool."""
    n = len(vehicles)
    is_heard = np.zeros(graphs * n * n, np.bool_)
    for part in parts:
        to, by = codes_of(vehicles, part.receivers)[part.to], codes_of(vehicles, part.senders)[part.by]
        when = (part.received_ns - begin_ns) // SPAN_NS
        counted = (when >= 0) & (when < graphs)
        is_heard[((when * n + to) * n + by)[counted]] = True
    either = is_heard.reshape(graphs, n, n)
    return either | either.transpose(0, 2, 1)


def algebraic_connectivity(adjacent: Array) -> Array:
    """Second smallest eigenvalues (m,) of the Laplacians of undirected graphs (m, n, n), n >= 2."""
    m, n, _ = adjacent.shape
    values = np.empty(m)
    step = max(1, AT_ONCE // n**2)
    with threadpool_limits(1):  # sums do not depend on the number of cores
        for first in range(0, m, step):
            some = adjacent[first : first + step].astype(np.float64)
            laplacian = -some
            laplacian[:, range(n), range(n)] += some.sum(axis=2)
            values[first : first + step] = np.linalg.eigvalsh(laplacian)[:, 1]
    return np.round(values, DECIMALS) + 0.0  # no -0.0
