"""What is done at all radios alike, written twice: with vectors for NumPy, and as loops, which are quicker when compiled.

In compiled code ``f_loop`` stands for ``f`` (see `netsim.mac.jit.cache`). Both do the same operations on the same numbers in
the same order, and leave the same bits behind; but a loop leaves out what changes nothing at a radio.
"""

from typing import Any

import numpy as np

from vcmvsp.netsim.interfaces.layers import Ints
from vcmvsp.netsim.mac.dcf.backoff import defer, defer_one
from vcmvsp.netsim.mac.dcf.interference import (
    energy_end,
    energy_end_at,
    interference,
    interference_at,
    order_by_end,
)
from vcmvsp.netsim.mac.dcf.state import (
    COLLISION,
    EIFS_OVER,
    ERROR,
    HEADER,
    NEVER,
    NOBODY,
    ON_AIR,
    PAYLOAD_OVER_NS,
    RECEIVED,
    TIMEOUT,
    TRANSMITTING,
    UNDETECTED,
    Rules,
    State,
)
from vcmvsp.netsim.phy.error_table import between, look_up_one, places


def copy(values: Any, to: Any) -> None:
    """Put values in the place of others, (n,)."""
    to[:] = values


def copy_loop(values: Any, to: Any) -> None:
    """See `copy`."""
    for j in range(len(to)):
        to[j] = values[j]


def soonest(times: Ints) -> int:
    """Where the least of some times is, the first of equal ones."""
    return int(times.argmin())


def soonest_loop(times: Ints) -> int:
    """See `soonest`."""
    first = 0
    for k in range(1, len(times)):
        if times[k] < times[first]:
            first = k
    return first


def suffer(s: State, rules: Rules, i: int, header_ns: int, payload_ns: int, header_ends: bool) -> None:
    """The frame of radio i was exposed to what is on the air now, for parts of its header and its payload."""
    sinr, least = s.level[i] / interference(s, rules, i), s.least[i]
    np.minimum(least, sinr, out=least)
    if header_ns == 0 and payload_ns == 0:
        return
    receiving = s.lock == i if s.detected[i] else np.ones(len(least), np.bool_)
    step, part = places(sinr)
    hazard = s.hazard[i].copy()
    if header_ns > 0:
        hazard += rules.header_bits_per_ns * header_ns * between(s.tables[HEADER], step, part)
        if header_ends:
            s.spoiled[i] = receiving & (hazard >= s.patience[i])
    if payload_ns > 0:
        hazard += s.payload_bits_per_ns[i] * payload_ns * between(s.tables[s.curve[i]], step, part)
    np.putmask(s.hazard[i], receiving, hazard)


def suffer_loop(s: State, rules: Rules, i: int, header_ns: int, payload_ns: int, header_ends: bool) -> None:
    """See `suffer`."""
    lock, level, least, hazard, patience = s.lock, s.level[i], s.least[i], s.hazard[i], s.patience[i]
    header_table, table = s.tables[HEADER], s.tables[s.curve[i]]
    header_bits, payload_bits = rules.header_bits_per_ns * header_ns, s.payload_bits_per_ns[i] * payload_ns
    alone, undetected = s.counts[ON_AIR] == 1, not s.detected[i]
    for j in range(len(lock)):
        sinr = level[j] / (rules.noise_mw if alone else interference_at(s, rules, i, j))
        least[j] = min(least[j], sinr)
        receiving = undetected or lock[j] == i
        if receiving and header_ns > 0:
            hazard[j] += header_bits * look_up_one(header_table, sinr)
        if header_ends:
            s.spoiled[i, j] = receiving and hazard[j] >= patience[j]
        if receiving and payload_ns > 0:
            hazard[j] += payload_bits * look_up_one(table, sinr)


def hear_begin(s: State, rules: Rules, i: int, now: int) -> None:
    """Radio i begins to send: who is free hears it; who receives what it cannot decode, or what is weaker, lets go of that."""
    sending, level = s.end_ns > now, s.level[i]
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        held = s.lock == other
        if captures(s, rules, other, now):
            s.lock[held & (level >= rules.capture * s.level[other])] = NOBODY
        if now >= s.start_ns[other] + rules.header_end_ns:
            s.lock[held & s.spoiled[other]] = NOBODY
    s.lock[i] = NOBODY
    s.pending[i] = ~sending & (s.lock == NOBODY)
    s.pending[i, i] = False
    s.deaf[i] = sending
    s.spoiled[i] = False
    s.hazard[i] = 0.0
    s.least[i] = np.inf
    level[level < rules.faintest_mw] = 0.0
    level[i] = 0.0


