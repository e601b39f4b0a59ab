"""The numbers of a run, computed from what it recorded: formation error, radio, age of information, safety.

Formation error of a follower (Toh 2012, equations 3-31 and 3-34, for any slot): its handle,
``h = p_f + ell (cos th_f, sin th_f)``, should lie on the point ``r = p_l + Rot(th_l) (slot + (ell, 0))`` of its leader's frame;
``|z| = |r - h|``. All poses are true ones, whatever the vehicles believed.

The schema ``vcmvsp.metrics/1``, as `Recorder.metrics` gives it; where there is nothing to measure a value is None, never NaN::

    schema, scenario, seed
    duration_s                      simulated time that the run lasted
    formation                       |z| at the recorded instants
      rms_m, mean_m, max_m          over the window and all followers
      final_m                       greatest at the last instant
      settling_s                    from then on no follower is more than 5 cm off, to the end of the run
      per_follower.<name>           rms_m, mean_m, max_m, final_m of one
    radio                           of the whole run, but for the ages
      frames                        frames that entered the channel
      receptions, delivery_ratio    frames received, and their share of frame x receiver
      losses.<cause>                how many were lost, by cause
      delay_s                       mean, p50, p95, p99, max; from sending to reception
      age_s                         mean, p95, max; age of the newest message at the agents' ticks in the window (`ages_s`)
    safety
      collisions                    touches that began
      min_separation_m              smallest distance of two centres at a recorded instant
    digest                          SHA-256 of all that was recorded (`cosim.record.digest`)
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from cosim.record.columns import names_of, numbers
from cosim.record.tables import Placement
from cosim.types import Array

SCHEMA = "vcmvsp.metrics/1"
SETTLED_M = 0.05  # a follower this near to its place has settled
FOREVER_NS = 2**62
Window = tuple[float, float | None]  # s, both ends included; None: the end of the run


@dataclass(frozen=True)
class Motion:
    """The recorded poses of m instants and n vehicles; NaN where a vehicle was not there."""

    time_ns: Array  # (m,)
    names: tuple[str, ...]
    position: Array  # (3, m, n) m, world
    yaw: Array  # (m, n) rad

    def column(self, name: str) -> int:
        """Which column belongs to a vehicle."""
        return self.names.index(name)


@dataclass(frozen=True)
class Link:
    """What one vehicle received of another, in order of reception."""

    sent_ns: Array  # the newest sending time received so far
    received_ns: Array

    def age_ns(self, at_ns: Array) -> Array:
        """Age of the newest message at these instants, of which none lies before the first reception."""
        newest = np.searchsorted(self.received_ns, at_ns, side="right") - 1
        return np.asarray(at_ns - self.sent_ns[newest])


def motion(states: pa.Table) -> Motion:
    """The table of states as dense arrays."""
    names, code = names_of(states, "vehicle")
    times, instant = np.unique(numbers(states, "time_ns"), return_inverse=True)

    def dense(values: Array) -> Array:
        result = np.full((len(times), len(names)), np.nan)
        result[instant, code] = values
        return result

    w, x, y, z = (numbers(states, name) for name in ("qw", "qx", "qy", "qz"))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    position = np.stack([dense(numbers(states, name)) for name in ("x", "y", "z")])
    return Motion(times, names, position, dense(yaw))


def formation_errors(moved: Motion, follows: Sequence[Placement]) -> dict[str, Array]:
    """``|z|`` (m,) in m of every follower, in the order of the run's vehicles; NaN before it follows anyone."""
    x, y, _ = moved.position
    errors = {}
    for name in _followers(moved.names, follows):
        error = np.full(len(moved.time_ns), np.nan)
        f = moved.column(name)
        for begin, end, placed in _spans(name, follows):
            if placed.leader is None:
                continue
            span = slice(*np.searchsorted(moved.time_ns, [begin, end]))
            leader, (slot_x, slot_y), ell = moved.column(placed.leader), placed.slot, placed.handle_m
            th_l, th_f = moved.yaw[span, leader], moved.yaw[span, f]
            cos, sin, ahead = np.cos(th_l), np.sin(th_l), slot_x + ell
            ex = x[span, leader] + cos * ahead - sin * slot_y - x[span, f] - ell * np.cos(th_f)
            ey = y[span, leader] + sin * ahead + cos * slot_y - y[span, f] - ell * np.sin(th_f)
            error[span] = np.hypot(ex, ey)
        errors[name] = error
    return errors


