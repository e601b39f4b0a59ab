"""Delivery after reception: rate limit of a link, duplicates, and order of frames."""

import math

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Probability, Seconds
from vcmvsp.netsim.interfaces.layers import BitRate, Draw, Ints

NEVER = -1  # instead of a time: lost, or no copy


class Delivery:
    """What a link does with a frame that its receiver has received, from one sender to one receiver, in this order.

    It is the only layer with memory, and models a wireless bridge or a relay as network emulators do.

    1. ``rate_bps``: a link passes one frame at a time, each in ``8 size / rate`` (payload, rounded up to 1 ns). Others wait,
       first come first served (D. V. Lindley, The theory of queues with a single server, 1952)::

           wait = max(0, departure of the frame before - arrival),   departure = arrival + wait + 8 size / rate

       A frame that would have to wait longer than ``queue_s`` is lost.
    2. ``reorder = false``: a frame that would overtake arrives 1 ns behind what it would have overtaken, copies included.
    3. ``duplicate``: with this probability a copy arrives ``duplicate_delay_s`` after the frame. Copies take no time of a rate.

    "Before" and "first" mean the order of the calls of `deliver`, which is that of the frames' ends on the air.

    Args:
        rate_bps: of a link, one frame at a time; None: no limit.
        queue_s: longest wait for the rate, more is lost; None: no limit.
        duplicate: probability of a copy.
        duplicate_delay_s: from the frame to its copy.
        reorder: false: no frame overtakes another.
    """

    cause = "rate limit"

    def __init__(
        self,
        rate_bps: BitRate | None = None,
        queue_s: Seconds | None = None,
        duplicate: Probability = 0.0,
        duplicate_delay_s: Seconds = 0.0,
        *,
        reorder: bool = True,
    ) -> None:
        if queue_s is not None and rate_bps is None:
            raise ScenarioError("queue_s limits the wait in a rate-limited queue: set rate_bps too", key="queue_s")
        self.rate_bps, self.duplicate, self.reorder = rate_bps, duplicate, reorder
        self._queue_ns = None if queue_s is None else seconds_to_ns(queue_s)
        self._duplicate_ns = seconds_to_ns(duplicate_delay_s)
        self.open(0)

    def open(self, count: int) -> None:
        """Reset to unused links between ``count`` radios."""
        shape = (count, count)  # sender, receiver
        self._departed = np.zeros(shape, np.int64)  # end of the link's last frame
        self._arrived = np.full(shape, NEVER, np.int64)  # last arrival, copies included

    def deliver(
        self, sender_row: int, rows: NDArray[np.intp], received_ns: Ints, size_bytes: int, draw: Draw
    ) -> tuple[Ints, Ints]:
        """Deliver a received frame to its receivers.

        Args:
            sender_row: row of the sender.
            rows: of the receivers, (n,), each once.
            received_ns: time of reception at each receiver, (n,) ns; -1: not received.
            size_bytes: payload.
            draw: two uniforms for each receiver.

        Returns:
            Times of arrival of the frame and of its copy, (n,) ns each; -1: never. A received frame that never arrives is lost
            by the rate limit.
        """
        arrival = received_ns
        if self.rate_bps is not None:
            arrival = self._limit(sender_row, rows, arrival, math.ceil(8 * size_bytes * SECOND_NS / self.rate_bps))
        if not self.reorder:
            behind = np.maximum(arrival, self._arrived[sender_row, rows] + 1)
            arrival = np.where(arrival >= 0, behind, NEVER)
        copy = np.full(len(arrival), NEVER, np.int64)
        if self.duplicate:
            doubled = (arrival >= 0) & (draw()[..., 0] < self.duplicate)
            copy[doubled] = arrival[doubled] + self._duplicate_ns
        if not self.reorder:
            last = np.maximum(arrival, copy)
            self._arrived[sender_row, rows] = np.where(last >= 0, last, self._arrived[sender_row, rows])
        return arrival, copy

    def _limit(self, sender_row: int, rows: NDArray[np.intp], arrival: Ints, service_ns: int) -> Ints:
        free = self._departed[sender_row, rows]
        begin = np.maximum(arrival, free)
        passed = arrival >= 0
        if self._queue_ns is not None:
            passed &= begin - arrival <= self._queue_ns
        departure = begin + service_ns
        self._departed[sender_row, rows] = np.where(passed, departure, free)
        return np.where(passed, departure, NEVER)
