"""Backoffs: when a radio that wants to send may, for what it knows of the medium.

A backoff counts whole slots from DIFS behind the end of the last busy time (IEEE 802.11-2016, 10.3.4.3); behind a payload that
could not be decoded, from EIFS. What is done for all radios is written twice, as in `netsim.dcf_kernels`.
"""

import numpy as np

from netsim.dcf_state import NEVER, NOBODY, SCARCE, Rules, State
from netsim.layers import Ints


def sense(s: State, rules: Rules, busy: Ints, now: int) -> None:
    """All radios know that the medium is busy until some time, (n,): backoffs stand still, and what is due moves."""
    n = len(s.lock)
    begun = np.maximum(s.counting_ns, np.maximum(s.idle_ns, s.eifs_ns) + rules.difs_ns)
    counted = np.minimum(np.maximum(now - begun, 0) // rules.slot_ns, s.slots)
    s.counting_ns[:] = np.where(begun <= now, begun + counted * rules.slot_ns, s.counting_ns)
    s.slots[:] = s.slots - counted
    s.idle_ns[:] = np.maximum(s.idle_ns, busy)
    resumed = np.maximum(s.counting_ns, np.maximum(s.idle_ns, s.eifs_ns) + rules.difs_ns)
    s.due[:n] = np.where(s.due[:n] < NEVER, np.maximum(resumed + s.slots * rules.slot_ns, s.wake_ns), NEVER)


def sense_loop(s: State, rules: Rules, busy: Ints, now: int) -> None:
    """See `sense`."""
    counting_ns, slots, idle_ns, eifs_ns, due = s.counting_ns, s.slots, s.idle_ns, s.eifs_ns, s.due
    for j in range(len(busy)):
        begun = max(counting_ns[j], max(idle_ns[j], eifs_ns[j]) + rules.difs_ns)
        if begun <= now:
            counting_ns[j] = begun
            if slots[j] > 0:
                counted = min((now - begun) // rules.slot_ns, slots[j])
                counting_ns[j] += counted * rules.slot_ns
                slots[j] -= counted
        idle_ns[j] = max(idle_ns[j], busy[j])
        if due[j] < NEVER:
            resumed = max(counting_ns[j], max(idle_ns[j], eifs_ns[j]) + rules.difs_ns)
            due[j] = max(resumed + slots[j] * rules.slot_ns, s.wake_ns[j])


def doze(s: State, rules: Rules, now: int) -> None:
    """Who woke up in vain by now lies down again, before anything else happens: `sense` makes nobody send who is asleep.

    In ns-3.44 a radio that wants to send looks when its backoff would be over, by what it knew when it last looked. What makes
    it wait longer it finds out then; but nothing wakes it earlier. So where EIFS ends early, because a payload begins to be
    received, it oversleeps if it had been told of the EIFS already, and then sends at once. By the standard it would be up.
    """
    if s.wake_ns.min() > now:
        return
    receiving = s.lock != NOBODY
    in_header = receiving & (s.wake_ns <= s.start_ns[s.lock] + rules.header_end_ns)
    left = s.slots * rules.slot_ns
    busy_ns = np.where(receiving, s.idle_ns, np.maximum(s.idle_ns, s.eifs_ns))
    woken = behind = np.maximum(s.counting_ns, busy_ns + rules.difs_ns) + left
    if in_header.any():
        before = np.maximum(s.counting_ns, np.maximum(s.header_ns, s.eifs_ns) + rules.difs_ns) + left
        woken = np.where(in_header & (before > now), before, behind)
    s.wake_ns[:] = np.where(s.wake_ns <= now, woken, s.wake_ns)


def doze_loop(s: State, rules: Rules, now: int) -> None:
    """See `doze`."""
    wake_ns = s.wake_ns
    for j in range(len(wake_ns)):
        if wake_ns[j] <= now:
            wake_ns[j] = expected_ns(s, rules, j, wake_ns[j])
            if wake_ns[j] <= now:
                wake_ns[j] = expected_ns(s, rules, j, now)


def expected_ns(s: State, rules: Rules, i: int, now: int) -> int:
    """When the backoff of radio i will be over, by what it knows; of a frame whose header it receives it knows no length."""
    busy_ns, held = max(s.idle_ns[i], s.eifs_ns[i]), s.lock[i]
    if held != NOBODY:
        in_header = now <= s.start_ns[held] + rules.header_end_ns
        busy_ns = max(s.header_ns[i], s.eifs_ns[i]) if in_header else s.idle_ns[i]
    return int(max(s.counting_ns[i], busy_ns + rules.difs_ns) + s.slots[i] * rules.slot_ns)


def count_down(s: State, rules: Rules, i: int, now: int) -> None:
    """The slots of radio i that have passed; see `sense`."""
    begun = max(s.counting_ns[i], max(s.idle_ns[i], s.eifs_ns[i]) + rules.difs_ns)
    if begun <= now:
        counted = min((now - begun) // rules.slot_ns, s.slots[i])
        s.counting_ns[i] = begun + counted * rules.slot_ns
        s.slots[i] -= counted


def ready_ns(s: State, rules: Rules, i: int) -> int:
    """When the backoff of radio i is over."""
    begun = max(s.counting_ns[i], max(s.idle_ns[i], s.eifs_ns[i]) + rules.difs_ns)
    return int(begun + s.slots[i] * rules.slot_ns)


def request(s: State, rules: Rules, i: int, now: int) -> None:
    """Radio i wants to send, as soon as its backoff is over."""
    s.wake_ns[i] = expected_ns(s, rules, i, now)
    s.due[i] = ready_ns(s, rules, i)


def draw(s: State, i: int) -> int:
    """Place of the next draw of radio i in store."""
    place = int(s.drawn[i] - s.store[i])
    s.drawn[i] += 1
    if place + 1 == s.backoff.shape[1]:
        s.counts[SCARCE] = 1
    return place


def back_off(s: State, i: int, counting_ns: int) -> None:
    """Radio i draws a new backoff, which counts from a time on, if the medium is idle."""
    s.slots[i] = int(s.backoff[i, draw(s, i)] * (s.window[i] + 1))
    s.counting_ns[i] = counting_ns
