"""Metrics of the radio: frames, losses, delays, age of information, connectivity.

Age of information: the age of the newest message that a receiver has from a sender. For a follower, the sender is its current
leader; in a run without followers, every link to a vehicle with an agent counts. A link counts from its first reception on.
Over time the age is a sawtooth: it rises at one second per second, and falls at each reception of a newer message to that
message's own age. It is measured at the agents' ticks, when agents use it, and over all time: with period T, delay d and
independent losses of probability p the mean is ``d + T (1 + p) / (2 (1 - p))``, and the mean of the peaks just before each
fall ``d + T / (1 - p)`` (renewal theory; Kaul, Yates and Gruteser, INFOCOM 2012).
Connectivity: in each second of the window the graph has an edge between two vehicles if either received a frame of the other
in it. The algebraic connectivity is the second smallest eigenvalue of its Laplacian (Fiedler, Czechoslovak Mathematical
Journal 23, 1973): 0 for a disconnected graph, N for a complete graph, 1 for a star, 2 (1 - cos(pi/N)) for a path. The
convergence rate of a consensus is proportional to it. Every vehicle of the run counts, sender or not; messages sent less
than once a second leave seconds without an edge.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.metrics.motion import FOREVER_NS, Window, followers, stretches, window_ns
from vcmvsp.cosim.tables.columns import codes_of, names_of, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import Array


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
    received = numbers(radio, "received_ns", null=-1)
    got = np.flatnonzero(received >= 0)
    return ReceptionRows(receivers, senders, to[got], by[got], numbers(radio, "sent_ns")[got], received[got])


def informed(radio: pa.Table, got: ReceptionRows) -> ReceptionRows:
    """Receptions of information: as `receptions`, but relayed messages count from their origin.

    A relayed message counts only at its destinations (`cosim.metrics.routing`).
    """
    if "origin" not in radio.column_names:
        return got
    rows = np.flatnonzero(numbers(radio, "received_ns", null=-1) >= 0)
    (origins, by), (destinations, only) = names_of(radio, "origin"), names_of(radio, "destination")
    by, only = by[rows], only[rows]
    told, anybody = np.array(origins) != "", np.array(destinations) == ""
    meant = told[by] & (codes_of(got.receivers, origins)[by] != got.to)
    meant &= anybody[only] | (codes_of(got.receivers, destinations)[only] == got.to)
    sent_ns = numbers(radio, "origin_sent_ns")[rows]
    return ReceptionRows(got.receivers, origins, got.to[meant], by[meant], sent_ns[meant], got.received_ns[meant])


def radio_metrics(radio: pa.Table, ages: dict[str, float | None]) -> dict[str, Any]:
    """The ``radio`` part: counts of the whole run, delays of all receptions, the given ages.

    A frame still in transit at the end of the run is neither received nor lost.
    """
    outcomes, code = names_of(radio, "outcome")
    counts = dict(zip(outcomes, np.bincount(code, minlength=len(outcomes)).tolist(), strict=True))
    got, under_way = counts.get("received", 0), counts.pop(UNDER_WAY, 0)
    decided = radio.num_rows - under_way
    delays = numbers(radio, "delay_ns", null=-1)
    delays = delays[delays >= 0] / SECOND_NS
    return {
        "frames": int(np.count_nonzero(np.diff(numbers(radio, "frame"), prepend=-1))),  # the rows of a frame are adjacent
        "receptions": got,
        "delivery_ratio": got / decided if decided else None,
        "under_way": under_way,
        "losses": {cause: counts[cause] for cause in sorted(counts) if cause != "received" and counts[cause]},
        "delay_s": quantiles(delays, ("mean", "p50", "p95", "p99", "max")),
        "age_s": ages,
    }


def quantiles(values: Array, names: Sequence[str]) -> dict[str, float | None]:
    """Mean, sd, min, median, max and percentiles (``p95``; linear between ranks); None without values."""
    if not values.size:
        return dict.fromkeys(names)
    percents = {"min": 0, "median": 50} | {name: int(name[1:]) for name in names if name[0] == "p"}
    of: dict[str, Any] = {"mean": np.mean, "sd": np.std, "max": np.max}
    return {name: float(of[name](values) if name in of else np.percentile(values, percents[name])) for name in names}


class LinkHistory(NamedTuple):
    """Receptions of one receiver from one sender, in order."""

    sent_ns: Array  # the newest sending time received so far
    received_ns: Array

    def age_ns(self, at_ns: Array) -> Array:
        """Age of the newest message at these instants, none before the first reception."""
        newest = self.received_ns.searchsorted(at_ns, side="right") - 1
        return np.asarray(at_ns - self.sent_ns[newest])

    def sawtooth(self, begin_ns: int, end_ns: int) -> "Sawtooth":
        """The age from ``begin_ns``, not before the first reception, to ``end_ns``."""
        first, stop = (int(self.received_ns.searchsorted(at_ns, side="right")) for at_ns in (begin_ns, end_ns))
        edges = np.empty(stop - first + 2, np.int64)
        edges[0], edges[1:-1], edges[-1] = begin_ns, self.received_ns[first:stop], end_ns
        begins, ends, sent = edges[:-1], edges[1:], self.sent_ns[first - 1 : stop]
        last = ends > begins  # of messages that arrive at the same time
        last[-1] = True  # the last tooth may have zero length
        if not last.all():
            begins, ends, sent = begins[last], ends[last], sent[last]
        low, high = (begins - sent) / SECOND_NS, (ends - sent) / SECOND_NS
        area, falls = float((high @ high - low @ low) / 2.0), sent[1:] > sent[:-1]
        return Sawtooth(area, (end_ns - begin_ns) / SECOND_NS, high[:-1][falls])


class Sawtooth(NamedTuple):
    """The age of information over a stretch of time."""

    area: float  # its integral over time, s2
    length: float  # s
    peaks: Array  # s, just before each reception that lowered it


class _Stretch(NamedTuple):
    receiver: str
    link: LinkHistory
    begin_ns: int  # not before the first reception
    end_ns: int


def links(radio: pa.Table | ReceptionRows) -> dict[tuple[str, str], LinkHistory]:
    """Reception history of every link (receiver, sender), over any relays."""
    got = radio if isinstance(radio, ReceptionRows) else informed(radio, receptions(radio))
    width = max(len(got.senders), 1)
    code = got.to.astype(np.int64) * width + got.by
    small = len(got.receivers) * width < 2**16  # radix sort, in linear time
    order = np.argsort(code.astype(np.uint16) if small else code, kind="stable")
    link, received = code[order], got.received_ns[order]
    starts = np.flatnonzero(np.diff(link, prepend=-1))
    turned = np.diff(received) < 0
    turned[starts[1:] - 1] = False
    if turned.any():  # messages out of order
        order = order[np.lexsort((received, link))]
        received = got.received_ns[order]
    sent = got.sent_ns[order]
    return {
        (got.receivers[link[begin] // width], got.senders[link[begin] % width]): LinkHistory(
            np.maximum.accumulate(sent[begin:end]), received[begin:end]
        )
        for begin, end in pairwise([*starts.tolist(), len(order)])
    }


def age_metrics(
    got: ReceptionRows, follows: Sequence[Placement], ticks: Mapping[str, Ticks], window: Window, end_ns: int
) -> dict[str, float | None]:
    """Age of the newest message (s) at the receivers' ticks in the window; its mean over time, and the mean of its peaks."""
    counted = list(_stretches(links(got), follows, ticks))
    begin, last = window_ns(window)
    spans = ((each.link, max(each.begin_ns, begin), min(each.end_ns, last, end_ns)) for each in counted)
    saws = [link.sawtooth(since, until) for link, since, until in spans if since < until]
    peaks = np.concatenate([np.empty(0), *(saw.peaks for saw in saws)])
    return {
        **quantiles(_at_ticks(counted, ticks, window, end_ns), ("mean", "p95", "max")),
        "time_average": float(np.divide(*np.cumsum([saw[:2] for saw in saws], axis=0)[-1])) if saws else None,
        "peak": float(np.mean(peaks)) if peaks.size else None,
    }


