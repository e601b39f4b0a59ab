"""The queues of the radios: lists that run through the arrays of the frames. For NumPy and compilation alike."""

from netsim.dcf_state import DECIDED, NEVER, NOBODY, Rules, State


def enqueue(s: State, i: int, f: int) -> None:
    """Behind all frames of at least its priority."""
    before, after = s.tail[i], NOBODY
    if before != NOBODY and s.priority[before] < s.priority[f]:
        before, after = NOBODY, s.head[i]
        while s.priority[after] >= s.priority[f]:
            before, after = after, s.behind[after]
    insert(s, i, f, before, after)


def insert(s: State, i: int, f: int, before: int, after: int) -> None:
    """Between two neighbours in the queue of radio i."""
    s.behind[f] = after
    if before == NOBODY:
        s.head[i] = f
    else:
        s.behind[before] = f
    if after == NOBODY:
        s.tail[i] = f
    s.waiting[i] += 1


def leave(s: State, i: int) -> int:
    """Take the first frame out of the queue of radio i."""
    f = int(s.head[i])
    s.head[i] = s.behind[f]
    if s.head[i] == NOBODY:
        s.tail[i] = NOBODY
    s.waiting[i] -= 1
    return f


def expire(s: State, rules: Rules, i: int, now: int) -> bool:
    """Whether the first frame that waits was too old, and is gone."""
    f = s.head[i]
    if f == NOBODY or now - s.offered_ns[f] <= rules.lifetime_ns:
        return False
    decide(s, leave(s, i), now, s.outcome[f])
    return True


def decide(s: State, f: int, now: int, fate: int) -> None:
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