def hear_begin_loop(s: State, rules: Rules, i: int, now: int) -> None:
    """See `hear_begin`."""
    lock, level, pending, deaf, spoiled = s.lock, s.level[i], s.pending[i], s.deaf[i], s.spoiled[i]
    hazard, least, end_ns = s.hazard[i], s.least[i], s.end_ns
    lock[i] = NOBODY
    for j in range(len(lock)):
        held = lock[j]
        if held != NOBODY:
            capture = captures(s, rules, held, now) and level[j] >= rules.capture * s.level[held, j]
            if capture or (now >= s.start_ns[held] + rules.header_end_ns and s.spoiled[held, j]):
                lock[j] = NOBODY
        deaf[j] = end_ns[j] > now
        pending[j] = not deaf[j] and lock[j] == NOBODY
        spoiled[j] = False
        hazard[j] = 0.0
        least[j] = np.inf
        if level[j] < rules.faintest_mw:
            level[j] = 0.0
    pending[i] = False
    level[i] = 0.0


def captures(s: State, rules: Rules, other: int, now: int) -> bool:
    """Whether what begins now may take over who is receiving from radio other."""
    within = now <= s.start_ns[other] + rules.detect_ns + rules.capture_ns
    return bool(rules.capture_ns > 0 and s.detected[other] and within)


def notice(s: State, rules: Rules, i: int) -> None:
    """The frame of radio i is noticed or not; in `State.busy`: until when the medium is busy for what is known now."""
    level, strongest, busy = s.level[i], s.pending[i].copy(), s.busy
    busy[:] = 0
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            strongest &= ~(s.pending[other] & (s.level[other] > level))
    power = interference(s, rules, i)
    noticed = strongest & (level >= s.sensitivity_mw) & (level >= rules.preamble_snr * power)
    s.lock[noticed] = i
    np.putmask(s.header_ns, noticed, np.maximum(s.idle_ns, s.start_ns[i] + rules.header_end_ns))
    s.pending[i] = False
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            s.pending[other] &= ~noticed
    busy[noticed] = s.end_ns[i]
    missed = strongest & ~noticed
    if np.count_nonzero(missed):
        order_by_end(s)
        np.putmask(busy, missed, energy_end(s, rules.busy_mw))


def notice_loop(s: State, rules: Rules, i: int) -> None:
    """See `notice`."""
    lock, level, pending, sensitivity_mw = s.lock, s.level[i], s.pending[i], s.sensitivity_mw
    count, busy = s.counts[ON_AIR], s.busy
    order_by_end(s)
    for j in range(len(lock)):
        busy[j] = 0
        if not pending[j]:
            continue
        strongest, power = True, rules.noise_mw
        for at in range(count):
            other = s.air[at]
            if other != i:
                power += s.level[other, j]
                strongest = strongest and not (s.pending[other, j] and s.level[other, j] > level[j])
        pending[j] = False
        if not strongest:
            continue
        if level[j] >= sensitivity_mw[j] and level[j] >= rules.preamble_snr * power:
            lock[j], busy[j] = i, s.end_ns[i]
            s.header_ns[j] = max(s.idle_ns[j], s.start_ns[i] + rules.header_end_ns)
            for at in range(count):
                s.pending[s.air[at], j] = False
        else:
            busy[j] = energy_end_at(s, rules.busy_mw, j)


