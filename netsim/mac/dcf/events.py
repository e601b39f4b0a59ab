"""The distributed coordination function (IEEE 802.11-2016, 10.3.4): who sends when, event by event.

After ns-3.44 (``ChannelAccessManager``, ``Txop``, ``FrameExchangeManager``): a backoff counts whole slots from DIFS behind the
end of the last busy time, stands still while the medium is busy, and is drawn anew after every transmission, whether another
frame waits or not. A frame that finds the medium idle and no backoff left waits DIFS from then on.

Written for NumPy and for compilation alike, see `netsim.mac.jit.cache`: what changes is in the arrays of a `DcfState`.
"""

from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes
from vcmvsp.netsim.mac.dcf.backoff import back_off, count_down, defer_one, doze, draw, request, sense, wait
from vcmvsp.netsim.mac.dcf.capture import detect, put_on_air, settle, take_off_air
from vcmvsp.netsim.mac.dcf.queues import decide, enqueue, expire, insert, leave, next_decision
from vcmvsp.netsim.mac.dcf.state import (
    ACK,
    ACKNOWLEDGEMENT,
    ANSWER,
    ARRIVED,
    BROADCAST,
    DECIDED,
    DECISION,
    NEVER,
    NOBODY,
    OFFERED,
    ON_AIR,
    PAYLOAD_OVER_NS,
    QUEUE_FULL,
    RECEIVED,
    SCARCE,
    SOONEST,
    START,
    TIMEOUT,
    UNICAST,
    WANTED,
    DcfRules,
    DcfState,
)

# Why `run` comes back.
DONE, LEVELS, DRAWS, OUTPUT = 0, 1, 2, 3

# What else happens, behind `START`, `ANSWER` and `TIMEOUT`.
DETECT, END, ARRIVE = 3, 4, 5


def run(s: DcfState, rules: DcfRules, until: int) -> int:
    """Everything that happens up to and including ``until``; or as far as it can, and why it cannot go on."""
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
    """What happens next, to which radio (or frame, if it arrives), and when.

    Of what happens at the same time, ends come first, then starts, then detections, then arrivals.
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
    """Radio i has done with a frame, or with an attempt; its new backoff counts from a time on."""
    s.sending[i] = NOBODY
    s.due[i] = s.wake_ns[i] = NEVER
    back_off(s, rules, i, counting_ns)
    if s.head[i] != NOBODY:
        request(s, rules, i, now)


def arrive(s: DcfState, rules: DcfRules, f: int, now: int) -> None:
    """A frame comes to its sender's queue; if one that waits there has expired, that one leaves it first."""
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
            else:
                wait(s, rules, i, now + rules.difs_ns)
        request(s, rules, i, now)


# --- sending ---


def begin(s: DcfState, rules: DcfRules, what: int, i: int, now: int) -> bool:
    """What was due of radio i; False: levels are needed first."""
    if what == START:
        return start(s, rules, i, now)
    if what == ANSWER:
        acknowledge(s, rules, i, now)
    else:
        give_up(s, rules, i, now)
    return True


def start(s: DcfState, rules: DcfRules, i: int, now: int) -> bool:
    """Radio i sends its first frame; False: its levels are needed."""
    if expire(s, rules, i, now):
        if s.head[i] == NOBODY:
            release(s, rules, i, now, now)
        return True
    f = s.head[i]
    if f == NOBODY:  # all expired while it waited
        release(s, rules, i, now, now)
        return True
    if s.attempts[f] == 0 and s.row[f] != NOBODY:
        copy(s.levels[s.row[f]], s.level[i])
        copy(s.patiences[f], s.patience[i])
        s.answer[i] = 1.0
    elif s.placed[i] != f:
        s.counts[WANTED] = f
        return False
    s.placed[i] = NOBODY
    copy(s.level[i], s.heard[i])
    s.sending[i] = leave(s, i)
    s.attempts[f] += 1
    s.began_ns[f] = now
    s.kind[i] = BROADCAST if s.to[f] == NOBODY else UNICAST
    s.payload_bits_per_ns[i] = s.frame_bits[f] / (s.air_ns[f] - rules.header_end_ns)
    s.curve[i] = s.frame_curve[f]
    s.due[i] = s.wake_ns[i] = NEVER
    send(s, rules, i, now, s.air_ns[f])
    return True


