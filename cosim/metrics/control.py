"""What control asks of the vehicles: commanded velocities.

A command holds until the next one, the last to the end of the run. So the commanded speed |v| and yaw rate are step
functions of time, and their root mean squares and the control effort, ``integral of |v|^2 dt``, are exact. The commanded
acceleration is the change from one command to the next over the time between them, its root mean square weighted with that
time; |v| and changes are those of vectors. While a vehicle flies to a way-point no velocity is commanded, and the time does
not count.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import Window, window_ns
from vcmvsp.cosim.types import Array

KEYS = ("speed_rms_m_s", "yaw_rate_rms_rad_s", "acceleration_rms_m_s2", "yaw_acceleration_rms_rad_s2", "effort_m2_s")


def control_metrics(commands: Mapping[str, Array], vehicles: Sequence[str], window: Window, end_ns: int) -> dict[str, Any]:
    """The ``control`` part, of each vehicle and of all.

    ``commands`` are rows of time in ns, velocity (3) in m/s and yaw rate in rad/s, in order of time; NaN: none from then on.
    """
    begin, last = window_ns(window)
    none = np.empty((0, 5))
    sums = {name: _sums(commands.get(name, none), begin, min(last, end_ns)) for name in vehicles}
    total = np.sum(list(sums.values()), axis=0)
    return {**_summary(total), "per_vehicle": {name: _summary(own) for name, own in sums.items()}}


@np.errstate(over="ignore")  # a command may be any number: what cannot be said of it is infinite
def _sums(rows: Array, begin: int, end: int) -> Array:
    """Integrals over time: 1, |v|^2 and w^2 under command; 1, |dv/dt|^2 and (dw/dt)^2 between commands."""
    rows = rows[np.append(np.diff(rows[:, 0]) > 0, True)[: len(rows)]]  # of several at one instant the last counts
    time, values = rows[:, 0], rows[:, 1:]
    held = np.diff(np.append(time, end).clip(begin, end)) / SECOND_NS
    held[np.isnan(values[:, 0])] = 0.0
    step, apart = np.diff(values, axis=0), np.diff(time) / SECOND_NS
    judged = (time[1:] >= begin) & (time[1:] <= end) & ~np.isnan(step[:, 0])
    step, apart = step[judged], apart[judged]
    squared = np.where(held[:, np.newaxis] > 0.0, values, 0.0) ** 2  # no time of what is infinite would be no number
    changed = step**2 / apart[:, np.newaxis]
    return np.array(
        [
            held.sum(),
            held @ squared[:, :3].sum(axis=1),
            held @ squared[:, 3],
            apart.sum(),
            changed[:, :3].sum(),
            changed[:, 3].sum(),
        ]
    )


def _summary(sums: Array) -> dict[str, float | None]:
    held, speed, yaw_rate, apart, acceleration, yaw_acceleration = sums.tolist()
    if not held:
        return dict.fromkeys(KEYS)
    return {
        "speed_rms_m_s": (speed / held) ** 0.5,
        "yaw_rate_rms_rad_s": (yaw_rate / held) ** 0.5,
        "acceleration_rms_m_s2": (acceleration / apart) ** 0.5 if apart else None,
        "yaw_acceleration_rms_rad_s2": (yaw_acceleration / apart) ** 0.5 if apart else None,
        "effort_m2_s": speed,
    }
