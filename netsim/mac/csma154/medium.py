"""Unslotted CSMA/CA of IEEE 802.15.4 as state machines of the radios over one event queue.

A frame waits ``U{0 .. 2^BE - 1}`` backoff units of 320 us, then its radio assesses the channel for 128 us. If the channel is
idle, the radio turns around for 192 us, deaf meanwhile, and sends; else BE is incremented and the frame waits again, or is
given up (IEEE 802.15.4-2006, 7.5.1.4; constants of 6.4.1 and 7.4.1 at 62500 symbols a second).

An acknowledgement is sent 192 us after its frame, without contention; its radio cancels its own backoff or wait for an
acknowledgement, and restarts it afterwards. After a frame, or its acknowledgement, the sender waits for an interframe space,
but not after a frame that it gave up. All this is as in ns-3.44.
"""

import heapq
import math
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.cosim.types import Decibels, Seconds
from vcmvsp.netsim.interfaces.layers import BACKOFF_SLOT, US, Floats, Keys, Phy
from vcmvsp.netsim.interfaces.medium import Codes, Decided, Fate, Medium, Offered
from vcmvsp.netsim.mac.csma154.receivers import AirborneFrame, Csma154Air
from vcmvsp.netsim.mac.event_medium import EventMedium, QueuedRadio
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors

TURNAROUND_NS = 192 * US  # aTurnaroundTime, 12 symbols
ACK_NS = 352 * US  # air time of an acknowledgement: 11 bytes
ACK_BITS = 88
ACK_WAIT_NS = 864 * US  # macAckWaitDuration, 54 symbols
SHORT_NS = 768 * US  # air time of a PSDU of 18 bytes (aMaxSIFSFrameSize)
SIFS_NS, LIFS_NS = 192 * US, 640 * US  # after a frame of at most `SHORT_NS`, and after a longer one
UNIT_NS = 320_000  # aUnitBackoffPeriod, 20 symbols
CCA_NS = 128_000  # 8 symbols

_BLOCK = 16  # contentions planned at once

Exponent = Annotated[int, msgspec.Meta(ge=0, le=16)]
Few = Annotated[int, msgspec.Meta(ge=0, le=28)]
Many = Annotated[int, msgspec.Meta(ge=1)]


class RadioState(Enum):
    """State of a radio."""

    NOTHING = auto()
    CONTENDING = auto()  # backoff and assessment
    SENDING = auto()  # turnaround included
    AWAITING = auto()  # an acknowledgement
    RESTING = auto()  # interframe space
    ANSWERING = auto()  # acknowledgement and both turnarounds


class Csma154Radio(QueuedRadio):
    """State machine of one radio: its queue, its current frame, and the progress of that frame."""

    def __init__(self, row: int, key: Keys, rules: "Csma154") -> None:
        super().__init__(row)
        self.doing = RadioState.NOTHING
        self.stamp = 0  # events of earlier stamps are cancelled
        self.ready_ns = 0  # end of the interframe space
        self.frame: Offered | None = None
        self.air_ns = 0  # of the frame
        self.assessments_ns: list[int] = []  # ends of all assessments that this contention may need
        self.found_busy = 0  # assessments that found the channel busy
        self.attempts = 0  # on the air
        self.flight: AirborneFrame | None = None  # on the air
        self.last: tuple[AirborneFrame, Codes] | None = None  # attempt, and its fate
        self.received_ns = -1  # time of reception of a unicast frame, of sending of a broadcast
        self.answers: tuple[int, int] | None = None  # row and frame that the radio acknowledges now
        self._key = key  # (1,)
        self._windows = 2.0 ** np.minimum(rules.min_be + np.arange(rules.max_backoffs + 1), rules.max_be)
        self._contentions = 0
        self._plans: list[list[int]] = []
        self._luck: list[list[float]] = []

    def plan(self) -> list[int]:
        """Plan a contention: end of each assessment if all before it find the channel busy, ns from now.

        Draw k is a pure function of the radio's key and k. Contention c owns draws c m to c m + m - 1, m = max_backoffs + 1.
        """
        place = self._contentions % _BLOCK
        if place == 0:
            shape = _BLOCK, len(self._windows)
            first = self._contentions * len(self._windows)
            draws = link_uniform(self._key, np.arange(first, first + shape[0] * shape[1], dtype=np.uint64), BACKOFF_SLOT)
            units = (draws[:, 0].reshape(shape) * self._windows).astype(np.int64)
            self._plans = np.cumsum(units * UNIT_NS + CCA_NS, axis=1).tolist()
            self._luck = draws[:, 1].reshape(shape).tolist()
        self._contentions += 1
        return self._plans[place]

    def luck(self) -> float:
        """Patience (`netsim.interfaces.medium.Offered`) of the acknowledgement of the last attempt."""
        return -math.log1p(-self._luck[(self._contentions - 1) % _BLOCK][0])


