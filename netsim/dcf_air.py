"""What is on the air, and what each radio makes of it: detection, carrier sense, interference.

After ns-3.44 (``PhyEntity``, ``InterferenceHelper``, ``ThresholdPreambleDetectionModel``):

- A radio that is neither sending nor receiving notices a frame `detect_ns` after its start, if the frame is then the strongest
  of those that it hears begin, strong enough, and by `preamble_snr` above noise and interference. It receives it to its end;
  what else begins meanwhile is interference. Only a header that cannot be decoded sets it free earlier.
- The medium is busy while the radio sends or receives, and while the sum of all powers is at least `busy_mw`, found out when
  it fails to detect a frame, and at the end of one that it received. Of frames that began while it was sending and go on
  behind it, it learns at its own end; of those that began before, only if the sum is `energy_mw`.

All functions work in NumPy and compiled alike: loops only over what is on the air, sums in its order.
"""

import numpy as np

from netsim.dcf_state import (
    ACK,
    COLLISION,
    ERROR,
    NOBODY,
    ON_AIR,
    RECEIVED,
    TRANSMITTING,
    UNDETECTED,
    Rules,
    State,
)
from netsim.hazard import look_up
from netsim.layers import Floats, Ints


def interference(s: State, rules: Rules, i: int) -> Floats:
    """Noise and the power of everything but the frame of radio i, (n,) mW."""
    total = np.full(len(s.lock), rules.noise_mw)
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            total = total + s.level[other]
    return total


def energy_end(s: State, threshold_mw: float) -> Ints:
    """Until when the sum of the powers on the air stays at the threshold, (n,) ns; 0 where it is below."""
    n = len(s.lock)
    until = np.zeros(n, np.int64)
    total = np.zeros(n)
    count = s.counts[ON_AIR]
    taken = np.zeros(n, np.bool_)
    for _ in range(count):  # by their ends, the last first
        latest, last = -1, NOBODY
        for at in range(count):
            other = s.air[at]
            if not taken[other] and s.end_ns[other] > latest:
                latest, last = s.end_ns[other], other
        taken[last] = True
        total = total + s.level[last]
        until = np.where((until == 0) & (total >= threshold_mw), latest, until)
    return until


def settle(s: State, rules: Rules, i: int, now: int) -> None:
    """Add up what the frame of radio i has suffered since the last time, at a constant SINR."""
    since = s.settled_ns[i]
    if now <= since:
        return
    s.settled_ns[i] = now
    sinr = s.level[i] / interference(s, rules, i)
    s.least[i] = np.minimum(s.least[i], sinr)
    start, header_end = s.start_ns[i] + rules.preamble_ns, s.start_ns[i] + rules.header_end_ns
    header_ns = min(now, header_end) - max(since, start)
    if header_ns > 0:
        s.hazard[i] = s.hazard[i] + rules.header_bits_per_ns * header_ns * look_up(s.tables[1], sinr)
        if now >= header_end:
            s.spoiled[i] = s.hazard[i] >= s.patience[i]
    payload_ns = now - max(since, header_end)
    if payload_ns > 0:
        table = s.tables[2] if s.kind[i] == ACK else s.tables[0]
        s.hazard[i] = s.hazard[i] + s.payload_bits_per_ns[i] * payload_ns * look_up(table, sinr)


def settle_all(s: State, rules: Rules, now: int) -> None:
    """The same for everything on the air: what follows is another set of frames."""
    for at in range(s.counts[ON_AIR]):
        settle(s, rules, s.air[at], now)


