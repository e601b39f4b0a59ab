"""The distributed coordination function (IEEE 802.11-2016, 10.3.4): channel access, event by event.

As in ns-3.44 (``ChannelAccessManager``, ``Txop``, ``FrameExchangeManager``), a backoff counts whole slots from DIFS after the
end of the last busy time, freezes while the medium is busy, and is drawn after every transmission, even if no other frame
waits. A frame that finds the medium idle and no backoff left waits for DIFS; in 802.11n (EDCA) for the end of the slot.

A unicast frame above the RTS threshold is preceded by RTS and CTS (10.3.2.4, 10.3.2.7): radios that decode one of them are
silent until the end of the acknowledgement (`DcfState.nav_ns`). A reservation by RTS ends early if no frame follows.

With rate control a unicast frame has the highest rate whose `DcfState.least_snr` is below the SINR that its destination had of
the last acknowledged frame, or of an RTS since. At first, and after a frame that was given up, it has the lowest rate (ns-3.44,
``IdealWifiManager``).

A radio stores the slots left at the last extension of the busy time, and the time at which they end without another extension:
slots are no events. After a payload that could not be decoded it waits for EIFS. The queues are linked lists in the arrays of
the frames.

The code runs interpreted or compiled, see `cosim.compiled`; all state is in the arrays of a `DcfState`.
"""

from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes
from vcmvsp.netsim.mac.dcf.capture import defer, detect, physical_end, put_on_air, settle, take_off_air
from vcmvsp.netsim.mac.dcf.state import (
    ACK,
    ACKNOWLEDGEMENT,
    ANSWER,
    ARRIVED,
    BROADCAST,
    COLLISION,
    CTS,
    DECIDED,
    DECISION,
    NAV_RESET,
    NEVER,
    NOBODY,
    OFFERED,
    ON_AIR,
    PAYLOAD_OVER_NS,
    QUEUE_FULL,
    RECEIVED,
    RTS,
    SCARCE,
    SOONEST,
    START,
    TIMEOUT,
    UNICAST,
    WANTED,
    DcfRules,
    DcfState,
)

# Reasons for `run` to return.
DONE, LEVELS, DRAWS, OUTPUT = 0, 1, 2, 3

# Further events, after those of `DcfState.due`.
DETECT, END, ARRIVE = 4, 5, 6


def run(s: DcfState, rules: DcfRules, until: int) -> int:
    """Process the events up to and including ``until``, as far as possible; returns the reason to stop."""
    while True:
        if s.counts[SCARCE]:
            return DRAWS
        if s.counts[DECIDED] == len(s.out_frame):  # every event decides one frame at most
            return OUTPUT
        what, who, now = upcoming(s, rules)
        if now > until:
            s.counts[SOONEST], s.counts[DECISION] = now, next_decision(s, rules)
            return DONE
        if what == DETECT:
            doze(s, rules, now)
            detect(s, rules, who)
            sense(s, rules, now)
        elif what == END:
            finish(s, rules, who, now)
        elif what == ARRIVE:
            arrive(s, rules, who, now)
        elif not begin(s, rules, what, who, now):
            return LEVELS


def upcoming(s: DcfState, rules: DcfRules) -> tuple[int, int, int]:
    """The next event: kind, radio (of an arrival: frame), time.

    At equal times ends come first, then starts, detections and arrivals.
    """
    what, who, when = ARRIVE, s.air[0], NEVER
    if s.counts[ARRIVED] < s.counts[OFFERED]:
        who = s.arrivals[s.counts[ARRIVED]]
        when = s.offered_ns[who]
    end = NEVER
    ends = s.air[0]
    for at in range(s.counts[ON_AIR]):
        i = s.air[at]
        if what != DETECT and not s.detected[i] and s.start_ns[i] + rules.detect_ns <= when:  # of these the first to start
            what, who, when = DETECT, i, s.start_ns[i] + rules.detect_ns
        if s.end_ns[i] < end:
            ends, end = i, s.end_ns[i]
    first = soonest(s.due)
    if s.due[first] <= when:
        what, who, when = first // len(s.lock), first % len(s.lock), s.due[first]
    if end <= when:
        what, who, when = END, ends, end
    return what, who, when


def release(s: DcfState, rules: DcfRules, i: int, now: int, counting_ns: int) -> None:
    """End a frame, or an attempt, of radio i; its new backoff counts from ``counting_ns``."""
    s.sending[i] = NOBODY
    s.due[i] = s.wake_ns[i] = NEVER
    back_off(s, rules, i, counting_ns)
    if s.head[i] != NOBODY:
        request(s, rules, i, now)