def send(s: DcfState, rules: DcfRules, i: int, now: int, air_ns: int) -> None:
    """Put a frame on the air, and know that it is busy."""
    count_down(s, rules, i, now)
    put_on_air(s, rules, i, now, air_ns)
    s.eifs_ns[i] = 0
    s.idle_ns[i] = max(s.idle_ns[i], now + air_ns)
    defer_one(s, rules, i)


def acknowledge(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i answers a unicast frame: over the way that it came, faded anew, and elsewhere as strong as what it sent last."""
    f = s.acked[i]
    back = s.sender[f]
    answer = s.level[back, i] * (s.power_mw[i] / s.power_mw[back]) * s.answer[back]
    copy(s.heard[i], s.level[i])
    s.level[i, back] = answer
    s.patience[i] = s.doubt[i, draw(s, i)]
    s.kind[i] = ACK
    s.payload_bits_per_ns[i] = rules.ack_bits_per_ns
    s.curve[i] = ACKNOWLEDGEMENT
    s.due[ANSWER * len(s.lock) + i] = NEVER
    doze(s, rules, now)
    send(s, rules, i, now, rules.ack_air_ns)


def finish(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """What radio i sends ends."""
    n = len(s.lock)
    doze(s, rules, now)
    # Who received a unicast frame keeps silent for the acknowledgement.
    reserved_ns = now + rules.sifs_ns + rules.ack_air_ns if s.kind[i] == UNICAST else 0
    take_off_air(s, rules, i, now, reserved_ns)
    sense(s, rules, now)
    if s.kind[i] == ACK:
        f = s.acked[i]
        s.acked[i] = NOBODY
        back = s.sender[f]
        if s.fate[i, back] == RECEIVED and s.sending[back] == f:
            s.due[TIMEOUT * n + back] = NEVER
            s.window[back] = rules.cw_min
            s.failures[back] = 0
            decide(s, f, now, s.outcome[f])
            release(s, rules, back, now, now)
        return
    f = s.sending[i]
    if s.kind[i] == BROADCAST:
        decide(s, f, now, RECEIVED)
        copy(s.fate[i], s.out_fate[s.counts[DECIDED] - 1])
        copy(s.least[i], s.out_least[s.counts[DECIDED] - 1])
        release(s, rules, i, now, now)
        return
    to = s.to[f]
    s.least_there[f] = s.least[i, to]
    s.due[TIMEOUT * n + i] = now + rules.timeout_ns
    if s.fate[i, to] == RECEIVED:
        s.acked[to] = f
        s.due[ANSWER * n + to] = now + rules.sifs_ns
        if not s.told[f]:  # whether its sender will know or not
            decide(s, f, now, RECEIVED)
            s.out_done[s.counts[DECIDED] - 1] = False
            s.told[f] = True
    s.outcome[f] = s.fate[i, to]


def give_up(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """No acknowledgement has come, unless it, or something else, is being received: then when that is over."""
    timeout = TIMEOUT * len(s.lock) + i
    settle(s, rules, now)
    heard = s.lock[i]
    if heard != NOBODY and s.start_ns[heard] + rules.header_end_ns <= now and not s.spoiled[heard, i]:
        s.due[timeout] = s.end_ns[heard] + PAYLOAD_OVER_NS
        return
    s.due[timeout] = NEVER
    f = s.sending[i]
    s.window[i] = min(2 * s.window[i] + 1, rules.cw_max)
    s.failures[i] += 1
    if s.failures[i] > rules.attempts:  # whatever frames they belong to: so ns-3.44
        s.failures[i] = 0
        s.window[i] = rules.cw_min
    if s.attempts[f] >= rules.attempts:
        decide(s, f, now, s.outcome[f])
    else:
        insert(s, i, f, NOBODY, s.head[i])
    heard_until_now = s.idle_ns[i] == now - PAYLOAD_OVER_NS
    release(s, rules, i, now, now if heard_until_now else now + rules.difs_ns)  # else the wait was a busy time


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


def copy(values: Floats | Codes, to: Floats | Codes) -> None:
    """Put values in the place of others, (n,)."""
    to[:] = values


def copy_loop(values: Floats | Codes, to: Floats | Codes) -> None:
    """See `copy`."""
    for j in range(len(to)):
        to[j] = values[j]
