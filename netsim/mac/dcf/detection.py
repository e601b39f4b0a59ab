"""What is on the air, and what each radio makes of it: detection, carrier sense, interference.

After ns-3.44 (``PhyEntity``, ``InterferenceHelper``, ``ThresholdPreambleDetectionModel``):

- A radio that is neither sending nor receiving notices a frame `detect_ns` after its start, if the frame is then the strongest
  of those that it hears begin, strong enough, and by `preamble_snr` above noise and interference. It receives it to its end;
  what else begins meanwhile is interference. Only a header that cannot be decoded sets it free earlier.
- The medium is busy while the radio sends or receives, and while the sum of all powers is at least `busy_mw`, found out when
  it fails to detect a frame, and at the end of one that it received. Of frames that began while it was sending and go on
  behind it, it learns at its own end; of those that began before, only if the sum is `energy_mw`.

For NumPy and compilation alike; what is done for all radios is in `netsim.mac.dcf.kernels`.
"""

from vcmvsp.netsim.mac.dcf.interference import energy_end_at, order_by_end
from vcmvsp.netsim.mac.dcf.kernels import hear_begin, judge, let_go, notice, suffer
from vcmvsp.netsim.mac.dcf.state import ON_AIR, Rules, State


def settle(s: State, rules: Rules, now: int) -> None:
    """Add up what all frames on the air have suffered since the last time: what follows is another set of them."""
    for at in range(s.counts[ON_AIR]):
        i = s.air[at]
        since = s.settled_ns[i]
        if since < now:
            begin, header_end = s.start_ns[i] + rules.preamble_ns, s.start_ns[i] + rules.header_end_ns
            header_ns = max(min(now, header_end) - max(since, begin), 0)
            suffer(s, rules, i, header_ns, max(now - max(since, header_end), 0), header_ns > 0 and now >= header_end)
            s.settled_ns[i] = now


def put_on_air(s: State, rules: Rules, i: int, now: int, air_ns: int) -> None:
    """Radio i starts to send: its level and patience are in place."""
    settle(s, rules, now)
    count = s.counts[ON_AIR]
    for at in range(count):
        other = s.air[at]
        s.shared[other] = True
        if s.pending[other, i] or s.lock[i] == other:  # it stops listening
            s.pending[other, i] = False
            s.deaf[other, i] = True
    hear_begin(s, rules, i, now)
    s.shared[i] = count > 0
    s.detected[i] = False
    s.start_ns[i] = now
    s.settled_ns[i] = now
    s.end_ns[i] = now + air_ns
    s.air[count] = i
    s.counts[ON_AIR] = count + 1


def detect(s: State, rules: Rules, i: int) -> None:
    """The frame of radio i is noticed or not; in `State.busy`: until when the medium is busy for what is known now."""
    s.detected[i] = True
    notice(s, rules, i)


def take_off_air(s: State, rules: Rules, i: int, now: int, reserved_ns: int) -> None:
    """The frame of radio i ends; in `State.busy`: until when the medium is busy for what those who received it find then.

    For those who could decode it, it is so until ``reserved_ns``.
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
        began = s.start_ns[s.air[count - 1]] > s.start_ns[i]  # something, while it was sending
        order_by_end(s)
        s.busy[i] = energy_end_at(s, rules.busy_mw if began else rules.energy_mw, i)
