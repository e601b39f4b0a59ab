"""Reception of IEEE 802.15.4: locks of receivers to frames, interference, clear channel assessment."""

import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes, Fate
from vcmvsp.netsim.phy.error_rate import ErrorRate

Rows = NDArray[np.intp]

FREE = -1  # locked to no frame
_UNNOTICED = 1e-9  # share of the noise: a weaker frame is no event at a receiver


class AirborneFrame:
    """One frame on the air."""

    def __init__(self, sender: int, start_ns: int, end_ns: int, power_mw: Floats, patience: Floats, bits: int) -> None:
        self.sender, self.start_ns, self.end_ns = sender, start_ns, end_ns
        self.power_mw = power_mw.copy()  # at every radio, (n,)
        self.power_mw[sender] = 0.0  # no interference with itself: the sender is deaf
        self.patience = patience  # the frame survives while its hazard is less, (n,)
        self.bits_per_ns = bits / (end_ns - start_ns)
        self.least_sinr: Floats = np.full(len(power_mw), np.inf)  # so far, (n,)
        self.deaf: Bools = np.zeros(0, np.bool_)  # radios that were deaf at its start, (n,)
        self.rows: Rows = np.zeros(0, np.intp)  # receivers locked to it, (m,)
        self.hazard: Floats = np.zeros(0)  # so far, (m,)
        self.settled_ns: Ints = np.zeros(0, np.int64)  # time up to which the hazard is counted, (m,)


class Csma154Air:
    """Frames on the air, and the states of n receivers.

    A free receiver (not sending, turning around or locked) locks to a starting frame if its SINR exceeds ``preamble_snr_db``,
    until the frame ends, even if it is lost. Later frames are interference only. Of frames that start in the same nanosecond
    the strongest comes first, as the nearest would.

    The hazard ``-log(success per bit)`` is summed over pieces of constant SINR. With ``forgetful``, as in ns-3.44, a piece ends
    only when another frame starts that is not far below the noise, and at the frame's own end: interference that has ended by
    then is ignored.
    """

    def __init__(
        self,
        count: int,
        noise_mw: Floats | float,
        errors: ErrorRate,
        *,
        preamble_snr_db: float,
        busy_dbm: float,
        forgetful: bool,
    ) -> None:
        self._noise_mw: Floats = np.full(count, noise_mw)
        self._errors, self._forgetful = errors, forgetful
        self._preamble_snr, self._busy_mw = 10.0 ** (preamble_snr_db / 10.0), 10.0 ** (busy_dbm / 10.0)
        self._flights: list[AirborneFrame] = []
        self._power_mw: Floats = np.zeros(count)  # of all frames on the air, (n,)
        self._locked: Rows = np.full(count, FREE, np.intp)  # sender of the locked frame, (n,)
        self._deaf_until_ns: Ints = np.zeros(count, np.int64)

    def deafen(self, radio: int, until_ns: int) -> None:
        """Make a radio that sends or turns around deaf to frames that start before ``until_ns``."""
        self._deaf_until_ns[radio] = until_ns

    def busy(self, radio: int) -> bool:
        """Whether a clear channel assessment that ends now finds the channel busy.

        It is busy if the radio is locked to a frame or the power of all frames exceeds the threshold (mode 1 of
        IEEE 802.15.4-2006, 6.9.9). As in ns-3.44, frames that end during the assessment do not count; frames that start do.
        """
        return bool(self._locked[radio] != FREE or self._power_mw[radio] >= self._busy_mw)

    def begin(self, now_ns: int, flights: list[AirborneFrame]) -> None:
        """Start frames, usually one."""
        strongest = np.max([each.power_mw for each in flights], axis=0)
        noticed = strongest > _UNNOTICED * self._noise_mw
        for each in self._flights:
            self._settle(each, now_ns, noticed[each.rows])
        deaf = self._deaf_until_ns > now_ns
        before = self._noise_mw + self._power_mw
        free = (self._locked == FREE) & ~deaf
        free &= strongest > self._preamble_snr * before
        for each in flights:
            each.deaf = deaf
            locking = free & (each.power_mw == strongest) if len(flights) > 1 else free
            each.rows = np.flatnonzero(locking)
            each.hazard = np.zeros(len(each.rows))
            each.settled_ns = np.full(len(each.rows), now_ns)
            self._locked[each.rows] = each.sender
            free = free & ~locking
        self._flights += flights
        self._add_up()
        for each in self._flights:
            sinr = each.power_mw / (self._noise_mw + (self._power_mw - each.power_mw))
            np.minimum(each.least_sinr, sinr, out=each.least_sinr)

    def end(self, now_ns: int, flight: AirborneFrame) -> Codes:
        """End a frame; returns its `Fate` at every radio, (n,)."""
        for each in [flight] if self._forgetful else self._flights:
            self._settle(each, now_ns, np.ones(len(each.rows), bool))
        self._flights.remove(flight)
        self._add_up()
        self._locked[flight.rows] = FREE
        received = flight.rows[flight.hazard < flight.patience[flight.rows]]
        fate = np.full(len(flight.power_mw), Fate.COLLISION, np.uint8)
        fate[received] = Fate.RECEIVED
        if len(received) < len(fate) - 1:
            fate[flight.deaf] = Fate.TRANSMITTING
            fate[flight.power_mw <= self._preamble_snr * self._noise_mw] = Fate.UNDETECTED
            lost = np.flatnonzero(fate == Fate.COLLISION)
            bits = flight.bits_per_ns * (flight.end_ns - flight.start_ns)
            alone = bits * self._hazard(flight.power_mw[lost], self._noise_mw[lost])
            fate[lost[alone >= flight.patience[lost]]] = Fate.ERROR
        fate[flight.sender] = Fate.TRANSMITTING
        return fate

    def _settle(self, flight: AirborneFrame, now_ns: int, where: Bools) -> None:
        """Add the hazard since the last update, at the constant SINR since then, at some receivers of the frame."""
        bits = flight.bits_per_ns * (now_ns - flight.settled_ns) * where
        if bits.any():
            power_mw = flight.power_mw[flight.rows]
            others_mw = self._power_mw[flight.rows] - power_mw
            flight.hazard += bits * self._hazard(power_mw, self._noise_mw[flight.rows] + others_mw)
            flight.settled_ns[where] = now_ns

    def _hazard(self, power_mw: Floats, disturbance_mw: Floats) -> Floats:
        return self._errors.bit_hazard(power_mw / disturbance_mw)

    def _add_up(self) -> None:
        """Sum all powers from scratch: no rounding errors of ended frames remain."""
        self._power_mw = np.zeros(len(self._noise_mw))
        for each in self._flights:
            self._power_mw += each.power_mw