def formation_metrics(moved: Motion, follows: Sequence[Placement], window: Window) -> dict[str, Any]:
    """The ``formation`` part: ``rms``, ``mean`` and ``max`` over the window, ``final`` and ``settling`` over the whole run."""
    errors = formation_errors(moved, follows)
    all_errors = np.array(list(errors.values())).reshape(len(errors), len(moved.time_ns))
    begin, end = _window_ns(window)
    inside = (moved.time_ns >= begin) & (moved.time_ns <= end)
    return {
        **_error_summary(all_errors, inside),
        "settling_s": _settling_s(moved.time_ns, all_errors),
        "per_follower": {name: _error_summary(error[np.newaxis], inside) for name, error in errors.items()},
    }


def links(radio: pa.Table) -> dict[tuple[str, str], Link]:
    """What was received over every link (receiver, sender)."""
    (receivers, to), (senders, by) = names_of(radio, "receiver"), names_of(radio, "sender")
    sent, received = numbers(radio, "sent_ns"), numbers(radio, "received_ns", null=-1)
    order = np.lexsort((received, by, to))
    order = order[received[order] >= 0]
    to, by, sent, received = to[order], by[order], sent[order], received[order]
    bounds = [*np.flatnonzero((np.diff(to, prepend=-1) != 0) | (np.diff(by, prepend=-1) != 0)).tolist(), len(order)]
    return {
        (receivers[to[begin]], senders[by[begin]]): Link(np.maximum.accumulate(sent[begin:end]), received[begin:end])
        for begin, end in pairwise(bounds)
    }


def ages_s(radio: pa.Table, follows: Sequence[Placement], ticks: Mapping[str, Ticks], window: Window, end_ns: int) -> Array:
    """Age of the newest message (s) at every tick of a receiving agent within the window.

    Of each follower: the age of what it has from the leader it then follows. In a run without followers: of every link.
    A link counts from its first reception on; ``ticks`` says when the agent of a vehicle acts, before ``end_ns``.
    """
    begin, last = _window_ns(window)
    train_of = {train: _train(train, begin, min(last + 1, end_ns)) for train in ticks.values()}
    heard = links(radio)
    if follows:
        followers = _followers(ticks, follows)
        spans = [(name, *span) for name in followers for span in _spans(name, follows)]
        wanted = [((name, at.leader), since, until) for name, since, until, at in spans if at.leader]
    else:
        wanted = [(key, 0, FOREVER_NS) for key in heard if key[0] in ticks]
    parts = [np.empty(0, np.int64)]
    for key, since, until in wanted:
        if key in heard:
            link, train = heard[key], train_of[ticks[key[0]]]
            first, stop = np.searchsorted(train, [max(since, link.received_ns[0]), until])
            parts.append(link.age_ns(train[first:stop]))
    return np.concatenate(parts) / SECOND_NS


