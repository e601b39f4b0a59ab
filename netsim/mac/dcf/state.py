"""State of all radios of a contention domain: arrays for NumPy and for compiled code.

Radios are rows 0..n-1. Times are integer nanoseconds. A radio sends one frame at a time, so frames on the air are named by
their senders: row i of an (n, n) array is about the frame that i is sending, or sent last, at each of the n radios.
"""

from typing import NamedTuple

import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes, Fate

FEW = 5  # radios: for up to so many, plain numbers and loops are quicker than NumPy
NEVER = 1 << 62
NOBODY = -1

# Timed events of a radio: rows of n in `DcfState.due`, processed in this order.
START, ANSWER, TIMEOUT = 0, 1, 2

PAYLOAD_OVER_NS = 400  # after the end of a payload that was no acknowledgement, its timeout ends (ns-3.44)

# What a radio is sending.
BROADCAST, UNICAST, ACK = 0, 1, 2

# Numbers in `DcfState.counts`.
ON_AIR = 0  # senders in `DcfState.air`
ARRIVED, OFFERED = 1, 2  # frames of `DcfState.arrivals` that have come to their queue, and all that have been offered
DECIDED = 3  # rows in the `out` arrays
SCARCE = 4  # 1: some radio has no draw left
WANTED = 5  # frame whose levels are asked for
SOONEST = 6  # when something happens next, as far as `run` has seen
EIFS_OVER = 7  # when the last EIFS is over that any radio has begun
DECISION = 8  # when a frame is decided next, as far as `run` has seen

# Rows of `DcfState.tables` that are always there; payloads have the others.
HEADER, ACKNOWLEDGEMENT = 0, 1

# Fates as plain numbers, for compiled code.
RECEIVED, UNDETECTED, TRANSMITTING = int(Fate.RECEIVED), int(Fate.UNDETECTED), int(Fate.TRANSMITTING)
COLLISION, ERROR = int(Fate.COLLISION), int(Fate.ERROR)
QUEUE_FULL, EXPIRED = int(Fate.QUEUE_FULL), int(Fate.EXPIRED)


class DcfRules(NamedTuple):
    """Constants of a medium."""

    slot_ns: int
    sifs_ns: int
    difs_ns: int
    eifs_ns: int  # that a receiver waits, before DIFS, behind a payload that it could not decode
    detect_ns: int  # from the start of a frame until it is noticed
    preamble_ns: int
    header_end_ns: int  # from the start of a frame
    header_bits_per_ns: float
    cw_min: int
    cw_max: int
    queue_frames: int
    lifetime_ns: int
    attempts: int
    ack_air_ns: int
    ack_bits_per_ns: float
    timeout_ns: int  # from the end of a unicast frame until its sender gives the acknowledgement up
    noise_mw: float
    busy_mw: float  # sum of powers at which the medium is busy
    energy_mw: float  # the same, of what a radio has not heard begin because it was sending
    faintest_mw: float  # what is weaker does not even disturb
    preamble_snr: float
    capture: float  # ratio of powers at which a later frame takes a receiver over, if it may
    capture_ns: int  # how long after detection it may
    draws: int  # of each radio, in store


