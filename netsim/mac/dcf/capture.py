"""What radios receive: preamble detection, physical-layer capture, interference, carrier sense.

As in ns-3.44 (``PhyEntity``, ``InterferenceHelper``, ``ThresholdPreambleDetectionModel``):

- A free radio (neither sending nor receiving) detects a frame `detect_ns` after its start, if the frame is then the strongest
  pending one, above the sensitivity, and by `preamble_snr` above noise and interference. It receives the frame to its end;
  frames that start meanwhile are interference. It is free earlier only if the header cannot be decoded, or if a stronger frame
  captures it (`captures`).
- The medium is busy while the radio sends or receives, and while the sum of all powers is at least `busy_mw`. The sum is
  evaluated when the radio fails to detect a frame, and at the end of a received frame. It is also evaluated at the end of its
  own frame; if no other frame started during that one, the threshold is `energy_mw`.

Powers are added in the order of the frames' starts.
"""

from math import inf

from vcmvsp.netsim.mac.dcf.state import (
    ACK,
    COLLISION,
    CTS,
    EIFS_OVER,
    ERROR,
    HEADER,
    NAV_RESET,
    NEVER,
    NOBODY,
    ON_AIR,
    PAYLOAD_OVER_NS,
    RECEIVED,
    RTS,
    TIMEOUT,
    TRANSMITTING,
    UNDETECTED,
    DcfRules,
    DcfState,
)
from vcmvsp.netsim.phy.error_rate import look_up_one


def put_on_air(s: DcfState, rules: DcfRules, i: int, now: int, air_ns: int) -> None:
    """Radio i starts to send; its level and patience are in `DcfState`."""
    settle(s, rules, now)
    count = s.counts[ON_AIR]
    for at in range(count):
        other = s.air[at]
        s.shared[other] = True
        if s.pending[other][i] or s.lock[i] == other:  # it stops listening
            s.pending[other][i] = False
            s.deaf[other][i] = True
    hear_begin(s, rules, i, now)
    s.shared[i] = count > 0
    s.detected[i] = False
    s.start_ns[i] = now
    s.settled_ns[i] = now
    s.end_ns[i] = now + air_ns
    s.air[count] = i
    s.counts[ON_AIR] = count + 1


def detect(s: DcfState, rules: DcfRules, i: int) -> None:
    """Preamble detection of radio i's frame at all radios; see `notice`."""
    s.detected[i] = True
    notice(s, rules, i)


def take_off_air(s: DcfState, rules: DcfRules, i: int, now: int, reserved_ns: int) -> None:
    """The frame of radio i ends; in `DcfState.busy`: the end of the busy time that its receivers then know of.

    For radios that decoded it, that is ``reserved_ns`` at least.
    """
    settle(s, rules, now)
    judge(s, rules, i, now)
    count = s.counts[ON_AIR] - 1
    found = False
    for at in range(count):
        found = found or s.air[at] == i
        if found:
            s.air[at] = s.air[at + 1]
    s.counts[ON_AIR] = count
    let_go(s, rules, i, now, reserved_ns)
    if count > 0:
        began = s.start_ns[s.air[count - 1]] > s.start_ns[i]  # another frame started during its own
        order_by_end(s)
        s.busy[i] = energy_end(s, rules.busy_mw if began else rules.energy_mw, i)


def settle(s: DcfState, rules: DcfRules, now: int) -> None:
    """Add the hazard of all frames on the air up to now, before the set of frames changes."""
    for at in range(s.counts[ON_AIR]):
        i = s.air[at]
        since = s.settled_ns[i]
        if since < now:
            begin, header_end = s.start_ns[i] + rules.preamble_ns, s.start_ns[i] + rules.header_end_ns
            header_ns = max(min(now, header_end) - max(since, begin), 0)
            suffer(s, rules, i, header_ns, max(now - max(since, header_end), 0), header_ns > 0 and now >= header_end)
            s.settled_ns[i] = now


