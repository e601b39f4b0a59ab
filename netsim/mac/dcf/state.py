"""State of all radios of a contention domain: arrays for NumPy and for compiled code.

Radios are rows 0..n-1. Times are integer nanoseconds. A radio sends one frame at a time, so frames on the air are named by
their senders: row i of an (n, n) array is about the frame that i is sending, or sent last, at each of the n radios.
"""

from typing import Annotated, Any, NamedTuple, get_args

import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes, Fate

NEVER = 1 << 62
NOBODY = -1

# Timed events of a radio: rows of n in `DcfState.due`, processed in this order; the last one only where frames have RTS.
START, ANSWER, TIMEOUT, NAV_RESET = 0, 1, 2, 3

PAYLOAD_OVER_NS = 400  # after the end of a payload that was no acknowledgement, its timeout ends (ns-3.44)

# What a radio is sending.
BROADCAST, UNICAST, ACK, RTS, CTS = 0, 1, 2, 3, 4

# Numbers in `DcfState.counts`.
ON_AIR = 0  # senders in `DcfState.air`
ARRIVED, OFFERED = 1, 2  # frames of `DcfState.arrivals` that have reached their queue, and all offered frames
DECIDED = 3  # rows in the `out` arrays
SCARCE = 4  # 1: some radio has no draw left
WANTED = 5  # frame whose levels are requested
SOONEST = 6  # time of the next event, as known to `run`
EIFS_OVER = 7  # end of the last EIFS of any radio
DECISION = 8  # time of the next decision, as known to `run`

# Fixed rows of `DcfState.tables`; the other rows are of payloads.
HEADER, ACKNOWLEDGEMENT = 0, 1

# Fates as plain numbers, for compiled code.
RECEIVED, UNDETECTED, TRANSMITTING = int(Fate.RECEIVED), int(Fate.UNDETECTED), int(Fate.TRANSMITTING)
COLLISION, ERROR = int(Fate.COLLISION), int(Fate.ERROR)
QUEUE_FULL, EXPIRED = int(Fate.QUEUE_FULL), int(Fate.EXPIRED)


class DcfRules(NamedTuple):
    """Constants of a medium."""

    slot_ns: int
    sifs_ns: int
    difs_ns: int  # 802.11n: AIFS
    aligned: int  # 1: a frame that finds the medium idle waits for the end of the slot, not for DIFS
    eifs_ns: int  # wait before DIFS after a payload that could not be decoded
    detect_ns: int  # from the start of a frame to its detection
    preamble_ns: int
    header_end_ns: int  # from the start of a frame
    header_bits_per_ns: float
    cw_min: int
    cw_max: int
    queue_frames: int
    lifetime_ns: int
    attempts: int
    rate_control: int  # 1: the rate of unicast frames follows the SNR
    cts_air_ns: int
    cts_bits_per_ns: float
    rts_air_ns: int  # 0: no frame has an RTS
    rts_bits_per_ns: float
    nav_reset_ns: int  # from the end of an RTS until its reservation may end, if no frame follows
    timeout_ns: int  # from the end of a unicast frame, or an RTS, to the timeout of its answer
    noise_mw: float
    busy_mw: float  # sum of powers at which the medium is busy
    energy_mw: float  # the same, for frames whose starts the radio missed because it was sending
    faintest_mw: float  # weaker frames are no interference
    preamble_snr: float
    capture: float  # ratio of powers at which a later frame captures a receiver
    capture_ns: int  # time after detection in which capture is possible
    draws: int  # of each radio, in store


# Arrays of `DcfState` with a letter for the size of each dimension, see `new_state`.
FrameBools = Annotated[Bools, "c"]
FrameInts = Annotated[Ints, "c"]
LinkBools = Annotated[Bools, "nn"]
LinkFloats = Annotated[Floats, "nn"]
OutputInts = Annotated[Ints, "o"]
RateFloats = Annotated[Floats, "r"]
RateInts = Annotated[Ints, "r"]
SizeInts = Annotated[Ints, "zr"]
RadioBools = Annotated[Bools, "n"]
RadioFloats = Annotated[Floats, "n"]
RadioInts = Annotated[Ints, "n"]


