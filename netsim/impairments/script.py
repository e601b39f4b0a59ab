"""Scripted changes of links at given times: outages, attenuation, delays."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import permutations
from typing import ClassVar, NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.federate import matches
from vcmvsp.cosim.types import Decibels, Probability, Seconds, frozen
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Floats, Frame, Ints


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Some links are different for some time.

    Args:
        from_s: start.
        to_s: end; None: at the end of the run.
        links: key expressions of ``sender/receiver``: ``car1/car2`` is that direction alone, ``car1/*`` all that car1 sends,
            ``*/car1`` all that is sent to it, ``**`` every link.
        loss: probability that a frame is lost; None: none is.
        attenuation_db: additional attenuation; negative: stronger signal; None: 0.
        delay_s: additional time from the end of the frame to its reception; None: 0.
    """

    from_s: Seconds
    to_s: Seconds | None = None
    links: tuple[str, ...] = ("**",)
    loss: Probability | None = None
    attenuation_db: Decibels | None = None
    delay_s: Seconds | None = None

    def __post_init__(self) -> None:
        if self.to_s is not None and self.to_s <= self.from_s:
            raise ValueError(f"to_s = {self.to_s:g} must be greater than from_s = {self.from_s:g}")
        if self.loss is None and self.attenuation_db is None and self.delay_s is None:
            raise ValueError(f"the entry from {self.from_s:g} s has no effect: set loss, attenuation_db or delay_s")

    @property
    def span_ns(self) -> tuple[int, int]:
        """Start, and end, which it does not include."""
        return seconds_to_ns(self.from_s), 2**63 if self.to_s is None else seconds_to_ns(self.to_s)

    def concerns(self, link: str) -> bool:
        """Whether a link, ``sender/receiver``, is one of its links."""
        return any(matches(each, link) for each in self.links)


class Effects(NamedTuple):
    """Combined effects of the active changes on n links."""

    passes: Floats  # (n,) probability that a frame is not lost
    gain_db: Floats  # (n,)
    delay_ns: Ints  # (n,) after the end of the frame


@dataclass(frozen=True)
class Script:
    """Changes concern each frame that is on the air at any time of them, as a whole.

    Several changes of a link lose frames independently of each other; their attenuations and delays add up. A name without a
    vehicle matches nothing (see `unmatched`).
    """

    changes: tuple[Change, ...] = ()  # changes of links in time
    cause: ClassVar[str] = "scripted outage"

    def gain_db(self, frame: Frame, draw: Draw) -> Floats:
        """Gain at each receiver, (n,) dB, to be added to the level."""
        return self._effects(frame).gain_db

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        passes = self._effects(frame).passes
        if np.all(passes == 1.0):
            return np.zeros(len(passes), np.bool_)
        return draw()[..., 0] >= passes

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) ns: the frame's end plus the active delays."""
        return self._effects(frame).delay_ns + (frame.end_ns - frame.sent_ns)

    def unmatched(self, vehicles: Sequence[str]) -> list[str]:
        """The key expressions that match no link between the vehicles."""
        links = [f"{sender}/{receiver}" for sender, receiver in permutations(vehicles, 2)]
        expressions = dict.fromkeys(expression for change in self.changes for expression in change.links)
        return [each for each in expressions if not any(map(partial(matches, each), links))]

    def _effects(self, frame: Frame) -> Effects:
        """Effects of the changes that are active while the frame is on the air."""
        edges, present, of = self._timeline
        first, last = bisect_right(edges, frame.start_ns), bisect_left(edges, frame.end_ns)
        now = present[first]
        if first < last:  # a change starts or ends while the frame is on the air
            now = tuple(sorted(set[int]().union(*present[first : last + 1])))
        return of(now, frame.sender, frame.receivers)

    @cached_property
    def _timeline(self) -> tuple[list[int], list[tuple[int, ...]], Callable[[tuple[int, ...], str, tuple[str, ...]], Effects]]:
        """Times of all changes, ns; the active changes before the first and after each of these; their effects."""
        spans = [each.span_ns for each in self.changes]
        edges = sorted(set[int]().union(*spans))

        def active(time_ns: int) -> tuple[int, ...]:
            return tuple(k for k, (begin, end) in enumerate(spans) if begin <= time_ns < end)

        return edges, [active(time_ns) for time_ns in (-1, *edges)], lru_cache(maxsize=4096)(self._together)

    def _together(self, present: tuple[int, ...], sender: str, receivers: tuple[str, ...]) -> Effects:
        passes, gain_db, delay_s = np.ones(len(receivers)), np.zeros(len(receivers)), np.zeros(len(receivers))
        for change in (self.changes[k] for k in present):
            struck = [change.concerns(f"{sender}/{receiver}") for receiver in receivers]
            passes[struck] *= 1.0 - (change.loss or 0.0)
            gain_db[struck] -= change.attenuation_db or 0.0
            delay_s[struck] += change.delay_s or 0.0
        return Effects(frozen(passes), frozen(gain_db), frozen([seconds_to_ns(each) for each in delay_s.tolist()], np.int64))