def hear_begin(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Start of radio i's frame at all radios: free ones wait for its preamble; some receivers drop the frame that they receive.

    They do if the new frame captures them, or if the header of the old one could not be decoded.
    """
    lock, level, pending, deaf, spoiled = s.lock, s.level[i], s.pending[i], s.deaf[i], s.spoiled[i]
    hazard, least, end_ns = s.hazard[i], s.least[i], s.end_ns
    lock[i] = NOBODY
    for j in range(len(lock)):
        held = lock[j]
        if held != NOBODY:
            capture = captures(s, rules, held, now) and level[j] >= rules.capture * s.level[held][j]
            if capture or (now >= s.start_ns[held] + rules.header_end_ns and s.spoiled[held][j]):
                lock[j] = NOBODY
        deaf[j] = end_ns[j] > now
        pending[j] = not deaf[j] and lock[j] == NOBODY
        spoiled[j] = False
        hazard[j] = 0.0
        least[j] = inf
        if level[j] < rules.faintest_mw:
            level[j] = 0.0
    pending[i] = False
    level[i] = 0.0


def captures(s: DcfState, rules: DcfRules, other: int, now: int) -> bool:
    """Whether a frame that begins now, if strong enough, captures the receivers of radio other's frame."""
    within = now <= s.start_ns[other] + rules.detect_ns + rules.capture_ns
    return bool(rules.capture_ns > 0 and s.detected[other] and within)


def notice(s: DcfState, rules: DcfRules, i: int) -> None:
    """Which radios detect the frame of radio i; in `DcfState.busy`: the end of the busy time, as known now."""
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
                power += s.level[other][j]
                strongest = strongest and not (s.pending[other][j] and s.level[other][j] > level[j])
        pending[j] = False
        if not strongest:
            continue
        if level[j] >= sensitivity_mw[j] and level[j] >= rules.preamble_snr * power:
            lock[j], busy[j] = i, s.end_ns[i]
            s.header_ns[j] = max(s.idle_ns[j], s.start_ns[i] + rules.header_end_ns)
            for at in range(count):
                s.pending[s.air[at]][j] = False
        else:
            busy[j] = energy_end(s, rules.busy_mw, j)


def suffer(s: DcfState, rules: DcfRules, i: int, header_ns: int, payload_ns: int, header_ends: bool) -> None:
    """Add hazard to the frame of radio i, for parts of its header and payload, at the SINR of now; keep the least SINR."""
    lock, level, least, hazard, patience = s.lock, s.level[i], s.least[i], s.hazard[i], s.patience[i]
    header_table, table = s.tables[HEADER], s.tables[s.curve[i]]
    header_bits, payload_bits = rules.header_bits_per_ns * header_ns, s.payload_bits_per_ns[i] * payload_ns
    alone, undetected = s.counts[ON_AIR] == 1, not s.detected[i]
    for j in range(len(lock)):
        sinr = level[j] / (rules.noise_mw if alone else interference(s, rules, i, j))
        least[j] = min(least[j], sinr)
        receiving = undetected or lock[j] == i
        if receiving and header_ns > 0:
            hazard[j] += header_bits * look_up_one(header_table, sinr)
        if header_ends:
            s.spoiled[i][j] = receiving and hazard[j] >= patience[j]
        if receiving and payload_ns > 0:
            hazard[j] += payload_bits * look_up_one(table, sinr)


def judge(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Set the fate at each radio of the frame of radio i, which ends now."""
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


def let_go(s: DcfState, rules: DcfRules, i: int, now: int, reserved_ns: int) -> None:
    """Free the receivers of radio i's frame, which has ended; in `DcfState.busy`: the end of the busy time.

    That is ``reserved_ns`` at least where the frame was decoded. A receiver that waits for an acknowledgement, and began to
    receive this frame before its timeout, stops waiting (IEEE 802.11-2016, 10.3.2.11), unless this was the acknowledgement.
    """
    lock, eifs_ns, fate, busy, others = s.lock, s.eifs_ns, s.fate[i], s.busy, s.counts[ON_AIR] > 0
    order_by_end(s)
    timeout, payload_ns = s.due[TIMEOUT * len(s.lock) :], s.start_ns[i] + rules.header_end_ns
    to = destination(s, i) if s.kind[i] >= RTS else NOBODY  # of a frame behind SIFS: it does not wait
    for j in range(len(lock)):
        busy[j] = reserved_ns if fate[j] == RECEIVED and j != to else 0
        if lock[j] == i:
            lock[j] = NOBODY
            if not s.spoiled[i][j]:
                if payload_ns <= timeout[j] < NEVER:
                    timeout[j] = now + PAYLOAD_OVER_NS
                if rules.rts_air_ns > 0:
                    reserve(s, rules, i, j, reserved_ns)
                eifs_ns[j] = 0
                if fate[j] != RECEIVED:
                    eifs_ns[j] = s.counts[EIFS_OVER] = now + rules.eifs_ns
                defer(s, rules, j)
            if others:
                busy[j] = max(busy[j], energy_end(s, rules.busy_mw, j))


def reserve(s: DcfState, rules: DcfRules, i: int, j: int, reserved_ns: int) -> None:
    """Set the NAV of radio j by the frame of radio i, which ends now; if it was an RTS, the NAV may be reset."""
    reset = NAV_RESET * len(s.lock) + j
    if s.start_ns[i] + rules.header_end_ns <= s.due[reset]:  # a frame followed the RTS before
        s.due[reset] = NEVER
    if s.fate[i][j] == RECEIVED and j != destination(s, i) and reserved_ns > s.nav_ns[j]:
        s.nav_ns[j] = reserved_ns
        if s.kind[i] == RTS:
            s.due[reset] = s.end_ns[i] + rules.nav_reset_ns


def destination(s: DcfState, i: int) -> int:
    """Destination of the frame that radio i is sending, or NOBODY: all."""
    if s.kind[i] == ACK or s.kind[i] == CTS:
        return int(s.sender[s.acked[i]])
    return int(s.to[s.sending[i]])


def physical_end(s: DcfState, rules: DcfRules, i: int, now: int) -> int:
    """Time until which radio i sends, receives, or senses power, as far as known, without reservations; 0: it does not."""
    if s.counts[ON_AIR] == 0:
        return 0
    order_by_end(s)
    end = energy_end(s, rules.busy_mw, i)
    if s.lock[i] != NOBODY:
        end = max(end, s.end_ns[s.lock[i]])
    return int(max(end, s.end_ns[i]) if s.end_ns[i] > now else end)


def defer(s: DcfState, rules: DcfRules, i: int) -> None:
    """Start or end EIFS for radio i, whose medium is busy until now at least."""
    s.over_ns[i] = max(s.idle_ns[i], s.eifs_ns[i]) + s.slots[i] * rules.slot_ns + rules.difs_ns
    s.due[i] = max(s.over_ns[i], s.wake_ns[i])


def interference(s: DcfState, rules: DcfRules, i: int, j: int) -> float:
    """Noise and the power of all frames but that of radio i, mW, at radio j."""
    total = rules.noise_mw
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            total += s.level[other][j]
    return total


def order_by_end(s: DcfState) -> None:
    """Sort the senders on the air into `DcfState.order`: the last to end first; of equal ends the first to start."""
    order = s.order
    for at in range(s.counts[ON_AIR]):
        i, to = s.air[at], at
        while to > 0 and s.end_ns[order[to - 1]] < s.end_ns[i]:
            order[to] = order[to - 1]
            to -= 1
        order[to] = i


def energy_end(s: DcfState, threshold_mw: float, j: int) -> int:
    """Time, ns, at which the power on the air, in `DcfState.order`, falls below the threshold at radio j; 0: it is below."""
    total = 0.0
    for at in range(s.counts[ON_AIR]):
        i = s.order[at]
        total += s.level[i][j]
        if total >= threshold_mw:
            return int(s.end_ns[i])
    return 0