def arrive(s: DcfState, rules: DcfRules, f: int, now: int) -> None:
    """Add frame f to its sender's queue; an expired frame leaves the queue first."""
    i = s.sender[f]
    if expire(s, rules, i, now):
        return
    s.counts[ARRIVED] += 1
    kept = s.sending[i] != NOBODY and s.to[s.sending[i]] != NOBODY  # until it is acknowledged
    if s.waiting[i] + kept >= rules.queue_frames:
        decide(s, f, now, QUEUE_FULL)
        return
    enqueue(s, i, f)
    if s.sending[i] == NOBODY and s.due[i] == NEVER:
        count_down(s, rules, i, now)
        if s.slots[i] == 0:
            if s.idle_ns[i] > now:
                back_off(s, rules, i, now)
            elif rules.aligned:
                wait(s, rules, i, next_slot_ns(s, rules, i, now))
            else:
                wait(s, rules, i, now + rules.difs_ns)
        request(s, rules, i, now)


# --- sending ---


def begin(s: DcfState, rules: DcfRules, what: int, i: int, now: int) -> bool:
    """Process the due event of radio i; False: levels are needed first."""
    if what == START:
        return start(s, rules, i, now)
    if what == ANSWER:
        s.due[ANSWER * len(s.lock) + i] = NEVER
        doze(s, rules, now)
        if s.acked[i] == NOBODY:
            send_protected(s, rules, i, now)
        else:
            answer(s, rules, i, now)
    elif what == TIMEOUT:
        give_up(s, rules, i, now)
    else:
        reset_nav(s, rules, i, now)
    return True


def start(s: DcfState, rules: DcfRules, i: int, now: int) -> bool:
    """Send the first frame in the queue of radio i; False: its levels are needed."""
    if expire(s, rules, i, now):
        if s.head[i] == NOBODY:
            release(s, rules, i, now, now)
        return True
    f = s.head[i]
    if f == NOBODY:  # all expired while it waited
        release(s, rules, i, now, now)
        return True
    set_rate(s, rules, f)
    if s.attempts[f] == 0 and s.known[f]:
        copy(s.levels[f], s.level[i])
        copy(s.patiences[f], s.patience[i])
        s.answer[i] = 1.0
    elif s.placed[i] != f:
        s.counts[WANTED] = f
        return False
    s.placed[i] = NOBODY
    copy(s.level[i], s.heard[i])
    s.sending[i] = leave(s, i)
    s.attempts[f] += 1
    s.due[i] = s.wake_ns[i] = NEVER
    if s.protected[f] and s.to[f] != NOBODY:
        send_rts(s, rules, i, now)
    else:
        send_data(s, rules, i, now)
    return True


def set_rate(s: DcfState, rules: DcfRules, f: int) -> None:
    """Give a waiting unicast frame the rate of its link."""
    if rules.rate_control == 0 or s.to[f] == NOBODY:
        return
    rate, size = s.rate[s.sender[f]][s.to[f]], s.frame_size[f]
    s.frame_rate[f] = rate
    s.air_ns[f], s.frame_bits[f] = s.size_air_ns[size][rate], s.size_bits[size][rate]
    s.frame_curve[f] = s.size_curve[size][rate]


def observe(s: DcfState, rules: DcfRules, i: int, to: int) -> None:
    """Radio i learns with how much SINR radio ``to`` has received its frame, and chooses the rate of its next one."""
    if rules.rate_control == 0:
        return
    best = 0
    for rate in range(len(s.least_snr)):
        if s.least_snr[rate] < s.least[i][to]:
            best = rate
    s.rate[i][to] = best


