"""Messages on their way to agents: `Mailboxes` hold them until a tick, `ReceivedMessages` are those of one tick of one agent.

Receptions travel as columns (`cosim.types.Receptions`). A `Reception` with its own copy of the body is made only when an agent
looks at it.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, overload

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, Message, Reception, Receptions

_MUTABLE = frozenset({dict, list})  # types that MessagePack decodes to


class ReceivedMessages(Sequence[Reception]):
    """Messages that a vehicle has received since its last tick, in order of arrival: a sequence of `Reception`.

    Items are made when they are looked at; the columns need no items. Each item has its own copy of the message's body.

    Attributes:
        now_ns: the tick.
    """

    def __init__(self, batch: "_SortedBatch", begin: int, end: int, now_ns: int) -> None:
        self._batch, self._begin, self._end, self.now_ns = batch, begin, end, now_ns
        self._items: dict[int, Reception] = {}

    @classmethod
    def of(cls, receptions: Iterable[Reception], now_ns: int) -> "ReceivedMessages":
        """The sequence of given items, which are not copied."""
        items = list(receptions)
        received = cls(_SortedBatch(receptions_at("", items, ("",))), 0, len(items), now_ns)
        received._items = dict(enumerate(items))
        return received

    @classmethod
    def none(cls, now_ns: int) -> "ReceivedMessages":
        """No messages."""
        return cls(_NOTHING, 0, 0, now_ns)

    def __len__(self) -> int:
        return self._end - self._begin

    @overload
    def __getitem__(self, place: int) -> Reception: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Reception, ...]: ...

    def __getitem__(self, place: int | slice) -> Reception | tuple[Reception, ...]:
        if isinstance(place, slice):
            return tuple(self._all()[place])
        return self._item(range(len(self))[place])

    def __iter__(self) -> Iterator[Reception]:
        return iter(self._all() if self._end > self._begin else ())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]  # bodies are mutable

    def __repr__(self) -> str:
        return f"ReceivedMessages({list(self)!r})"

    @property
    def senders(self) -> tuple[str, ...]:
        """Sender of each message, (n,)."""
        names = self._batch.senders
        return tuple([names[message] for message in self._rows(self._batch.messages_at)])

    @property
    def rssi_dbm(self) -> Array:
        """Received signal strength, (n,) dBm."""
        return self._batch.columns.rssi_dbm[self._begin : self._end]

    @property
    def sent_ns(self) -> Array:
        """Time of sending, (n,) ns."""
        columns = self._batch.columns
        return columns.sent_ns[columns.message[self._begin : self._end]]

    @property
    def received_ns(self) -> Array:
        """Time of arrival, (n,) ns."""
        return self._batch.columns.arrival_ns[self._begin : self._end]

    @property
    def age_s(self) -> Array:
        """Time since each message was sent, (n,) s."""
        return (self.now_ns - self.sent_ns) / 1e9

    def latest_by_sender(self) -> dict[str, Reception]:
        """The message of each sender that was sent last, in order of the senders' first arrivals.

        Of two that were sent at the same time, it is the later arrival.
        """
        sent_ns = self.sent_ns.tolist()
        latest: dict[str, int] = {}
        for place, sender in enumerate(self.senders):
            if sender not in latest or sent_ns[place] >= sent_ns[latest[sender]]:
                latest[sender] = place
        return {sender: self._item(place) for sender, place in latest.items()}

    def _rows(self, column: list[Any]) -> list[Any]:
        return column[self._begin : self._end]

    def _item(self, place: int) -> Reception:
        item = self._items.get(place)
        if item is None:
            (item,) = self._batch.receptions(self._begin + place, self._begin + place + 1)
            self._items[place] = item
        return item

    def _all(self) -> list[Reception]:
        """All items; those that were looked at before are the same objects."""
        if len(self._items) < len(self):
            items = dict(enumerate(self._batch.receptions(self._begin, self._end)))
            self._items = items | self._items
        return list(self._items.values())


class _SortedBatch:
    """Receptions by receiver, then arrival, with what their items need, made at the first look."""

    def __init__(self, columns: Receptions) -> None:
        self.columns = columns

    @cached_property
    def senders(self) -> list[str]:
        """Sender of each message, (k,)."""
        return [message.sender for message in self.columns.messages]

    @cached_property
    def messages_at(self) -> list[int]:
        """Number of the message of each reception, (m,)."""
        numbers: list[int] = self.columns.message.tolist()
        return numbers

    def receptions(self, begin: int, end: int) -> list[Reception]:
        """Some receptions, each with its own copy of the body: an agent that changes it does not affect other receivers."""
        rssi_dbm, arrival_ns = self._values
        parts = self.messages_at[begin:end], rssi_dbm[begin:end], arrival_ns[begin:end]
        found, fields = [], self._fields
        for number, level_dbm, at_ns in zip(*parts, strict=True):
            body, sender, size_bytes, to, priority, sent_ns = fields[number]
            message = Message(sender=sender, body=body(), size_bytes=size_bytes, to=to, priority=priority)
            found.append(Reception(message=message, rssi_dbm=level_dbm, sent_ns=sent_ns, received_ns=at_ns))
        return found

    @cached_property
    def _values(self) -> tuple[list[float], list[int]]:
        return self.columns.rssi_dbm.tolist(), self.columns.arrival_ns.tolist()

    @cached_property
    def _fields(self) -> list[tuple[Callable[[], Any], str, int, str | None, int, int]]:
        """Fields of the items of each message; the first makes a copy of the body."""
        return [
            (_copier(each.body), each.sender, each.size_bytes, each.to, each.priority, sent_ns)
            for each, sent_ns in zip(self.columns.messages, self.columns.sent_ns.tolist(), strict=True)
        ]


def _copier(body: dict[str, Any] | bytes) -> Callable[[], Any]:
    if isinstance(body, bytes):
        return body.__bytes__  # itself
    if _MUTABLE.isdisjoint(map(type, body.values())):
        return body.copy
    return partial(msgspec.msgpack.decode, msgspec.msgpack.encode(body))


class Mailboxes:
    """Receptions that some vehicles have not taken yet."""

    def __init__(self, names: Sequence[str], vehicles: Collection[str]) -> None:
        """Open a mailbox for each of ``vehicles``; ``names``: all vehicles, in the order of rows in batches."""
        self._row = {name: row for row, name in enumerate(names)}
        self._vehicles = frozenset(vehicles)
        self._owned = None if len(self._vehicles) == len(names) else self._mask(vehicles)
        self._waiting: list[Receptions] = []
        self._earliest_ns = 0  # arrival

    def put(self, batch: Receptions) -> None:
        """Add the receptions of the owners of these mailboxes."""
        if self._owned is not None:
            batch = _rows_of(batch, self._owned[batch.receiver])
        if len(batch.receiver):
            first_ns = int(batch.arrival_ns.min())
            self._earliest_ns = min(first_ns, self._earliest_ns) if self._waiting else first_ns
            self._waiting.append(batch)

    def take(self, now_ns: int, vehicles: Collection[str] | None = None) -> Receptions | None:
        """Take what has arrived by now at these vehicles (None: at all), by receiver and arrival; None: nothing.

        Receptions of equal arrival stay in the order of `put`.
        """
        if not self._waiting or self._earliest_ns > now_ns:
            return None
        batch = self._waiting[0] if len(self._waiting) == 1 else _joined(self._waiting)
        taken = batch.arrival_ns <= now_ns
        if vehicles is not None and len(vehicles) < len(self._vehicles):
            taken &= self._mask(vehicles)[batch.receiver]
        count = int(np.count_nonzero(taken))
        self._waiting = [] if count == len(taken) else [pruned(_rows_of(batch, ~taken))]
        if self._waiting:
            self._earliest_ns = int(self._waiting[0].arrival_ns.min())
        if not count:
            return None
        rows = np.flatnonzero(taken)
        receiver = batch.receiver[rows]
        order = np.lexsort((batch.arrival_ns[rows], receiver.astype(np.uint16) if len(self._row) < 1 << 16 else receiver))
        return _rows_of(batch, rows[order])

    def open(self, now_ns: int, vehicles: Collection[str] | None = None) -> dict[str, ReceivedMessages]:
        """What `take` takes, by vehicle."""
        batch = self.take(now_ns, vehicles)
        if batch is None:
            return {}
        receiver = batch.receiver
        begins = [0, *(np.flatnonzero(receiver[1:] != receiver[:-1]) + 1).tolist(), len(receiver)]
        sorted_batch, names = _SortedBatch(batch), batch.names
        return {
            names[row]: ReceivedMessages(sorted_batch, begin, end, now_ns)
            for row, begin, end in zip(receiver[begins[:-1]].tolist(), begins[:-1], begins[1:], strict=True)
        }

    def _mask(self, vehicles: Collection[str]) -> Array:
        mask = np.zeros(len(self._row), np.bool_)
        mask[[self._row[name] for name in vehicles]] = True
        return mask


def _rows_of(batch: Receptions, rows: Array) -> Receptions:
    """Some receptions of a batch, by number or by mask; all of its messages."""
    return msgspec.structs.replace(
        batch,
        message=batch.message[rows],
        receiver=batch.receiver[rows],
        arrival_ns=batch.arrival_ns[rows],
        rssi_dbm=batch.rssi_dbm[rows],
    )


def pruned(batch: Receptions) -> Receptions:
    """The batch without messages that it has no reception of."""
    used = np.zeros(len(batch.messages), np.bool_)
    used[batch.message] = True
    numbers = np.flatnonzero(used).tolist()
    return msgspec.structs.replace(
        batch,
        messages=tuple([batch.messages[number] for number in numbers]),
        sent_ns=batch.sent_ns[numbers],
        message=(np.cumsum(used, dtype=np.int32) - np.int32(1))[batch.message],
    )


def _joined(batches: Sequence[Receptions]) -> Receptions:
    """The receptions of batches of one run, in order."""
    first = np.cumsum([0, *(len(each.messages) for each in batches)])
    return Receptions(
        names=batches[0].names,
        messages=tuple(message for each in batches for message in each.messages),
        sent_ns=np.concatenate([each.sent_ns for each in batches]),
        message=np.concatenate([each.message + offset for each, offset in zip(batches, first, strict=False)]),
        receiver=np.concatenate([each.receiver for each in batches]),
        arrival_ns=np.concatenate([each.arrival_ns for each in batches]),
        rssi_dbm=np.concatenate([each.rssi_dbm for each in batches]),
    )


def receptions_at(vehicle: str, items: Sequence[Reception], names: tuple[str, ...]) -> Receptions:
    """Receptions of one vehicle as a batch; ``names``: all vehicles."""
    return Receptions(
        names=names,
        messages=tuple(each.message for each in items),
        sent_ns=np.array([each.sent_ns for each in items], np.int64),
        message=np.arange(len(items), dtype=np.int32),
        receiver=np.full(len(items), names.index(vehicle), np.int32),
        arrival_ns=np.array([each.received_ns for each in items], np.int64),
        rssi_dbm=np.array([each.rssi_dbm for each in items], np.float64),
    )


_NOTHING = _SortedBatch(receptions_at("", (), ("",)))