class _Kind(IntEnum):
    """Kinds of events, in their order within one nanosecond: as if with a small propagation delay."""

    ASSESSED = 0  # end of a clear channel assessment
    LANDED = 1  # end of a frame
    READY = 2  # end of an interframe space, or of the turnaround after an acknowledgement
    UNANSWERED = 3  # acknowledgement timeout
    TOOK_OFF = 4  # start of a frame


class Csma154Medium(EventMedium[_Kind, Csma154Radio]):
    """The `netsim.interfaces.medium.Medium`: an event queue over the radios' state machines."""

    def __init__(self, rules: "Csma154", air: Csma154Air, phy: Phy, errors: ErrorRate, keys: Keys) -> None:
        super().__init__([Csma154Radio(row, keys[row : row + 1], rules) for row in range(len(keys))], rules.queue_frames)
        self._rules, self._air, self._phy, self._errors = rules, air, phy, errors
        self._lifetime_ns = math.inf if rules.lifetime_s is None else seconds_to_ns(rules.lifetime_s)
        self._handlers = {
            _Kind.ASSESSED: self._assessed,
            _Kind.LANDED: self._landed,
            _Kind.READY: self._ready,
            _Kind.UNANSWERED: self._unanswered,
        }
        self._waiting: dict[int, None] = {}  # numbers of frames, in the order in which they were offered
        self._soonest: dict[int, int] = {}  # by row: earliest decision of its frame
        # Levels between radios, (n, n), as far as known from frames: for acknowledgements at third radios.
        self._levels = np.zeros((len(keys), len(keys)) if rules.acknowledge else (0, 0))
        self.power_mw: Floats = np.ones(len(keys))  # of the radios; equal unless set

    # Interface

    def offer(self, frame: Offered) -> None:
        """Hand over a frame."""
        super().offer(frame)
        self._waiting[frame.number] = None

    def next_ns(self) -> int | None:
        """Lower bound of the next decision; a busy channel may delay it. None: no frame waits."""
        if not self._waiting:
            return None
        soonest = min(self._soonest.values(), default=None)
        if self._offers:
            offered_ns = self._offers[0].time_ns
            return offered_ns if soonest is None else min(soonest, offered_ns)
        return soonest

    # Events

    def _happen(self) -> None:
        now_ns, kind, _, radio, stamp = heapq.heappop(self._events)
        if kind is _Kind.TOOK_OFF:
            radios = [radio]
            while self._events and self._events[0][:2] == (now_ns, kind):
                radios.append(heapq.heappop(self._events)[3])
            self._take_off(now_ns, radios)
        elif stamp == radio.stamp:
            self._handlers[kind](now_ns, radio)

    def _schedule(self, time_ns: int, kind: _Kind, radio: Csma154Radio) -> None:
        self._running += 1
        heapq.heappush(self._events, (time_ns, kind, self._running, radio, radio.stamp))

    def _enqueue(self, frame: Offered) -> None:
        radio, now_ns = self._radios[frame.sender], frame.time_ns
        if not self._admit(frame, sends=radio.frame is not None):
            return
        if radio.doing is RadioState.NOTHING:
            self._next(now_ns, radio)
        elif radio.frame is None:  # still in the interframe space
            self._soonest[radio.row] = max(radio.ready_ns, now_ns)

    def _next(self, now_ns: int, radio: Csma154Radio) -> None:
        while radio.queue:
            frame = heapq.heappop(radio.queue)[2]
            if now_ns - frame.time_ns > self._lifetime_ns:
                self._refuse(frame, now_ns, Fate.EXPIRED)
                continue
            radio.frame, radio.air_ns = frame, self._phy.air_time_ns(frame.size_bytes)
            radio.attempts, radio.last, radio.received_ns = 0, None, -1
            self._contend(now_ns, radio)
            return
        radio.frame, radio.doing = None, RadioState.NOTHING
        self._soonest.pop(radio.row, None)

    def _contend(self, now_ns: int, radio: Csma154Radio) -> None:
        radio.doing, radio.found_busy = RadioState.CONTENDING, 0
        radio.assessments_ns = [now_ns + after_ns for after_ns in radio.plan()]
        self._assess(radio)

    def _assess(self, radio: Csma154Radio) -> None:
        assessed_ns = radio.assessments_ns[radio.found_busy]
        self._soonest[radio.row] = min(assessed_ns + TURNAROUND_NS + radio.air_ns, radio.assessments_ns[-1])
        self._schedule(assessed_ns, _Kind.ASSESSED, radio)

    def _assessed(self, now_ns: int, radio: Csma154Radio) -> None:
        if not self._air.busy(radio.row):
            start_ns = now_ns + TURNAROUND_NS
            radio.doing = RadioState.SENDING
            self._soonest[radio.row] = start_ns + radio.air_ns
            self._air.deafen(radio.row, start_ns + radio.air_ns + TURNAROUND_NS)
            self._schedule(start_ns, _Kind.TOOK_OFF, radio)
            return
        radio.found_busy += 1
        if radio.found_busy < len(radio.assessments_ns):
            self._assess(radio)
        else:
            self._give_up(now_ns, radio)
            self._next(now_ns, radio)

    def _take_off(self, now_ns: int, radios: list[Csma154Radio]) -> None:
        for radio in radios:
            radio.flight = self._answer(now_ns, radio) if radio.answers is not None else self._attempt(now_ns, radio)
            self._schedule(radio.flight.end_ns, _Kind.LANDED, radio)
        self._air.begin(now_ns, [radio.flight for radio in radios if radio.flight is not None])

    def _attempt(self, now_ns: int, radio: Csma154Radio) -> AirborneFrame:
        frame = radio.frame
        assert frame is not None  # noqa: S101 -- it is at one
        power_mw, patience = frame.power_mw, frame.patience
        if radio.attempts or power_mw is None or patience is None:
            power_mw, patience = frame.renew(radio.attempts, now_ns)
        radio.attempts += 1
        _, bits = self._errors.payload(frame.size_bytes)
        flight = AirborneFrame(radio.row, now_ns, now_ns + radio.air_ns, power_mw, patience, bits)
        if self._rules.acknowledge:  # paths are the same in both directions
            self._levels[radio.row] = flight.power_mw
            self._levels[:, radio.row] = flight.power_mw * (self.power_mw / self.power_mw[radio.row])
        return flight

    def _answer(self, now_ns: int, radio: Csma154Radio) -> AirborneFrame:
        assert radio.answers is not None  # noqa: S101 -- it does answer
        sender, power_mw = self._radios[radio.answers[0]], self._levels[radio.row].copy()
        if sender.frame is not None and sender.frame.number == radio.answers[1] and sender.frame.answer is not None:
            power_mw[sender.row] *= sender.frame.answer(now_ns)
        luck = np.full(len(self._radios), sender.luck())
        return AirborneFrame(radio.row, now_ns, now_ns + ACK_NS, power_mw, luck, ACK_BITS)

    def _landed(self, now_ns: int, radio: Csma154Radio) -> None:
        flight = radio.flight
        assert flight is not None  # noqa: S101 -- it has been on the air
        fate = self._air.end(now_ns, flight)
        if radio.answers is not None:
            row, number = radio.answers
            self._answered(now_ns, radio, self._radios[row], number, heard=fate[row] == Fate.RECEIVED)
            return
        frame = radio.frame
        assert frame is not None  # noqa: S101 -- it has just been sent
        radio.last = flight, fate
        received = frame.to >= 0 and fate[frame.to] == Fate.RECEIVED
        if frame.to < 0 or (received and radio.received_ns < 0):
            radio.received_ns = now_ns
            self._decide(Decided(frame.number, flight.start_ns, now_ns, radio.attempts, fate, flight.least_sinr))
        if frame.to < 0 or not self._rules.acknowledge:
            self._finish(now_ns, radio)
            return
        radio.doing = RadioState.AWAITING
        self._schedule(now_ns + ACK_WAIT_NS, _Kind.UNANSWERED, radio)
        self._soonest[radio.row] = now_ns + (TURNAROUND_NS + ACK_NS if received else ACK_WAIT_NS)
        if received:
            self._acknowledge(now_ns, self._radios[frame.to], radio)

    def _finish(self, now_ns: int, radio: Csma154Radio) -> None:
        ifs_ns = SIFS_NS if radio.air_ns <= SHORT_NS else LIFS_NS
        self._give_up(now_ns, radio)
        self._rest(radio, now_ns + ifs_ns)

    def _rest(self, radio: Csma154Radio, until_ns: int) -> None:
        radio.doing, radio.ready_ns = RadioState.RESTING, until_ns
        self._schedule(until_ns, _Kind.READY, radio)
        if radio.queue or radio.frame is not None:
            self._soonest[radio.row] = until_ns

    def _ready(self, now_ns: int, radio: Csma154Radio) -> None:
        if radio.frame is None:
            self._next(now_ns, radio)
        else:
            self._contend(now_ns, radio)

    # Acknowledgements

    def _acknowledge(self, now_ns: int, radio: Csma154Radio, sender: Csma154Radio) -> None:
        """Interrupt the radio's contention or wait, and acknowledge; its own frame starts over afterwards."""
        if radio.doing is RadioState.AWAITING and radio.attempts > self._rules.max_retries:
            self._give_up(now_ns, radio)
        assert sender.frame is not None  # noqa: S101 -- it has just been received
        radio.stamp += 1
        radio.doing, radio.answers = RadioState.ANSWERING, (sender.row, sender.frame.number)
        start_ns = now_ns + TURNAROUND_NS
        self._air.deafen(radio.row, start_ns + ACK_NS + TURNAROUND_NS)
        self._schedule(start_ns, _Kind.TOOK_OFF, radio)
        radio.ready_ns = max(radio.ready_ns, start_ns + ACK_NS + TURNAROUND_NS)
        if radio.queue or radio.frame is not None:
            self._soonest[radio.row] = radio.ready_ns

    def _answered(self, now_ns: int, radio: Csma154Radio, sender: Csma154Radio, number: int, *, heard: bool) -> None:
        radio.answers = None
        self._rest(radio, radio.ready_ns)
        if sender.doing is RadioState.AWAITING and sender.frame is not None and sender.frame.number == number:
            if heard:
                sender.stamp += 1
                self._finish(now_ns, sender)
            else:
                self._soonest[sender.row] = now_ns - ACK_NS - TURNAROUND_NS + ACK_WAIT_NS

    def _unanswered(self, now_ns: int, radio: Csma154Radio) -> None:
        if radio.attempts <= self._rules.max_retries:
            self._contend(now_ns, radio)
        else:
            self._give_up(now_ns, radio)
            self._next(now_ns, radio)

    # Decisions

    def _give_up(self, now_ns: int, radio: Csma154Radio) -> None:
        """End the radio's frame: decide it by the fate of its last attempt, unless it was received before."""
        frame, last = radio.frame, radio.last
        assert frame is not None  # noqa: S101 -- it is at one
        radio.frame = None
        self._soonest.pop(radio.row, None)
        if last is None:
            self._refuse(frame, now_ns, Fate.BUSY_CHANNEL)
        elif radio.received_ns < 0:
            flight, fate = last
            self._decide(Decided(frame.number, flight.start_ns, now_ns, radio.attempts, fate, flight.least_sinr))

    def _decide(self, decided: Decided) -> None:
        super()._decide(decided)
        del self._waiting[decided.number]


