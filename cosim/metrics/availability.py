"""How well agents and real vehicles took part: missed ticks, ages of what is known, errors of prediction, stops.

An answer of an agent that comes in time leaves nothing here, however late it is on the wall clock: the run waits for it.
"""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.metrics.radio import Receptions, quantiles
from vcmvsp.cosim.types import Array, Incident, Presence, RealStatus

SPREAD = ("p50", "p99", "max")
LIMITS = "limits"  # among the causes of a `RealStatus`: of speed and acceleration


def agent_metrics(
    presences: Sequence[tuple[str, Presence]], ticks: Mapping[str, Ticks], end_ns: int, duration_ns: int
) -> dict[str, Any]:
    """The ``agents`` part of a run that lasted until ``end_ns``, and was to last ``duration_ns``, when agents do not act."""
    until_ns = min(end_ns + 1, duration_ns)  # an agent that ends the run has missed the tick at its end
    return {
        vehicle: _of_agent([each for name, each in presences if name == vehicle], train, end_ns, until_ns)
        for vehicle, train in sorted(ticks.items())
    }


def _of_agent(presences: Sequence[Presence], train: Ticks, end_ns: int, until_ns: int) -> dict[str, Any]:
    late, missed, reconnects, lost_ns = 0, 0, 0, 0
    gone_ns: int | None = None
    for presence in presences:
        if presence.state == "back":
            late, reconnects = late + presence.late, reconnects + 1
            if gone_ns is not None:
                missed, lost_ns = missed + _count(train, gone_ns, presence.since_ns), lost_ns + presence.since_ns - gone_ns
            gone_ns = None
        elif gone_ns is None:
            gone_ns = presence.since_ns
    if gone_ns is not None:
        missed, lost_ns = missed + _count(train, gone_ns, until_ns), lost_ns + max(0, end_ns - gone_ns)
    return {"late": late, "missed": missed, "reconnects": reconnects, "lost_s": lost_ns / SECOND_NS}


def _count(train: Ticks, from_ns: int, to_ns: int) -> int:
    """Ticks t with from <= t < to."""
    first, stop = (-(-time_ns * train.per // train.ns) for time_ns in (from_ns, to_ns))
    return max(0, stop - first)


def hardware_metrics(
    statuses: Mapping[str, Sequence[tuple[int, RealStatus]]],
    incidents: Sequence[tuple[str, Incident]],
    fixes: Mapping[str, int],
    got: Receptions,
) -> dict[str, Any]:
    """The ``hardware`` part: of each real vehicle, from its statuses (with times, ns), incidents and positions that came."""
    return {
        vehicle: _of_one(
            told, [each for name, each in incidents if name == vehicle], fixes.get(vehicle, 0), _delays_s(got, vehicle)
        )
        for vehicle, told in sorted(statuses.items())
    }


def _of_one(
    told: Sequence[tuple[int, RealStatus]], incidents: Sequence[Incident], fixes: int, delays_s: Array
) -> dict[str, Any]:
    statuses = [status for _, status in told]
    ages_s = _numbers([each.age_s for each in statuses])
    latency_s = float(np.median(ages_s)) if ages_s.size else None
    return {
        "age_s": quantiles(ages_s, SPREAD),
        "fix_age_s": quantiles(_numbers([each.fix_age_s for each in statuses]), SPREAD),
        "sigma_m": quantiles(_numbers([each.sigma_m for each in statuses]), SPREAD),
        "prediction_m": quantiles(_numbers([each.prediction_m for each in statuses]), SPREAD),
        "fixes": fixes,
        "gated": max((each.gated for each in statuses), default=0),
        "reconnects": max(0, max((each.link for each in statuses), default=0) - 1),
        "stops": dict(sorted(Counter(each.cause for each in incidents if each.what == "stopped").items())),
        "limited_s": sum(after - now for (now, status), (after, _) in itertools.pairwise(told) if status.causes) / SECOND_NS,
        "limited_by_s": limited_by_s(told),
        "frames_too_early": None if latency_s is None else int(np.count_nonzero(delays_s < latency_s)),
    }


def limited_by_s(told: Sequence[tuple[int, RealStatus]]) -> dict[str, float]:
    """How long each cause held a real vehicle back; its limits, which act whenever it gains speed, where nothing else did."""
    by_ns = Counter[str]()
    for (now, status), (after, _) in itertools.pairwise(told):
        others = [cause for cause in status.causes if cause != LIMITS]
        by_ns.update(dict.fromkeys(others or status.causes, after - now))
    return {cause: held_ns / SECOND_NS for cause, held_ns in sorted(by_ns.items())}


def _delays_s(got: Receptions, sender: str) -> Array:
    if sender not in got.senders:
        return np.empty(0)
    own = got.by == got.senders.index(sender)
    return np.asarray((got.received_ns[own] - got.sent_ns[own]) / SECOND_NS)


def _numbers(values: Sequence[float | None]) -> Array:
    return np.array([each for each in values if each is not None and np.isfinite(each)])