def radio_metrics(radio: pa.Table, ages: Array, end_ns: int) -> dict[str, Any]:
    """The ``radio`` part: counts of the whole run, delays of all receptions, ages as given.

    A frame that is still under way when the run ends is neither received nor lost.
    """
    outcomes, code = names_of(radio, "outcome")
    counts = dict(zip(outcomes, np.bincount(code, minlength=len(outcomes)).tolist(), strict=True))
    late = int((numbers(radio, "received_ns", null=-1) > end_ns).sum())
    receptions, decided = counts.get("received", 0) - late, radio.num_rows - late - counts.pop("under way", 0)
    delays = numbers(radio, "delay_ns", null=-1)
    delays = delays[(delays >= 0) & (numbers(radio, "received_ns", null=-1) <= end_ns)] / SECOND_NS
    return {
        "frames": len(np.unique(numbers(radio, "frame"))),
        "receptions": receptions,
        "delivery_ratio": receptions / decided if decided else None,
        "losses": {cause: counts[cause] for cause in sorted(counts) if cause != "received" and counts[cause]},
        "delay_s": _quantiles(delays, ("mean", "p50", "p95", "p99", "max")),
        "age_s": _quantiles(ages, ("mean", "p95", "max")),
    }


def min_separation_m(moved: Motion) -> float | None:
    """Smallest distance (m) between the centres of any two vehicles at any recorded instant."""
    best = np.inf
    for shift in range(1, len(moved.names)):  # column j against column j + shift: every pair once, whole blocks of memory
        apart = moved.position[:, :, shift:] - moved.position[:, :, :-shift]
        squared = np.einsum("kmn,kmn->mn", apart, apart)
        best = min(best, np.fmin.reduce(squared, axis=None, initial=np.inf))
    return float(np.sqrt(best)) if best < np.inf else None


def _followers(names: Iterable[str], follows: Sequence[Placement]) -> list[str]:
    following = {placement.vehicle for placement in follows}
    return [name for name in names if name in following]


def _spans(name: str, follows: Sequence[Placement]) -> list[tuple[int, int, Any]]:
    """Begin, end (ns) and place of each stretch of a follower's time."""
    own = [placement for placement in follows if placement.vehicle == name]
    ends = [*(placement.time_ns for placement in own[1:]), FOREVER_NS]
    return [(placement.time_ns, end, placement.follows) for placement, end in zip(own, ends, strict=True)]


def _train(ticks: Ticks, begin_ns: int, end_ns: int) -> Array:
    """The ticks with ``begin <= t < end``."""
    first, stop = (-(-max(0, bound) * ticks.per // ticks.ns) for bound in (begin_ns, end_ns))
    return np.array([ticks.at(k) for k in range(first, stop)], np.int64)


def _window_ns(window: Window) -> tuple[int, int]:
    begin, end = window
    return seconds_to_ns(begin), FOREVER_NS if end is None else seconds_to_ns(end)


def _error_summary(errors: Array, inside: Array) -> dict[str, float | None]:
    """Of errors (followers, m): root mean square, mean and maximum in the window, and the greatest at the last instant."""
    chosen = errors[:, inside]
    chosen = chosen[np.isfinite(chosen)]
    final = errors[:, -1:]
    final = final[np.isfinite(final)]
    return {
        "rms_m": float(np.sqrt(np.mean(chosen**2))) if chosen.size else None,
        "mean_m": float(np.mean(chosen)) if chosen.size else None,
        "max_m": float(np.max(chosen)) if chosen.size else None,
        "final_m": float(np.max(final)) if final.size else None,
    }


def _settling_s(time_ns: Array, errors: Array) -> float | None:
    """The earliest recorded instant from which no error exceeds `SETTLED_M` any more."""
    measured = np.any(np.isfinite(errors), axis=0)
    unsettled = np.flatnonzero(np.any(errors[:, measured] > SETTLED_M, axis=0))
    times = time_ns[measured]
    since = unsettled[-1] + 1 if unsettled.size else 0
    return float(times[since] / SECOND_NS) if since < len(times) else None


def _quantiles(values: Array, names: Sequence[str]) -> dict[str, float | None]:
    """Mean, maximum and percentiles (``p95``; linear between ranks)."""
    return {name: _quantile(values, name) if values.size else None for name in names}


def _quantile(values: Array, name: str) -> float:
    if name == "mean":
        return float(np.mean(values))
    return float(np.percentile(values, 100 if name == "max" else int(name[1:])))