def let_go(s: State, rules: Rules, i: int, now: int, reserved_ns: int) -> None:
    """Who received the frame of radio i, which is off the air, is free; in `State.busy`: until when the medium is busy then.

    It is at least until ``reserved_ns`` for those who could decode it. Who waits for an acknowledgement, and began to receive
    this before his timeout, need not wait for that any more: it was not his (IEEE 802.11-2016, 10.3.2.11), unless it was.
    """
    payload_ns = s.start_ns[i] + rules.header_end_ns
    held = s.lock == i
    heard = held & ~s.spoiled[i]
    received = s.fate[i] == RECEIVED
    lost, busy = heard & ~received, s.busy
    timeout = s.due[TIMEOUT * len(held) :]
    if timeout[timeout.argmin()] < NEVER:
        timeout[heard & (timeout < NEVER) & (timeout >= payload_ns)] = now + PAYLOAD_OVER_NS
    s.eifs_ns[heard] = 0
    if np.count_nonzero(lost):
        s.eifs_ns[lost] = s.counts[EIFS_OVER] = now + rules.eifs_ns
    if s.counts[EIFS_OVER] > now:
        defer(s, rules, heard)
    s.lock[held] = NOBODY
    busy[:] = 0
    busy[received] = reserved_ns
    if s.counts[ON_AIR] > 0:
        order_by_end(s)
        np.putmask(busy, held, np.maximum(busy, energy_end(s, rules.busy_mw)))


def let_go_loop(s: State, rules: Rules, i: int, now: int, reserved_ns: int) -> None:
    """See `let_go`."""
    lock, eifs_ns, fate, busy, others = s.lock, s.eifs_ns, s.fate[i], s.busy, s.counts[ON_AIR] > 0
    order_by_end(s)
    timeout, payload_ns = s.due[TIMEOUT * len(s.lock) :], s.start_ns[i] + rules.header_end_ns
    for j in range(len(lock)):
        busy[j] = reserved_ns if fate[j] == RECEIVED else 0
        if lock[j] == i:
            lock[j] = NOBODY
            if not s.spoiled[i, j]:
                if payload_ns <= timeout[j] < NEVER:
                    timeout[j] = now + PAYLOAD_OVER_NS
                eifs_ns[j] = 0
                if fate[j] != RECEIVED:
                    eifs_ns[j] = s.counts[EIFS_OVER] = now + rules.eifs_ns
                defer_one(s, rules, j)
            if others:
                busy[j] = max(busy[j], energy_end_at(s, rules.busy_mw, j))


def judge(s: State, rules: Rules, i: int, now: int) -> None:
    """Say for each radio whether it received the frame of radio i, which ends now; and if not, why not."""
    fate, level, alone = s.fate[i], s.level[i], s.hazard[i] < s.patience[i]
    ok = (s.lock == i) & alone
    if np.count_nonzero(ok) == len(ok) - 1:  # most often
        fate[:] = RECEIVED
        fate[i] = TRANSMITTING
        return
    if s.shared[i]:  # what would have become of it with nothing else on the air?
        step, part = places(level / rules.noise_mw)
        header = rules.header_bits_per_ns * (rules.header_end_ns - rules.preamble_ns) * between(s.tables[HEADER], step, part)
        payload_ns = now - s.start_ns[i] - rules.header_end_ns
        alone = header + s.payload_bits_per_ns[i] * payload_ns * between(s.tables[s.curve[i]], step, part) < s.patience[i]
    fate[:] = ERROR
    fate[alone] = COLLISION
    fate[s.deaf[i]] = TRANSMITTING
    fate[(level < s.sensitivity_mw) | (level < rules.preamble_snr * rules.noise_mw)] = UNDETECTED
    fate[ok] = RECEIVED
    fate[i] = TRANSMITTING


def judge_loop(s: State, rules: Rules, i: int, now: int) -> None:
    """See `judge`."""
    lock, level, hazard, patience, fate, deaf = s.lock, s.level[i], s.hazard[i], s.patience[i], s.fate[i], s.deaf[i]
    header_table, table = s.tables[HEADER], s.tables[s.curve[i]]
    header_bits = rules.header_bits_per_ns * (rules.header_end_ns - rules.preamble_ns)
    payload_bits = s.payload_bits_per_ns[i] * (now - s.start_ns[i] - rules.header_end_ns)
    for j in range(len(lock)):
        survived = hazard[j] < patience[j]
        if survived and lock[j] == i:
            fate[j] = RECEIVED
        elif level[j] < s.sensitivity_mw[j] or level[j] < rules.preamble_snr * rules.noise_mw:
            fate[j] = UNDETECTED
        elif deaf[j]:
            fate[j] = TRANSMITTING
        else:
            if s.shared[i]:
                snr = level[j] / rules.noise_mw
                suffered = header_bits * look_up_one(header_table, snr) + payload_bits * look_up_one(table, snr)
                survived = suffered < patience[j]
            fate[j] = COLLISION if survived else ERROR
    fate[i] = TRANSMITTING
