"""The queues of the radios: lists that run through the arrays of the frames. For NumPy and compilation alike."""

import numpy as np

from vcmvsp.netsim.mac.dcf.state import DECIDED, NEVER, NOBODY, ON_AIR, DcfRules, DcfState


def enqueue(s: DcfState, i: int, f: int) -> None:
    """Behind all frames of at least its priority."""
    before, after = s.tail[i], NOBODY
    if before != NOBODY and s.priority[before] < s.priority[f]:
        before, after = NOBODY, s.head[i]
        while s.priority[after] >= s.priority[f]:
            before, after = after, s.behind[after]
    insert(s, i, f, before, after)


def insert(s: DcfState, i: int, f: int, before: int, after: int) -> None:
    """Between two neighbours in the queue of radio i."""
    s.behind[f] = after
    if before == NOBODY:
        s.head[i] = f
    else:
        s.behind[before] = f
    if after == NOBODY:
        s.tail[i] = f
    s.waiting[i] += 1


def leave(s: DcfState, i: int) -> int:
    """Take the first frame out of the queue of radio i."""
    f = int(s.head[i])
    s.head[i] = s.behind[f]
    if s.head[i] == NOBODY:
        s.tail[i] = NOBODY
    s.waiting[i] -= 1
    return f


def expire(s: DcfState, rules: DcfRules, i: int, now: int) -> bool:
    """Whether the first frame that waits was too old, and is gone."""
    f = s.head[i]
    if f == NOBODY or now - s.offered_ns[f] <= rules.lifetime_ns:
        return False
    decide(s, leave(s, i), now, s.outcome[f])
    return True


def decide(s: DcfState, f: int, now: int, fate: int) -> None:
    """The fate of a frame, at all radios the same; what became of a broadcast one that was sent follows.

    Of one that was received before, and told so, it says that its place is free.
    """
    k = s.counts[DECIDED]
    s.counts[DECIDED] = k + 1
    s.out_frame[k] = f
    s.out_end[k] = NEVER if s.told[f] else now
    s.out_start[k] = s.began_ns[f]
    s.out_attempts[k] = s.attempts[f]
    s.out_done[k] = True
    s.out_fate[k] = fate
    s.out_least[k] = s.least_there[f]


def next_decision(s: DcfState, rules: DcfRules) -> int:
    """When a frame may be decided next, if nothing else comes."""
    n = len(s.lock)
    soonest = int(s.due[n + s.due[n:].argmin()])
    for at in range(s.counts[ON_AIR]):
        soonest = min(soonest, int(s.end_ns[s.air[at]]))
    wanting = (s.due[:n] < NEVER).nonzero()[0]
    if len(wanting) == 1:  # most often
        i = wanting[0]
        begin, f = s.due[i], s.head[i]
        late = f == NOBODY or begin > s.offered_ns[f] + rules.lifetime_ns
        soonest = min(soonest, int(begin if late else begin + s.air_ns[f]))
    elif len(wanting):
        heads, due = s.head[wanting], s.due[wanting]
        expired = (heads == NOBODY) | (due > s.offered_ns[heads] + rules.lifetime_ns)
        soonest = min(soonest, int(np.where(expired, due, due + s.air_ns[heads]).min()))
    return soonest


def next_decision_loop(s: DcfState, rules: DcfRules) -> int:
    """See `next_decision`."""
    n, soonest = len(s.lock), NEVER
    for at in range(s.counts[ON_AIR]):
        soonest = min(soonest, s.end_ns[s.air[at]])
    for i in range(n):
        soonest = min(soonest, s.due[n + i], s.due[2 * n + i])
        begin, f = s.due[i], s.head[i]
        if begin < NEVER:
            late = f == NOBODY or begin > s.offered_ns[f] + rules.lifetime_ns
            soonest = min(soonest, begin if late else begin + s.air_ns[f])
    return soonest
