"""Medium of IEEE 802.11: takes offered frames, and returns decisions.

The events are simulated by `netsim.mac.dcf.access`, on arrays; this module assigns frames to places in the arrays, and collects
decided frames.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.compiled.machine_code import LOAD_S, Core, available
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.interfaces.layers import BACKOFF_SLOT, Floats, Ints, Keys
from vcmvsp.netsim.interfaces.medium import Answer, Decided, DecidedFrames, Offered, Renew
from vcmvsp.netsim.mac.dcf import access, capture
from vcmvsp.netsim.mac.dcf.access import DRAWS, LEVELS, OUTPUT
from vcmvsp.netsim.mac.dcf.state import (
    ARRIVED,
    DECIDED,
    DECISION,
    EXPIRED,
    NEVER,
    NOBODY,
    OFFERED,
    SCARCE,
    SHAPES,
    SOONEST,
    WANTED,
    DcfRules,
    new_state,
)
from vcmvsp.netsim.phy import error_rate
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.error_rate import ErrorRate
from vcmvsp.netsim.phy.ofdm import Ofdm

FRAME_S = 1e-4  # CPU time of a frame of up to `FEW` radios, interpreted
FEW = 50
COMPILE_AFTER_S = 0.5  # CPU time of interpreted frames from which compiling pays, once for each computer
PER_FRAME = tuple(name for name, shape in SHAPES.items() if shape[0] == "c")
PER_SIZE = tuple(name for name, shape in SHAPES.items() if shape[0] == "z")
CORE = error_rate, capture, access


class Rate(NamedTuple):
    """A rate of unicast frames, and its acknowledgements."""

    phy: Dsss | Ofdm
    least_snr: float  # above which rate control takes it; a ratio of powers
    ack_air_ns: int
    ack_bits_per_ns: float
    ack_curve: ErrorRate


class DcfMedium:
    """The shared medium of n radios, and their queues.

    Args:
        rules: constants of the contention.
        rates: of unicast frames: the phy's, or, with rate control, all rising.
        phy: air times and bits of other frames.
        keys: (n,) random keys of the radios.
        curves: error rates of headers and of acknowledgements.
        sensitivity_mw: the weakest level that is detected.
        longest_bytes: longest payload without RTS/CTS; None: no frame has RTS/CTS.
        compile_core: whether to use compiled code; None: for many frames, if available.

    Attributes:
        levels: of acknowledgements, (n, n) mW, sender by row, may be set; default: the levels of the sender's last frame.
        sensitivity_mw: weakest level that each radio detects, (n,); default: the phy's.
        power_mw: transmitted power of each radio, (n,), for the levels of acknowledgements; equal unless set.
    """

    def __init__(
        self,
        rules: DcfRules,
        rates: Sequence[Rate],
        phy: Dsss | Ofdm,
        keys: Keys,
        curves: tuple[ErrorRate, ErrorRate],
        sensitivity_mw: float,
        *,
        longest_bytes: int | None = None,
        compile_core: bool | None = None,
    ) -> None:
        self._longest_bytes = longest_bytes
        self._phy, self._keys, self._rules, count = phy, keys, rules, len(keys)
        self._frame_s = FRAME_S * max(1.0, count / FEW)
        self._done, self._faster_at_s = 0, LOAD_S if compile_core is None and available() else None
        self._curves = list(curves)  # of the rows of `DcfState.tables`
        self._rates = rates
        self._state = new_state(rules, count, sensitivity_mw, np.stack([each.table for each in curves]), len(rates))
        self.levels: Floats = self._state.heard
        self.sensitivity_mw: Floats = self._state.sensitivity_mw
        self.power_mw: Floats = self._state.power_mw
        for k, rate in enumerate(rates):
            row = self._row_of(rate.ack_curve)
            self._state.least_snr[k], self._state.ack_curve[k] = rate.least_snr, row
            self._state.ack_air_ns[k], self._state.ack_bits_per_ns[k] = rate.ack_air_ns, rate.ack_bits_per_ns
        self._free = list(range(len(self._state.behind)))[::-1]  # places of frames, the lowest last
        self._number = np.zeros(len(self._state.behind), np.int64)  # of the frame at each place
        self._renew: dict[int, tuple[Renew, Answer | None]] = {}  # by their places
        self._undecided = 0
        self._sizes: dict[int, tuple[int, int, int, int]] = {}  # air time, bits, curve of frames, row of the size
        self._decided: list[DecidedFrames] = []  # not returned yet
        self._draw()
        self._state.slots[:] = (self._state.backoff[:, 0] * (rules.cw_min + 1)).astype(np.int64)
        self._state.over_ns[:] = rules.difs_ns + self._state.slots * rules.slot_ns
        self._state.drawn[:] = 1
        self._core = Core(CORE, self._state, self._rules)
        self._run = self._core.interpreted
        seen = self._faster_at_s is not None and self._core.is_loaded  # by an earlier run
        if (compile_core or seen) and count:
            self._run, self._faster_at_s = self._core.compiled, None

    def expect(self, frames: int) -> None:
        """Hint of the expected number of frames; decides now whether to compile."""
        if self._faster_at_s is not None:
            self._go_faster(self._frame_s * frames)
        self._faster_at_s = None

    def foresee(self, frames: int) -> None:
        """Hint of the number of further frames; loads compiled code if that pays."""
        work_s = self._frame_s * frames
        if self._faster_at_s is not None and work_s >= LOAD_S:
            self._go_faster(min(work_s, 0.99 * COMPILE_AFTER_S))

    # --- offers ---

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; nothing happens yet."""
        (place,) = self._take(1)
        known = frame.power_mw is not None and frame.patience is not None
        if known:
            self._state.levels[place], self._state.patiences[place] = frame.power_mw, frame.patience
        self._renew[place] = frame.renew, frame.answer
        self._put(place, frame.number, frame.time_ns, frame.sender, frame.size_bytes, known=known)
        self._state.to[place], self._state.priority[place] = frame.to, frame.priority
        self._arrive(place, 1, frame.time_ns)

    def offer_many(
        self, time_ns: Ints, sender: Ints, size_bytes: int, power_mw: Floats, patience: Floats, numbers: Ints
    ) -> None:
        """Hand over k broadcast frames of one size.

        Args:
            time_ns: (k,) times of the offers, never decreasing.
            sender: (k,) rows.
            size_bytes: payload.
            power_mw: (n, n) level of every sender (row) at every radio.
            patience: (k, n), see `Offered`.
            numbers: (k,) of the frames in `Decided`.
        """
        if not len(sender):
            return
        places = np.array(self._take(len(sender)))
        self._state.levels[places], self._state.patiences[places] = power_mw[sender], patience
        self._put(places, numbers, time_ns, sender, size_bytes, known=True)
        self._state.to[places], self._state.priority[places] = NOBODY, 0
        self._arrive(places, len(places), int(time_ns[0]))

    def _put(
        self, places: Ints | int, number: Ints | int, time_ns: Ints | int, sender: Ints | int, size_bytes: int, *, known: bool
    ) -> None:
        if size_bytes not in self._sizes:
            curve, bits = self._phy.errors.payload(size_bytes)
            row = self._put_size(size_bytes, len(self._sizes))
            self._sizes[size_bytes] = self._phy.air_time_ns(size_bytes), bits, self._row_of(curve), row
        s = self._state
        s.air_ns[places], s.frame_bits[places], s.frame_curve[places], s.frame_size[places] = self._sizes[size_bytes]
        s.sender[places], s.offered_ns[places], s.known[places], self._number[places] = sender, time_ns, known, number
        s.attempts[places], s.began_ns[places], s.told[places] = 0, -1, False
        s.protected[places] = self._longest_bytes is not None and size_bytes > self._longest_bytes
        s.outcome[places], s.least_there[places] = EXPIRED, np.nan

    def _put_size(self, size_bytes: int, row: int) -> int:
        """Add a size of frames at all rates; returns its row."""
        if not self._rules.rate_control:
            return 0
        if row == len(self._state.size_bits):
            s = self._state
            self._state = s._replace(**{name: np.concatenate([getattr(s, name)] * 2) for name in PER_SIZE})
        for k, rate in enumerate(self._rates):
            curve, bits = rate.phy.errors.payload(size_bytes)
            place = self._row_of(curve)
            self._state.size_air_ns[row, k] = rate.phy.air_time_ns(size_bytes)
            self._state.size_bits[row, k], self._state.size_curve[row, k] = bits, place
        return row

    def _row_of(self, curve: ErrorRate) -> int:
        if curve not in self._curves:
            self._curves.append(curve)
            self._state = self._state._replace(tables=np.vstack((self._state.tables, curve.table)))
        return self._curves.index(curve)

    def _arrive(self, places: Ints | int, count: int, time_ns: int) -> None:
        """Schedule arrivals of frames at their queues; ``time_ns``: of the first."""
        s = self._state
        arrived, offered = int(s.counts[ARRIVED]), int(s.counts[OFFERED])
        if offered + count > len(s.arrivals):  # move pending arrivals to the front; grow unless half is free then
            coming = s.arrivals[arrived:offered].copy()
            arrived, offered = 0, len(coming)
            if 2 * (offered + count) > len(s.arrivals):
                s = self._state = s._replace(arrivals=np.full(4 * (offered + count), NOBODY))
            s.arrivals[:offered] = coming
        s.arrivals[offered : offered + count] = places
        s.counts[ARRIVED], s.counts[OFFERED] = arrived, offered + count
        s.counts[SOONEST] = min(int(s.counts[SOONEST]), time_ns)
        self._undecided += count

    def _take(self, count: int) -> list[int]:
        while len(self._free) < count:
            s, places = self._state, len(self._state.behind)
            self._state = s._replace(**{name: np.concatenate([getattr(s, name)] * 2) for name in PER_FRAME})
            self._number = np.concatenate([self._number] * 2)
            self._free += range(2 * places - 1, places - 1, -1)
        taken = self._free[-count:]
        del self._free[-count:]
        return taken

    # --- decisions ---

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """All decisions up to ``until_ns``, in order of time."""
        return [each for batch in self.advance_many(until_ns) for each in batch.frames()]

    def advance_many(self, until_ns: int) -> Sequence[DecidedFrames]:
        """`advance`, as arrays."""
        self._work_off(until_ns)
        decided, self._decided = self._decided, []
        return decided

    def _work_off(self, until_ns: int) -> None:
        if until_ns < self._state.counts[SOONEST]:
            return
        if self._faster_at_s is not None and (work_s := self._frame_s * (self._done + self._undecided)) >= self._faster_at_s:
            self._go_faster(work_s)
        while code := self._run(self._state, self._rules, until_ns):
            if code == LEVELS:
                self._ask()
            elif code == DRAWS:
                self._draw()
            elif code == OUTPUT:
                self._collect()
        self._collect()

    def _ask(self) -> None:
        s = self._state
        place = int(s.counts[WANTED])
        i, (renew, answer) = int(s.sender[place]), self._renew[place]
        s.level[i], s.patience[i] = renew(int(s.attempts[place]), int(s.due[i]))
        s.answer[i] = 1.0 if answer is None else answer(int(s.due[i] + s.air_ns[place]) + self._rules.sifs_ns)
        s.placed[i] = place

    def _draw(self) -> None:
        s = self._state
        s.store[:] = s.drawn
        numbers = s.drawn[:, None] + np.arange(self._rules.draws)
        uniform = link_uniform(self._keys[:, None], numbers.astype(np.uint64), BACKOFF_SLOT)
        s.backoff[:] = uniform[..., 0]
        s.doubt[:] = -np.log1p(-uniform[..., 1])
        s.counts[SCARCE] = 0

    def _collect(self) -> None:
        """Collect decisions, and free the places of finished frames."""
        s = self._state
        count = int(s.counts[DECIDED])
        if not count:
            return
        s.counts[DECIDED] = 0
        which: Any = slice(count)
        if NEVER in s.out_end[:count].tolist():  # output before
            which = (s.out_end[:count] != NEVER).nonzero()[0]
        columns = (s.out_start, s.out_end, s.out_attempts, s.out_fate, s.out_least)
        batch = DecidedFrames(self._number[s.out_frame[which]], *(column[which].copy() for column in columns))
        if len(batch.number):
            self._decided.append(batch)
            self._undecided -= len(batch.number)
        freed = s.out_frame[:count][s.out_done[:count]].tolist()
        self._free += freed
        for place in freed if self._renew else ():
            self._renew.pop(place, None)
        self._done += count

    def _go_faster(self, work_s: float) -> None:
        """Switch to compiled code if that pays for this CPU time of interpreted frames, else check again later."""
        self._run = self._core.chosen(work_s, COMPILE_AFTER_S)
        self._faster_at_s = None if self._core.is_loaded else COMPILE_AFTER_S

    # --- forecast ---

    def next_ns(self) -> int | None:
        """Earliest time of the next decision if no other frame is offered; None: no frame waits or is on the air.

        The decision is later if the next frame has to wait for one that is just starting, or if a unicast frame needs a retry.
        """
        s = self._state
        if s.counts[ARRIVED] < s.counts[OFFERED]:  # frames offered later arrive later
            self._work_off(int(s.offered_ns[s.arrivals[s.counts[OFFERED] - 1]]))
        if self._decided:
            return int(self._decided[0].end_ns[0])
        return int(s.counts[DECISION]) if self._undecided else None
