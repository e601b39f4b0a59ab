"""IEEE 802.11 contention: the distributed coordination function, matched to ns-3.44."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Count, Decibels, Period
from vcmvsp.netsim.interfaces.layers import US, Keys, Phy
from vcmvsp.netsim.mac.dcf.medium import DcfMedium, Rate
from vcmvsp.netsim.mac.dcf.state import DcfRules
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

DRAWS_IN_STORE = 64
ACK_BYTES = 14 - 36  # PSDU of an acknowledgement or a CTS, as a payload with the headers of data
RTS_BYTES = 20 - 36


class Standard(NamedTuple):
    """Constants of a standard (IEEE 802.11-2016, tables 15-5, 16-4, 17-21, 18-5)."""

    slot_us: float
    sifs_us: float
    cw_min: int
    preamble_us: int
    header_us: int
    faintest_dbm: float  # ns-3.44 WifiPhy::RxSensitivity, over the standard's bandwidth
    ack_rates_bps: tuple[float, ...]
    lowest_ack_us: int  # at the lowest rate of the band
    aifsn: int = 2  # slots in DIFS, or in AIFS of best effort (table 9-155)

    @property
    def header_end_ns(self) -> int:
        """Time from the start of a frame to the end of its header."""
        return (self.preamble_us + self.header_us) * US


B = Standard(20.0, 10.0, 31, 144, 48, -101.0 + 10.0 * math.log10(22.0 / 20.0), (1e6, 2e6, 5.5e6, 11e6), 304)
G = Standard(20.0, 10.0, 15, 16, 4, -101.0, (6e6, 12e6, 24e6), 304)
A = Standard(9.0, 16.0, 15, 16, 4, -101.0, (6e6, 12e6, 24e6), 44)
BEST_EFFORT_AIFSN = 3  # of 802.11n


Attempts = Annotated[int, msgspec.Meta(ge=1, le=28)]
Micros = Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)]  # from a nanosecond, the unit of time, to a second
PsduBytes = Annotated[int, msgspec.Meta(ge=0, le=2**31)]
Margin = Annotated[float, msgspec.Meta(ge=0.0, le=400.0)]  # dB


@dataclass(frozen=True)
class Dcf:
    """Medium access of IEEE 802.11: carrier sense, random backoff and collisions.

    The phy selects the standard: `netsim.phy.dsss.Dsss` is 802.11b, `netsim.phy.ofdm.Ofdm` 802.11a at 5 GHz and g at
    2.4 GHz (ad hoc, no protection, long slots), or n with EDCA of best effort. None: the standard's value. All defaults are as
    in ns-3.44.
    """

    slot_us: Micros | None = None  # unit of backoffs; None: the standard's
    sifs_us: Micros | None = None  # from a frame to its acknowledgement; None: the standard's
    cw_min: Count | None = None  # a backoff is 0 to this many slots; None: the standard's
    cw_max: Count = 1023  # largest contention window after failed attempts, in slots
    cca_threshold_dbm: Decibels = -82.0  # sum of powers at which the medium is busy
    energy_threshold_dbm: Decibels = -62.0  # as `cca_threshold_dbm`, for a radio that missed the start of the frames
    preamble_time_us: Micros = 4.0  # from the start of a frame until it is noticed
    capture_margin_db: Margin | None = None  # a later frame that is stronger by this captures the receiver; None: no capture
    capture_window_us: Micros = 16.0  # time after the first frame was noticed in which capture is possible
    queue_frames: Count = 500  # maximum number of frames in the queue of a sender
    lifetime_s: Period = 0.5  # longest time of a frame in the queue; older frames are dropped
    attempts: Attempts = 7  # maximum number of transmissions of a unicast frame, or its RTS
    rts_threshold_bytes: PsduBytes | None = None  # unicast frames with more (payload and MAC headers) have RTS/CTS; None: none
    rate_control: Literal["none", "ideal"] = "none"  # rate of unicast frames: the phy's, or by the SNR of the last one

    def __post_init__(self) -> None:
        if self.cw_min is not None and self.cw_min > self.cw_max:
            raise ScenarioError(f"must not be more than cw_max = {self.cw_max}, not {self.cw_min}", key="cw_min")

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float, *, compile_core: bool | None = None) -> DcfMedium:
        """The medium of ``count`` radios with random keys (count,): backoff k of a radio depends on its key and k alone.

        ``compile_core``: whether to use compiled code, which changes no result; None: for many frames, if available.
        """
        if not isinstance(phy, Dsss | Ofdm):
            name = type(phy).__name__
            raise ScenarioError(f"dcf is the medium access of IEEE 802.11 and needs phy dsss or ofdm, not {name}", key="mac")
        control = self._control(phy)
        curves = phy.errors.header[0], control.errors.payload(ACK_BYTES)[0]
        sensitivity_mw = milliwatts(phy.sensitivity_dbm)
        limit = None if self.rts_threshold_bytes is None else self.rts_threshold_bytes - phy.headers_bytes
        rules = self.rules(phy, noise_mw)
        rates = [_rate(each) for each in self._phys(phy)]
        return DcfMedium(
            rules, rates, phy, keys[:count], curves, sensitivity_mw, longest_bytes=limit, compile_core=compile_core
        )

    def _phys(self, phy: Dsss | Ofdm) -> list[Dsss | Ofdm]:
        """The phy at each rate of unicast frames, rising."""
        if self.rate_control == "none":
            return [phy]
        if isinstance(phy, Dsss):
            raise ScenarioError("ideal chooses among the rates of 802.11a, g, n and ax: use phy ofdm", key="mac.rate_control")
        return [replace(phy, rate_bps=rate) for rate in phy.rates_bps]

    def _control(self, phy: Dsss | Ofdm) -> Dsss | Ofdm:
        """The phy at the rate of RTS and CTS: that of acknowledgements, of the lowest rate with rate control."""
        return ack_phy(self._phys(phy)[0], standard_of(phy))

    def rules(self, phy: Dsss | Ofdm, noise_mw: float) -> DcfRules:
        """All constants, in nanoseconds, milliwatts and ratios."""
        standard = standard_of(phy)
        cw_min = standard.cw_min if self.cw_min is None else self.cw_min
        if cw_min > self.cw_max:
            raise ScenarioError(f"must not be less than cw_min = {cw_min} of the standard, not {self.cw_max}", key="mac.cw_max")
        slot_ns = round((self.slot_us or standard.slot_us) * US)
        sifs_ns = round((self.sifs_us or standard.sifs_us) * US)
        header_end_ns = standard.header_end_ns
        control = self._control(phy)
        cts_air_ns, rts_air_ns = control.air_time_ns(ACK_BYTES), control.air_time_ns(RTS_BYTES)
        capture_ns = 0 if self.capture_margin_db is None else round(self.capture_window_us * US)
        return DcfRules(
            slot_ns=slot_ns,
            sifs_ns=sifs_ns,
            difs_ns=sifs_ns + standard.aifsn * slot_ns,
            aligned=int(standard.aifsn == BEST_EFFORT_AIFSN),
            eifs_ns=sifs_ns + standard.lowest_ack_us * US,
            detect_ns=round(self.preamble_time_us * US),
            preamble_ns=standard.preamble_us * US,
            header_end_ns=header_end_ns,
            header_bits_per_ns=phy.errors.header[1] / (standard.header_us * US),
            cw_min=cw_min,
            cw_max=self.cw_max,
            queue_frames=self.queue_frames,
            lifetime_ns=round(self.lifetime_s * SECOND_NS),
            attempts=self.attempts,
            rate_control=int(self.rate_control != "none"),
            cts_air_ns=cts_air_ns,
            cts_bits_per_ns=control.errors.payload(ACK_BYTES)[1] / (cts_air_ns - header_end_ns),
            rts_air_ns=0 if self.rts_threshold_bytes is None else rts_air_ns,
            rts_bits_per_ns=control.errors.payload(RTS_BYTES)[1] / (rts_air_ns - header_end_ns),
            nav_reset_ns=2 * (sifs_ns + slot_ns) + cts_air_ns + header_end_ns,
            timeout_ns=sifs_ns + slot_ns + header_end_ns,
            noise_mw=noise_mw,
            busy_mw=milliwatts(self.cca_threshold_dbm),
            energy_mw=milliwatts(self.energy_threshold_dbm),
            faintest_mw=milliwatts(standard.faintest_dbm),
            preamble_snr=10.0 ** (phy.preamble_snr_db / 10.0),
            capture=10.0 ** ((self.capture_margin_db or 0.0) / 10.0),
            capture_ns=capture_ns,
            draws=DRAWS_IN_STORE,
        )


def standard_of(phy: Dsss | Ofdm) -> Standard:
    """Constants of 802.11b, or of a, g or n by band and rate."""
    if isinstance(phy, Dsss):
        return B
    standard = A if phy.band == "5GHz" else G
    return standard._replace(aifsn=BEST_EFFORT_AIFSN) if phy.is_ht else standard


def ack_phy(phy: Dsss | Ofdm, standard: Standard) -> Dsss | Ofdm:
    """The phy at the rate of acknowledgements: the highest mandatory one that is not above that of the data."""
    rate = max(each for each in standard.ack_rates_bps if each <= phy.rate_bps)
    return replace(phy, rate_bps=rate)


def _rate(phy: Dsss | Ofdm) -> Rate:
    """A rate of unicast frames, with its acknowledgements."""
    standard = standard_of(phy)
    control = ack_phy(phy, standard)
    air_ns, (curve, bits) = control.air_time_ns(ACK_BYTES), control.errors.payload(ACK_BYTES)
    least_snr = 10.0 ** (phy.least_snr_db / 10.0) if isinstance(phy, Ofdm) else 0.0
    return Rate(phy, least_snr, air_ns, bits / (air_ns - standard.header_end_ns), curve)


def milliwatts(dbm: float) -> float:
    """Convert a power from dBm to mW."""
    return float(10.0 ** (dbm / 10.0))