def send_data(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i sends its frame."""
    f = s.sending[i]
    s.began_ns[f] = now
    kind = BROADCAST if s.to[f] == NOBODY else UNICAST
    send(s, rules, i, now, kind, s.frame_curve[f], s.frame_bits[f] / (s.air_ns[f] - rules.header_end_ns), s.air_ns[f])


def send_rts(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i sends an RTS before its frame."""
    f = s.sending[i]
    s.began_ns[f] = now
    copy(s.patience[i], s.patiences[f])
    fill(s.doubt[i][draw(s, i)], s.patience[i])
    send(s, rules, i, now, RTS, ACKNOWLEDGEMENT, rules.rts_bits_per_ns, rules.rts_air_ns)


def send_protected(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i sends its frame after RTS and CTS, with the level of the RTS."""
    copy(s.patiences[s.sending[i]], s.patience[i])
    send_data(s, rules, i, now)


def send(
    s: DcfState, rules: DcfRules, i: int, now: int, kind: int, curve: int, payload_bits_per_ns: float, air_ns: int
) -> None:
    """Put a frame of radio i on the air, and update carrier sense."""
    s.kind[i], s.curve[i], s.payload_bits_per_ns[i] = kind, curve, payload_bits_per_ns
    count_down(s, rules, i, now)
    put_on_air(s, rules, i, now, air_ns)
    s.eifs_ns[i] = 0
    s.idle_ns[i] = max(s.idle_ns[i], now + air_ns)
    defer(s, rules, i)


def answer(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i sends ACK or CTS: same path, new fading; at other radios with the level of its last frame."""
    f = s.acked[i]
    back = s.sender[f]
    level = s.level[back][i] * (s.power_mw[i] / s.power_mw[back]) * s.answer[back]
    copy(s.heard[i], s.level[i])
    s.level[i][back] = level
    fill(s.doubt[i][draw(s, i)], s.patience[i])
    if s.kind[back] == RTS:
        send(s, rules, i, now, CTS, ACKNOWLEDGEMENT, rules.cts_bits_per_ns, rules.cts_air_ns)
    else:
        rate = s.frame_rate[f]
        send(s, rules, i, now, ACK, s.ack_curve[rate], s.ack_bits_per_ns[rate], s.ack_air_ns[rate])


def finish(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """End the transmission of radio i."""
    doze(s, rules, now)
    duration = duration_ns(s, rules, i)
    take_off_air(s, rules, i, now, now + duration if duration > 0 else 0)
    sense(s, rules, now)
    if s.kind[i] == BROADCAST:
        decide(s, s.sending[i], now, RECEIVED)
        copy(s.fate[i], s.out_fate[s.counts[DECIDED] - 1])
        copy(s.least[i], s.out_least[s.counts[DECIDED] - 1])
        release(s, rules, i, now, now)
    elif s.kind[i] == ACK or s.kind[i] == CTS:
        finish_answer(s, rules, i, now)
    else:
        finish_request(s, rules, i, now)


def finish_request(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """The destination answers the unicast frame, or the RTS, of radio i; an RTS unless the medium is reserved there."""
    f, n = s.sending[i], len(s.lock)
    to = s.to[f]
    s.least_there[f] = s.least[i][to]
    s.due[TIMEOUT * n + i] = now + rules.timeout_ns
    s.outcome[f] = s.fate[i][to]
    if s.fate[i][to] != RECEIVED:
        return
    if s.kind[i] == RTS:
        s.outcome[f] = COLLISION  # until the CTS is received
        if s.nav_ns[to] > now:
            return
    elif not s.told[f]:  # independent of the acknowledgement
        decide(s, f, now, RECEIVED)
        s.out_done[s.counts[DECIDED] - 1] = False
        s.told[f] = True
    s.acked[to] = f
    s.due[ANSWER * n + to] = now + rules.sifs_ns


def finish_answer(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """The sender that has received the CTS of radio i sends its frame; one that has received the ACK turns to the next."""
    f, n = s.acked[i], len(s.lock)
    s.acked[i] = NOBODY
    back = s.sender[f]
    if s.fate[i][back] != RECEIVED or s.sending[back] != f:
        return
    s.due[TIMEOUT * n + back] = NEVER
    observe(s, rules, back, i)
    if s.kind[i] == CTS:
        s.due[ANSWER * n + back] = now + rules.sifs_ns
    else:
        s.window[back] = rules.cw_min
        s.failures[back] = 0
        decide(s, f, now, s.outcome[f])
        release(s, rules, back, now, now)


def duration_ns(s: DcfState, rules: DcfRules, i: int) -> int:
    """Time that the frame of radio i reserves behind its end: to the end of the acknowledgement; of ACK and broadcasts 0."""
    kind = s.kind[i]
    f = s.acked[i] if kind == CTS else s.sending[i]
    acknowledged = rules.sifs_ns + s.ack_air_ns[s.frame_rate[f]]
    if kind == UNICAST:
        return int(acknowledged)
    if kind == CTS:
        return int(rules.sifs_ns + s.air_ns[f] + acknowledged)
    if kind == RTS:
        return int(2 * rules.sifs_ns + rules.cts_air_ns + s.air_ns[f] + acknowledged)
    return 0


def is_receiving(s: DcfState, rules: DcfRules, i: int, now: int) -> bool:
    """Whether radio i receives the payload of a frame."""
    settle(s, rules, now)
    heard = s.lock[i]
    return bool(heard != NOBODY and s.start_ns[heard] + rules.header_end_ns <= now and not s.spoiled[heard][i])


def reset_nav(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """No frame followed an RTS: its reservation ends at radio i (IEEE 802.11-2016, 10.3.2.4), unless it receives one now."""
    s.due[NAV_RESET * len(s.lock) + i] = NEVER
    if is_receiving(s, rules, i, now):
        return
    s.nav_ns[i] = now
    s.idle_ns[i] = max(now, physical_end(s, rules, i, now))
    defer(s, rules, i)
    if s.wake_ns[i] < NEVER:
        request(s, rules, i, now)
        s.due[i] = max(s.over_ns[i], s.wake_ns[i])


def give_up(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Timeout of radio i without ACK or CTS; postponed while it receives a frame."""
    timeout = TIMEOUT * len(s.lock) + i
    if is_receiving(s, rules, i, now):
        s.due[timeout] = s.end_ns[s.lock[i]] + PAYLOAD_OVER_NS
        return
    s.due[timeout] = NEVER
    f = s.sending[i]
    s.window[i] = min(2 * s.window[i] + 1, rules.cw_max)
    s.failures[i] += 1
    if s.failures[i] > rules.attempts:  # over all frames, as in ns-3.44
        s.failures[i] = 0
        s.window[i] = rules.cw_min
    if s.attempts[f] >= rules.attempts:
        s.rate[i][s.to[f]] = 0
        decide(s, f, now, s.outcome[f])
    else:
        insert(s, i, f, NOBODY, s.head[i])
    heard_until_now = s.idle_ns[i] == now - PAYLOAD_OVER_NS
    release(s, rules, i, now, now if heard_until_now else now + rules.difs_ns)  # else the wait counts as busy time


def soonest(times: Ints) -> int:
    """Index of the earliest time, the first of equal ones."""
    first = 0
    for k in range(1, len(times)):
        if times[k] < times[first]:
            first = k
    return first


def copy(values: Floats | Codes, to: Floats | Codes) -> None:
    """Copy values into an array, (n,)."""
    for j in range(len(to)):
        to[j] = values[j]


def fill(value: float, to: Floats | Codes) -> None:
    """Set all elements of an array, (n,)."""
    for j in range(len(to)):
        to[j] = value


def sense(s: DcfState, rules: DcfRules, now: int) -> None:
    """The medium is busy until the times in `DcfState.busy`, (n,): freeze backoffs and move due times.

    A radio that already had a later end of the busy time is unchanged: if its access timer has expired, it sends now.
    """
    busy, slots, idle_ns, over_ns, due = s.busy, s.slots, s.idle_ns, s.over_ns, s.due
    for j in range(len(busy)):
        if busy[j] > idle_ns[j]:
            count_down(s, rules, j, now)
            idle_ns[j] = busy[j]
            over_ns[j] = max(over_ns[j], busy[j] + slots[j] * rules.slot_ns + rules.difs_ns)
            due[j] = max(over_ns[j], s.wake_ns[j])


def doze(s: DcfState, rules: DcfRules, now: int) -> None:
    """Re-arm the access timers that expired while the medium was busy, before any other event.

    In ns-3.44 the access timer is set to the end of the backoff by the state of the medium at that time. A longer busy time
    re-arms it at its expiry, but nothing shortens it: if EIFS ends early, because a payload begins to be received, the radio
    sends late, at the expiry of the timer. By the standard it would send earlier.
    """
    wake_ns = s.wake_ns
    for j in range(len(wake_ns)):
        if wake_ns[j] <= now:
            wake_ns[j] = expected_ns(s, rules, j, wake_ns[j])
            if wake_ns[j] <= now:
                wake_ns[j] = expected_ns(s, rules, j, now)


def expected_ns(s: DcfState, rules: DcfRules, i: int, now: int) -> int:
    """End of the backoff of radio i by its carrier sense; the length of a frame is unknown until its header is received."""
    held = s.lock[i]
    if held == NOBODY:
        return int(s.over_ns[i])
    in_header = now <= s.start_ns[held] + rules.header_end_ns
    busy_ns = max(s.header_ns[i], s.eifs_ns[i]) if in_header else s.idle_ns[i]
    return int(busy_ns + s.slots[i] * rules.slot_ns + rules.difs_ns)


def count_down(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Subtract the slots that have passed at radio i, without the current one; in EDCA, which counts from AIFS on, with it."""
    current = rules.aligned if now >= s.over_ns[i] - s.slots[i] * rules.slot_ns else 0
    s.slots[i] = min(max((s.over_ns[i] + (rules.slot_ns - 1 - now)) // rules.slot_ns - current, 0), s.slots[i])


def request(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i has a frame to send: set its access timer to the end of the backoff."""
    s.wake_ns[i] = expected_ns(s, rules, i, now)
    s.due[i] = s.over_ns[i]


def draw(s: DcfState, i: int) -> int:
    """Index of the next backoff draw of radio i in its row of ``s.backoff``; marks that draws run out (`SCARCE`)."""
    place = int(s.drawn[i] - s.store[i])
    s.drawn[i] += 1
    if place + 1 == len(s.backoff[i]):
        s.counts[SCARCE] = 1
    return place


def back_off(s: DcfState, rules: DcfRules, i: int, counting_ns: int) -> None:
    """Draw a backoff of radio i; it counts from ``counting_ns`` if the medium is idle."""
    s.slots[i] = int(s.backoff[i][draw(s, i)] * (s.window[i] + 1))
    wait(s, rules, i, counting_ns)


def wait(s: DcfState, rules: DcfRules, i: int, counting_ns: int) -> None:
    """Count the remaining slots of radio i from ``counting_ns`` if the medium is idle."""
    begins = max(counting_ns, max(s.idle_ns[i], s.eifs_ns[i]) + rules.difs_ns)
    s.over_ns[i] = begins + s.slots[i] * rules.slot_ns


def next_slot_ns(s: DcfState, rules: DcfRules, i: int, now: int) -> int:
    """The first slot boundary of radio i that is not earlier than now."""
    begin = max(s.idle_ns[i], s.eifs_ns[i]) + rules.difs_ns
    return int(begin + max(0, now - begin + rules.slot_ns - 1) // rules.slot_ns * rules.slot_ns)


def enqueue(s: DcfState, i: int, f: int) -> None:
    """Insert a frame into the queue of radio i, after all frames of at least its priority."""
    before, after = s.tail[i], NOBODY
    if before != NOBODY and s.priority[before] < s.priority[f]:
        before, after = NOBODY, s.head[i]
        while s.priority[after] >= s.priority[f]:
            before, after = after, s.behind[after]
    insert(s, i, f, before, after)


def insert(s: DcfState, i: int, f: int, before: int, after: int) -> None:
    """Insert a frame between two neighbours in the queue of radio i."""
    s.behind[f] = after
    if before == NOBODY:
        s.head[i] = f
    else:
        s.behind[before] = f
    if after == NOBODY:
        s.tail[i] = f
    s.waiting[i] += 1


def leave(s: DcfState, i: int) -> int:
    """Remove the first frame from the queue of radio i."""
    f = int(s.head[i])
    s.head[i] = s.behind[f]
    if s.head[i] == NOBODY:
        s.tail[i] = NOBODY
    s.waiting[i] -= 1
    return f


def expire(s: DcfState, rules: DcfRules, i: int, now: int) -> bool:
    """Drop the first frame in the queue of radio i if it has expired; returns whether it did."""
    f = s.head[i]
    if f == NOBODY or now - s.offered_ns[f] <= rules.lifetime_ns:
        return False
    decide(s, leave(s, i), now, s.outcome[f])
    return True


def decide(s: DcfState, f: int, now: int, fate: int) -> None:
    """Output the decision of a frame, with one fate at all radios; the fates of a sent broadcast are set afterwards.

    If the reception of the frame was output before, this decision only frees its place.
    """
    k = s.counts[DECIDED]
    s.counts[DECIDED] = k + 1
    s.out_frame[k] = f
    s.out_end[k] = NEVER if s.told[f] else now
    s.out_start[k] = s.began_ns[f]
    s.out_attempts[k] = s.attempts[f]
    s.out_done[k] = True
    fill(fate, s.out_fate[k])
    fill(s.least_there[f], s.out_least[k])


def next_decision(s: DcfState, rules: DcfRules) -> int:
    """Earliest time of the next decision if no other frame is offered."""
    n, soonest = len(s.lock), NEVER
    for at in range(s.counts[ON_AIR]):
        soonest = min(soonest, s.end_ns[s.air[at]])
    for i in range(n):
        for row in range(1, len(s.due) // n):
            soonest = min(soonest, s.due[row * n + i])
        begin, f = s.due[i], s.head[i]
        if begin < NEVER:
            late = f == NOBODY or begin > s.offered_ns[f] + rules.lifetime_ns
            if not late:  # the last attempt may end with its RTS
                set_rate(s, rules, f)
                begin += min(s.air_ns[f], rules.rts_air_ns) if s.protected[f] else s.air_ns[f]
            soonest = min(soonest, begin)
    return soonest