class DcfState(NamedTuple):
    """State of a medium: n radios, c places for frames, k draws in store, o rows of output, r bit rates, z sizes of frames."""

    # The radios' view of the medium, (n,)
    idle_ns: RadioInts  # busy until then, as far as known: sending, receiving, carrier sense, reservation
    header_ns: RadioInts  # the same, while it receives no more than the header of its locked frame
    nav_ns: RadioInts  # end of the reservations of frames to other radios
    eifs_ns: RadioInts  # until then a frame that could not be decoded may be acknowledged
    sensitivity_mw: RadioFloats
    power_mw: RadioFloats  # transmitted power
    lock: RadioInts  # sender of the frame that it receives, or NOBODY
    # Their contention, (n,)
    slots: RadioInts  # of its backoff, left at the last extension of the busy time
    over_ns: RadioInts  # end of these slots, by its carrier sense
    wake_ns: RadioInts  # access timer: next check whether it may send; NEVER: nothing to send
    window: RadioInts  # contention window: a backoff is one of 0..window
    failures: RadioInts  # attempts since the last acknowledgement
    drawn: RadioInts  # draws used
    store: RadioInts  # number of the first draw in store
    backoff: Annotated[Floats, "nk"]  # (n, k) uniform
    doubt: Annotated[Floats, "nk"]  # (n, k) exponential variates: patience of acknowledgements
    due: Annotated[Ints, "t"]  # (3 n,) or (4 n,) times of its next start, answer (or data after CTS), timeout, reset of NAV
    # Their queues, (n,)
    head: RadioInts  # first waiting frame, or NOBODY
    tail: RadioInts
    waiting: RadioInts  # frames in the queue
    sending: RadioInts  # frame on the air, or waiting for its acknowledgement, or NOBODY
    acked: RadioInts  # frame that it is about to acknowledge, or to clear to send
    # Their transmissions, (n,)
    kind: RadioInts
    start_ns: RadioInts
    end_ns: RadioInts
    payload_bits_per_ns: RadioFloats
    curve: RadioInts  # row of `tables` for its payload
    settled_ns: RadioInts  # time up to which `hazard` is counted
    detected: RadioBools  # its time of detection has passed
    shared: RadioBools  # another frame was on the air during it
    air: RadioInts  # (n,) senders on the air, in the order of their starts; the first counts[ON_AIR] are valid
    # ... at each radio, (n, n)
    level: LinkFloats  # mW
    heard: LinkFloats  # mW, of acknowledgements
    answer: RadioFloats  # (n,) fading of the acknowledgement to each radio over that of its data frame, a ratio
    patience: LinkFloats
    hazard: LinkFloats
    least: LinkFloats  # SINR
    pending: LinkBools  # start heard by a free radio, not detected yet
    deaf: LinkBools  # the radio was sending itself
    spoiled: LinkBools  # the header is over, and could not be decoded
    fate: Annotated[Codes, "nn"]
    tables: Floats  # (k, 2^16 + 1) hazards of `HEADER`, `ACKNOWLEDGEMENT` and payloads
    # Bit rates, (r,): that of the phy, or rising ones for unicast frames
    rate: Annotated[Ints, "nn"]  # (n, n) of the next unicast frame to each radio
    least_snr: RateFloats  # above which it is chosen; a ratio of powers
    ack_air_ns: RateInts
    ack_bits_per_ns: RateFloats
    ack_curve: RateInts  # row of `tables`
    size_air_ns: SizeInts  # of frames, by size and rate
    size_bits: SizeInts
    size_curve: SizeInts
    # Frames in the queues or on the air, (c,)
    behind: FrameInts  # the next in the queue, or NOBODY
    sender: FrameInts
    to: FrameInts
    priority: FrameInts
    offered_ns: FrameInts
    air_ns: FrameInts
    frame_bits: FrameInts
    frame_curve: FrameInts  # row of `tables` for its payload
    frame_size: FrameInts  # row of `size_air_ns`
    frame_rate: FrameInts  # of its last attempt
    protected: FrameBools  # longer than the RTS threshold
    attempts: FrameInts
    known: FrameBools  # levels and patience of its first attempt are known; else they are requested
    began_ns: FrameInts  # last attempt; -1: none yet
    told: FrameBools  # unicast, and its reception was output: independent of the acknowledgement
    outcome: FrameInts  # fate of a unicast frame at its destination, of the last attempt
    least_there: Annotated[Floats, "c"]  # SINR, of the last attempt
    patiences: Annotated[Floats, "cn"]  # (c, n)
    levels: Annotated[Floats, "cn"]  # (c, n) mW
    placed: RadioInts  # (n,) frame whose levels are in `level` for the radio's transmission
    arrivals: Annotated[Ints, "a"]  # offered frames, by time
    counts: Annotated[Ints, "e"]
    # Results of functions for their callers, (n,)
    busy: RadioInts  # end of the busy time, as each radio knows now
    order: RadioInts  # senders on the air, by the ends of their frames; the first counts[ON_AIR] are valid
    # Decided frames, (o,) and (o, n)
    out_frame: OutputInts
    out_start: OutputInts
    out_end: OutputInts  # NEVER: output before
    out_attempts: OutputInts
    out_done: Annotated[Bools, "o"]  # the frame's place is free
    out_fate: Annotated[Codes, "on"]
    out_least: Annotated[Floats, "on"]


SHAPES = {name: get_args(hint)[1] for name, hint in DcfState.__annotations__.items() if hint is not Floats}
"""Shapes of the fields of `DcfState`, in letters; without `tables`."""

_INITIAL: dict[str, Any] = {
    **dict.fromkeys(("lock", "head", "tail", "sending", "acked", "air", "order", "placed", "arrivals"), NOBODY),
    **dict.fromkeys(("behind", "to"), NOBODY),
    **dict.fromkeys(("wake_ns", "due"), NEVER),
    **dict.fromkeys(("curve", "frame_curve", "ack_curve"), ACKNOWLEDGEMENT),
    **dict.fromkeys(("power_mw", "answer"), 1.0),
    "began_ns": -1,
    "outcome": EXPIRED,
}
"""Values of the fields that do not begin at 0."""


def new_state(rules: DcfRules, count: int, sensitivity_mw: float, tables: Floats, rates: int) -> DcfState:
    """Initial state: no transmissions, empty queues, medium idle since time 0."""
    size = {
        "n": count,
        "t": (4 if rules.rts_air_ns else 3) * count,
        "k": rules.draws,
        "c": 256,
        "a": 256,
        "o": 256,
        "e": 9,
        "r": rates,
        "z": 8,
    }
    first = {**_INITIAL, "window": rules.cw_min, "sensitivity_mw": sensitivity_mw}
    arrays: dict[str, Any] = {"tables": tables}
    for name, shape in SHAPES.items():
        number = get_args(get_args(DcfState.__annotations__[name])[0])[-1]  # of NDArray, as its release of NumPy has it
        number = next(iter(get_args(number)), number)  # of np.dtype[number]
        arrays[name] = np.full([size[letter] for letter in shape], first.get(name, 0), number)
    return DcfState(**arrays)