class DcfState(NamedTuple):
    """Everything that changes. n radios, c places for frames, r rows of levels, k draws in store, o of output."""

    # The radios' view of the medium, (n,)
    idle_ns: Ints  # busy until then, as far as known: sending, receiving, carrier sense, reservation
    header_ns: Ints  # the same, while it receives no more than the header of what it is locked to
    eifs_ns: Ints  # until then a frame that could not be decoded may be acknowledged
    sensitivity_mw: Floats
    power_mw: Floats  # with which it sends
    lock: Ints  # whose frame it is receiving, or NOBODY
    # Their contention, (n,)
    slots: Ints  # of its backoff that were left when it last learnt that the medium is busy for longer
    over_ns: Ints  # when the last of them is over, for what it knows
    wake_ns: Ints  # access timer: next check whether it may send; NEVER: nothing to send
    window: Ints  # contention window: a backoff is one of 0..window
    failures: Ints  # attempts since the last acknowledgement
    drawn: Ints  # draws used
    store: Ints  # number of the first draw in store
    backoff: Floats  # (n, k) uniform
    doubt: Floats  # (n, k) exponential variates: patience of acknowledgements
    due: Ints  # (3 n,) when it starts to send; sends an acknowledgement; gives one up
    # Their queues, (n,)
    head: Ints  # first frame that waits, or NOBODY
    tail: Ints
    waiting: Ints  # frames in the queue
    sending: Ints  # frame that is being sent, or whose acknowledgement is waited for, or NOBODY
    acked: Ints  # frame that it is about to acknowledge
    # What they send, (n,)
    kind: Ints
    start_ns: Ints
    end_ns: Ints
    payload_bits_per_ns: Floats
    curve: Ints  # row of `tables` for its payload
    settled_ns: Ints  # until then `hazard` has been added up
    detected: Bools  # the time in which it may be noticed is over
    shared: Bools  # something else was on the air at some time
    air: Ints  # (n,) those who are sending, in the order of their starts; the first counts[ON_AIR] count
    # ... at each radio, (n, n)
    level: Floats  # mW
    heard: Floats  # mW, of acknowledgements
    answer: Floats  # (n,) fading of the acknowledgement to each radio over that of its data frame, a ratio
    patience: Floats
    hazard: Floats
    least: Floats  # SINR
    pending: Bools  # heard begin by a radio that is free, not yet detected
    deaf: Bools  # the radio was sending itself
    spoiled: Bools  # the header is over, and could not be decoded
    fate: Codes
    tables: Floats  # (k, 2^16 + 1) hazards of `HEADER`, `ACKNOWLEDGEMENT` and payloads
    # Frames that wait or are being sent, (c,)
    behind: Ints  # the next in the queue, or NOBODY
    sender: Ints
    to: Ints
    priority: Ints
    offered_ns: Ints
    air_ns: Ints
    frame_bits: Ints
    frame_curve: Ints  # row of `tables` for its payload
    attempts: Ints
    row: Ints  # of its levels; NOBODY: they are asked for
    began_ns: Ints  # last attempt; -1: none yet
    told: Bools  # unicast and received; that is decided, whatever becomes of the acknowledgement
    outcome: Ints  # fate of a unicast frame where it is meant for, at the last attempt
    least_there: Floats  # SINR, of the last attempt
    patiences: Floats  # (c, n)
    levels: Floats  # (r, n)
    placed: Ints  # (n,) frame whose levels have been put in the place of what this radio sends
    arrivals: Ints  # frames that are offered, by time
    counts: Ints
    # What functions leave for those who called them, (n,)
    busy: Ints  # until when the medium is busy, for what each radio learns now
    order: Ints  # those who are sending, by the ends of their frames; the first counts[ON_AIR] count
    # Decided frames, (o,) and (o, n)
    out_frame: Ints
    out_start: Ints
    out_end: Ints  # NEVER: was told before
    out_attempts: Ints
    out_done: Bools  # the frame needs its place no more
    out_fate: Codes
    out_least: Floats


def new_state(
    rules: DcfRules, count: int, sensitivity_mw: float, tables: Floats, *, frames: int = 256, output: int = 256
) -> DcfState:
    """Nobody sends, nothing waits; the medium has been idle since time 0."""
    n = count

    def ints(value: int, size: int = n) -> Ints:
        return np.full(size, value, np.int64)

    def floats(*shape: int) -> Floats:
        return np.zeros(shape)

    def bools(*shape: int) -> Bools:
        return np.zeros(shape, np.bool_)

    return DcfState(
        idle_ns=ints(0),
        header_ns=ints(0),
        eifs_ns=ints(0),
        sensitivity_mw=np.full(n, sensitivity_mw),
        power_mw=np.ones(n),
        lock=ints(NOBODY),
        slots=ints(0),
        over_ns=ints(0),
        wake_ns=ints(NEVER),
        window=ints(rules.cw_min),
        failures=ints(0),
        drawn=ints(0),
        store=ints(0),
        backoff=floats(n, rules.draws),
        doubt=floats(n, rules.draws),
        due=ints(NEVER, 3 * n),
        head=ints(NOBODY),
        tail=ints(NOBODY),
        waiting=ints(0),
        sending=ints(NOBODY),
        acked=ints(NOBODY),
        kind=ints(BROADCAST),
        start_ns=ints(0),
        end_ns=ints(0),
        payload_bits_per_ns=floats(n),
        curve=ints(ACKNOWLEDGEMENT),
        settled_ns=ints(0),
        detected=bools(n),
        shared=bools(n),
        air=ints(NOBODY),
        level=floats(n, n),
        heard=floats(n, n),
        answer=np.ones(n),
        patience=floats(n, n),
        hazard=floats(n, n),
        least=floats(n, n),
        pending=bools(n, n),
        deaf=bools(n, n),
        spoiled=bools(n, n),
        fate=np.zeros((n, n), np.uint8),
        tables=tables,
        behind=ints(NOBODY, frames),
        sender=ints(0, frames),
        to=ints(NOBODY, frames),
        priority=ints(0, frames),
        offered_ns=ints(0, frames),
        air_ns=ints(0, frames),
        frame_bits=ints(0, frames),
        frame_curve=ints(ACKNOWLEDGEMENT, frames),
        attempts=ints(0, frames),
        row=ints(NOBODY, frames),
        began_ns=ints(-1, frames),
        told=bools(frames),
        outcome=ints(EXPIRED, frames),
        least_there=floats(frames),
        patiences=floats(frames, n),
        levels=floats(64, n),
        placed=ints(NOBODY),
        arrivals=ints(NOBODY, frames),
        counts=ints(0, 9),
        busy=ints(0),
        order=ints(NOBODY),
        out_frame=ints(0, output),
        out_start=ints(0, output),
        out_end=ints(0, output),
        out_attempts=ints(0, output),
        out_done=bools(output),
        out_fate=np.zeros((output, n), np.uint8),
        out_least=floats(output, n),
    )
