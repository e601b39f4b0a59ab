"""Media without carrier sense: radios send at times of their own, whatever others do; nothing is acknowledged or repeated.

Frames that overlap interfere: the hazard ``-log(success per bit)`` is summed over the pieces of constant interference. With a
phy without packet errors, frames that overlap at a receiver are lost there, but for one that is ``capture_db`` of the phy above
the sum of the others. A radio that sends at any time of a frame does not receive it.
"""

import heapq
import math
from collections.abc import Iterator, Sequence
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Phy
from vcmvsp.netsim.interfaces.medium import Codes, Decided, Fate, Offered
from vcmvsp.netsim.mac.event_medium import EventMedium, QueuedRadio
from vcmvsp.netsim.phy.error_rate import ErrorRate


class BlindEvent(IntEnum):
    """Kinds of events, in their order within one nanosecond."""

    ENDED = 0  # a frame
    TURN = 1  # of a radio with a frame to send


class BlindFrame(NamedTuple):
    """One frame on the air; arrays: at every radio, (n,)."""

    offered: Offered
    start_ns: int
    end_ns: int
    power_mw: Floats
    patience: Floats

    def overlaps(self, other: "BlindFrame") -> bool:
        """Whether both are on the air at the same time."""
        return self.start_ns < other.end_ns and other.start_ns < self.end_ns


class BlindRadio(QueuedRadio):
    """One radio."""

    is_busy = False  # it waits for its turn, or sends


R = TypeVar("R", bound=BlindRadio)


