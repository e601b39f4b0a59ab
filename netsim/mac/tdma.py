"""Time division: each radio sends in its own slots, by the clock of its vehicle.

Slot i of a schedule of m slots begins, by a vehicle's clock, at ``(k m + i) slot_s``, k = 0, 1, ... A radio sends one frame in
a slot, ``guard_s`` after its begin; the frame must end ``guard_s`` before its end. So clocks that differ by up to ``2 guard_s``
never make frames of neighbouring slots overlap. Jitter of a clock has no effect. Nothing is acknowledged or repeated.

Frames that overlap interfere: the hazard ``-log(success per bit)`` is summed over the pieces of constant interference. With a
phy without packet errors, frames that overlap at a receiver are lost there. A radio that sends at any time of a frame does not
receive it.
"""

import heapq
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative, Period
from vcmvsp.cosim.vehicle_clock import VehicleClock
from vcmvsp.netsim.interfaces.layers import Floats, Keys, Phy
from vcmvsp.netsim.interfaces.medium import Codes, Decided, Fate, Medium, Offered
from vcmvsp.netsim.phy.error_rate import ErrorRate

STEPPED_NS = 1000  # a clock that differs by more from what was expected was set meanwhile

Many = Annotated[int, msgspec.Meta(ge=1)]


class _Kind(IntEnum):
    """Kinds of events, in their order within one nanosecond."""

    ENDED = 0  # a frame
    SLOT = 1  # of a radio with a frame to send


class TdmaFrame(NamedTuple):
    """One frame on the air; arrays: at every radio, (n,)."""

    offered: Offered
    start_ns: int
    end_ns: int
    power_mw: Floats
    patience: Floats

    def overlaps(self, other: "TdmaFrame") -> bool:
        """Whether both are on the air at the same time."""
        return self.start_ns < other.end_ns and other.start_ns < self.end_ns


class TdmaRadio:
    """The queue of one radio, its slots, and its clock."""

    def __init__(self, row: int, slots: Sequence[int], clock: VehicleClock) -> None:
        self.row, self.slots, self.clock = row, slots, clock
        self.queue: list[tuple[int, int, Offered]] = []  # heap: higher priorities first, then first come, first served
        self.is_busy = False  # it waits for its slot, or sends


