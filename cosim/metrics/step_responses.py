"""How a follower gets to its place: overshoot of its error and rate of the decay.

Both are of its largest step: of the stretches of time in which it has one place to keep, the one that begins with the
greatest error. One that begins within ``settled_m`` of its place makes no step.

- Overshoot (as in Toh 2012, Figs 30 and 31): the component of z along the start error z0, in the follower's frame, begins
  at |z0|; as far as it ever falls below zero, as share of |z0|. Whatever disturbs the follower later counts, too.
- Rate of convergence: the k of ``|z| = |z0| exp(-k t)``, least squares of ln|z| over the recorded instants from the start
  until |z| first falls below 5 % of |z0|, or below twice the error that remains: the RMS |z| of the stretch's last fifth.
  None where that leaves fewer than two instants.
"""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array

ARRIVED = 0.05  # share of |z0|
REMAINS = 2.0  # times the RMS |z| of the last fifth: noise seldom exceeds it


def response(steps: Sequence[tuple[Array, Array]], settled_m: float) -> tuple[float | None, float | None]:
    """Overshoot and rate (1/s) of the largest of these steps.

    Each is recorded instants (m,) in ns and the error z (m,) at them in the follower's frame, m: z1 + i z2; NaN where it is not
    known.
    """
    known = [(time_ns[there], z[there]) for time_ns, z in steps if (there := np.isfinite(z)).any()]
    if not known:
        return None, None
    time_ns, z = max(known, key=lambda step: abs(step[1][0]))
    start = abs(z[0])
    if start <= settled_m:
        return None, None
    along = (z * np.conj(z[0])).real / start
    return float(max(0.0, -along.min() / start)), _rate(time_ns, np.abs(z))


def _rate(time_ns: Array, error: Array) -> float | None:
    remains = np.sqrt(np.mean(error[-max(1, len(error) // 5) :] ** 2))
    arrived = np.flatnonzero(error < max(ARRIVED * error[0], REMAINS * remains))
    stop = arrived[0] if arrived.size else len(error)
    if stop < 2:
        return None
    t = (time_ns[:stop] - time_ns[0]) / SECOND_NS
    t -= t.mean()
    return float(-(t @ np.log(error[:stop])) / (t @ t))
