"""Age of information: how old the newest message is that a vehicle has of another.

Of each follower, what it has from the leader it then follows; in a run without followers, every link to a vehicle with an
agent. A link counts from its first reception on. Over time the age is a sawtooth: it rises at one second per second, and
falls at each reception of something newer to that message's own age. It is taken at the agents' ticks, when they act on it,
and over all time: with period T, delay d and independent losses of probability p the mean is ``d + T (1 + p) / (2 (1 -
p))``, and the mean of the peaks just before each fall ``d + T / (1 - p)`` (renewal theory; Kaul, Yates and Gruteser,
INFOCOM 2012, for the notion).
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.metrics.radio import Receptions, informed, quantiles, receptions
from vcmvsp.cosim.metrics.window import FOREVER_NS, Window, followers, stretches, window_ns
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import Array


class LinkHistory(NamedTuple):
    """What one vehicle received of another, in order of reception."""

    sent_ns: Array  # the newest sending time received so far
    received_ns: Array

    def age_ns(self, at_ns: Array) -> Array:
        """Age of the newest message at these instants, of which none lies before the first reception."""
        newest = self.received_ns.searchsorted(at_ns, side="right") - 1
        return np.asarray(at_ns - self.sent_ns[newest])

    def sawtooth(self, begin_ns: int, end_ns: int) -> "Sawtooth":
        """The age from ``begin_ns`` (not before the first reception) to ``end_ns``."""
        first, stop = (int(self.received_ns.searchsorted(at_ns, side="right")) for at_ns in (begin_ns, end_ns))
        edges = np.empty(stop - first + 2, np.int64)
        edges[0], edges[1:-1], edges[-1] = begin_ns, self.received_ns[first:stop], end_ns
        begins, ends, sent = edges[:-1], edges[1:], self.sent_ns[first - 1 : stop]
        last = ends > begins  # of messages that arrive at once
        last[-1] = True  # the last tooth may be of no length
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
    """A stretch of time, of which the age over a link counts."""

    receiver: str
    link: LinkHistory
    begin_ns: int  # not before the first reception
    end_ns: int


def links(radio: pa.Table | Receptions) -> dict[tuple[str, str], LinkHistory]:
    """What was received of every vehicle by every other (receiver, sender), over whatever relays."""
    got = radio if isinstance(radio, Receptions) else informed(radio, receptions(radio))
    width = max(len(got.senders), 1)
    code = got.to.astype(np.int64) * width + got.by
    small = len(got.receivers) * width < 2**16  # then sorting takes time in proportion to the rows
    order = np.argsort(code.astype(np.uint16) if small else code, kind="stable")
    link, received = code[order], got.received_ns[order]
    starts = np.flatnonzero(np.diff(link, prepend=-1))
    turned = np.diff(received) < 0
    turned[starts[1:] - 1] = False
    if turned.any():  # messages that overtake each other
        order = order[np.lexsort((received, link))]
        received = got.received_ns[order]
    sent = got.sent_ns[order]
    return {
        (got.receivers[link[begin] // width], got.senders[link[begin] % width]): LinkHistory(
            np.maximum.accumulate(sent[begin:end]), received[begin:end]
        )
        for begin, end in pairwise([*starts.tolist(), len(order)])
    }


def ages_s(radio: pa.Table, follows: Sequence[Placement], ticks: Mapping[str, Ticks], window: Window, end_ns: int) -> Array:
    """Age of the newest message (s) at every tick of a receiving agent within the window.

    ``ticks`` says when the agent of a vehicle acts, before ``end_ns``.
    """
    return _at_ticks(list(_stretches(links(radio), follows, ticks)), ticks, window, end_ns)


def age_metrics(
    got: Receptions, follows: Sequence[Placement], ticks: Mapping[str, Ticks], window: Window, end_ns: int
) -> dict[str, float | None]:
    """Mean, 95th percentile and maximum of `ages_s`; mean over all time in the window; mean of the peaks."""
    counted = list(_stretches(links(got), follows, ticks))
    begin, last = window_ns(window)
    spans = ((each.link, max(each.begin_ns, begin), min(each.end_ns, last, end_ns)) for each in counted)
    saws = [link.sawtooth(since, until) for link, since, until in spans if since < until]
    peaks = np.concatenate([np.empty(0), *(saw.peaks for saw in saws)])
    return {
        **quantiles(_at_ticks(counted, ticks, window, end_ns), ("mean", "p95", "max")),
        "time_average": sum(saw.area for saw in saws) / sum(saw.length for saw in saws) if saws else None,
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
    train_of = {train: _train(train, begin, min(last + 1, end_ns)) for train in dict.fromkeys(ticks.values())}
    own = {receiver: train_of[train] for receiver, train in ticks.items()}
    parts = [np.empty(0, np.int64)]
    for each in counted:
        train = own[each.receiver]
        parts.append(each.link.age_ns(train[train.searchsorted(each.begin_ns) : train.searchsorted(each.end_ns)]))
    return np.concatenate(parts) / SECOND_NS


def _train(ticks: Ticks, begin_ns: int, end_ns: int) -> Array:
    """The ticks with ``begin <= t < end``."""
    first, stop = (-(-max(0, bound) * ticks.per // ticks.ns) for bound in (begin_ns, end_ns))
    return np.array([ticks.at(k) for k in range(first, stop)], np.int64)