class TdmaMedium:
    """The `netsim.interfaces.medium.Medium` of time division.

    Args:
        rules: slot, guard time and queue.
        phy: gives the time on the air.
        errors: of the phy; None: it has none.
        radios: all radios, by row.
        slots: number of slots after which the schedule repeats.
        noise_mw: at every receiver.
    """

    def __init__(
        self, rules: "Tdma", phy: Phy, errors: ErrorRate | None, radios: Sequence[TdmaRadio], slots: int, noise_mw: float
    ) -> None:
        self._rules, self._phy, self._errors, self._radios = rules, phy, errors, radios
        self._slot_ns, self._guard_ns = seconds_to_ns(rules.slot_s), seconds_to_ns(rules.guard_s)
        self._period_ns = slots * self._slot_ns
        self._noise_mw = noise_mw
        self._preamble_snr = 10.0 ** (getattr(phy, "preamble_snr_db", -math.inf) / 10.0)
        self._events: list[tuple[int, _Kind, int, TdmaRadio, int]] = []  # heap: time, kind, number, radio, begin by its clock
        self._frames: dict[int, TdmaFrame] = {}  # by row of the sender: on the air
        self._ended: list[TdmaFrame] = []  # that may overlap one on the air
        self._offers: deque[Offered] = deque()
        self._running = 0
        self._decided: list[Decided] = []
        self.levels: Floats = np.zeros((len(radios), len(radios)))  # of acknowledgements, which there are none of
        self.sensitivity_mw: Floats = np.zeros(len(radios))

    def expect(self, frames: int) -> None:
        """Ignored: nothing is compiled."""

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; raises `ScenarioError` if it fits in no slot."""
        air_ns, room_ns = self._phy.air_time_ns(frame.size_bytes), self._slot_ns - 2 * self._guard_ns
        if air_ns > room_ns:
            problem = f"a frame of {frame.size_bytes} bytes takes {air_ns / 1e6:g} ms, and a slot has {room_ns / 1e6:g} ms"
            raise ScenarioError(f"{problem}: use longer slots, or shorter messages", key="radio.mac.slot_s")
        self._offers.append(frame)

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """Process all events and offers up to ``until_ns``."""
        events, offers = self._events, self._offers
        while True:
            event_ns = events[0][0] if events else until_ns + 1
            if offers and offers[0].time_ns < event_ns:
                if offers[0].time_ns > until_ns:
                    break
                self._enqueue(offers.popleft())
            elif event_ns <= until_ns:
                now_ns, kind, _, radio, begin_ns = heapq.heappop(events)
                if kind is _Kind.ENDED:
                    self._end(now_ns, radio)
                else:
                    self._begin(now_ns, radio, begin_ns)
            else:
                break
        decided, self._decided = self._decided, []
        return decided

    def next_ns(self) -> int | None:
        """Lower bound of the next decision; None: no frame has a slot to come."""
        times = [event[0] for event in self._events[:1]]
        return min([*times, *(frame.time_ns for frame in list(self._offers)[:1])], default=None)

    def _schedule(self, time_ns: int, kind: _Kind, radio: TdmaRadio, begin_ns: int = 0) -> None:
        self._running += 1
        heapq.heappush(self._events, (time_ns, kind, self._running, radio, begin_ns))

    def _enqueue(self, frame: Offered) -> None:
        radio, limit = self._radios[frame.sender], self._rules.queue_frames
        if limit is not None and len(radio.queue) + (radio.row in self._frames) >= limit:
            nothing = np.full(len(self._radios), np.nan)
            full = np.full(len(self._radios), Fate.QUEUE_FULL, np.uint8)
            self._decided.append(Decided(frame.number, -1, frame.time_ns, 0, full, nothing))
            return
        self._running += 1
        heapq.heappush(radio.queue, (-frame.priority, self._running, frame))
        if not radio.is_busy:
            self._await_slot(frame.time_ns, radio)

    def _await_slot(self, now_ns: int, radio: TdmaRadio) -> None:
        """Schedule the next slot of a radio; without slots its frames wait until the run ends."""
        radio.is_busy = bool(radio.slots)
        if not radio.slots:
            return
        own_ns = radio.clock.mean_ns(now_ns)
        offsets_ns = [slot * self._slot_ns + self._guard_ns for slot in radio.slots]
        begin_ns = min(offset - (offset - own_ns) // self._period_ns * self._period_ns for offset in offsets_ns)
        self._schedule(max(now_ns, radio.clock.time_ns(begin_ns)), _Kind.SLOT, radio, begin_ns)

    def _begin(self, now_ns: int, radio: TdmaRadio, begin_ns: int) -> None:
        if abs(radio.clock.mean_ns(now_ns) - begin_ns) > STEPPED_NS:
            self._await_slot(now_ns, radio)
            return
        frame = heapq.heappop(radio.queue)[2]
        power_mw, patience = frame.power_mw, frame.patience
        if power_mw is None or patience is None:
            power_mw, patience = frame.renew(0, now_ns)
        end_ns = now_ns + self._phy.air_time_ns(frame.size_bytes)
        self._frames[radio.row] = TdmaFrame(frame, now_ns, end_ns, power_mw, patience)
        self._schedule(end_ns, _Kind.ENDED, radio)

    def _end(self, now_ns: int, radio: TdmaRadio) -> None:
        ended = self._frames.pop(radio.row)
        self._decide(ended, [each for each in (*self._frames.values(), *self._ended) if each.overlaps(ended)])
        present = [each.start_ns for each in self._frames.values()]
        self._ended = [each for each in (*self._ended, ended) if present and each.end_ns > min(present)]
        if radio.queue:
            self._await_slot(now_ns, radio)
        else:
            radio.is_busy = False

    def _decide(self, frame: TdmaFrame, others: Sequence[TdmaFrame]) -> None:
        """Decide a frame, given all frames that overlap it."""
        if self._errors is None:
            fate, least_sinr = self._without_errors(frame, others)
        else:
            fate, least_sinr = self._with_errors(self._errors, frame, others)
        fate[frame.offered.sender] = Fate.TRANSMITTING
        self._decided.append(Decided(frame.offered.number, frame.start_ns, frame.end_ns, 1, fate, least_sinr))

    def _without_errors(self, frame: TdmaFrame, others: Sequence[TdmaFrame]) -> tuple[Codes, Floats]:
        """Fates, and no ratios, (n,) each: lost where another frame is noticed, too."""
        fate = np.full(len(self._radios), Fate.RECEIVED, np.uint8)
        for each in others:
            fate[each.power_mw >= self.sensitivity_mw] = Fate.COLLISION
        fate[[each.offered.sender for each in others]] = Fate.TRANSMITTING
        fate[frame.power_mw < self.sensitivity_mw] = Fate.UNDETECTED
        return fate, np.full(len(self._radios), np.nan)

    def _with_errors(self, model: ErrorRate, frame: TdmaFrame, others: Sequence[TdmaFrame]) -> tuple[Codes, Floats]:
        """Fates and least SINR, (n,) each."""
        errors, bits = model.payload(frame.offered.size_bytes)
        header, header_bits = model.header
        cuts = {min(max(time_ns, frame.start_ns), frame.end_ns) for each in others for time_ns in (each.start_ns, each.end_ns)}
        alone = frame.power_mw / self._noise_mw
        hazard, least_sinr, detected = np.zeros(len(alone)), alone, alone > 0.0
        for begin_ns, end_ns in pairwise(sorted(cuts | {frame.start_ns, frame.end_ns})):
            present = [each.power_mw for each in others if each.start_ns <= begin_ns and each.end_ns >= end_ns]
            sinr = frame.power_mw / (self._noise_mw + np.sum(present, axis=0))
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


@dataclass(frozen=True)
class Tdma:
    """Time division: each radio sends in its own slots, by the clock of its vehicle (`clock`).

    Args:
        slot_s: length of a slot: the time on the air of the longest frame, and twice the guard time, at least.
        schedule: vehicle of each slot in turn, "": none; default: a slot for each vehicle in the scenario's order. A vehicle
            without a slot never sends.
        guard_s: time without sending at the begin and at the end of a slot.
        queue_frames: maximum number of frames at a sender, with the frame on the air; None: no limit.
    """

    slot_s: Period
    schedule: tuple[str, ...] = ()
    guard_s: NonNegative = 0.0
    queue_frames: Many | None = None

    def __post_init__(self) -> None:
        if 2.0 * self.guard_s >= self.slot_s:
            raise ScenarioError(f"must be less than half of slot_s = {self.slot_s:g}, not {self.guard_s:g}", key="guard_s")

    def names(self) -> tuple[str, ...]:
        """Names in the schedule."""
        return tuple(name for name in self.schedule if name)

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The medium of ``count`` radios with a slot each, without names and clocks."""
        return self._medium(phy, [TdmaRadio(row, (row,), VehicleClock()) for row in range(count)], count, noise_mw)

    def open_named(self, phy: Phy, names: Sequence[str], clocks: Mapping[str, VehicleClock], noise_mw: float) -> Medium:
        """The medium of vehicles with the clocks of some of them."""
        schedule = self.schedule or tuple(names)
        radios = []
        for row, name in enumerate(names):
            slots = tuple(slot for slot, owner in enumerate(schedule) if owner == name)
            radios.append(TdmaRadio(row, slots, clocks.get(name, VehicleClock())))
        return self._medium(phy, radios, len(schedule), noise_mw)

    def _medium(self, phy: Phy, radios: Sequence[TdmaRadio], slots: int, noise_mw: float) -> Medium:
        return TdmaMedium(self, phy, getattr(phy, "errors", None), radios, slots, noise_mw)
