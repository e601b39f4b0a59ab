"""What the radio did: frames, losses, delays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import Array


@dataclass(frozen=True)
class Receptions:
    """The frames that were received, in the order in which they entered the channel."""

    receivers: tuple[str, ...]
    senders: tuple[str, ...]
    to: Array  # (n,) number of the receiver's name
    by: Array  # (n,) number of the sender's
    sent_ns: Array  # (n,)
    received_ns: Array  # (n,)


def receptions(radio: pa.Table) -> Receptions:
    """Those of the table of frames."""
    (receivers, to), (senders, by) = names_of(radio, "receiver"), names_of(radio, "sender")
    received = numbers(radio, "received_ns", null=-1)
    got = np.flatnonzero(received >= 0)
    return Receptions(receivers, senders, to[got], by[got], numbers(radio, "sent_ns")[got], received[got])


def informed(radio: pa.Table, got: Receptions) -> Receptions:
    """Whose information was received by whom, and from when it was: as `receptions`, but for what was passed on.

    That came from its origin, and only to those for whom it was meant (`cosim.metrics.routing`).

    Args:
        radio: the table of frames.
        got: its receptions.
    """
    if "origin" not in radio.column_names:
        return got
    rows = np.flatnonzero(numbers(radio, "received_ns", null=-1) >= 0)
    (origins, by), (destinations, only) = names_of(radio, "origin"), names_of(radio, "destination")
    by, only = by[rows], only[rows]
    told, anybody = np.array(origins) != "", np.array(destinations) == ""
    meant = told[by] & (_codes(got.receivers, origins)[by] != got.to)
    meant &= anybody[only] | (_codes(got.receivers, destinations)[only] == got.to)
    sent_ns = numbers(radio, "origin_sent_ns")[rows]
    return Receptions(got.receivers, origins, got.to[meant], by[meant], sent_ns[meant], got.received_ns[meant])


def _codes(names: Sequence[str], others: Sequence[str]) -> Array:
    """Of each of the others its number among the names; -1: it is none of them."""
    numbered = {name: number for number, name in enumerate(names)}
    return np.array([numbered.get(each, -1) for each in others], np.int32)


def radio_metrics(radio: pa.Table, ages: dict[str, float | None]) -> dict[str, Any]:
    """The ``radio`` part: counts of the whole run, delays of all receptions, ages as given.

    A frame that is still under way when the run ends is neither received nor lost.
    """
    outcomes, code = names_of(radio, "outcome")
    counts = dict(zip(outcomes, np.bincount(code, minlength=len(outcomes)).tolist(), strict=True))
    got, under_way = counts.get("received", 0), counts.pop(UNDER_WAY, 0)
    decided = radio.num_rows - under_way
    delays = numbers(radio, "delay_ns", null=-1)
    delays = delays[delays >= 0] / SECOND_NS
    return {
        "frames": int(np.count_nonzero(np.diff(numbers(radio, "frame"), prepend=-1))),  # the rows of a frame are together
        "receptions": got,
        "delivery_ratio": got / decided if decided else None,
        "under_way": under_way,
        "losses": {cause: counts[cause] for cause in sorted(counts) if cause != "received" and counts[cause]},
        "delay_s": quantiles(delays, ("mean", "p50", "p95", "p99", "max")),
        "age_s": ages,
    }


def quantiles(values: Array, names: Sequence[str]) -> dict[str, float | None]:
    """Mean, maximum and percentiles (``p95``; linear between ranks); None where there are no values."""
    return {name: _quantile(values, name) if values.size else None for name in names}


def _quantile(values: Array, name: str) -> float:
    if name == "mean":
        return float(np.mean(values))
    return float(np.max(values)) if name == "max" else float(np.percentile(values, int(name[1:])))
