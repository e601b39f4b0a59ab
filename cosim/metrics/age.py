"""Age of information: the age of the newest message that a receiver has from a sender.

For a follower, the sender is its current leader; in a run without followers, every link to a vehicle with an agent counts. A
link counts from its first reception on. Over time the age is a sawtooth: it rises at one second per second, and falls at each
reception of a newer message to that message's own age. It is measured at the agents' ticks, when agents use it, and over all
time: with period T, delay d and independent losses of probability p the mean is ``d + T (1 + p) / (2 (1 - p))``, and the mean
of the peaks just before each fall ``d + T / (1 - p)`` (renewal theory; Kaul, Yates and Gruteser, INFOCOM 2012).

Ten thousand links have short histories: they lie one behind the other, and each step is done for many links at once.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.metrics.motion import FOREVER_NS, Window, followers, stretches, window_ns
from vcmvsp.cosim.metrics.radio import Parts, ReceptionRows, informed, quantiles
from vcmvsp.cosim.tables.columns import codes_of
from vcmvsp.cosim.tables.schema import Placement, Table
from vcmvsp.cosim.types import Array

AT_ONCE = 1 << 17  # receptions in one step
Pair = tuple[str, str]  # receiver, sender


class LinkHistory(NamedTuple):
    """Receptions of one receiver from one sender, in order."""

    sent_ns: Array  # the newest sending time received so far
    received_ns: Array

    def age_ns(self, at_ns: Array) -> Array:
        """Age of the newest message at these instants, none before the first reception."""
        newest = self.received_ns.searchsorted(at_ns, side="right") - 1
        return np.asarray(at_ns - self.sent_ns[newest])


@dataclass(frozen=True)
class LinkHistories:
    """Reception histories of k links, one behind the other, in the order of their pairs' codes."""

    pairs: Sequence[Pair]  # (k,)
    starts: Array  # (k + 1,) first reception of each link, and the number of receptions
    sent_ns: Array  # (n,) the newest sending time received so far
    received_ns: Array  # (n,)

    def by_pair(self) -> dict[Pair, LinkHistory]:
        """The history of each link."""
        spans = pairwise(self.starts.tolist())
        cuts = (LinkHistory(self.sent_ns[begin:end], self.received_ns[begin:end]) for begin, end in spans)
        return dict(zip(self.pairs, cuts, strict=True))


class _Stretches(NamedTuple):
    """Stretches of time in which links count."""

    link: Array  # (s,) index of the link
    begin_ns: Array  # (s,) not before the first reception
    end_ns: Array  # (s,)

    def cut(self, begin_ns: int, end_ns: int) -> "_Stretches":
        """The parts of the stretches between two times."""
        begins, ends = np.maximum(self.begin_ns, begin_ns), np.minimum(self.end_ns, end_ns)
        return _Stretches(self.link, begins, ends).some(begins < ends)

    def some(self, rows: slice | Array) -> "_Stretches":
        """The stretches of these rows, or of those for which a mask is true."""
        return _Stretches(*(each[rows] for each in self))


def links(radio: Table, pairs: Collection[Pair] | None = None) -> dict[Pair, LinkHistory]:
    """Reception history of every link (receiver, sender), or of wanted ones, over any relays."""
    return histories(Parts(radio, informed), pairs).by_pair()


def histories(parts: Iterable[ReceptionRows], pairs: Collection[Pair] | None = None) -> LinkHistories:
    """Reception histories of all links, or of wanted ones, from receptions in parts that name the same vehicles."""
    names: tuple[Sequence[str], Sequence[str]] = (), ()
    counts = np.zeros(0, np.int64)
    for part in parts:
        names = part.receivers, part.senders
        part_counts = np.bincount(_code(part), minlength=len(part.receivers) * len(part.senders))
        counts = counts + part_counts if len(counts) else part_counts
    if pairs is not None:
        codes = _codes(names, pairs)
        chosen = np.zeros_like(counts)
        chosen[codes] = counts[codes]
        counts = chosen
    link_codes = np.flatnonzero(counts)
    starts = np.cumsum(counts) - counts  # where the next reception of each link goes
    total = int(counts.sum())
    result = LinkHistories(
        _pairs(names, link_codes), np.append(starts[link_codes], total), np.empty(total, np.int64), np.empty(total, np.int64)
    )
    for part in parts:
        code = _code(part)
        order = _by_link(part)
        if pairs is not None:
            order = order[counts[code[order]] > 0]
        code = code[order]
        first = np.flatnonzero(np.diff(code, prepend=-1))
        count = np.diff(first, append=len(code))
        places = np.repeat(starts[code[first]] - first, count) + np.arange(len(code))
        starts[code[first]] += count
        result.sent_ns[places], result.received_ns[places] = part.sent_ns[order], part.received_ns[order]
    _put_in_order(result)
    return result


