"""How well agents were there: what was missed while they were lost.

Answers that come in time leave nothing here, however late they are on the wall clock: the run waits for them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.types import Presence


def agent_metrics(
    presences: Sequence[tuple[str, Presence]], ticks: Mapping[str, Ticks], end_ns: int, duration_ns: int
) -> dict[str, Any]:
    """Of each vehicle with an agent: ``late``, ``missed``, ``reconnects`` and ``lost_s`` (`cosim.metrics`).

    Args:
        presences: vehicles that lost their agents or got them back, in order.
        ticks: when the agent of each vehicle acts.
        end_ns: how long the run lasted.
        duration_ns: how long it was to last; agents do not act at that instant.
    """
    until_ns = min(end_ns + 1, duration_ns)  # an agent that ends the run has missed the tick at its end
    return {
        vehicle: _of_one([each for name, each in presences if name == vehicle], train, end_ns, until_ns)
        for vehicle, train in sorted(ticks.items())
    }


def _of_one(presences: Sequence[Presence], train: Ticks, end_ns: int, until_ns: int) -> dict[str, Any]:
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
    return max(0, _before(train, to_ns) - _before(train, from_ns))


def _before(train: Ticks, time_ns: int) -> int:
    """Ticks earlier than a time."""
    return -(-time_ns * train.per // train.ns)
