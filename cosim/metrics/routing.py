"""Metrics of the network layer: hop counts, overhead, and the origin of the information in a frame.

With routing, relays send frames with messages of other vehicles. So the table of frames has five more columns: ``origin``, the
vehicle that made the message; ``origin_sent_ns`` and ``origin_number``, its time and sequence number there; ``destination``,
empty for a broadcast; and ``message``, whether the message was ``under way`` at the end of the run or ``over``. A frame of
the routing protocol has an empty origin and no number, and so has a frame whose message was under way when a run was aborted.
"""

from array import array
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.radio import quantiles
from vcmvsp.cosim.tables.columns import code_of, codes_of, column, name_column, names_of, nulls, numbers
from vcmvsp.cosim.types import Array, Routed

COLUMNS = ("origin", "destination", "origin_sent_ns", "origin_number", "message")
FATES = ("", "over", "under way")
_NOBODY = 0, 0, 0  # time, number and outcome of a frame without a message


class Routing:
    """Collects the routing events of messages."""

    def __init__(self, vehicles: Sequence[str]) -> None:
        self._names = (*vehicles, "")
        self._code: Mapping[str, int] = {name: code for code, name in enumerate(self._names)}
        self._messages = array("q")  # origin, destination, sent_ns, number, fate of each
        self._frames = array("q")  # frame number, and index of its message
        self._arrivals = array("q")  # hops and delay (ns) of each
        self._counts = dict.fromkeys(("messages", "decided", "forwarded", "no_route", "control_frames", "control_bytes"), 0)

    def __bool__(self) -> bool:
        """Whether any message was routed."""
        return bool(self._frames or self._counts["messages"])

    def take(self, routed: Routed) -> None:
        """Record a message that ended, or was under way at the end of the run."""
        counts, code, frames = self._counts, self._code, len(routed.frames)
        origin, to, fate = ("", "", "") if routed.update else (routed.origin, routed.to or "", FATES[1 + routed.under_way])
        for frame in routed.frames:
            self._frames.extend((frame, len(self._messages) // 5))
        self._messages.extend((code[origin], code[to], routed.sent_ns, routed.number, FATES.index(fate)))
        if routed.update:
            counts["control_frames"] += frames
            counts["control_bytes"] += frames * routed.frame_bytes
            return
        counts["messages"] += 1
        counts["forwarded"] += max(0, frames - 1)
        counts["no_route"] += not frames
        is_addressee = [routed.to in (None, receiver) for receiver in routed.receivers]
        for hops, received_ns in compress(zip(routed.hops, routed.received_ns, strict=True), is_addressee):
            self._arrivals.extend((hops, received_ns - routed.sent_ns))
        addressees = len(self._names) - 2 if routed.to is None else 1
        counts["decided"] += sum(is_addressee) if routed.under_way else addressees

    def metrics(self) -> dict[str, Any]:
        """The ``routing`` part, of the whole run. Messages still under way at its end have not failed."""
        counts = dict(self._counts)
        hops, delays = np.array(self._arrivals, np.int64).reshape(-1, 2).T
        decided = counts.pop("decided")
        mean, most = (float(hops.mean()), int(hops.max())) if len(hops) else (None, None)
        return {
            "messages": counts.pop("messages"),
            "arrivals": len(hops),
            "delivery_ratio": len(hops) / decided if decided else None,
            "hops_mean": mean,
            "hops_max": most,
            "delay_s": quantiles(delays / SECOND_NS, ("mean", "p50", "p95", "p99", "max")),
            **counts,
        }

    def table(self, radio: pa.Table, radio_of: Array | None = None) -> pa.Table:
        """The table of frames with `COLUMNS`.

        Args:
            radio_of: radio of each frame, by number, of several radios; frames of those without routing are whole messages.
        """
        nothing = len(self._names) - 1
        messages = np.append(np.array(self._messages, np.int64), (nothing, nothing, *_NOBODY)).reshape(-1, 5).T
        frame_rows, frames = np.array(self._frames, np.int64).reshape(-1, 2), numbers(radio, "frame")
        place = np.full(1 + max(frame_rows[:, 0].max(initial=-1), frames.max(initial=-1)), -1)
        place[frame_rows[:, 0]] = frame_rows[:, 1]
        of = place[frames]  # -1: an aborted run never reports some messages
        origin, to, fate = (messages[row][of].astype(np.int32) for row in (0, 1, 4))
        if radio_of is not None:
            direct = ~np.isin(radio_of[frames], radio_of[frame_rows[:, 0]])
            senders, sender = names_of(radio, "sender")
            origin[direct] = codes_of(self._names, senders)[sender[direct]]
        columns = (
            name_column(self._names, origin),
            name_column(self._names, to),
            column(np.where(of < 0, numbers(radio, "sent_ns"), messages[2][of])),
            column(messages[3][of], valid=messages[0][of] != nothing),
            name_column(FATES, fate),
        )
        for name, each in zip(COLUMNS, columns, strict=True):
            radio = radio.append_column(name, each)
        return radio


def unreached_s(radio: pa.Table, receiver: str, origin: str) -> Array:
    """Sending times (s) of messages to a vehicle that reached it over no relay."""
    (origins, by), (destinations, to) = names_of(radio, "origin"), names_of(radio, "destination")
    (receivers, at), (fates, fate) = names_of(radio, "receiver"), names_of(radio, "message")
    own, its = by == code_of(origins, origin), (to == code_of(destinations, "")) | (to == code_of(destinations, receiver))
    matches = own & its & (fate == code_of(fates, "over"))
    number, sent_ns = numbers(radio, "origin_number", null=-1), numbers(radio, "origin_sent_ns")
    is_received = own & (at == code_of(receivers, receiver)) & ~nulls(radio, "received_ns") & (number >= 0)
    lost_ns = np.full(1 + number.max(initial=-1), -1)  # by number
    lost_ns[number[matches]] = sent_ns[matches]
    lost_ns[number[is_received]] = -1
    return np.asarray(np.sort(lost_ns[lost_ns >= 0]) / SECOND_NS)