class BlindMedium(EventMedium[BlindEvent, R]):
    """Base of the `netsim.interfaces.medium.Medium` without carrier sense; a subclass says when a radio sends.

    Args:
        queue_frames: maximum number of frames at a sender, with the frame on the air; None: no limit.
        phy: gives the time on the air and, if it has any, packet errors.
        radios: all radios, by row.
        noise_mw: at every receiver.
    """

    def __init__(self, queue_frames: int | None, phy: Phy, radios: Sequence[R], noise_mw: float) -> None:
        super().__init__(radios, queue_frames)
        self._phy, self._noise_mw = phy, noise_mw
        self._errors: ErrorRate | None = getattr(phy, "errors", None)
        self._preamble_snr = 10.0 ** (getattr(phy, "preamble_snr_db", -math.inf) / 10.0)
        capture_db: float | None = getattr(phy, "capture_db", None)
        self._capture = None if capture_db is None else 10.0 ** (capture_db / 10.0)
        self._frames: dict[int, BlindFrame] = {}  # by row of the sender: on the air
        self._ended: list[BlindFrame] = []  # that may overlap one on the air
        self.levels: Floats = np.zeros((len(radios), len(radios)))  # of acknowledgements, which there are none of
        self.sensitivity_mw: Floats = np.zeros(len(radios))

    def next_ns(self) -> int | None:
        """Lower bound of the next decision; None: no frame has a turn to come."""
        times = [event[0] for event in self._events[:1]]
        return min([*times, *(frame.time_ns for frame in list(self._offers)[:1])], default=None)

    def _happen(self) -> None:
        now_ns, kind, _, radio, turn = heapq.heappop(self._events)
        if kind is BlindEvent.ENDED:
            self._end(now_ns, radio)
        else:
            self._take_turn(now_ns, radio, turn)

    def _schedule(self, time_ns: int, kind: BlindEvent, radio: R, turn: int = 0) -> None:
        self._running += 1
        heapq.heappush(self._events, (time_ns, kind, self._running, radio, turn))

    def _enqueue(self, frame: Offered) -> None:
        radio = self._radios[frame.sender]
        if self._admit(frame, sends=radio.row in self._frames) and not radio.is_busy:
            self._await_turn(frame.time_ns, radio)

    def _await_turn(self, now_ns: int, radio: R) -> None:
        """Schedule the next turn of a radio with a frame; without one, its frames wait until the run ends."""
        raise NotImplementedError

    def _take_turn(self, now_ns: int, radio: R, turn: int) -> None:
        """Send the first frame of a radio's queue, at its turn."""
        frame = heapq.heappop(radio.queue)[2]
        power_mw, patience = frame.power_mw, frame.patience
        if power_mw is None or patience is None:
            power_mw, patience = frame.renew(0, now_ns)
        end_ns = now_ns + self._phy.air_time_ns(frame.size_bytes)
        self._frames[radio.row] = BlindFrame(frame, now_ns, end_ns, power_mw, patience)
        self._schedule(end_ns, BlindEvent.ENDED, radio)

    def _end(self, now_ns: int, radio: R) -> None:
        ended = self._frames.pop(radio.row)
        self._judge(ended, [each for each in (*self._frames.values(), *self._ended) if each.overlaps(ended)])
        present = [each.start_ns for each in self._frames.values()]
        self._ended = [each for each in (*self._ended, ended) if present and each.end_ns > min(present)]
        if radio.queue:
            self._await_turn(now_ns, radio)
        else:
            radio.is_busy = False

    def _judge(self, frame: BlindFrame, others: Sequence[BlindFrame]) -> None:
        """Decide a frame, given all frames that overlap it."""
        if self._errors is None:
            fate, least_sinr = self._without_errors(frame, others)
        else:
            fate, least_sinr = self._with_errors(self._errors, frame, others)
        fate[frame.offered.sender] = Fate.TRANSMITTING
        self._decide(Decided(frame.offered.number, frame.start_ns, frame.end_ns, 1, fate, least_sinr))

    def _without_errors(self, frame: BlindFrame, others: Sequence[BlindFrame]) -> tuple[Codes, Floats]:
        """Fates and least SINR, (n,) each; NaN without capture, where a frame is lost if another one is noticed, too."""
        fate = np.full(len(self._radios), Fate.RECEIVED, np.uint8)
        least_sinr = np.full(len(self._radios), np.nan)
        if self._capture is None:
            for each in others:
                fate[each.power_mw >= self.sensitivity_mw] = Fate.COLLISION
        else:
            worst_mw = np.zeros(len(self._radios))
            for _, _, interference_mw in _pieces(frame, others):
                worst_mw = np.maximum(worst_mw, interference_mw)
            fate[frame.power_mw < self._capture * worst_mw] = Fate.COLLISION
            least_sinr = frame.power_mw / (self._noise_mw + worst_mw)
        fate[[each.offered.sender for each in others]] = Fate.TRANSMITTING
        fate[frame.power_mw < self.sensitivity_mw] = Fate.UNDETECTED
        return fate, least_sinr

    def _with_errors(self, model: ErrorRate, frame: BlindFrame, others: Sequence[BlindFrame]) -> tuple[Codes, Floats]:
        """Fates and least SINR, (n,) each."""
        errors, bits = model.payload(frame.offered.size_bytes)
        header, header_bits = model.header
        alone = frame.power_mw / self._noise_mw
        hazard, least_sinr, detected = np.zeros(len(alone)), alone, alone > 0.0
        for begin_ns, end_ns, interference_mw in _pieces(frame, others):
            sinr = frame.power_mw / (self._noise_mw + interference_mw)
            if begin_ns == frame.start_ns:
                detected = sinr > self._preamble_snr
                hazard = hazard + header_bits * header.bit_hazard(sinr)
            share = (end_ns - begin_ns) / (frame.end_ns - frame.start_ns)
            hazard = hazard + share * bits * errors.bit_hazard(sinr)
            least_sinr = np.minimum(least_sinr, sinr)
        by_noise = bits * errors.bit_hazard(alone) + header_bits * header.bit_hazard(alone) >= frame.patience
        fate = np.full(len(alone), Fate.COLLISION, np.uint8)
        fate[by_noise] = Fate.ERROR
        fate[detected & (hazard < frame.patience)] = Fate.RECEIVED
        fate[[each.offered.sender for each in others]] = Fate.TRANSMITTING
        fate[(alone <= self._preamble_snr) | (frame.power_mw < self.sensitivity_mw)] = Fate.UNDETECTED
        return fate, least_sinr


def _pieces(frame: BlindFrame, others: Sequence[BlindFrame]) -> Iterator[tuple[int, int, Floats | float]]:
    """Begin and end (ns) of each piece of a frame, and the sum of the powers of other frames meanwhile, (n,) mW."""
    cuts = {min(max(time_ns, frame.start_ns), frame.end_ns) for each in others for time_ns in (each.start_ns, each.end_ns)}
    for begin_ns, end_ns in pairwise(sorted(cuts | {frame.start_ns, frame.end_ns})):
        present = [each.power_mw for each in others if each.start_ns <= begin_ns and each.end_ns >= end_ns]
        yield begin_ns, end_ns, np.sum(present, axis=0)
