"""Deliveries to programs: lateness on the wall clock, their table, and separation of agents' messages from datagrams."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, Message, Traffic
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge import messages
from vcmvsp.netsim.bridge.gateways.base import BROADCAST

if TYPE_CHECKING:
    import pyarrow as pa

NEVER = -1


class Echoes:
    """Datagrams of programs on their way to agents; times of the run."""

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self._vehicles = vehicles
        self._sent: dict[int, tuple[str, bytes]] = {}  # by number: sender, payload
        self._coming: Counter[tuple[str, int, str, bytes]] = Counter()  # receiver, time, sender, payload

    def sent(self, batch: messages.NewDatagrams) -> None:
        """Note datagrams that enter the radio."""
        for number, sender, payload in zip(batch.number.tolist(), batch.sender.tolist(), batch.payloads, strict=True):
            self._sent[number] = self._vehicles[sender], payload

    def decided(self, traffic: Traffic) -> None:
        """Note their deliveries."""
        rows = zip(traffic.number.tolist(), traffic.receiver.tolist(), traffic.arrival_ns.tolist(), strict=True)
        for number, receiver, received_ns in rows:
            sender, payload = self._sent[number]
            if payload:  # an empty payload causes no reception
                self._coming[self._vehicles[receiver], received_ns, sender, payload] += 1
        for number in traffic.settled.tolist():
            del self._sent[number]

    def agent_payload(self, vehicle: str, message: Message, received_ns: int) -> bytes | None:
        """Payload for programs if an agent sent the message; None for a datagram of a program."""
        body = message.body
        if not isinstance(body, bytes):
            return encode(body)
        echo = vehicle, received_ns, message.sender, body
        if echo not in self._coming:
            return body
        self._coming[echo] -= 1
        if not self._coming[echo]:
            del self._coming[echo]
        return None


class Columns:
    """Integer columns that grow by blocks of rows."""

    def __init__(self, *names: str) -> None:
        self._columns = {name: np.full(1024, NEVER, np.int64) for name in names}
        self.rows = 0

    def __getitem__(self, name: str) -> Array:
        """The rows of a column, writable."""
        return self._columns[name][: self.rows]

    def reach(self, rows: int) -> None:
        """Grow to at least ``rows`` rows, filled with `NEVER`."""
        for name, values in self._columns.items():
            if rows > len(values):
                more = np.full(max(rows, 2 * len(values)) - len(values), NEVER, np.int64)
                self._columns[name] = np.concatenate([values, more])
        self.rows = max(self.rows, rows)

    def add(self, **blocks: Array) -> None:
        """Append n rows, (n,) of each column; other columns get `NEVER`."""
        first = self.rows
        self.reach(first + len(next(iter(blocks.values()))))
        for name, block in blocks.items():
            self._columns[name][first : self.rows] = block


class Lateness:
    """Datagrams and deliveries of a run."""

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self._vehicles = vehicles
        self._sent = Columns("gateway", "sender", "sent_ns", "receivers", "settled")  # by number of the datagram
        self._due = Columns("number", "frame", "receiver", "received_ns", "due_ns", "late")  # by number of the delivery
        self._datagram_count = 0

    def sent(
        self, number: Array, gateway: Array, sender: Array, to: Array, sent_ns: Array, others: Array | None = None
    ) -> None:
        """Add datagrams, (n,) each, to the row ``to`` or to all; ``sent_ns`` is a time of the run.

        ``others``: number of the receivers of a broadcast, (n,); None: all other vehicles.
        """
        self._datagram_count += len(number)
        self._sent.reach(int(number.max()) + 1)
        receivers = np.where(to == BROADCAST, len(self._vehicles) - 1 if others is None else others, 1)
        for name, values in (("gateway", gateway), ("sender", sender), ("sent_ns", sent_ns), ("receivers", receivers)):
            self._sent[name][number] = values

    def due(self, traffic: Traffic, at_ns: Array) -> None:
        """Add deliveries with their times on the monotonic clock, (n,) ns, and mark settled datagrams."""
        columns = {"number": traffic.number, "frame": traffic.frame, "receiver": traffic.receiver}
        self._due.add(**columns, received_ns=traffic.arrival_ns, due_ns=at_ns)
        self._sent["settled"][traffic.settled] = 1

    def delivered(self, row: Array, at_ns: Array) -> None:
        """Set the times at which deliveries (n,) were made, (n,) ns on the monotonic clock."""
        self._due["late"][row] = at_ns - self._due["due_ns"][row]

    def summary(self, counts: dict[str, dict[str, int]]) -> dict[str, Any]:
        """Percentiles of lateness, s, and numbers of datagrams; None without deliveries."""
        late_s = self._due["late"][self._due["late"] != NEVER] / SECOND_NS
        p50, p99, most = np.quantile(late_s, [0.5, 0.99, 1.0]).tolist() if len(late_s) else (None, None, None)
        return {
            "datagrams": self._datagram_count,
            "delivered": len(late_s),
            "lost": self._lost(),
            "p50_s": p50,
            "p99_s": p99,
            "max_s": most,
            "over_1ms": int(np.count_nonzero(late_s > 1e-3)),
            "counts": counts,
        }

    def _lost(self) -> int:
        """Pairs of settled datagram and receiver without a delivery."""
        settled = self._sent["settled"] != NEVER
        number, receiver = self._due["number"], self._due["receiver"]
        arrived = np.unique((number * len(self._vehicles) + receiver)[settled[number]])  # copies count once
        return int(self._sent["receivers"][settled].sum()) - len(arrived)

    def table(self, gateways: tuple[str, ...]) -> "pa.Table":
        """A row for each delivery, in the order of the run's decisions; times of the run, ``late_s`` of the wall clock."""
        import pyarrow as pa

        number, vehicles = self._due["number"], self._vehicles
        columns = {
            "number": pa.array(number),
            "frame": pa.array(self._due["frame"]),
            "door": _names(gateways, self._sent["gateway"][number]),
            "sender": _names(vehicles, self._sent["sender"][number]),
            "receiver": _names(vehicles, self._due["receiver"]),
            "came_ns": pa.array(self._sent["sent_ns"][number]),
            "wanted_ns": pa.array(self._due["received_ns"]),
            "late_s": pa.array(self._due["late"] / SECOND_NS, mask=self._due["late"] == NEVER),
        }
        return pa.table(columns)


def _names(names: tuple[str, ...], codes: Array) -> Any:
    """A dictionary column from ``codes``, (n,) places in ``names``."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(pa.array(codes, pa.int32()), pa.array(names, pa.string()))
