"""Backoffs: access times of the radios by their carrier sense.

A backoff counts whole slots from DIFS behind the end of the last busy time (IEEE 802.11-2016, 10.3.4.3); behind a payload that
could not be decoded, from EIFS. A radio keeps how many slots were left when it last learnt of a longer busy time, and when the
last of them is over if it learns of no other: nothing needs to be done while they pass. What is done for all radios is written
twice, as in `netsim.mac.dcf.capture`.
"""

import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools
from vcmvsp.netsim.mac.dcf.state import NOBODY, SCARCE, DcfRules, DcfState


def sense(s: DcfState, rules: DcfRules, now: int) -> None:
    """The medium is busy until the times in `DcfState.busy`, (n,): freeze backoffs and move due times.

    A radio that already had a later end of the busy time is unchanged: if its access timer has expired, it sends now.
    """
    busy = s.busy
    longer = busy > s.idle_ns
    if not np.count_nonzero(longer):
        return
    left = np.minimum(np.maximum((s.over_ns + (rules.slot_ns - 1 - now)) // rules.slot_ns, 0), s.slots)
    np.putmask(s.slots, longer, left)
    np.putmask(s.idle_ns, longer, busy)
    np.putmask(s.over_ns, longer, np.maximum(s.over_ns, busy + left * rules.slot_ns + rules.difs_ns))
    np.putmask(s.due[: len(busy)], longer, np.maximum(s.over_ns, s.wake_ns))


def sense_loop(s: DcfState, rules: DcfRules, now: int) -> None:
    """See `sense`."""
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
    if s.wake_ns[s.wake_ns.argmin()] > now:
        return
    woken, receiving = s.over_ns, s.lock != NOBODY
    if np.count_nonzero(receiving):
        left = s.slots * rules.slot_ns + rules.difs_ns
        woken = np.where(receiving, s.idle_ns + left, woken)
        before = np.maximum(s.header_ns, s.eifs_ns) + left
        in_header = s.wake_ns <= s.start_ns[s.lock] + rules.header_end_ns
        np.putmask(woken, receiving & in_header & (before > now), before)
    np.putmask(s.wake_ns, s.wake_ns <= now, woken)


def doze_loop(s: DcfState, rules: DcfRules, now: int) -> None:
    """See `doze`."""
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


def defer(s: DcfState, rules: DcfRules, who: Bools) -> None:
    """Start or end EIFS for some radios, (n,), whose medium is busy until now at least."""
    over = np.maximum(s.idle_ns, s.eifs_ns) + s.slots * rules.slot_ns + rules.difs_ns
    np.putmask(s.over_ns, who, over)
    np.putmask(s.due[: len(who)], who, np.maximum(over, s.wake_ns))


def defer_one(s: DcfState, rules: DcfRules, i: int) -> None:
    """The same for radio i."""
    s.over_ns[i] = max(s.idle_ns[i], s.eifs_ns[i]) + s.slots[i] * rules.slot_ns + rules.difs_ns
    s.due[i] = max(s.over_ns[i], s.wake_ns[i])


def count_down(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """The slots of radio i that have passed; those that have begun have not."""
    s.slots[i] = min(max((s.over_ns[i] + (rules.slot_ns - 1 - now)) // rules.slot_ns, 0), s.slots[i])


def request(s: DcfState, rules: DcfRules, i: int, now: int) -> None:
    """Radio i has a frame to send: set its access timer to the end of the backoff."""
    s.wake_ns[i] = expected_ns(s, rules, i, now)
    s.due[i] = s.over_ns[i]


def draw(s: DcfState, i: int) -> int:
    """Place of the next draw of radio i in store."""
    place = int(s.drawn[i] - s.store[i])
    s.drawn[i] += 1
    if place + 1 == s.backoff.shape[1]:
        s.counts[SCARCE] = 1
    return place


def back_off(s: DcfState, rules: DcfRules, i: int, counting_ns: int) -> None:
    """Radio i draws a new backoff, which counts from a time on, if the medium is idle."""
    s.slots[i] = int(s.backoff[i, draw(s, i)] * (s.window[i] + 1))
    wait(s, rules, i, counting_ns)


def wait(s: DcfState, rules: DcfRules, i: int, counting_ns: int) -> None:
    """The slots that radio i has left count from a time on, if the medium is idle."""
    begins = max(counting_ns, max(s.idle_ns[i], s.eifs_ns[i]) + rules.difs_ns)
    s.over_ns[i] = begins + s.slots[i] * rules.slot_ns
