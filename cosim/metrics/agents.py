"""Metrics of commands and of the participation of agents and real vehicles: missed ticks, ages of information, stops.

A command holds until the next one, the last until the end of the run. So the commanded speed |v| and yaw rate are step
functions of time, and their root mean squares and the control effort, ``integral of |v|^2 dt``, are exact. The commanded
acceleration is the change from one command to the next over the time between them, its root mean square weighted with that
time; |v| and changes are of vectors. Time towards a way-point has no commanded velocity and does not count.

An answer that arrives in time leaves no trace here, however late on the wall clock: the run waits for it.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.metrics.motion import Window, window_ns
from vcmvsp.cosim.metrics.radio import ReceptionRows, quantiles
from vcmvsp.cosim.tables.columns import code_of
from vcmvsp.cosim.types import Array, Incident, Presence, RealStatus

KEYS = ("speed_rms_m_s", "yaw_rate_rms_rad_s", "acceleration_rms_m_s2", "yaw_acceleration_rms_rad_s2", "effort_m2_s")
SPREAD = ("p50", "p99", "max")
T = TypeVar("T")
LIMITS = "limits"  # a cause in `RealStatus`: limits of speed and acceleration


def control_metrics(commands: Mapping[str, Array], vehicles: Sequence[str], window: Window, end_ns: int) -> dict[str, Any]:
    """The ``control`` part, per vehicle and for all vehicles together.

    ``commands`` are rows of time in ns, velocity (3) in m/s and yaw rate in rad/s, in order of time; NaN: no command.
    """
    begin, last = window_ns(window)
    none = np.empty((0, 5))
    sums = {name: _sums(commands.get(name, none), begin, min(last, end_ns)) for name in vehicles}
    total = np.sum(list(sums.values()), axis=0)
    return {**_summary(total), "per_vehicle": {name: _summary(own) for name, own in sums.items()}}


@np.errstate(over="ignore")  # a command may be any number: what cannot be said of it is infinite
def _sums(rows: Array, begin: int, end: int) -> Array:
    """Integrals over time: 1, |v|^2 and w^2 under command; 1, |dv/dt|^2 and (dw/dt)^2 between commands."""
    rows = rows[np.append(np.diff(rows[:, 0]) > 0, True)[: len(rows)]]  # the last of several at one instant counts
    time, values = rows[:, 0], rows[:, 1:]
    held_s = np.diff(np.append(time, end).clip(begin, end)) / SECOND_NS
    held_s[np.isnan(values[:, 0])] = 0.0
    step, apart = np.diff(values, axis=0), np.diff(time) / SECOND_NS
    judged = (time[1:] >= begin) & (time[1:] <= end) & ~np.isnan(step[:, 0])
    step, apart = step[judged], apart[judged]
    squared = np.where(held_s[:, np.newaxis] > 0.0, values, 0.0) ** 2  # zero time times infinity would be NaN
    changed = step**2 / apart[:, np.newaxis]
    return np.array(
        [
            held_s.sum(),
            held_s @ squared[:, :3].sum(axis=1),
            held_s @ squared[:, 3],
            apart.sum(),
            changed[:, :3].sum(),
            changed[:, 3].sum(),
        ]
    )


def _summary(sums: Array) -> dict[str, float | None]:
    held_s, speed, yaw_rate, apart, acceleration, yaw_acceleration = sums.tolist()
    if not held_s:
        return dict.fromkeys(KEYS)
    held = (speed / held_s) ** 0.5, (yaw_rate / held_s) ** 0.5
    changed = ((acceleration / apart) ** 0.5, (yaw_acceleration / apart) ** 0.5) if apart else (None, None)
    return dict(zip(KEYS, (*held, *changed, speed), strict=True))


def agent_metrics(
    presences: Sequence[tuple[str, Presence]], ticks: Mapping[str, Ticks], end_ns: int, duration_ns: int
) -> dict[str, Any]:
    """The ``agents`` part of a run that ended at ``end_ns`` of ``duration_ns``, given the ticks at which agents did not act."""
    until_ns = min(end_ns + 1, duration_ns)  # an agent that ends the run has missed the tick at its end
    own = _by_vehicle(presences)
    return {vehicle: _of_agent(own[vehicle], train, end_ns, until_ns) for vehicle, train in sorted(ticks.items())}


def _by_vehicle(events: Iterable[tuple[str, T]]) -> defaultdict[str, list[T]]:
    groups = defaultdict[str, list[T]](list)
    for vehicle, event in events:
        groups[vehicle].append(event)
    return groups


def _of_agent(presences: Sequence[Presence], train: Ticks, end_ns: int, until_ns: int) -> dict[str, Any]:
    late, missed, reconnects, lost_ns = 0, 0, 0, 0
    gone_ns: int | None = None
    for presence in presences:
        if presence.state == "back":
            late, reconnects = late + presence.late, reconnects + 1
            if gone_ns is not None:
                missed += len(train.between(gone_ns, presence.since_ns))
                lost_ns += presence.since_ns - gone_ns
            gone_ns = None
        elif gone_ns is None:
            gone_ns = presence.since_ns
    if gone_ns is not None:
        missed += len(train.between(gone_ns, until_ns))
        lost_ns += max(0, end_ns - gone_ns)
    return {"late": late, "missed": missed, "reconnects": reconnects, "lost_s": lost_ns / SECOND_NS}


def hardware_metrics(
    statuses: Mapping[str, Sequence[tuple[int, RealStatus]]],
    incidents: Sequence[tuple[str, Incident]],
    fixes: Mapping[str, int],
    parts: Iterable[ReceptionRows],
) -> dict[str, Any]:
    """The ``hardware`` part of each real vehicle, from its timed statuses (ns), incidents and received fixes."""
    own, numbers = _by_vehicle(incidents), {}
    for vehicle, history in sorted(statuses.items()):
        numbers[vehicle] = _of_one(history, own[vehicle], fixes.get(vehicle, 0), _delays_s(parts, vehicle))
    return numbers


def _of_one(
    history: Sequence[tuple[int, RealStatus]], incidents: Sequence[Incident], fixes: int, delays_s: Array
) -> dict[str, Any]:
    known = {name: _known(history, name) for name in ("age_s", "fix_age_s", "sigma_m", "prediction_m")}
    latency_s = float(np.median(known["age_s"])) if known["age_s"].size else None
    stops = Counter(each.cause for each in incidents if each.what == "stopped")
    limited_ns = [after - now for (now, status), (after, _) in itertools.pairwise(history) if status.causes]
    numbers: dict[str, Any] = {name: quantiles(values, SPREAD) for name, values in known.items()}
    return numbers | {
        "fixes": fixes,
        "gated": int(_known(history, "gated").max()),
        "reconnects": max(0, int(_known(history, "link").max()) - 1),
        "stops": dict(sorted(stops.items())),
        "limited_s": sum(limited_ns) / SECOND_NS,
        "limited_by_s": limited_by_s(history),
        "frames_too_early": None if latency_s is None else int(np.count_nonzero(delays_s < latency_s)),
    }


def _known(history: Sequence[tuple[int, RealStatus]], name: str) -> Array:
    """A number of the statuses, without unknown values."""
    values = np.array([getattr(status, name) for _, status in history], np.float64)  # None becomes NaN
    return values[np.isfinite(values)]


def limited_by_s(history: Sequence[tuple[int, RealStatus]]) -> dict[str, float]:
    """Time for which each cause limited a real vehicle; `LIMITS`, active in every acceleration, counts only on its own."""
    by_ns = Counter[str]()
    for (now, status), (after, _) in itertools.pairwise(history):
        others = [cause for cause in status.causes if cause != LIMITS]
        by_ns.update(dict.fromkeys(others or status.causes, after - now))
    return {cause: held_ns / SECOND_NS for cause, held_ns in sorted(by_ns.items())}


def _delays_s(parts: Iterable[ReceptionRows], sender: str) -> Array:
    delays_s = [np.empty(0)]
    for part in parts:
        own = part.by == code_of(part.senders, sender)
        delays_s.append((part.received_ns[own] - part.sent_ns[own]) / SECOND_NS)
    return np.concatenate(delays_s)