def _stretches(
    heard: Mapping[tuple[str, str], LinkHistory], follows: Sequence[Placement], ticks: Mapping[str, Ticks]
) -> Iterator[_Stretch]:
    if follows:
        spans = [(name, *span) for name in followers(ticks, follows) for span in stretches(name, follows)]
        wanted = [((name, at.leader), since, until) for name, since, until, at in spans if at.leader is not None]
    else:
        wanted = [(key, 0, FOREVER_NS) for key in heard if key[0] in ticks]
    for key, since, until in wanted:
        if key in heard:
            yield _Stretch(key[0], heard[key], max(since, int(heard[key].received_ns[0])), until)


def _at_ticks(counted: Sequence[_Stretch], ticks: Mapping[str, Ticks], window: Window, end_ns: int) -> Array:
    begin, last = window_ns(window)
    train_of: dict[Ticks, Array] = {}
    for train in dict.fromkeys(ticks.values()):
        train_of[train] = np.array([train.at(k) for k in train.between(begin, min(last + 1, end_ns))], np.int64)
    parts = [np.empty(0, np.int64)]
    for each in counted:
        at_ns = train_of[ticks[each.receiver]]
        parts.append(each.link.age_ns(at_ns[at_ns.searchsorted(each.begin_ns) : at_ns.searchsorted(each.end_ns)]))
    return np.concatenate(parts) / SECOND_NS


SPAN_NS = SECOND_NS  # time covered by one graph
MOST_VEHICLES = 200  # above, eigenvalues would take longer than the run
AT_ONCE = 1 << 20  # matrix entries in memory at once
DECIMALS = 9  # eigenvalues agree on all machines to this precision


def connectivity_metrics(got: ReceptionRows, vehicles: Sequence[str], window: Window, end_ns: int) -> dict[str, float | None]:
    """The ``connectivity`` part; None for a single vehicle, more than `MOST_VEHICLES`, or a window shorter than `SPAN_NS`."""
    begin, last = window_ns(window)
    graphs = (min(last, end_ns) - begin) // SPAN_NS
    if not 2 <= len(vehicles) <= MOST_VEHICLES or graphs < 1:
        return dict.fromkeys(("mean", "min", "connected_share"))
    values = algebraic_connectivity(adjacency(got, vehicles, begin, graphs))
    return {"mean": float(values.mean()), "min": float(values.min()), "connected_share": float((values > 0.0).mean())}


def adjacency(got: ReceptionRows, vehicles: Sequence[str], begin_ns: int, graphs: int) -> Array:
    """Adjacency of the vehicles in each of ``graphs`` seconds, in either direction: (graphs, n, n) bool."""
    n, to, by = len(vehicles), codes_of(vehicles, got.receivers)[got.to], codes_of(vehicles, got.senders)[got.by]
    when = (got.received_ns - begin_ns) // SPAN_NS
    counted = (when >= 0) & (when < graphs)
    heard = np.zeros(graphs * n * n, np.bool_)
    heard[((when * n + to) * n + by)[counted]] = True
    either = heard.reshape(graphs, n, n)
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
