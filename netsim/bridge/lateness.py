"""When datagrams were to be delivered, and when they were: what a run with a bridge can be held to."""

from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.clock import SECOND_NS
from cosim.types import Array

if TYPE_CHECKING:
    import pyarrow as pa

NEVER = -1


class Columns:
    """Columns of numbers to which rows are added, a block at a time.

    Args:
        names: of the columns.
        empty: what a row holds that was only made room for.
    """

    def __init__(self, *names: str, empty: int = NEVER) -> None:
        self._columns = {name: np.full(1024, empty, np.int64) for name in names}
        self._empty, self.rows = empty, 0

    def __getitem__(self, name: str) -> Array:
        """The rows of a column, to be read and written."""
        return self._columns[name][: self.rows]

    def reach(self, rows: int) -> None:
        """Have at least so many rows."""
        for name, values in self._columns.items():
            if rows > len(values):
                more = np.full(max(rows, 2 * len(values)) - len(values), self._empty, np.int64)
                self._columns[name] = np.concatenate([values, more])
        self.rows = max(self.rows, rows)

    def add(self, **blocks: Array) -> None:
        """Add rows below: of each column as many."""
        first = self.rows
        self.reach(first + len(next(iter(blocks.values()))))
        for name, block in blocks.items():
            self._columns[name][first : self.rows] = block


class Lateness:
    """Of all deliveries of a run."""

    def __init__(self) -> None:
        self._sent = Columns("frame", "door", "sender", "sent_ns")  # by number of the datagram
        self._due = Columns("number", "receiver", "received_ns", "left_ns", "wanted", "late")  # by delivery
        self._taken = self._lost = 0

    def sent(self, number: Array, door: Array, sender: Array, sent_ns: Array) -> None:
        """Datagrams that were given to the radio, (n,) each; ``sent_ns`` in the run's time."""
        self._taken += len(number)
        self._sent.reach(int(number.max()) + 1)
        for name, values in (("door", door), ("sender", sender), ("sent_ns", sent_ns)):
            self._sent[name][number] = values

    def carried(self, number: Array, frame: Array, lost: int) -> None:
        """The frames of these datagrams, (n,) each, did not reach so many radios that they were meant for."""
        self._sent["frame"][number] = frame
        self._lost += lost

    def due(self, number: Array, receiver: Array, received_ns: Array, at_ns: Array) -> None:
        """Deliveries, (n,) each: when in the run's time, and on the monotonic clock."""
        self._due.add(number=number, receiver=receiver, received_ns=received_ns, wanted=at_ns)

    def went(self, row: Array, at_ns: Array, left_ns: Array) -> None:
        """When deliveries, of these places among all, left: on the monotonic clock, and in the run's time."""
        self._due["late"][row] = at_ns - self._due["wanted"][row]
        self._due["left_ns"][row] = left_ns

    def summary(self, counts: dict[str, dict[str, int]]) -> dict[str, Any]:
        """How late deliveries were, s, and how many of what there were; None where there were none."""
        late_s = self._due["late"][self._due["left_ns"] != NEVER] / SECOND_NS
        p50, p99, most = np.quantile(late_s, [0.5, 0.99, 1.0]).tolist() if len(late_s) else (None, None, None)
        return {
            "datagrams": self._taken,
            "delivered": len(late_s),
            "lost": self._lost,
            "p50_s": p50,
            "p99_s": p99,
            "max_s": most,
            "over_1ms": int(np.count_nonzero(late_s > 1e-3)),
            "counts": counts,
        }

    def table(self, doors: tuple[str, ...], vehicles: tuple[str, ...]) -> "pa.Table":
        """A row per delivery, in the order in which the run decided; times in the run's, ``late_s`` on the wall clock."""
        import pyarrow as pa

        number = self._due["number"]
        gone = self._due["left_ns"] != NEVER
        columns = {
            "number": pa.array(number),
            "frame": pa.array(self._sent["frame"][number]),
            "door": _names(doors, self._sent["door"][number]),
            "sender": _names(vehicles, self._sent["sender"][number]),
            "receiver": _names(vehicles, self._due["receiver"]),
            "came_ns": pa.array(self._sent["sent_ns"][number]),
            "wanted_ns": pa.array(self._due["received_ns"]),
            "left_ns": pa.array(self._due["left_ns"], mask=~gone),
            "late_s": pa.array(self._due["late"] / SECOND_NS, mask=~gone),
        }
        return pa.table(columns)


def _names(names: tuple[str, ...], codes: Array) -> Any:
    """A column of names, by their places."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(pa.array(codes, pa.int32()), pa.array(names, pa.string()))