@dataclass(frozen=True)
class Csma154:
    """Unslotted CSMA/CA of IEEE 802.15.4 at 2.4 GHz, as ns-3.44 ``LrWpanMac`` and ``LrWpanPhy``.

    The sensitivity is not a threshold of reception: it sets the noise (`ThermalNoise.ieee802154`). A message of several
    frames contends once, and is received or lost as a whole.

    Args:
        min_be: exponent of the first backoff (macMinBE).
        max_be: exponent of the longest backoff (macMaxBE).
        max_backoffs: a frame is dropped when the channel was busy more often than this (macMaxCSMABackoffs).
        acknowledge: unicast frames are acknowledged, and repeated without an acknowledgement.
        max_retries: maximum number of retries (macMaxFrameRetries).
        queue_frames: maximum number of frames at a sender, with the frame on the air; None: no limit.
        lifetime_s: longest time of a frame in the queue; older frames are dropped; None: no limit.
        cca_above_sensitivity_db: total level of all frames, above the phy's sensitivity, at which the channel is busy; it is
            also busy for a radio that is receiving a frame.
        preamble_snr_db: least ratio to noise and interference at which a frame is noticed.
        forget_interference: interference that ends before another frame begins or this one ends has no effect, as in
            ns-3.44; false: it has.
    """

    min_be: Exponent = 3
    max_be: Exponent = 5
    max_backoffs: Few = 4
    acknowledge: bool = True
    max_retries: Few = 3
    queue_frames: Many | None = None
    lifetime_s: Seconds | None = None
    cca_above_sensitivity_db: Decibels = 10.0
    preamble_snr_db: Decibels = -5.0
    forget_interference: bool = True

    def __post_init__(self) -> None:
        if self.min_be > self.max_be:
            raise ScenarioError(f"must not be more than max_be = {self.max_be}, not {self.min_be}", key="min_be")

    @property
    def needs_snr_db(self) -> float:
        """Least SINR at which a frame is detected, dB, independent of the phy's sensitivity."""
        return self.preamble_snr_db

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The medium of ``count`` radios.

        Args:
            phy: `netsim.phy.ieee802154.Ieee802154`.
            count: n.
            keys: random keys of the radios, (n,): a backoff is a pure function of its radio's key and of its number.
            noise_mw: at every receiver.
        """
        errors = getattr(phy, "errors", None)
        if not isinstance(errors, OqpskErrors):
            raise ScenarioError(
                f"csma154 is the medium access of IEEE 802.15.4 and needs phy ieee802154, not {type(phy).__name__}", key="kind"
            )
        air = Csma154Air(
            count,
            noise_mw,
            errors,
            preamble_snr_db=self.preamble_snr_db,
            busy_dbm=phy.sensitivity_dbm + self.cca_above_sensitivity_db,
            forgetful=self.forget_interference,
        )
        return Csma154Medium(self, air, phy, errors, keys)
