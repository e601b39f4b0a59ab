"""When datagrams were to be delivered, and when they were: what a run with a bridge can be held to."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, Traffic
from vcmvsp.netsim.bridge.gateways.base import BROADCAST

if TYPE_CHECKING:
    import pyarrow as pa

NEVER = -1


class Columns:
    """Columns of numbers to which rows are added, a block at a time.

    Args:
        names: of the columns.
    """

    def __init__(self, *names: str) -> None:
        self._columns = {name: np.full(1024, NEVER, np.int64) for name in names}
        self.rows = 0

    def __getitem__(self, name: str) -> Array:
        """The rows of a column, to be read and written."""
        return self._columns[name][: self.rows]

    def reach(self, rows: int) -> None:
        """Have at least so many rows; `NEVER` stands in those that were only made room for."""
        for name, values in self._columns.items():
            if rows > len(values):
                more = np.full(max(rows, 2 * len(values)) - len(values), NEVER, np.int64)
                self._columns[name] = np.concatenate([values, more])
        self.rows = max(self.rows, rows)

    def add(self, **blocks: Array) -> None:
        """Add n rows below, (n,) of each column; `NEVER` stands in those that are not given."""
        first = self.rows
        self.reach(first + len(next(iter(blocks.values()))))
        for name, block in blocks.items():
            self._columns[name][first : self.rows] = block


class Lateness:
    """Of all deliveries of a run.

    Args:
        vehicles: of the run.
    """

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self._vehicles = vehicles
        self._sent = Columns("door", "sender", "sent_ns", "meant", "settled")  # by number of the datagram
        self._due = Columns("number", "frame", "receiver", "received_ns", "wanted", "late")  # by delivery
        self._taken = 0

    def sent(self, number: Array, door: Array, sender: Array, to: Array, sent_ns: Array) -> None:
        """Datagrams that were given to the radio, (n,) each: for the row ``to``, or all; ``sent_ns`` in the run's time."""
        self._taken += len(number)
        self._sent.reach(int(number.max()) + 1)
        meant = np.where(to == BROADCAST, len(self._vehicles) - 1, 1)
        for name, values in (("door", door), ("sender", sender), ("sent_ns", sent_ns), ("meant", meant)):
            self._sent[name][number] = values

    def due(self, traffic: Traffic, at_ns: Array) -> None:
        """What arrives, and when that is on the monotonic clock, (n,) ns; what is settled."""
        came = {"number": traffic.number, "frame": traffic.frame, "receiver": traffic.receiver}
        self._due.add(**came, received_ns=traffic.arrival_ns, wanted=at_ns)
        self._sent["settled"][traffic.settled] = 1

    def went(self, row: Array, at_ns: Array) -> None:
        """When deliveries, of these places among all, left: (n,) ns on the monotonic clock."""
        self._due["late"][row] = at_ns - self._due["wanted"][row]

    def summary(self, counts: dict[str, dict[str, int]]) -> dict[str, Any]:
        """How late deliveries were, s, and how many of what there were; None where there were none."""
        late_s = self._due["late"][self._due["late"] != NEVER] / SECOND_NS
        p50, p99, most = np.quantile(late_s, [0.5, 0.99, 1.0]).tolist() if len(late_s) else (None, None, None)
        return {
            "datagrams": self._taken,
            "delivered": len(late_s),
            "lost": self._lost(),
            "p50_s": p50,
            "p99_s": p99,
            "max_s": most,
            "over_1ms": int(np.count_nonzero(late_s > 1e-3)),
            "counts": counts,
        }

    def _lost(self) -> int:
        """Vehicles that did not receive a datagram that was meant for them, summed up over datagrams that are settled."""
        settled = self._sent["settled"] != NEVER
        number, receiver = self._due["number"], self._due["receiver"]
        arrived = np.unique((number * len(self._vehicles) + receiver)[settled[number]])  # some come twice
        return int(self._sent["meant"][settled].sum()) - len(arrived)

    def table(self, doors: tuple[str, ...]) -> "pa.Table":
        """A row per delivery, in the order in which the run decided; times in the run's, ``late_s`` on the wall clock."""
        import pyarrow as pa

        number, vehicles = self._due["number"], self._vehicles
        columns = {
            "number": pa.array(number),
            "frame": pa.array(self._due["frame"]),
            "door": _names(doors, self._sent["door"][number]),
            "sender": _names(vehicles, self._sent["sender"][number]),
            "receiver": _names(vehicles, self._due["receiver"]),
            "came_ns": pa.array(self._sent["sent_ns"][number]),
            "wanted_ns": pa.array(self._due["received_ns"]),
            "late_s": pa.array(self._due["late"] / SECOND_NS, mask=self._due["late"] == NEVER),
        }
        return pa.table(columns)


def _names(names: tuple[str, ...], codes: Array) -> Any:
    """A column of names, by their places."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(pa.array(codes, pa.int32()), pa.array(names, pa.string()))
