"""What the network layer did: how many hops messages took, what that cost, and whose information a frame carried.

With routing a frame is sent by whoever passes a message on. So the table of frames says in three columns more what was in it:
``origin`` and ``origin_sent_ns``, the vehicle whose message it is and when that had it, and ``destination``, the only one
meant, empty for a broadcast; a frame that tells of routes has an empty origin.
"""

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from cosim.clock import SECOND_NS
from cosim.record.columns import column, name_column, names_of, numbers
from cosim.record.metrics.radio import informed, quantiles
from cosim.types import Array, Routed

COLUMNS = ("origin", "destination", "origin_sent_ns")


class Routing:
    """Takes what the network layer tells of messages.

    Args:
        vehicles: of the run, in its order.
    """

    def __init__(self, vehicles: Sequence[str]) -> None:
        self._names = (*vehicles, "")
        self._code: Mapping[str, int] = {name: code for code, name in enumerate(self._names)}
        self._frames = array("q")  # frame, origin, destination, sent_ns of each
        self._arrivals = array("q")  # hops, delay ns of each
        self._counts = dict.fromkeys(("messages", "meant", "forwarded", "no_route", "control_frames", "control_bytes"), 0)

    def __bool__(self) -> bool:
        """Whether there was anything to tell."""
        return bool(self._frames or self._counts["messages"])

    def take(self, routed: Routed) -> None:
        """A message that is under way no more."""
        counts, code, frames = self._counts, self._code, len(routed.frames)
        origin, to = ("", "") if routed.update else (routed.origin, routed.to or "")
        for frame in routed.frames:
            self._frames.extend((frame, code[origin], code[to], routed.sent_ns))
        if routed.update:
            counts["control_frames"] += frames
            counts["control_bytes"] += frames * routed.frame_bytes
            return
        counts["messages"] += 1
        counts["meant"] += len(self._names) - 2 if routed.to is None else 1
        counts["forwarded"] += max(0, frames - 1)
        counts["no_route"] += not frames
        for receiver, hops, received_ns in zip(routed.receivers, routed.hops, routed.received_ns, strict=True):
            if routed.to in (None, receiver):
                self._arrivals.extend((hops, received_ns - routed.sent_ns))

    def metrics(self) -> dict[str, Any]:
        """The ``routing`` part, of the whole run."""
        counts = dict(self._counts)
        hops, delays = np.array(self._arrivals, np.int64).reshape(-1, 2).T
        meant = counts.pop("meant")
        return {
            "messages": counts.pop("messages"),
            "arrivals": len(hops),
            "delivery_ratio": len(hops) / meant if meant else None,
            "hops_mean": float(hops.mean()) if len(hops) else None,
            "hops_max": int(hops.max()) if len(hops) else None,
            "delay_s": quantiles(delays / SECOND_NS, ("mean", "p50", "p95", "p99", "max")),
            **counts,
        }

    def told(self, radio: pa.Table) -> pa.Table:
        """The table of frames with `COLUMNS`."""
        known = np.array(self._frames, np.int64).reshape(-1, 4)
        known = known[np.argsort(known[:, 0])]
        frames, nothing = numbers(radio, "frame"), len(self._names) - 1
        rows = np.minimum(np.searchsorted(known[:, 0], frames), len(known) - 1)
        found = known[rows, 0] == frames  # of a run that broke off, some were not told of
        origin, to = (np.where(found, known[rows, each], nothing).astype(np.int32) for each in (1, 2))
        sent_ns = np.where(found, known[rows, 3], numbers(radio, "sent_ns"))
        columns = name_column(self._names, origin), name_column(self._names, to), column(sent_ns)
        for name, each in zip(COLUMNS, columns, strict=True):
            radio = radio.append_column(name, each)
        return radio


def unreached_s(radio: pa.Table, receiver: str, origin: str) -> Array:
    """When messages were sent that were meant for a vehicle and came to it over nobody, s."""
    (origins, by), (destinations, to) = names_of(radio, "origin"), names_of(radio, "destination")
    own = np.array(origins, np.str_)[by] == origin
    meant = own & np.isin(np.array(destinations, np.str_)[to], ("", receiver))
    got = informed(radio)
    came = (np.array(got.receivers, np.str_)[got.to] == receiver) & (np.array(got.senders, np.str_)[got.by] == origin)
    return np.asarray(np.setdiff1d(numbers(radio, "origin_sent_ns")[meant], got.sent_ns[came]) / SECOND_NS)
