"""Our contention core alone, fed with the frames of ns-3: the same places, the same times, other backoffs."""

import time
from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np
from msgspec import convert
from numpy.typing import NDArray

from bench.ns3 import program
from bench.ns3.cases import REFERENCE_LOSS_DB, Case
from bench.ns3.program import Floats, Frames
from bench.ns3.sample import Sample, tally
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import key64
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Medium, Offered
from vcmvsp.netsim.mac.dcf.medium import DcfMedium
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

ErrorModel = Literal["table", "yans", "nist"]

QUEUED = 3  # of ``wifi.cc`` when saturated
REFILL_NS = 50_000


def core(case: Case, seed: int) -> Sample:
    """One run of `netsim.mac.dcf.parameters`."""
    positions = case.positions
    n, air = len(positions), Air(case, seed)
    medium = air.open(np.array([key64(seed, f"radio{i}") for i in range(n)], np.uint64))
    begin = time.process_time()
    decided = list(_saturated(case, air, medium) if case.saturated else _periodic(case, seed, air, medium))
    cpu_s = time.process_time() - begin
    return tally(positions, air.frames(decided, n, case), cpu_s)


class Air:
    """Levels and draws of every frame."""

    def __init__(self, case: Case, seed: int) -> None:
        standard, rate = case.phy.split("-")
        self.phy = _phy(standard, float(rate) * 1e6, case.errors)
        self._noise_mw = 10.0 ** (self.phy.noise_dbm / 10.0)
        distance = np.linalg.norm(case.positions[:, None] - case.positions[None], axis=2)
        loss_db = REFERENCE_LOSS_DB[standard] + 10.0 * case.exponent * np.log10(np.maximum(distance, 1.0))
        self.mean_mw: Floats = 10.0 ** ((self.phy.tx_power_dbm - loss_db) / 10.0)
        np.fill_diagonal(self.mean_mw, 0.0)
        self._mac = Dcf(rts_threshold_bytes=case.rts_bytes, rate_control="ideal" if case.ideal else "none")
        self._size, self._m, self._random, self._offered = (
            case.size,
            case.nakagami,
            np.random.default_rng(seed),
            list[Offered](),
        )

    def open(self, keys: NDArray[np.uint64]) -> DcfMedium:
        """The core, with the keys (n,) of the radios."""
        medium = self._mac.open(self.phy, len(keys), keys, self._noise_mw)
        assert isinstance(medium, DcfMedium)
        medium.levels[:] = self.mean_mw  # of acknowledgements
        return medium

    def frame(self, sender: int, to: int, time_ns: int) -> Offered:
        """The next one."""
        number = len(self._offered)
        power, patience = self._levels(sender)
        renew, answer = partial(self._renewed, sender), partial(self._answer, sender, to)
        faded = (None, None, renew, answer) if self._m and to >= 0 else (power, patience, renew)
        frame = Offered(number, time_ns, sender, to, self._size, 0, *faded)
        self._offered.append(frame)
        return frame

    def sender(self, number: int) -> int:
        """Of a frame."""
        return self._offered[number].sender

    def _levels(self, sender: int) -> tuple[Floats, Floats]:
        level = self.mean_mw[sender]
        if self._m:
            level = level * self._random.gamma(self._m, 1.0 / self._m, len(level))
        return level, self._random.exponential(size=len(level))

    def _renewed(self, sender: int, _attempt: int, _start_ns: int) -> tuple[Floats, Floats]:
        self._last = self._levels(sender)
        return self._last

    def _answer(self, sender: int, to: int, _start_ns: int) -> float:
        """With a fading of its own, as in ns-3."""
        return float(self._levels(sender)[0][to] / self._last[0][to])

    def frames(self, decided: list[Decided], n: int, case: Case) -> Frames:
        """Outcomes of the counted frames."""
        begin_ns = round(case.warmup_s * SECOND_NS)
        end_ns = begin_ns + round(case.duration_s * SECOND_NS)
        pairs = [(self._offered[each.number], each) for each in decided]
        pairs = [(frame, each) for frame, each in pairs if begin_ns <= frame.time_ns < end_ns]
        delay_ns = np.full((len(pairs), n), -1, np.int32)
        for row, (frame, each) in enumerate(pairs):
            delay_ns[row, each.fate == Fate.RECEIVED] = each.end_ns - frame.time_ns

        columns = [(frame.sender, frame.to, frame.time_ns, each.start_ns, each.attempts) for frame, each in pairs]
        sender, to, sent_ns, start_ns, attempts = np.array(columns).reshape(-1, 5).T
        return Frames(sender, to, sent_ns, start_ns, attempts, delay_ns)


def _phy(standard: str, bps: float, errors: str) -> Dsss | Ofdm:
    if standard == "b":
        return Dsss(rate_bps=bps)
    return Ofdm(rate_bps=bps, band="5GHz" if standard == "a" else "2.4GHz", error_model=convert(errors, ErrorModel))


def _to(case: Case, sender: int) -> int:
    if case.sink:
        return 0
    return (sender + 1) % case.nodes if case.unicast else -1


def _periodic(case: Case, seed: int, air: Air, medium: Medium) -> Iterator[Decided]:
    """Times of ns-3, before and after the measured time too."""
    frames = program.run(case.positions, case.ns3(seed)).frames
    period_ns = round(SECOND_NS / case.hz)
    until_ns = round((case.warmup_s + case.duration_s + case.drain_s) * SECOND_NS)
    arrivals: list[tuple[int, int]] = []
    for sender in range(case.sink, case.nodes):
        phase = int(frames.sent_ns[frames.sender == sender][0]) % period_ns
        arrivals += [(at, sender) for at in range(phase, until_ns, period_ns)]
    for at, sender in sorted(arrivals):
        medium.offer(air.frame(sender, _to(case, sender), at))
    yield from medium.advance(until_ns)


def _saturated(case: Case, air: Air, medium: Medium) -> Iterator[Decided]:
    """Every decided frame makes room for the next."""
    until_ns = round((case.warmup_s + case.duration_s + case.drain_s) * SECOND_NS)
    for sender in range(case.sink, case.nodes):
        for _ in range(QUEUED):
            medium.offer(air.frame(sender, _to(case, sender), 1_000 * sender))
    for now in range(REFILL_NS, until_ns, REFILL_NS):
        for each in medium.advance(now):
            yield each
            sender = air.sender(each.number)
            medium.offer(air.frame(sender, _to(case, sender), now))
