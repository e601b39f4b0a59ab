"""Jammers: transmitters of interference, without frames."""

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.types import Decibels, Period, Seconds, Vec3
from vcmvsp.netsim.interfaces.layers import Floats

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Waypoint = tuple[Seconds, float, float, float]  # time s, x, y, z m

LossDb = Callable[[Floats, Floats], Floats]
"""Mean loss from a point (3,) m to points (n, 3) m: (n,) dB."""


class Emitter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One jammer: it stands somewhere, rides on a vehicle, or moves by itself.

    Args:
        power_dbm: while it is on, within the bandwidth of the receivers, antenna gain included.
        position: where it stands, m, world; None: it moves.
        vehicle: the vehicle that carries it; None: no vehicle does.
        path: pairs of time and place, ``[t, x, y, z]`` in s and m, world: straight lines at constant speed between them; it
            waits at the first until then, and stays at the last; None: it has none.
        from_s: start.
        to_s: end; None: at the end of the run.
        duty: fraction of each period in which it is on, from the start of the period; 1: always.
        period_s: from pulse to pulse, the first begins at ``from_s``; None: it does not pulse.
    """

    power_dbm: Decibels
    position: Vec3 | None = None
    vehicle: str | None = None
    path: tuple[Waypoint, ...] | None = None
    from_s: Seconds = 0.0
    to_s: Seconds | None = None
    duty: Share = 1.0
    period_s: Period | None = None

    def __post_init__(self) -> None:
        problem = ""
        if sum(each is not None for each in (self.position, self.vehicle, self.path)) != 1:
            problem = "a jammer needs exactly one of position, vehicle and path"
        elif self.path is not None and (not self.path or any(a[0] >= b[0] for a, b in pairwise(self.path))):
            problem = "path must have points [t, x, y, z], each later than the one before"
        elif self.to_s is not None and self.to_s <= self.from_s:
            problem = f"to_s = {self.to_s:g} must be greater than from_s = {self.from_s:g}"
        elif self.duty < 1.0 and self.period_s is None:
            problem = f"duty = {self.duty:g} is a pulsed jammer, which needs period_s"
        if problem:
            raise ValueError(problem)


@dataclass(frozen=True)
class Jammer:
    """A frame is disturbed by each source that is on at any time while the frame is on the air, with its whole power.

    The power at a receiver is ``power_dbm`` minus the mean loss on the path; it counts as noise. A source on a vehicle moves
    with it; a source on the receiver's own vehicle is at the shortest distance of the path loss.
    """

    sources: tuple[Emitter, ...] = ()  # the jammers

    def interference_mw(
        self, start_ns: int, end_ns: int, rx: Floats, loss_db: LossDb, where: Callable[[str], Floats]
    ) -> Floats:
        """Power at each receiver from all sources that are on at any time of ``[start_ns, end_ns)``, (n,) mW.

        It is the mean power during pulses: pauses between pulses do not reduce it. Positions of sources are those at
        ``start_ns``.

        Args:
            start_ns: start of the frame on the air.
            end_ns: its end.
            rx: receivers, (n, 3) m, world.
            loss_db: mean loss from a point to the receivers.
            where: position of a vehicle, (3,) m, world.
        """
        power = np.zeros(len(rx))
        for each in self._sources:
            if each.on(start_ns, end_ns):
                power += 10.0 ** ((each.source.power_dbm - loss_db(each.place(start_ns, where), rx)) / 10.0)
        return power

    def names(self) -> tuple[str, ...]:
        """The vehicles that carry sources."""
        return tuple(dict.fromkeys(each.vehicle for each in self.sources if each.vehicle is not None))

    @cached_property
    def _sources(self) -> "list[_Ready]":
        return [_Ready(each) for each in self.sources]


class _Ready:
    """A source with times in whole nanoseconds."""

    def __init__(self, source: Emitter) -> None:
        self.source = source
        self._from_ns = seconds_to_ns(source.from_s)
        self._to_ns = None if source.to_s is None else seconds_to_ns(source.to_s)
        self._pulses = None if source.duty == 1.0 or source.period_s is None else Ticks.every(source.period_s)
        self._on_ns = max(1, round(source.duty * (source.period_s or 0.0) * SECOND_NS))
        self._place = None if source.position is None else np.array(source.position)
        self._times_s = [point[0] for point in source.path or ()]
        self._points = np.array([point[1:] for point in source.path or ()])

    def on(self, start_ns: int, end_ns: int) -> bool:
        """Whether the source is on at any time of ``[start_ns, end_ns)``."""
        begin = max(start_ns, self._from_ns)
        end = end_ns if self._to_ns is None else min(end_ns, self._to_ns)
        if begin >= end or self._pulses is None:
            return begin < end
        # The last pulse that starts before the end also ends last.
        last = -(-(end - self._from_ns) * self._pulses.per // self._pulses.ns) - 1
        return self._pulses.at(last) + self._on_ns > begin - self._from_ns

    def place(self, time_ns: int, where: Callable[[str], Floats]) -> Floats:
        """Position of the source, (3,) m, world."""
        if self._place is not None:
            return self._place
        if self.source.vehicle is not None:
            return where(self.source.vehicle)
        time_s, times = time_ns / SECOND_NS, self._times_s
        after = bisect_right(times, time_s)
        if after in (0, len(times)):
            place: Floats = self._points[max(0, after - 1)]
        else:
            share = (time_s - times[after - 1]) / (times[after] - times[after - 1])
            place = self._points[after - 1] + share * (self._points[after] - self._points[after - 1])
        return place
