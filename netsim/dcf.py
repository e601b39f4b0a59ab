"""IEEE 802.11 contention: the distributed coordination function, matched to ns-3.44."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from cosim.clock import SECOND_NS
from cosim.errors import ScenarioError
from cosim.rng import link_uniform
from cosim.types import Count, NonNegative, Positive
from netsim import compiled, dcf_core
from netsim.dcf_core import DRAWS, LEVELS, OUTPUT
from netsim.dcf_state import (
    ARRIVED,
    DECIDED,
    EXPIRED,
    NEVER,
    NOBODY,
    OFFERED,
    ON_AIR,
    SCARCE,
    SOONEST,
    WANTED,
    Rules,
    State,
    new_state,
)
from netsim.draws import BACKOFF_SLOT
from netsim.hazard import hazard_table
from netsim.layers import Floats, Keys, Phy
from netsim.medium import Decided, Medium, Offered
from netsim.phy import US, Dsss
from netsim.phy_ofdm import Ofdm

DRAWS_IN_STORE = 64
COMPILE_AFTER = 5000  # frames: what they take in NumPy is what compiled code takes to be loaded
ACK_BYTES = 14 - 36  # its PSDU, as a payload that has the headers of data
PER_FRAME = (
    *("behind", "sender", "to", "priority", "offered_ns", "air_ns", "frame_bits", "attempts", "row"),
    *("began_ns", "told", "outcome", "least_there"),
)
CORE = ("netsim.hazard", "netsim.dcf_air", "netsim.dcf_queue", "netsim.dcf_core")


class Standard(NamedTuple):
    """What a standard fixes (IEEE 802.11-2016, tables 15-5, 16-4, 17-21)."""

    slot_us: float
    sifs_us: float
    cw_min: int
    preamble_us: int
    header_us: int
    faintest_dbm: float  # ns-3.44 WifiPhy::RxSensitivity, over the standard's bandwidth
    ack_rates_bps: tuple[float, ...]
    lowest_ack_us: int  # at the lowest rate of the band


B = Standard(20.0, 10.0, 31, 144, 48, -101.0 + 10.0 * math.log10(22.0 / 20.0), (1e6, 2e6, 5.5e6, 11e6), 304)
G = Standard(20.0, 10.0, 15, 16, 4, -101.0, (6e6, 12e6, 24e6), 304)
A = Standard(9.0, 16.0, 15, 16, 4, -101.0, (6e6, 12e6, 24e6), 44)


@dataclass(frozen=True)
class Dcf:
    """Radios share the air as IEEE 802.11 says: they listen before they send, back off, and collide.

    The phy says which standard it is: `netsim.phy.Dsss` is 802.11b, `netsim.phy_ofdm.Ofdm` 802.11a at 5 GHz and g at 2.4 GHz
    (ad hoc, no protection, long slots). None takes the standard's value. All defaults are those of ns-3.44.
    """

    slot_us: Positive | None = None  # unit of backoffs; None: the standard's
    sifs_us: Positive | None = None  # from a frame to its acknowledgement; None: the standard's
    cw_min: Count | None = None  # a backoff is 0 to this many slots; None: the standard's
    cw_max: Count = 1023  # the same at most, after failures
    cca_threshold_dbm: float = -82.0  # sum of powers at which the medium is busy
    energy_threshold_dbm: float = -62.0  # the same, for a radio that has not heard the frames begin
    preamble_time_us: Positive = 4.0  # from the start of a frame until it is noticed
    capture_margin_db: NonNegative | None = None  # a later frame so much stronger takes the receiver over; None: none does
    capture_window_us: Positive = 16.0  # within this time from when the first was noticed
    queue_frames: Count = 500  # that may wait at a sender
    lifetime_s: Positive = 0.5  # of a frame in the queue
    attempts: Count = 7  # to send a unicast frame

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The air for ``count`` radios whose random keys are (count,): backoff k of a radio depends on its key and k alone."""
        return DcfMedium(self, phy, count, keys, noise_mw)

    def standard(self, phy: Phy) -> Standard:
        """Of a phy."""
        if isinstance(phy, Dsss):
            return B
        if isinstance(phy, Ofdm):
            return A if phy.band == "5GHz" else G
        raise ScenarioError(
            f"dcf is IEEE 802.11: it goes with the phys dsss and ofdm, not with {type(phy).__name__}", key="mac"
        )

    def rules(self, phy: Any, noise_mw: float) -> Rules:
        """Everything in nanoseconds, milliwatts and ratios."""
        standard = self.standard(phy)
        slot_ns = round((self.slot_us or standard.slot_us) * US)
        sifs_ns = round((self.sifs_us or standard.sifs_us) * US)
        header_end_ns = (standard.preamble_us + standard.header_us) * US
        control = ack_phy(phy, standard)
        ack_air_ns = control.air_time_ns(ACK_BYTES)
        return Rules(
            slot_ns=slot_ns,
            sifs_ns=sifs_ns,
            difs_ns=sifs_ns + 2 * slot_ns,
            eifs_ns=sifs_ns + standard.lowest_ack_us * US,
            detect_ns=round(self.preamble_time_us * US),
            preamble_ns=standard.preamble_us * US,
            header_end_ns=header_end_ns,
            header_bits_per_ns=phy.errors.header[1] / (standard.header_us * US),
            cw_min=standard.cw_min if self.cw_min is None else self.cw_min,
            cw_max=self.cw_max,
            queue_frames=self.queue_frames,
            lifetime_ns=round(self.lifetime_s * SECOND_NS),
            attempts=self.attempts,
            ack_air_ns=ack_air_ns,
            ack_bits_per_ns=control.errors.payload_bits(ACK_BYTES) / (ack_air_ns - header_end_ns),
            timeout_ns=sifs_ns + slot_ns + header_end_ns,
            noise_mw=noise_mw,
            busy_mw=milliwatts(self.cca_threshold_dbm),
            energy_mw=milliwatts(self.energy_threshold_dbm),
            faintest_mw=milliwatts(standard.faintest_dbm),
            preamble_snr=10.0 ** (phy.preamble_snr_db / 10.0),
            capture=10.0 ** ((self.capture_margin_db or 0.0) / 10.0),
            capture_ns=0 if self.capture_margin_db is None else round(self.capture_window_us * US),
            draws=DRAWS_IN_STORE,
        )


