"""The air between IEEE 802.15.4 receivers: which frame each is locked to, and what the others do to it."""

import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes, Fate
from vcmvsp.netsim.phy.error_rate import ErrorRate

Rows = NDArray[np.intp]

FREE = -1  # locked to no frame
_UNNOTICED = 1e-9  # of the noise: what is weaker is no event at a receiver


class AirborneFrame:
    """One frame on the air."""

    def __init__(self, sender: int, start_ns: int, end_ns: int, power_mw: Floats, patience: Floats, bits: int) -> None:
        self.sender, self.start_ns, self.end_ns = sender, start_ns, end_ns
        self.power_mw = power_mw.copy()  # at every radio, (n,)
        self.power_mw[sender] = 0.0  # its own frame does not disturb it: it is deaf
        self.patience = patience  # survives while its hazard is less, (n,)
        self.bits_per_ns = bits / (end_ns - start_ns)
        self.least_sinr: Floats = np.full(len(power_mw), np.inf)  # so far, (n,)
        self.deaf: Bools = np.zeros(0, np.bool_)  # who was when it began, (n,)
        self.rows: Rows = np.zeros(0, np.intp)  # who is locked to it, (m,)
        self.hazard: Floats = np.zeros(0)  # so far, (m,)
        self.settled_ns: Ints = np.zeros(0, np.int64)  # up to here, (m,)


class Csma154Air:
    """What n receivers make of the frames that are on the air.

    A receiver that neither sends nor turns round nor is locked to a frame locks to one that begins, if its SINR exceeds
    ``preamble_snr_db``: for the whole frame, whatever comes of it. Later frames only disturb. Of frames that begin in the same
    nanosecond the strongest comes first, as the nearest would.

    The hazard ``-log(success per bit)`` of each piece of constant SINR adds up. With ``forgetful``, as in ns-3.44, a frame is
    looked at only when another begins that is not far below the noise, and at its own end: a disturbance that is over by then
    is forgotten.
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
        self._power_mw: Floats = np.zeros(count)  # of them all, (n,)
        self._locked: Rows = np.full(count, FREE, np.intp)  # to whose frame, (n,)
        self._deaf_until_ns: Ints = np.zeros(count, np.int64)

    def deafen(self, radio: int, until_ns: int) -> None:
        """It sends, or turns round for it, and hears nothing that begins before ``until_ns``."""
        self._deaf_until_ns[radio] = until_ns

    def busy(self, radio: int) -> bool:
        """The verdict of a clear channel assessment that ends now.

        Busy is who is locked to a frame, and who has the power of all frames above the threshold (mode 1 of IEEE 802.15.4-2006,
        6.9.9). As in ns-3.44, a frame that ends during the assessment is not noticed; one that begins is: it outlasts it.
        """
        return bool(self._locked[radio] != FREE or self._power_mw[radio] >= self._busy_mw)

    def begin(self, now_ns: int, flights: list[AirborneFrame]) -> None:
        """These frames, usually one, go on the air."""
        noticed = np.max([each.power_mw for each in flights], axis=0) > _UNNOTICED * self._noise_mw
        for each in self._flights:
            self._settle(each, now_ns, noticed[each.rows])
        deaf = self._deaf_until_ns > now_ns
        before = self._noise_mw + self._power_mw
        free = (self._locked == FREE) & ~deaf
        strongest = np.max([each.power_mw for each in flights], axis=0) if len(flights) > 1 else flights[0].power_mw
        free &= strongest > self._preamble_snr * before
        for each in flights:
            each.deaf = deaf
            mine = free & (each.power_mw == strongest) if len(flights) > 1 else free
            each.rows = np.flatnonzero(mine)
            each.hazard = np.zeros(len(each.rows))
            each.settled_ns = np.full(len(each.rows), now_ns)
            self._locked[each.rows] = each.sender
            free = free & ~mine
        self._flights += flights
        self._add_up()
        for each in self._flights:
            sinr = each.power_mw / (self._noise_mw + (self._power_mw - each.power_mw))
            np.minimum(each.least_sinr, sinr, out=each.least_sinr)

    def end(self, now_ns: int, flight: AirborneFrame) -> Codes:
        """A frame ends: its `Fate` at every radio, (n,)."""
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
        """Count the hazard since it was last counted, at the SINR that lasted since then, at some of its receivers."""
        bits = flight.bits_per_ns * (now_ns - flight.settled_ns) * where
        if bits.any():
            power_mw = flight.power_mw[flight.rows]
            others_mw = self._power_mw[flight.rows] - power_mw
            flight.hazard += bits * self._hazard(power_mw, self._noise_mw[flight.rows] + others_mw)
            flight.settled_ns[where] = now_ns

    def _hazard(self, power_mw: Floats, disturbance_mw: Floats) -> Floats:
        return self._errors.bit_hazard(power_mw / disturbance_mw)

    def _add_up(self) -> None:
        """From scratch, so that nothing is left of what has ended."""
        self._power_mw = np.zeros(len(self._noise_mw))
        for each in self._flights:
            self._power_mw += each.power_mw