def _pairs(names: tuple[Sequence[str], Sequence[str]], codes: Array) -> list[Pair]:
    receivers, senders = names
    return [(receivers[code // len(senders)], senders[code % len(senders)]) for code in codes.tolist()]


def _codes(names: tuple[Sequence[str], Sequence[str]], pairs: Collection[Pair]) -> Array:
    """Numbers of links, as far as both names are known."""
    receivers, senders = zip(*pairs, strict=True) if pairs else ((), ())
    to, by = codes_of(names[0], receivers), codes_of(names[1], senders)
    return (to * len(names[1]) + by)[(to >= 0) & (by >= 0)]


def _code(part: ReceptionRows) -> Array:
    """Number of the link of each reception: links to one receiver are adjacent."""
    return part.to.astype(np.int64) * len(part.senders) + part.by


def _by_link(part: ReceptionRows) -> Array:
    """The receptions in the order of their links; within a link, in their own order."""
    narrow = np.uint16 if max(len(part.receivers), len(part.senders)) < 1 << 16 else np.int64  # radix sort, in linear time
    by_sender = np.argsort(part.by.astype(narrow), kind="stable")
    return np.asarray(by_sender[np.argsort(part.to[by_sender].astype(narrow), kind="stable")])


def _put_in_order(links: LinkHistories) -> None:
    """Sort the receptions of each link by time, and replace sending times by the newest so far."""
    starts, sent, received = links.starts, links.sent_ns, links.received_ns
    for number in _links_with(received[1:] < received[:-1], starts):
        span = slice(starts[number], starts[number + 1])
        order = np.argsort(received[span], kind="stable")
        sent[span], received[span] = sent[span][order], received[span][order]
    for number in _links_with(sent[1:] < sent[:-1], starts):
        span = slice(starts[number], starts[number + 1])
        np.maximum.accumulate(sent[span], out=sent[span])


def _links_with(turns: Array, starts: Array) -> list[int]:
    """The links with a reception, other than their first, at which ``turns`` is true."""
    turns[starts[1:-1] - 1] = False
    return list(dict.fromkeys((starts.searchsorted(np.flatnonzero(turns), side="right") - 1).tolist()))


def age_metrics(
    parts: Iterable[ReceptionRows], follows: Sequence[Placement], ticks: Mapping[str, Ticks], window: Window, end_ns: int
) -> dict[str, float | None]:
    """Age of the newest message (s) at the receivers' ticks in the window; its mean over time, and the mean of its peaks."""
    if follows:
        spans = [(name, *span) for name in followers(ticks, follows) for span in stretches(name, follows)]
        intervals = [((name, at.leader), since, until) for name, since, until, at in spans if at.leader is not None]
        receptions = histories(parts, {pair for pair, _, _ in intervals})
    else:
        receptions = histories(parts)
        intervals = [(pair, 0, FOREVER_NS) for pair in receptions.pairs if pair[0] in ticks]
    counted = _stretches(receptions, intervals)
    begin, last = window_ns(window)
    over_time, peak = _sawtooth(receptions, counted.cut(begin, min(last, end_ns)))
    ages = _at_ticks(receptions, counted, ticks, window, end_ns)
    del receptions
    return {**quantiles(ages, ("mean", "p95", "max")), "time_average": over_time, "peak": peak}


def _stretches(receptions: LinkHistories, intervals: Sequence[tuple[Pair, int, int]]) -> _Stretches:
    """The stretches of known links, given link, begin and end (ns) of each."""
    place = {pair: number for number, pair in enumerate(receptions.pairs)}
    rows = [(place[pair], since, until) for pair, since, until in intervals if pair in place]
    link, since, until = np.array(rows, np.int64).reshape(-1, 3).T
    return _Stretches(link, np.maximum(since, receptions.received_ns[receptions.starts[link]]), until)


def _sawtooth(receptions: LinkHistories, counted: _Stretches) -> tuple[float | None, float | None]:
    """Mean of the age over the time of all stretches, and of its peaks, s; None without any."""
    if not len(counted.link):
        return None, None
    batches = [_teeth(receptions, counted.some(rows)) for rows in _batches(np.diff(receptions.starts)[counted.link])]
    areas, lengths = np.concatenate([areas for areas, _ in batches]), (counted.end_ns - counted.begin_ns) / SECOND_NS
    peaks = np.concatenate([peaks for _, peaks in batches])
    over_time = float(np.cumsum(areas)[-1] / np.cumsum(lengths)[-1])
    return over_time, float(np.mean(peaks)) if peaks.size else None


def _teeth(receptions: LinkHistories, counted: _Stretches) -> tuple[Array, Array]:
    """Integral of the age over each stretch, s2, and the ages just before the receptions that lowered them, s."""
    first, stop = (_after(receptions, counted.link, at_ns) for at_ns in (counted.begin_ns, counted.end_ns))
    counts = stop - first + 1
    rows = _ranges(first - 1, counts)
    begins, ends, sent = receptions.received_ns[rows], np.empty_like(rows), receptions.sent_ns[rows]
    head = np.cumsum(counts) - counts
    ends[:-1], ends[head + counts - 1], begins[head] = begins[1:], counted.end_ns, counted.begin_ns
    last = ends > begins  # of messages that arrive at the same time
    last[head + counts - 1] = True  # the last tooth may have zero length
    if not last.all():
        begins, ends, sent = begins[last], ends[last], sent[last]
        counts = np.add.reduceat(last.astype(np.int64), head)
        head = np.cumsum(counts) - counts
    low, high = (begins - sent) / SECOND_NS, (ends - sent) / SECOND_NS
    falls = sent[1:] > sent[:-1]
    falls[head[1:] - 1] = False
    return (_squares(high, head, counts) - _squares(low, head, counts)) / 2.0, high[:-1][falls]


def _squares(values: Array, head: Array, counts: Array) -> Array:
    """Sum of the squares of each run of values, given where it begins and how many it has: as of ``run @ run``, to the bit."""
    sums = np.empty(len(counts))
    for count in np.unique(counts).tolist():
        which = np.flatnonzero(counts == count)
        runs = values[head[which][:, np.newaxis] + np.arange(count)]
        sums[which] = np.vecdot(runs, runs)
    return sums


def _at_ticks(receptions: LinkHistories, counted: _Stretches, ticks: Mapping[str, Ticks], window: Window, end_ns: int) -> Array:
    """Age at each tick of the receiver in each stretch, s."""
    begin, last = window_ns(window)
    trains = [ticks[receptions.pairs[link][0]] for link in counted.link.tolist()]
    at_ns: dict[Ticks, Array] = {}
    for train in dict.fromkeys(trains):
        at_ns[train] = np.array([train.at(k) for k in train.between(begin, min(last + 1, end_ns))], np.int64)
    batches, row = list[tuple[_Stretches, Array, int]](), 0
    for train, equal in groupby(trains):
        some = counted.some(slice(row, row + len(list(equal))))
        row += len(some.link)
        counts = np.diff(at_ns[train].searchsorted([some.begin_ns, some.end_ns]), axis=0)[0]
        some, counts = some.some(counts > 0), counts[counts > 0]
        for rows in _batches(np.diff(receptions.starts)[some.link] + counts):
            batches.append((some.some(rows), at_ns[train], int(counts[rows].sum())))
    ages, row = np.empty(sum(count for *_, count in batches)), 0
    for some, at, count in batches:
        ages[row : row + count] = _ages_ns(receptions, some, at) / SECOND_NS
        row += count
    return ages


def _ages_ns(receptions: LinkHistories, counted: _Stretches, at_ns: Array) -> Array:
    """Age at the instants of each stretch, one stretch after the other; every stretch has an instant."""
    first, stop = at_ns.searchsorted([counted.begin_ns, counted.end_ns])
    begin, end = (_after(receptions, counted.link, at_ns[each]) for each in (first, stop - 1))
    counts, came = stop - first, end - begin
    head = np.cumsum(counts) - counts
    known_at = np.repeat(head - first, came) + at_ns.searchsorted(receptions.received_ns[_ranges(begin, came)])
    step = np.bincount(known_at, minlength=int(counts.sum()))  # by which the newest reception changes from instant to instant
    step[head] += begin - 1
    step[head[1:]] -= end[:-1] - 1
    return np.asarray(at_ns[_ranges(first, counts)] - receptions.sent_ns[np.cumsum(step)])


def _after(receptions: LinkHistories, link: Array, at_ns: Array) -> Array:
    """First reception of each link after a time, by bisection of all at once; without one, the end of the link."""
    low, high = receptions.starts[link], receptions.starts[link + 1]
    while (low < high).any():
        middle = (low + high) // 2
        later = receptions.received_ns[np.minimum(middle, len(receptions.received_ns) - 1)] > at_ns
        low, high = np.where(later | (low == high), low, middle + 1), np.where(later, middle, high)
    return low


def _ranges(first: Array, counts: Array) -> Array:
    """The integers from each ``first``, as many as ``counts`` says, one range after the other."""
    return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def _batches(sizes: Array) -> Iterator[slice]:
    """Rows in batches of about `AT_ONCE` in size."""
    edges = np.flatnonzero(np.diff(np.cumsum(sizes) // AT_ONCE)) + 1
    return (slice(*each) for each in pairwise([0, *edges.tolist(), len(sizes)]) if each[0] < each[1])