def ack_phy(phy: Any, standard: Standard) -> Any:
    """The phy at the rate of acknowledgements: the highest mandatory one that is not above that of the data."""
    rate = max(each for each in standard.ack_rates_bps if each <= phy.rate_bps)
    return replace(phy, rate_bps=rate)


def milliwatts(dbm: float) -> float:
    """Of a power in dBm."""
    return float(10.0 ** (dbm / 10.0))


class DcfMedium:
    """The air that n radios share, and their queues.

    ``levels`` (n, n) may be set from outside: at what level, mW, each radio (row) is heard by each other (column) when it
    acknowledges. Otherwise it is as strong as what it sent last.
    """

    def __init__(
        self, mac: Dcf, phy: Any, count: int, keys: Keys, noise_mw: float, *, compile_core: bool | None = None
    ) -> None:
        self._phy, self._keys = phy, keys
        self._rules = rules = mac.rules(phy, noise_mw)
        self._run = dcf_core.run
        self._compile_after = COMPILE_AFTER if compile_core is None and compiled.available() else None  # so many frames
        if compile_core and count:
            self._run = compiled.compiled(CORE, "run")
        control = ack_phy(phy, mac.standard(phy))
        errors = (phy.errors, phy.errors.header[0], control.errors)
        tables = np.stack([hazard_table(each) for each in errors])
        self._state = new_state(rules, count, milliwatts(phy.sensitivity_dbm), tables)
        self._free = list(range(len(self._state.behind)))[::-1]
        self._free_rows = list(range(len(self._state.levels)))[::-1]
        self._frames: dict[int, Offered] = {}  # by their places
        self._waiting: dict[int, None] = {}  # numbers of those that are not decided
        self._sizes: dict[int, tuple[int, int]] = {}
        self._decided: list[Decided] = []  # and not yet handed out
        self._draw()
        self._state.slots[:] = (self._state.backoff[:, 0] * (rules.cw_min + 1)).astype(np.int64)
        self._state.drawn[:] = 1

    @property
    def levels(self) -> Floats:
        """Levels of acknowledgements, (n, n) mW."""
        return self._state.heard

    @property
    def sensitivity_mw(self) -> Floats:
        """The weakest level that each radio notices, (n,): as the phy says, unless set."""
        return self._state.sensitivity_mw

    def expect(self, frames: int) -> None:
        """About so many frames will be offered: for many the core is compiled at once."""
        if self._compile_after is not None and frames >= COMPILE_AFTER:
            self._compile()

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; nothing happens yet."""
        if not self._free:
            self._more_frames()
        place = self._free.pop()
        self._frames[place] = frame
        self._waiting[frame.number] = None
        s, i = self._state, frame.sender
        if frame.size_bytes not in self._sizes:
            size = frame.size_bytes
            self._sizes[size] = self._phy.air_time_ns(size), self._phy.errors.payload_bits(size)
        s.air_ns[place], s.frame_bits[place] = self._sizes[frame.size_bytes]
        s.sender[place], s.to[place], s.priority[place], s.offered_ns[place] = i, frame.to, frame.priority, frame.time_ns
        s.attempts[place], s.began_ns[place], s.told[place] = 0, -1, False
        s.outcome[place], s.least_there[place] = EXPIRED, np.nan
        s.row[place] = self._keep(frame) if frame.power_mw is not None and frame.patience is not None else NOBODY
        self._arrive(place)

    def _keep(self, frame: Offered) -> int:
        if not self._free_rows:
            rows = len(self._state.levels)
            doubled = {name: np.concatenate([getattr(self._state, name)] * 2) for name in ("levels", "patiences")}
            self._state = self._state._replace(**doubled)
            self._free_rows = list(range(rows, 2 * rows))[::-1]
        row = self._free_rows.pop()
        self._state.levels[row], self._state.patiences[row] = frame.power_mw, frame.patience
        return row

    def _arrive(self, place: int) -> None:
        s = self._state
        arrived, offered = s.counts[ARRIVED], s.counts[OFFERED]
        if offered == len(s.arrivals):
            if arrived:
                s.arrivals[: offered - arrived] = s.arrivals[arrived:offered].copy()
                s.counts[ARRIVED], s.counts[OFFERED] = 0, offered - arrived
            else:
                s = self._state = s._replace(arrivals=np.concatenate([s.arrivals] * 2))
            offered = s.counts[OFFERED]
        s.arrivals[offered] = place
        s.counts[OFFERED] = offered + 1
        s.counts[SOONEST] = min(s.counts[SOONEST], s.offered_ns[place])

    def _more_frames(self) -> None:
        s = self._state
        count = len(s.behind)
        self._state = s._replace(**{name: np.concatenate([getattr(s, name)] * 2) for name in PER_FRAME})
        self._free = list(range(count, 2 * count))[::-1]

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """Everything that is decided up to ``until_ns``, in the order of its time."""
        self._work_off(until_ns)
        decided, self._decided = self._decided, []
        return decided

    def _work_off(self, until_ns: int) -> None:
        if until_ns < self._state.counts[SOONEST]:
            return
        while code := self._run(self._state, self._rules, until_ns):
            if code == LEVELS:
                self._renew()
            elif code == DRAWS:
                self._draw()
            elif code == OUTPUT:
                self._collect()
        self._collect()

    def _renew(self) -> None:
        s = self._state
        place = int(s.counts[WANTED])
        frame = self._frames[place]
        i = frame.sender
        s.level[i], s.patience[i] = frame.renew(int(s.attempts[place]), int(s.due[i]))
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
        s = self._state
        count = int(s.counts[DECIDED])
        for k in range(count):
            place = int(s.out_frame[k])
            frame, start_ns, end_ns = self._frames[place], int(s.out_start[k]), int(s.out_end[k])
            if end_ns != NEVER:
                del self._waiting[frame.number]
                fate, least_sinr = s.out_fate[k].copy(), s.out_least[k].copy()
                self._decided.append(Decided(frame.number, start_ns, end_ns, int(s.out_attempts[k]), fate, least_sinr))
            if not s.out_done[k]:
                continue
            del self._frames[place]
            if s.row[place] != NOBODY:
                self._free_rows.append(int(s.row[place]))
            self._free.append(place)
        s.counts[DECIDED] = 0
        if self._compile_after is not None:
            self._compile_after -= count
            if self._compile_after <= 0:  # the same state goes on at another speed
                self._compile()

    def _compile(self) -> None:
        self._run, self._compile_after = compiled.compiled(CORE, "run"), None

    def next_ns(self) -> int | None:
        """When a frame will be decided next, if no other is offered; None: no frame waits or is on the air.

        Never too late; too early where what would be sent next has to wait for what is just starting, and for a unicast frame
        that will have to be sent again.
        """
        s = self._state
        if s.counts[ARRIVED] < s.counts[OFFERED]:  # what comes later is offered later
            self._work_off(int(s.offered_ns[s.arrivals[s.counts[OFFERED] - 1]]))
        if self._decided:
            return self._decided[0].end_ns
        return next_decision(self._state, self._rules) if self._waiting else None

    def waiting(self) -> Sequence[int]:
        """Numbers of the frames that are offered and not yet decided."""
        return sorted(self._waiting)


def next_decision(s: State, rules: Rules) -> int:
    """See `DcfMedium.next_ns`; something waits or is on the air."""
    n = len(s.lock)
    soonest = [int(s.end_ns[i]) for i in s.air[: s.counts[ON_AIR]].tolist()]
    soonest.append(int(s.due[n:].min()))
    wanting = np.flatnonzero(s.due[:n] < NEVER)
    if len(wanting):
        heads, due = s.head[wanting], s.due[wanting]
        expired = (heads == NOBODY) | (due > s.offered_ns[heads] + rules.lifetime_ns)
        soonest.append(int(np.where(expired, due, due + s.air_ns[heads]).min()))
    return min(soonest)
