"""What the powers on the air add up to, in the order in which frames began: the same to the last bit at one radio or at all."""

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.mac.dcf.state import ON_AIR, Rules, State


def interference(s: State, rules: Rules, i: int) -> Floats | float:
    """Noise and the power of everything but the frame of radio i, (n,) mW; a number if there is nothing else."""
    total: Floats | float = rules.noise_mw
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            total = total + s.level[other]
    return total


def interference_at(s: State, rules: Rules, i: int, j: int) -> float:
    """The same at radio j."""
    total = rules.noise_mw
    for at in range(s.counts[ON_AIR]):
        other = s.air[at]
        if other != i:
            total += s.level[other, j]
    return total


def order_by_end(s: State) -> None:
    """Put in `State.order` who is on the air, the last to end first; of those that end together the first to start."""
    order = s.order
    for at in range(s.counts[ON_AIR]):
        i, to = s.air[at], at
        while to > 0 and s.end_ns[order[to - 1]] < s.end_ns[i]:
            order[to] = order[to - 1]
            to -= 1
        order[to] = i


def energy_end(s: State, threshold_mw: float) -> Ints:
    """Until when the sum of the powers on the air, in `State.order`, stays at the threshold, (n,) ns; 0 where it is below."""
    until = np.zeros(len(s.lock), np.int64)
    total = np.zeros(len(s.lock))
    for i in s.order[: s.counts[ON_AIR]]:
        total += s.level[i]
        until[(total >= threshold_mw) & (until == 0)] = s.end_ns[i]
    return until


def energy_end_at(s: State, threshold_mw: float, j: int) -> int:
    """The same at radio j."""
    total = 0.0
    for at in range(s.counts[ON_AIR]):
        i = s.order[at]
        total += s.level[i, j]
        if total >= threshold_mw:
            return int(s.end_ns[i])
    return 0