def put_on_air(s: State, rules: Rules, i: int, now: int, air_ns: int) -> None:
    """Radio i starts to send: its level and patience are in place."""
    settle_all(s, rules, now)
    sending = s.end_ns > now
    free = ~sending
    count = s.counts[ON_AIR]
    for at in range(count):
        other = s.air[at]
        s.shared[other] = True
        if s.pending[other, i] or s.lock[i] == other:  # it stops listening
            s.pending[other, i] = False
            s.deaf[other, i] = True
        held = s.lock == other
        if rules.capture_ns > 0 and s.detected[other] and now <= s.start_ns[other] + rules.detect_ns + rules.capture_ns:
            taken = held & (s.level[i] >= rules.capture * s.level[other])
        else:
            taken = np.zeros(len(s.lock), np.bool_)
        if now >= s.start_ns[other] + rules.header_end_ns:
            taken = taken | (held & s.spoiled[other])
        s.lock[:] = np.where(taken, NOBODY, s.lock)
    s.lock[i] = NOBODY
    free = free & (s.lock == NOBODY)
    free[i] = False
    s.pending[i] = free
    s.deaf[i] = sending
    s.spoiled[i] = False
    s.hazard[i] = 0.0
    s.least[i] = np.inf
    s.level[i] = np.where(s.level[i] < rules.faintest_mw, 0.0, s.level[i])
    s.level[i, i] = 0.0
    s.shared[i] = count > 0
    s.detected[i] = False
    s.start_ns[i] = now
    s.settled_ns[i] = now
    s.end_ns[i] = now + air_ns
    s.air[count] = i
    s.counts[ON_AIR] = count + 1


def detect(s: State, rules: Rules, i: int) -> Ints:
    """The frame of radio i is noticed or not; until when the medium is busy for what is known now, (n,)."""
    s.detected[i] = True
    strongest = s.pending[i].copy()
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            strongest = strongest & ~(s.pending[other] & (s.level[other] > s.level[i]))
    power = interference(s, rules, i)
    noticed = strongest & (s.level[i] >= s.sensitivity_mw) & (s.level[i] >= rules.preamble_snr * power)
    s.lock[:] = np.where(noticed, i, s.lock)
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        s.pending[other] = s.pending[other] & ~noticed
    missed = strongest & ~noticed
    s.pending[i] = False
    busy = np.where(noticed, s.end_ns[i], 0)
    if missed.any():
        busy = np.where(missed, energy_end(s, rules.busy_mw), busy)
    return busy


def take_off_air(s: State, rules: Rules, i: int, now: int) -> Ints:
    """The frame of radio i ends; until when the medium is busy for what those who received it find then, (n,)."""
    settle_all(s, rules, now)
    verdict(s, rules, i, now)
    count = s.counts[ON_AIR] - 1
    found = False
    for at in range(count):
        found = found or s.air[at] == i
        if found:
            s.air[at] = s.air[at + 1]
    s.counts[ON_AIR] = count
    held = s.lock == i
    failed = held & (s.fate[i] != RECEIVED)
    s.eifs_ns[:] = np.where(held & ~s.spoiled[i], np.where(failed, now + rules.eifs_ns, 0), s.eifs_ns)
    s.lock[:] = np.where(held, NOBODY, s.lock)
    busy = np.zeros(len(s.lock), np.int64)
    if count > 0:
        busy = np.where(held, energy_end(s, rules.busy_mw), busy)
        began = False  # something, while it was sending
        for at in range(count):
            began = began or s.start_ns[s.air[at]] > s.start_ns[i]
        busy[i] = energy_end(s, rules.busy_mw if began else rules.energy_mw)[i]
    return busy


def verdict(s: State, rules: Rules, i: int, now: int) -> None:
    """Say for each radio whether it received the frame of radio i, which ends now; and if not, why not."""
    survived = s.hazard[i] < s.patience[i]
    ok = (s.lock == i) & survived
    alone = survived
    if s.shared[i]:  # what would have become of it with nothing else on the air?
        snr = s.level[i] / rules.noise_mw
        table = s.tables[2] if s.kind[i] == ACK else s.tables[0]
        header = rules.header_bits_per_ns * (rules.header_end_ns - rules.preamble_ns) * look_up(s.tables[1], snr)
        payload_ns = now - s.start_ns[i] - rules.header_end_ns
        alone = header + s.payload_bits_per_ns[i] * payload_ns * look_up(table, snr) < s.patience[i]
    weak = (s.level[i] < s.sensitivity_mw) | (s.level[i] < rules.preamble_snr * rules.noise_mw)
    fate = np.where(alone, COLLISION, ERROR)
    fate = np.where(s.deaf[i], TRANSMITTING, fate)
    fate = np.where(weak, UNDETECTED, fate)
    s.fate[i] = np.where(ok, RECEIVED, fate)
    s.fate[i, i] = TRANSMITTING
